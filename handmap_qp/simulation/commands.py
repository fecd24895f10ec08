"""What a mapping commands over time: `Commands`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import affine


@dataclass(frozen=True, slots=True, eq=False)
class Commands:
    """What a mapping commands over time.

    Attributes:
        name: Name of the mapping.
        hand: The robot hand.
        time: Instants [s], shape (T,).
        q: Joint angles [rad], shape (T, n).
        wrist: Wrist poses, shape (T, 4, 4).
    """

    name: str
    hand: Hand
    time: np.ndarray
    q: np.ndarray
    wrist: np.ndarray

    def between(self, i: int, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return joints and wrist at a share of the way from sample i - 1 to sample i.

        Args:
            i: Index of the later sample, from 1.
            share: 0 for the earlier sample, 1 for the later one.

        Returns:
            Joint angles [rad], shape (n,), and the wrist pose, shape (4, 4).
        """
        q = self.q[i - 1] + share * (self.q[i] - self.q[i - 1])
        return q, between_poses(self.wrist[i - 1], self.wrist[i], share)


def between_poses(start: np.ndarray, end: np.ndarray, share: float) -> np.ndarray:
    """Return the pose at a share of the way: positions in a line, rotations about one axis.

    Args:
        start: Pose at share 0, shape (4, 4).
        end: Pose at share 1, shape (4, 4).
        share: Between 0 and 1.
    """
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    rotation = Rotation.from_rotvec(share * turn).as_matrix() @ start[:3, :3]
    return affine(rotation, start[:3, 3] + share * (end[:3, 3] - start[:3, 3]))
