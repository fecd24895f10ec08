"""`Recorder`: keeps what joints did while they followed a session, for data sets."""

from pathlib import Path

import numpy as np

from handmap_qp.apps.datasets.robot_log import RobotLog, save_robot_log
from handmap_qp.errors import warn
from handmap_qp.hands import Names
from handmap_qp.se3 import Array


class Recorder:
    """Keeps measured joints, commands and torques, turn by turn.

    An episode is a time in which joints followed; approaches and holds are left out.

    Args:
        joint_names: The joints that have a motor, in the order of all arrays.
    """

    def __init__(self, joint_names: Names) -> None:
        self._names = joint_names
        self._episode = 0
        self._rows: list[tuple[float, int, Array, Array, Array]] = []

    def begin(self) -> None:
        """Begin another episode: what follows does not go on from the last turn."""
        self._episode += 1

    def add(self, now: float, q: Array, action: Array, effort: Array) -> None:
        """Add a turn.

        Args:
            now: Its time [s, monotonic].
            q: Where the joints were measured [rad], shape (n,).
            action: Where they are commanded to be [rad], shape (n,).
            effort: Their torques [N m], shape (n,); NaN where they are not known.
        """
        # A driver may write its next answers into the same arrays.
        arrays = q.copy(), action.copy(), effort.copy()
        self._rows.append((now, self._episode, *arrays))

    def save(self, file: Path, robot: str, task: str = "") -> None:
        """Write a log of the robot, or warn if there is nothing to write.

        Args:
            file: The file, an `.npz`.
            robot: Name of the robot.
            task: What was done, in words.

        Raises:
            InvalidInputError: If it cannot be written.
        """
        if len(self._rows) < 2:
            warn(f"{file} is not written: the motors did not follow")
            return
        time, episode, q, action, effort = map(np.array, zip(*self._rows, strict=True))
        log = RobotLog(
            name=file.stem,
            time=time - time[0],
            joint_names=self._names,
            q=q,
            action=action,
            effort=effort,
            episode=episode,
            task=task,
            robot=robot,
        )
        save_robot_log(file, log, "--log")
