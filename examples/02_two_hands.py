"""Two hands of one person on two robot hands: one mapper for each side.

python examples/02_two_hands.py
"""

import numpy as np

from handmap_qp import HandMapper, load_hand

MAPPERS = {
    "right": HandMapper(load_hand("human"), load_hand("allegro_right"), dt=1 / 60),
    "left": HandMapper(load_hand("human_left"), load_hand("allegro_left"), dt=1 / 60),
}


def main() -> None:
    """Close the right hand while the left one opens."""
    steps = {}
    for share in np.linspace(0.0, 1.0, 30):
        for side, mapper in MAPPERS.items():
            human = mapper.human
            closed = share if side == "right" else 1.0 - share
            q = human.rest + 0.8 * closed * (human.upper_limits - human.rest)
            steps[side] = mapper.map_step(q, np.eye(4))
    for side, step in steps.items():
        print(side, MAPPERS[side].robot.name, step.status)


if __name__ == "__main__":
    main()
