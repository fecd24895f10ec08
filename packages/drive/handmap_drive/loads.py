"""What the fingers of a hand feel by the torques of their motors."""

from collections.abc import Mapping

import numpy as np

from handmap_qp.hands import Names


class FingerLoads:
    """The load of each finger: the largest of its motors.

    Args:
        joint_names: Joints in the order of the driver.
        fingers: Finger of each joint that belongs to one, by its name.
    """

    def __init__(self, joint_names: Names, fingers: Mapping[str, str]) -> None:
        self._columns: dict[str, list[int]] = {}
        for i, joint in enumerate(joint_names):
            if joint in fingers:
                self._columns.setdefault(fingers[joint], []).append(i)

    def of(self, torque: np.ndarray) -> dict[str, float]:
        """Return the load of each finger, 0 to 1; 0 if its motors do not tell.

        Args:
            torque: Torques as shares of the largest, shape (n,); NaN where it is not known.
        """
        share = np.minimum(np.nan_to_num(np.abs(torque)), 1.0)
        return {name: float(share[own].max()) for name, own in self._columns.items()}
