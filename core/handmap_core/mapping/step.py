"""`MapStep`: what a mapper makes of a sample, stage by stage."""

from __future__ import annotations

import copyreg
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any, Literal, NamedTuple

import numpy as np

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError
from handmap_core.hands import Hand, Names
from handmap_core.human import Finding, Rule, Verdict
from handmap_core.ik import (
    WRIST_LEVERS,
    IkOptions,
    IkResult,
    Status,
    result_of,
    wrist_error,
)
from handmap_core.se3 import Array, ArrayStruct, lengths
from .targets import AnyPose, Targets

StepStatus = Status | Literal["held", "gliding"]
"""Outcome of a step: that of the inverse kinematics, or that of the tracker's samples."""


# A wrist this near its target has arrived [m, rad].
_ARRIVED, _ARRIVED_TURN = (IkOptions().point_tolerance / WRIST_LEVERS).tolist()


def arm_held_by(hand: Hand, at_speed_limit: Array, at_limit: Array) -> Array:
    """Return what keeps the wrist of an arm off its target, if it is off; shape (T,).

    A joint's speed limit (`speed`) comes before a position limit (`limit`); else it is the `reach`.

    Args:
        hand: The hand on the arm.
        at_speed_limit: Whether each joint is at its speed limit only, shape (T, n).
        at_limit: Whether it is at a position limit, shape (T, n).
    """
    arm = hand.moves_wrist
    by_speed = at_speed_limit[..., arm].any(axis=-1)
    by_limit = at_limit[..., arm].any(axis=-1)
    return np.where(by_speed, "speed", np.where(by_limit, "limit", "reach"))


class RobotCommand(ArrayStruct, frozen=True):
    """Command for a robot driver.

    Attributes:
        joint_names: Names of the n joints.
        q: Their angles [rad], shape (n,), inside their limits.
        wrist: Pose of the wrist frame in the robot's world, shape (4, 4).
        effort: Torques with which a grip presses by `q` [N m], shape (n,); None without one.
    """

    joint_names: Names
    q: Array
    wrist: Array
    effort: Array | None = None


class StepSummary(NamedTuple):
    """What goes with a command to those who watch the robot: plain numbers, no arrays.

    The compiled core makes it without the stages that its numbers come from.

    Attributes:
        point_error: Distance between targets and points [m], m numbers.
        wrist_error: How far the robot's wrist is from its target [m, rad], 2 numbers.
        at_bound: True for joints at a position or speed limit, in the order of `command.q`, n of
            them.
        residual: RMS distance of human points from where T takes them [m]; 0 without T.
        flags: As of the targets.
    """

    point_error: Sequence[float]
    wrist_error: Sequence[float]
    at_bound: Sequence[bool]
    residual: float
    flags: Names


class Stages(ArrayStruct, frozen=True):
    """The stages of a step, which the compiled core makes when they are asked for.

    Attributes:
        pose: The human hand.
        asked: The method's targets and diagnostics.
        ik: Result of the inverse kinematics (in place of eq. 8).
        command: The robot's next joint angles and wrist pose.
    """

    pose: AnyPose
    asked: Targets
    ik: IkResult
    command: RobotCommand

    @classmethod
    def of(cls, pose: AnyPose, targets: Targets, result: IkResult) -> Stages:
        """Return the stages of a step whose robot has moved."""
        hand = result.hand
        q = result.q[hand.q_indices]
        command = RobotCommand(hand.joint_names, q, result.wrist)
        return cls(pose, targets, result, command)

    @property
    def status(self) -> Status:
        """Outcome of the inverse kinematics."""
        return self.ik.status

    @property
    def summary(self) -> StepSummary:
        """What goes with the command to those who watch the robot."""
        norms = self.asked.diagnostics.get("residual_norms", np.zeros(1))
        return StepSummary(
            lengths(self.ik.errors).tolist(),
            wrist_error(self.command.wrist, self.asked.wrist).tolist(),
            (self.ik.active[self.ik.hand.joint_columns] != 0).tolist(),
            math.sqrt(norms.dot(norms) / len(norms)),
            self.asked.flags,
        )


