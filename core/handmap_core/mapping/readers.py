"""Readers: what was measured on a human hand becomes a sample of it.

`LandmarkReader` takes the landmarks of a tracker, `JointReader` joint angles (eq. 4). The core
reads them. Python checks numbers that the core does not take as they are, converts them, and says
what is wrong with them.
"""

from __future__ import annotations

from itertools import compress
from typing import TypedDict

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.core import core
from handmap_core.errors import InvalidInputError, InvalidOptionsError
from handmap_core.hands import Hand, Names
from handmap_core.human import (
    LANDMARK_COUNT,
    LANDMARK_NAMES,
    PALM,
    landmarks_at_rest,
    palm_fit_weights,
)
from handmap_core.models import LandmarkReaderModel, encode
from handmap_core.se3 import (
    Array,
    PoseLike,
    QuatOrder,
    as_floats,
    as_points,
    check_pose,
)
from .targets import HumanPose


class _LandmarkReaderState(TypedDict):
    """What a copy of a `LandmarkReader` is made of."""

    quat_order: QuatOrder | None
    model: LandmarkReaderModel


class LandmarkReader:
    """Turns the 21 landmarks of a tracker into samples of a human hand.

    Args:
        human: The human hand, scaled to the person.
        quat_order: Order of the quaternion in wrist poses of seven numbers.

    Attributes:
        quat_order: As given.
        model: What the core reads by.
        core: The reader of the core.

    Raises:
        InvalidOptionsError: If a reference point of the hand is not a landmark.
    """

    def __init__(self, human: Hand, quat_order: QuatOrder | None = None) -> None:
        self.quat_order = quat_order
        names = [point.name for point in human.reference_points]
        if missing := [name for name in names if name not in LANDMARK_NAMES]:
            raise InvalidOptionsError(
                f"{', '.join(missing)} cannot be read from landmarks",
                option="human_points",
                advice="choose reference points among the landmarks, or call map_points",
            )
        self.model = LandmarkReaderModel(
            used=np.array([*map(LANDMARK_NAMES.index, names)]),
            palm=landmarks_at_rest(human)[PALM],
            weights=palm_fit_weights(human.palm_weights),
        )
        self.core = core.LandmarkReader(encode(self.model))

    def __getstate__(self) -> _LandmarkReaderState:
        """Return what a copy is made of."""
        return {"quat_order": self.quat_order, "model": self.model}

    def __setstate__(self, state: _LandmarkReaderState) -> None:
        """Read as another one does."""
        self.quat_order = state["quat_order"]
        self.model = state["model"]
        self.core = core.LandmarkReader(encode(self.model))

    def read(
        self, landmarks: ArrayLike, wrist: PoseLike | None = None
    ) -> tuple[HumanPose, Names]:
        """Return a sample; landmarks have no limits that they could be outside.

        Args:
            landmarks: In MediaPipe's order, in the human's world [m], shape (21, 3).
            wrist: The tracker's own wrist pose; fitted to the landmarks of the palm (Kabsch 1976)
                if None.

        Raises:
            InvalidInputError: If a coordinate is not finite, or `wrist` is not a pose.
        """
        pose = self.core.read(landmarks, wrist)
        if pose is None:
            points = as_points(landmarks, "landmarks", LANDMARK_COUNT)
            if wrist is not None:
                wrist = check_pose(wrist, "wrist_pose", self.quat_order)
            pose = self.core.pose_of(points, wrist)
        return HumanPose.of_core(pose), ()


class JointReader:
    """Turns joint angles into samples of a human hand (eq. 4).

    Args:
        human: The human hand.
        tolerance: How far a joint may be outside its limits [rad].
        quat_order: Order of the quaternion in wrist poses of seven numbers.

    Attributes:
        core: The reader of the core.
    """

    def __init__(
        self, human: Hand, tolerance: float, quat_order: QuatOrder | None
    ) -> None:
        self.human = human
        self.tolerance = tolerance
        self.quat_order = quat_order
        self.core = core.JointReader(human.tree)

    def __reduce__(
        self,
    ) -> tuple[type[JointReader], tuple[Hand, float, QuatOrder | None]]:
        """Build a copy with a reader of the core of its own."""
        return JointReader, (self.human, self.tolerance, self.quat_order)

    def read(
        self, q: ArrayLike, wrist_pose: PoseLike | None
    ) -> tuple[HumanPose, Names]:
        """Return a sample, and the names of the joints that are outside their limits.

        Args:
            q: Joint angles in the order of `human.joint_names` [rad], shape (n,).
            wrist_pose: Pose of the wrist in the human's world, as of `HandMapper.map_step`.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        if pose := self.core.read(q, wrist_pose):
            return HumanPose.of_core(pose), ()
        human = self.human
        wrist = check_pose(wrist_pose, "wrist_pose", self.quat_order)
        angles, excess = check_joints(human, q, "human_q", self.tolerance)
        outside = tuple(compress(human.joint_names, excess > 0.0))
        return HumanPose.of_core(self.core.pose_of(angles, wrist)), outside


def check_joints(
    hand: Hand, q: ArrayLike, name: str, tolerance: float = 0.0
) -> tuple[Array, Array]:
    """Return joint positions, and how far each is outside its limits, at most a tolerance."""
    lower, upper = hand.limits
    angles = as_floats(q, name, shape=lower.shape)
    excess = np.maximum(lower - angles, angles - upper)
    # `<=` is also false for NaN.
    if not (excess <= tolerance).all():
        i = np.argmax(excess)
        raise InvalidInputError(
            f"{hand.joint_names[i]} is {angles[i]:.6g} rad, expected within "
            f"[{lower[i] - tolerance:.6g}, {upper[i] + tolerance:.6g}]",
            argument=f"{name}[{i}]",
            value=float(angles[i]),
        )
    return angles, excess
