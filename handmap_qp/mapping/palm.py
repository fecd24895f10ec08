"""Methods whose palm follows the human's, and the landmarks of a human hand by name."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING

import numpy as np

from handmap_core.errors import InvalidOptionsError
from handmap_core.mapping.alignment import rotation_of
from handmap_core.mapping.targets import AnyPose, HumanPose, RobotPosture, TargetMap
from handmap_core.se3 import Array, affine
from handmap_qp.hands import Hand
from .alignment import AlignedOptions

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs


class PalmMethod:
    """Base of methods for two hands whose wrist target is that of a `PalmMap`.

    See `BoundMethod`.
    """

    contacts: ShapePairs | None = None
    needs_wrist = "the pose of the palm"
    reference_needs_wrist = ""
    renews_reference = False
    map_type: Callable[..., TargetMap]
    """Its map, made of it and both hands at the reference; by `start`."""

    def __init__(self, choices: AlignedOptions, human: Hand, robot: Hand) -> None:
        self.alignment = choices.alignment
        self.wrist_to_palm = human.wrist_to_palm
        self.human = human
        self.robot = robot

    def palm_of(self, sample: AnyPose) -> Array:
        """Return the palm pose of a sample whose wrist was measured, shape (4, 4)."""
        assert sample.wrist is not None
        return sample.wrist @ self.wrist_to_palm

    def start_palm(self, sample: HumanPose) -> Array:
        """Return the human's palm in the robot's world; the origin where `palm` aligns them."""
        if self.alignment == "palm":
            return np.eye(4)
        return affine(rotation_of(self.alignment)) @ self.palm_of(sample)

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        """Take both hands as they are for the reference; see `BoundMethod.start`."""
        return self.map_type(self, sample, robot)


def palm_of(sample: HumanPose, human: Hand) -> Array:
    """Return the palm pose of a sample whose wrist was measured, shape (4, 4)."""
    assert sample.wrist is not None
    return sample.wrist @ human.wrist_to_palm


def point_indices(human: Hand) -> dict[str, int]:
    """Return the indices of a human hand's reference points by name."""
    return {point.name: k for k, point in enumerate(human.reference_points)}


def require_points(human: Hand, names: Iterable[str], user: str) -> Array:
    """Return the indices of named reference points of a human hand, shape (k,).

    Args:
        human: The human hand.
        names: The names.
        user: What needs them, for the message.

    Raises:
        InvalidOptionsError: If the hand has no reference point of a name.
    """
    wanted = list(names)
    known = point_indices(human)
    if missing := [name for name in wanted if name not in known]:
        raise InvalidOptionsError(
            f"{user} needs {', '.join(missing)} among the human's points",
            option="human_points",
            advice="load the human with points='joints' or points='landmarks'",
        )
    return np.array([known[name] for name in wanted], dtype=int)
