"""Tasks in closed loop: an operator sees the scene, a mapping moves the robot's hand.

Files, in the order of reading:

    operator.py   the seam of operators, and the human hand that they show
    task.py       the seam of tasks: scene, signals, success, record
    mapping.py    the seam of mappings, and all that can be named on the command line
    attempt.py    one attempt: the loop, and its outcome
    experts.py    operators: policies that move their own hand
    adroit.py     tasks: door and relocate of gymnasium-robotics
    person.py     an operator: a person who picks, and learns where the pads meet
    picking.py    a task: pick and place of household objects
    catalogue.py  tasks and their operators by name
    shares.py     intervals of shares, paired comparisons, stable orders
    judge.py      a second judge, which shares no function with the tasks
    judge_picking.py   the second judge of picks
    benches.py    all attempts of a run, in processes
    report.py     rows of tables, comparisons, and whether the judge is sound
    film.py       films of attempts
    page.py       the page
    cli.py        `handmap score --tasks`
"""
