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

from collections.abc import Callable, Mapping
from contextlib import suppress
from importlib import import_module
from pkgutil import iter_modules
from typing import (
    TYPE_CHECKING,
    ClassVar,
    NamedTuple,
    Protocol,
    Self,
    runtime_checkable,
)

from handmap_core.errors import InvalidOptionsError, did_you_mean
from handmap_core.mapping.bound_method import BoundMethod as CoreBoundMethod
from handmap_core.mapping.targets import AnyPose as AnyPose
from handmap_core.mapping.targets import CoreMap as CoreMap
from handmap_core.mapping.targets import HumanPose as HumanPose
from handmap_core.mapping.targets import RobotPosture as RobotPosture
from handmap_core.mapping.targets import TargetMap as TargetMap
from handmap_core.mapping.targets import Targets as Targets
from handmap_core.mapping.targets import core_pose as core_pose
from handmap_core.options import Options
from handmap_core.plugins import Plugins
from handmap_qp.hands import Hand
from handmap_qp.ik import (
    IkOptions,
)
from . import methods

if TYPE_CHECKING:
    from handmap_qp.hands import ShapePairs


class BoundMethod(CoreBoundMethod, Protocol):
    """A method for two given hands.

    Attributes:
        robot: The hand that follows, with the reference points that the method moves.
        contacts: Collision shapes kept apart; None for the choice of
            `IkOptions.avoids_self_collision`.
    """

    robot: Hand
    contacts: ShapePairs | None


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
