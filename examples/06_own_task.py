"""A task of your own: the fingertips stay above a table.

python examples/06_own_task.py
"""

import numpy as np

from handmap_qp import HandMapper, TaskRows, load_hand
from handmap_qp.hands import Configuration

WEIGHT = 1000.0  # per metre; that of a reference point is 100


class AboveTable:
    """Keep every reference point of the robot above a height [m]."""

    def __init__(self, height: float) -> None:
        self.height = height

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return a row for each point that is below the table."""
        depths = np.minimum(0.0, hand.points[:, 2] - self.height)
        rows = hand.point_jacobian()[2::3]
        return TaskRows(WEIGHT * depths, WEIGHT * (depths < 0.0)[:, None] * rows)


def lowest_point(tasks: list) -> float:
    """Return the height of the lowest point when the human makes a fist."""
    human, robot = load_hand("human"), load_hand("allegro_right")
    mapper = HandMapper(human, robot, tasks=tasks, dt=1 / 60)
    postures = human.rest + np.linspace(0.0, 0.8, 60)[:, None] * (
        human.upper_limits - human.rest
    )
    step = [mapper.map_step(q, np.eye(4)) for q in postures][-1]
    return step.points[:, 2].min()


def main() -> None:
    """Compare the lowest point with and without the table."""
    without = lowest_point([])
    height = without + 0.01
    with_task = lowest_point([AboveTable(height)])
    print(f"lowest point {1e3 * without:.1f} mm, table at {1e3 * height:.1f} mm")
    print(f"with the task {1e3 * with_task:.1f} mm")


if __name__ == "__main__":
    main()