AnyStages = Stages | core.Stages
"""Stages, of Python or of the core: both have the same attributes."""


def _reduced_stages(stages: core.Stages) -> tuple[Any, ...]:
    """Make a copy of stages of the core one of Python, by copy or pickle."""
    return Stages, (stages.pose, stages.asked, stages.ik, stages.command)


copyreg.pickle(core.Stages, _reduced_stages)


def step_views(
    make_targets: Callable[[list[Array], bool], Targets],
    hand: Hand,
    links: Sequence[Names],
) -> core.StepViews:
    """Return what makes the objects of a core's step that are asked for.

    Args:
        make_targets: Makes targets of their arrays, given whether a stretch is clamped.
        hand: The hand that is moved.
        links: Links of each pair of shapes that are kept apart; see `result_of`.
    """
    return core.StepViews(
        targets=make_targets,
        ik=partial(result_of, hand=hand, links=links),
        command=partial(RobotCommand, hand.joint_names),
        summary=StepSummary,
    )


class SampleStep(ArrayStruct, frozen=True, kw_only=True):
    """What is known of a sample that was mapped, whatever it became.

    Attributes:
        out_of_range: Human joints used though beyond their limits, within the tolerance.
        duration: Wall time of the step [s].
        verdict: What the guard said about the sample; None where no guard saw it.
        confidence: The tracker's own confidence, from 0 to 1.
        is_gliding: Whether the robot is still on its way back to the human after a hold.
    """

    out_of_range: Names = ()
    duration: float = 0.0
    verdict: Verdict | None = None
    confidence: float = 1.0
    is_gliding: bool = False

    @property
    def pose(self) -> AnyPose:
        """The human hand that was mapped."""
        raise NotImplementedError

    @property
    def is_held(self) -> bool:
        """Whether the sample was not followed, and the robot held its posture."""
        return self.verdict is not None and self.verdict.is_held


