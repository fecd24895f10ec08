"""Compare two methods on one motion: how far do the robot's fingertips close?

`handmap compare` does this for recordings, with all metrics, peers and pictures.

    python examples/03_compare_methods.py
"""

import numpy as np

from handmap_qp import HandMapper, load_hand


def closing(preset: str) -> float:
    """Return the change of the mean distance of the robot's tips from its palm [m]."""
    human, robot = load_hand("human"), load_hand("allegro_right")
    mapper = HandMapper(human, robot, preset, dt=1 / 60)
    fist = human.rest + 0.9 * (human.upper_limits - human.rest)
    distances = []
    for share in np.linspace(0.0, 1.0, 60):
        step = mapper.map_step(human.rest + share * (fist - human.rest), np.eye(4))
        palm = step.command.wrist[:3, 3]
        tips = robot.with_points("fingertips").points(
            step.command.q, step.command.wrist
        )
        distances.append(np.linalg.norm(tips - palm, axis=1).mean())
    return distances[-1] - distances[0]


def main() -> None:
    """Print the figures of two presets."""
    for preset in ("teleoperation", "paper"):
        print(f"{preset:15} closes by {-1e3 * closing(preset):5.1f} mm")


if __name__ == "__main__":
    main()
