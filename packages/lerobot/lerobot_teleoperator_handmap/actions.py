"""What an action is: the commanded joints of a hand, and its wrist's pose where it floats."""

from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from handmap_qp import Hand, load_hand
from handmap_qp.se3 import pose_from_xyz_quat, quat_wxyz_from_rotation

Action = dict[str, float]

_WRIST = tuple(f"wrist.{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))


def features(hand: Hand) -> dict[str, type]:
    """Return the names of an action's numbers: `JOINT.pos` [rad], `wrist.x` [m] to `wrist.qz`."""
    joints = [f"{name}.pos" for name in hand.joint_names]
    return dict.fromkeys([*joints, *(_WRIST if hand.is_floating else ())], float)


def action_of(hand: Hand, q: ArrayLike, wrist: np.ndarray | None) -> Action:
    """Return an action.

    Args:
        hand: The robot hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).
        wrist: Pose of the wrist, shape (4, 4); not used of a hand that does not float.
    """
    numbers = [*np.asarray(q, dtype=float)]
    if hand.is_floating:
        pose = np.eye(4) if wrist is None else wrist
        numbers += [*pose[:3, 3], *quat_wxyz_from_rotation(pose[:3, :3])]
    return dict(zip(features(hand), map(float, numbers), strict=True))


def command_of(hand: Hand, action: Action) -> tuple[np.ndarray, np.ndarray | None]:
    """Return joint angles and wrist pose of an action; None for a hand that does not float.

    A policy's quaternion need not have the length 1: it is normalised.
    """
    numbers = np.array([action[name] for name in features(hand)])
    q, wrist = np.split(numbers, [len(hand.joint_names)])
    if not hand.is_floating:
        return q, None
    wrist[3:] /= np.linalg.norm(wrist[3:])
    return q, pose_from_xyz_quat(wrist, "wxyz")


class OfHand:
    """What the teleoperator and the robot of a hand have in common; neither is calibrated here."""

    config: Any

    @cached_property
    def hand(self) -> Hand:
        """The robot hand."""
        return load_hand(self.config.hand)

    @property
    def action_features(self) -> dict[str, type]:
        """Names of an action's numbers."""
        return features(self.hand)

    @property
    def is_calibrated(self) -> bool:
        """True: the service measures the person's hand, and a simulated hand needs none."""
        return True

    def calibrate(self) -> None:
        """Do nothing."""

    def configure(self) -> None:
        """Do nothing."""