class MapStep(SampleStep, frozen=True):
    """One step of the mapping, stage by stage.

    Values of T raise InvalidOptionsError if the method has no T.

    Attributes:
        stages: The stages, which the properties below name one by one.
    """

    stages: AnyStages

    @property
    def pose(self) -> AnyPose:
        """The human hand that was mapped."""
        return self.stages.pose

    @property
    def command(self) -> RobotCommand:
        """The robot's next joint angles and wrist pose."""
        return self.stages.command

    @property
    def human_points(self) -> Array:
        """Human reference points in the human's world (eq. 4) [m], shape (n_h, 3)."""
        return self.stages.pose.points

    @property
    def human_wrist(self) -> Array | None:
        """Pose of the human's wrist, given or fitted to landmarks, (4, 4); None if unknown."""
        return self.stages.pose.wrist

    @property
    def asked(self) -> Targets:
        """The method's targets and diagnostics."""
        return self.stages.asked

    @property
    def ik(self) -> IkResult:
        """Result of the inverse kinematics (in place of eq. 8)."""
        return self.stages.ik

    @property
    def held_by(self) -> Names:
        """Both links of the pair that keeps the hand from its targets; empty if none does."""
        return self.ik.held_by

    @property
    def rule(self) -> Rule:
        """Name of what is wrong with the sample (`human.sample.RULES`); empty if nothing."""
        return self.verdict.rule if self.verdict else ""

    @property
    def finding(self) -> Finding | None:
        """What the input is instead of what it says, with advice; None if it is plausible."""
        return self.verdict.finding if self.verdict else None

    @property
    def consistency(self) -> float:
        """RMS difference of bones and palm from the person's [m]; NaN if it was not measured."""
        return self.verdict.consistency if self.verdict else math.nan

    @property
    def diagnostics(self) -> Mapping[str, Array]:
        """Intermediate results of the method, by name; see `Targets`."""
        return self.asked.diagnostics

    @property
    def motion(self) -> Array:
        """T from the reference configuration to now (eqs. 5-6), shape (4, 4)."""
        return self.named("motion")

    @property
    def motion_rigid(self) -> Array:
        """T_rb (eq. 2), shape (4, 4)."""
        return self.named("motion_rigid")

    @property
    def motion_deformation(self) -> Array:
        """T_def (eq. 2), after clamping and gain, shape (4, 4).

        With neither, `motion_deformation @ motion_rigid == motion`.
        """
        return self.named("motion_deformation")

    @property
    def residual_norms(self) -> Array:
        """Distance of each human point from where T takes it [m], shape (n_h,)."""
        return self.named("residual_norms")

    @property
    def residual(self) -> float:
        """RMS distance of human points from where T takes them [m]; 0 without T."""
        return self.stages.summary.residual

    @property
    def stretches(self) -> Array:
        """Eigenvalues of the stretch U before clamping, shape (3,)."""
        return self.named("stretches")

    @property
    def is_clamped(self) -> bool:
        """True if a stretch was outside its allowed range; False for methods without T."""
        return "stretch_clamped" in self.stages.summary.flags

    @property
    def targets(self) -> Array:
        """Targets of the robot's reference points (eq. 7) [m], shape (n_r, 3)."""
        return self.asked.points

    @property
    def wrist_target(self) -> Array:
        """Target pose of the robot's wrist, shape (4, 4)."""
        return self.asked.wrist

    @property
    def wrist_error(self) -> Array:
        """How far the robot's wrist is from its target [m, rad], shape (2,)."""
        return np.array(self.stages.summary.wrist_error)

    @property
    def arm_held_by(self) -> str:
        """What keeps the arm's wrist off its target (`arm_held_by`); empty if nothing does."""
        if self.stages.status in ("released", "failed"):
            return ""
        summary = self.stages.summary
        # For two numbers, numpy takes many times as long. Neither is NaN if both have arrived.
        off, turned = summary.wrist_error
        if off <= _ARRIVED and turned <= _ARRIVED_TURN:
            return ""
        hand = self.ik.hand
        if not hand.moves_wrist.any():
            return ""
        at_limit = hand.at_position_limit(self.command.q)
        at_bound = np.array(summary.at_bound)
        return arm_held_by(hand, at_bound & ~at_limit, at_limit).item()

    @property
    def points(self) -> Array:
        """The robot's reference points after the step [m], shape (n_r, 3)."""
        return self.ik.points

    @property
    def point_error(self) -> Array:
        """Distance between targets and points [m], shape (n_r,)."""
        return np.array(self.stages.summary.point_error)

    @property
    def at_bound(self) -> Array:
        """True for joints at a position or speed limit, in the order of `command.q`, shape (n,)."""
        return np.array(self.stages.summary.at_bound)

    @property
    def status(self) -> StepStatus:
        """Outcome of the step.

        `held`: the sample made no sense (see `rule`), and the robot held its posture; `gliding`:
        the robot is on its way back to the human after a hold. Otherwise the outcome of the inverse
        kinematics (`IkResult.status`), so `converged` means that the sample made sense too.
        """
        if self.is_held:
            return "held"
        status = self.stages.status
        is_coming = self.is_gliding and status != "released"
        return "gliding" if is_coming else status

    @property
    def iterations(self) -> int:
        """QPs solved."""
        return self.ik.iterations

    def named(self, name: str) -> Array:
        """Return a result of the method by its name in `diagnostics`."""
        if name not in self.diagnostics:
            raise InvalidOptionsError(
                f"its diagnostics have no {name}",
                option="method",
                advice=f"there are {', '.join(self.diagnostics) or 'none'}",
            )
        return self.diagnostics[name]
