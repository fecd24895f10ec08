"""A gripper closes on a cube in MuJoCo, takes it from its stand, and lifts it.

python examples/09_mujoco_object.py
"""

import numpy as np

from handmap_qp import load_hand
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.apps.simulation.commands import PinchWindow
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch import PinchScene, PinchTrial


def main() -> None:
    """Close within a fifth of a second, rise, and print what became of the cube."""
    time = np.arange(61) / 50.0
    q = np.interp(time, [0.0, 0.2], [0.04, 0.0])[:, None]
    wrist = np.tile(np.diag([1.0, -1.0, -1.0, 1.0]), (61, 1, 1))
    wrist[:, 2, 3] = np.interp(time, [0.4, 1.0], [0.0, 0.1])
    robot = load_hand("panda_gripper")
    commands = RobotMotion(robot, time, q, wrist, step_cpu=np.zeros(61))
    scene = PinchScene(commands, PinchWindow(0, 10, 60), Physics())
    outcome = scene.run(PinchTrial(mass=0.1))
    lifted = np.ptp(outcome.episode.at.object_pose[:, 2, 3])
    print("held" if outcome.is_held else "lost", end=", ")
    print(f"lifted by {1e3 * lifted:.0f} mm, slipped by {1e3 * outcome.slip:.1f} mm")


if __name__ == "__main__":
    main()
