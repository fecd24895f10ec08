"""Other retargeting packages, run over the same recordings for comparison.

- `build`: builds an environment for each peer (`make peers`).
- `runner`: runs a peer over a recording, inside its environment.
- `results`: starts the runner from the product's environment, keeps its results, and gives them in
  the order of our hands' joints.
"""
