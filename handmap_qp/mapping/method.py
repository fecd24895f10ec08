"""The seam between a mapper and its mapping method, and what a mapper makes of a sample.

A method says how a human sample becomes targets of the robot. It goes through three stages:

    Method                      the choices, independent of any hand
      .bind(human, robot)    -> BoundMethod: checked against two hands
      .start(sample, posture) -> TargetMap: counted from one reference
      .targets(sample)       -> Targets: of one sample, for the QP

`MapStep` has these targets, what the QP made of them, and the command of the robot.

Every module in `handmap_qp.mapping.methods` is a method with presets (`PRESETS`). One of another
package is a file with its options (a subclass of `MethodOptions` with `bind`) and presets, which
entry points of the group `handmap_qp.presets` name.
"""

from __future__ import annotations

import copyreg
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from functools import cached_property, partial
from importlib import import_module
from pkgutil import iter_modules
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    Literal,
    NamedTuple,
    Protocol,
    Self,
    runtime_checkable,
)

import numpy as np

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError, did_you_mean
from handmap_core.options import Options
from handmap_core.se3 import Array, ArrayStruct, lengths
from handmap_qp.hands import Hand, Names
from handmap_qp.human import Finding, Rule, Verdict
from handmap_qp.ik import (
    WRIST_LEVERS,
    IkOptions,
    IkResult,
    Status,
    Task,
    result_of,
    wrist_error,
)
from handmap_qp.plugins import Plugins
from . import methods

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs


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
        flags: What a user should know of this sample, a word each, such as `stretch_clamped`.
    """

    points: Array
    wrist: Array
    diagnostics: Mapping[str, Array] = {}
    tasks: tuple[Task, ...] = ()
    margins: Array | None = None
    flags: Names = ()
    regularisation: Array | None = None


class TargetMap(Protocol):
    """Turns samples into targets, counted from one reference of both hands.

    One that the core has too is a `CoreMap`.

    Attributes:
        rest: Joint positions that the QP's rest term pulls to [rad or m], shape (n,).
    """

    rest: Array

    def targets(self, sample: HumanPose) -> Targets:
        """Return the targets of one sample; a failure changes nothing."""


def without_core(target_map: object) -> dict[str, object]:
    """Return the attributes of a map but the core's own, which a copy makes again."""
    own = core.TargetMap, core.PalmMap
    return {
        name: value
        for name, value in vars(target_map).items()
        if not isinstance(value, own)
    }


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
        return self.asked(*self.core_map.targets(core_pose(sample)))

    def make_core(self) -> core.TargetMap:
        """Return the map as the core has it."""
        raise NotImplementedError

    def asked(self, parts: list[Array], is_clamped: bool) -> Targets:
        """Return the targets whose arrays the core or the published method has computed.

        Args:
            parts: The arrays: points, wrist, and what the map of the core adds to them.
            is_clamped: Whether a stretch was outside its allowed range.
        """
        raise NotImplementedError


class BoundMethod(Protocol):
    """A method for two given hands.

    Attributes:
        robot: The hand that follows, with the reference points that the method moves.
        contacts: Collision shapes kept apart; None for the choice of
            `IkOptions.avoids_self_collision`.
        needs_wrist: Use of every sample's wrist pose, for error messages; empty if not needed.
        reference_needs_wrist: Use of the reference sample's wrist pose, likewise.
        renews_reference: True if every sample becomes the reference of the next one (Fig. 3).
    """

    robot: Hand
    contacts: ShapePairs | None
    needs_wrist: str
    reference_needs_wrist: str
    renews_reference: bool

    def start_palm(self, sample: HumanPose) -> Array:
        """Return where a floating robot's palm is put at the first sample, shape (4, 4)."""

    def start(self, sample: HumanPose, robot: RobotPosture) -> TargetMap:
        """Take both hands as they are for the reference.

        Raises:
            DegeneratePointsError: If the sample's points do not determine a motion.
        """


@runtime_checkable
class Method(Protocol):
    """A mapping method: its choices, independent of any hand."""

    def bind(self, human: Hand, robot: Hand) -> BoundMethod:
        """Check the method against two hands, and prepare what depends on them alone.

        Raises:
            InvalidOptionsError: If the choices contradict the hands.
        """


FOLLOWING = IkOptions(wrist_position_weight=10.0, wrist_orientation_weight=10.0)
"""QP weights of methods whose palm follows the human's."""


class MethodOptions(Options, frozen=True):
    """Base of methods that presets name: its fields are its options.

    Attributes:
        weights: Weights and settings of the QP where neither a preset nor the user gives any.
    """

    weights: ClassVar[IkOptions] = IkOptions()

    def fitted_to(self, human: Hand) -> Self:
        """Return these options with those that a measured person decides, if there are any."""
        del human
        return self

    def bind(self, human: Hand, robot: Hand) -> BoundMethod:
        """Check the method against two hands; see `Method.bind`."""
        raise InvalidOptionsError(
            f"{type(self).__name__} has no `bind` for {robot.name}",
            option="method",
        )


class Preset(NamedTuple):
    """A method with its options and QP weights that go together.

    Attributes:
        method: The method, which is the struct of its options.
        ik: Weights and settings of the QP.
        purpose: Intended use, in words.
        weakness: Known weaknesses, in words.
        rank: Place in lists of presets: those with a lower one come first.
        suits: Whether it may be the default of two hands, human and robot; the first one is.
    """

    method: MethodOptions
    ik: IkOptions
    purpose: str
    weakness: str
    rank: int = 2
    suits: Callable[[Hand, Hand], bool] = lambda *_: False


def _own() -> dict[str, Preset]:
    found = [
        item
        for module in iter_modules(methods.__path__, f"{methods.__name__}.")
        for item in import_module(module.name).PRESETS.items()
    ]
    return dict(sorted(found, key=lambda item: item[1].rank))


PRESETS: Mapping[str, Preset] = Plugins(
    "handmap_qp.presets", _own, "handmap_qp.mapping.method:Preset"
)
"""All presets, by name."""


def get_preset(name: str) -> Preset:
    """Return a preset.

    Raises:
        InvalidOptionsError: If there is no such preset.
    """
    is_name = isinstance(name, str)
    if is_name:
        with suppress(KeyError):
            return PRESETS[name]
    raise InvalidOptionsError(
        option="preset",
        expected=f"one of {', '.join(PRESETS)}",
        value=name,
        advice=did_you_mean(name, PRESETS) if is_name else "",
    )


def default_preset(human: Hand, robot: Hand) -> str:
    """Return the preset of two hands for which none is named: the first that suits them."""
    return next(name for name, each in PRESETS.items() if each.suits(human, robot))


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


class MapStep(ArrayStruct, frozen=True):
    """One step of the mapping, stage by stage.

    Values of T raise InvalidOptionsError if the method has no T.

    Attributes:
        stages: The stages, which the properties below name one by one.
        out_of_range: Human joints used though beyond their limits, within the tolerance.
        duration: Wall time of the step [s].
        verdict: What the guard said about the sample; None where no guard saw it.
        confidence: The tracker's own confidence, from 0 to 1.
        is_gliding: Whether the robot is still on its way back to the human after a hold.
    """

    stages: AnyStages
    out_of_range: Names
    duration: float
    verdict: Verdict | None = None
    confidence: float = 1.0
    is_gliding: bool = False

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
    def is_held(self) -> bool:
        """Whether the sample was not followed, and the robot held its posture."""
        return self.verdict is not None and self.verdict.is_held

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
