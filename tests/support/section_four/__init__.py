"""The paper's numerical experiment (Sec. IV): two hands on one cube, a wrist arc and a synergy.

`benchmarks/paper/paper_figures.py` runs it and draws its figures,
`benchmarks/paper/beyond_the_paper.py` asks its open questions.

- `statics`: grasp matrix, and object motion and forces with compliant contacts and joints.
- `contacts`: a hand's contacts with an object.
- `cube`: the paper's two grasps.
- `experiment`: the runs, step by step as in Fig. 3.
- `figures`, `drawings`: Figs. 4 to 7, their numbers, and the table of claims.
"""
