"""The seam between a mapper and its mapping method.

A method says how a human sample becomes targets of the robot. It goes through three stages:

    Method                      the choices, independent of any hand
      .bind(human, robot)    -> BoundMethod: checked against two hands
      .start(sample, posture) -> TargetMap: counted from one reference
      .targets(sample)       -> Targets: of one sample, for the QP

A `MapStep` has these targets, what the QP made of them, and the command of the robot.

Every module in `handmap_qp.mapping.methods` is a method with presets (`PRESETS`). One of another
package is a file with its options (a subclass of `MethodOptions` with `bind`) and presets, which
entry points of the group `handmap_qp.presets` name.
"""

from __future__ import annotations

import copyreg
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cached_property
from importlib import import_module
from pkgutil import iter_modules
from typing import (
    TYPE_CHECKING,
    Any,
    ClassVar,
    NamedTuple,
    Protocol,
    Self,
    runtime_checkable,
)

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError, did_you_mean
from handmap_core.options import Options
from handmap_core.se3 import Array, ArrayStruct
from handmap_qp.hands import Hand, Names
from handmap_qp.ik import (
    IkOptions,
    Task,
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
