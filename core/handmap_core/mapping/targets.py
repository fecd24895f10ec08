"""What a mapping method takes and makes: `HumanPose`, `RobotPosture`, `TargetMap`, `Targets`."""

from __future__ import annotations

import copyreg
from collections.abc import Mapping
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import numpy as np

from handmap_core.core import core, without_core
from handmap_core.errors import InvalidOptionsError
from handmap_core.hands import Names
from handmap_core.ik import Task
from handmap_core.se3 import Array, ArrayStruct


class HumanPose(ArrayStruct, frozen=True):
    """A human hand at one instant, in the human's world W.

    Attributes:
        points: Its reference points [m], shape (n_h, 3).
        wrist: Pose of its wrist, shape (4, 4); None where it was not measured.
    """

    points: Array
    wrist: Array | None

    @classmethod
    def of_core(cls, pose: core.HumanPose) -> HumanPose:
        """Return a pose that the core has."""
        return cls(pose.points, pose.wrist)


AnyPose = HumanPose | core.HumanPose
"""A pose, of Python or of the core: both have the same attributes."""


def core_pose(pose: AnyPose) -> core.HumanPose:
    """Return a pose as the core has it."""
    if isinstance(pose, core.HumanPose):
        return pose
    return core.HumanPose(pose.points, pose.wrist)


def _reduced_pose(pose: core.HumanPose) -> tuple[Any, ...]:
    """Make a copy of a pose of the core one of Python, by copy or pickle."""
    return HumanPose, (pose.points, pose.wrist)


copyreg.pickle(core.HumanPose, _reduced_pose)


class RobotPosture(NamedTuple):
    """A robot hand at one instant, in the robot's world V.

    Attributes:
        q: Joint positions in the order of `Hand.joint_names` [rad or m], shape (n,).
        points: Its reference points [m], shape (n_r, 3).
        wrist: Pose of its wrist, shape (4, 4).
    """

    q: Array
    points: Array
    wrist: Array


class Targets(ArrayStruct, frozen=True):
    """The targets of a method for one sample.

    These names of diagnostics mean the same in every method that has them:

        motion              T from the reference to now, in the human's world, shape (4, 4)
        motion_rigid        T_rb, shape (4, 4)
        motion_deformation  T_def, shape (4, 4)
        stretches           stretches of T before clamping, shape (3,)
        pivot_image         where T takes the point that T_def acts about [m], shape (3,)
        residual_norms      distance of human points from where T takes them [m], shape (n,)

    Attributes:
        points: Targets of the robot's reference points [m], shape (n_r, 3).
        wrist: Target pose of its wrist, shape (4, 4); ignored if the wrist is fixed.
        diagnostics: Intermediate results of the method, by name; `MapStep.diagnostics` has them.
        tasks: Further terms of the QP's cost, for this sample.
        margins: Distance that each pair of shapes keeps [m], shape (k,); the hand's if omitted.
        regularisation: Share of the QP's rest weight and damping of each joint, shape (n,); all
            of both if omitted.
        rest: Joint positions that the QP's rest term pulls to for this sample [rad or m], shape
            (n,); those of the map if omitted.
        flags: What a user should know of this sample, a word each, such as `stretch_clamped`.
    """

    points: Array
    wrist: Array
    diagnostics: Mapping[str, Array] = {}
    tasks: tuple[Task, ...] = ()
    margins: Array | None = None
    flags: Names = ()
    regularisation: Array | None = None
    rest: Array | None = None


class TargetMap(Protocol):
    """Turns samples into targets, counted from one reference of both hands.

    One that the core has too is a `CoreMap`.

    Attributes:
        rest: Joint positions that the QP's rest term pulls to [rad or m], shape (n,), unless a
            sample's `Targets` say others.
    """

    rest: Array

    def targets(self, sample: HumanPose) -> Targets:
        """Return the targets of one sample; a failure changes nothing."""


class CoreMap:
    """Base of target maps whose formulas the core has."""

    @cached_property
    def core_map(self) -> core.TargetMap:
        """The map as the core has it, made at its first use."""
        return self.make_core()

    def __getstate__(self) -> dict[str, object]:
        """Return the state of a copy."""
        return without_core(self)

    def targets(self, sample: HumanPose) -> Targets:
        """Return the targets of one sample, computed by the core; see `TargetMap`."""
        return self.targets_of(*self.core_map.targets(core_pose(sample)))

    def make_core(self) -> core.TargetMap:
        """Return the map as the core has it."""
        raise NotImplementedError

    def targets_of(self, parts: list[Array], is_clamped: bool) -> Targets:
        """Return the targets whose arrays the core or the published method has computed.

        Args:
            parts: The arrays: points, wrist, and what the map of the core adds to them.
            is_clamped: Whether a stretch was outside its allowed range.
        """
        raise NotImplementedError


def check_members(made: object, wanted: tuple[str, ...], maker: str) -> None:
    """Reject an object of a user's method that lacks members.

    Args:
        made: The object.
        wanted: Names of the members.
        maker: The call that returned it, for the message.

    Raises:
        InvalidOptionsError: If one is missing; the message names all.
    """
    has = {*dir(made)}
    if missing := [name for name in wanted if name not in has]:
        raise InvalidOptionsError(
            f"{maker} returned {type(made).__name__}, which lacks {', '.join(missing)}",
            option="method",
            advice="derive the method from handmap_qp.CustomMethod, which has all but `targets`",
        )


def check_targets(targets: Targets, points: int, target_map: TargetMap) -> None:
    """Reject what is not the targets of a robot hand; NaN passes, and holds the robot.

    Args:
        targets: What the user's method returned.
        points: Number of the robot's reference points, n_r.
        target_map: Whose method it is, for the message.

    Raises:
        InvalidOptionsError: If it is not a `Targets`, or an array has another shape.
    """
    maker = f"{type(target_map).__name__}.targets(sample)"
    if not isinstance(targets, Targets):
        raise InvalidOptionsError(
            f"{maker} returned {type(targets).__name__}, expected Targets(points, wrist)",
            option="method",
            advice="`place_joints` and `place_points` of handmap_qp.CustomMethod make them",
        )
    for name, array, shape in (
        ("points", targets.points, (points, 3)),
        ("wrist", targets.wrist, (4, 4)),
    ):
        if np.shape(array) != shape:
            raise InvalidOptionsError(
                f"{maker} returned {name} of shape {np.shape(array)}, expected {shape}",
                option="method",
                advice="a row for each of the robot's reference points"
                * (name == "points"),
            )
