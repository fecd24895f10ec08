"""Tasks in closed loop: an operator sees the scene, a mapping moves the robot's hand.

Files, in the order of reading:

    operator.py   the seam of operators, and the human hand that they show
    task.py       the seam of tasks: scene, signals, success, record
    mapping.py    the seam of mappings, and all that can be named on the command line
    outside.py    mappings: programs of others, live in a loop
    attempt.py    one attempt: the loop, and its outcome
    experts.py    operators: policies that move their own hand
    adroit.py     tasks: door and relocate of gymnasium-robotics
    person.py     an operator: a person who picks, and learns where the pads meet
    household.py  objects, made of simple shapes
    touch.py      forces of a hand on an object, and causes of lost grips
    table.py      what all tasks on a table share
    fixtures.py   furniture: rings of boxes, and joints that an object rides on
    picking.py    a task: pick and place of household objects
    lifting.py    a task: lift a bottle, eggs and a pen, and break nothing
    pressing.py   a task: press a button and nothing beside it, and who points
    turning.py    a task: turn a cap, and who turns it
    pouring.py    a task: pour balls into a bowl, and who tilts the cup
    inserting.py  a task: insert a peg with 2 mm of play, and who does it
    handing.py    a task: hand a bar over with two hands
    two_hands.py  an operator: a person with two hands, who does it
    replaying.py  operators: recorded people, open loop
    catalogue.py  tasks and their operators by name
    shares.py     intervals of shares, paired comparisons, stable orders
    judge.py      a second judge, which shares no function with the tasks
    judge_picking.py, judge_table.py   the second judges of picks, and of the others on a table
    journal.py    attempts of a run, kept as they come
    benches.py    all attempts of a run, in processes
    report.py     rows of tables, comparisons, and whether the judge is sound
    film.py       films of attempts
    page.py       the page
    cli.py        `handmap score --tasks`
"""
