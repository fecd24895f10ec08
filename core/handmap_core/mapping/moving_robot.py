"""`MovingRobot`: the robot's side of a mapper, from targets to a command.

It owns how the robot moves, its clock, and whether it is engaged. It does not know where targets
come from: a `TargetSource` makes them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from msgspec import structs

from handmap_core.core import core
from handmap_core.errors import expect
from handmap_core.hands import Configuration, Hand
from handmap_core.ik import IkOptions, IkResult, Motion, Task, When
from handmap_core.ik.gate import IkGate
from handmap_core.se3 import Array
from .command_time import CallerClock, check_dt, check_when
from .hand_request import HandRequest
from .reference import Placement
from .step import Stages, step_views
from .targets import Targets

if TYPE_CHECKING:
    from handmap_core import _core


class Solver(Protocol):
    """The QP that moves a robot, and the gate that knows how it moves; see `PointIk`."""

    @property
    def hand(self) -> Hand:
        """The robot as one hand."""

    @property
    def gate(self) -> IkGate:
        """Admits the displacements."""

    @property
    def configuration(self) -> Configuration:
        """The robot's present posture."""

    @property
    def core(self) -> _core.Ik:
        """The compiled core of the robot."""

    @property
    def options(self) -> IkOptions:
        """Weights and settings."""

    @property
    def is_compiled(self) -> bool:
        """Whether the core solves the QP."""

    def place(self, q: Array) -> None:
        """Put the robot at a configuration, shape (nq,), at rest."""

    def solve(
        self,
        point_targets: Array,
        wrist_target: Array | None,
        dt: When,
        *,
        rest: Array | None = None,
        regularisation: Array | None = None,
        tasks: Sequence[Task] = (),
        margins: Array | None = None,
        speed: float = 1.0,
    ) -> IkResult:
        """Move the robot towards its targets for one sample; see `PointIk.solve`."""

    def hold(self, dt: When) -> IkResult:
        """Bring the robot to a stop, without targets."""


AnySolver = TypeVar("AnySolver", bound=Solver)


class MovingRobot(Generic[AnySolver]):
    """A robot that a QP moves.

    Args:
        point_ik: The robot's present posture and the QP.
        usual_dt: Usual time between commands [s], where a caller gives none.

    Attributes:
        point_ik: As given; `replace_solver` changes it.
        usual_dt: As given.
        placement: Whether it is known where the robot is. It is not where a floating hand was reset
            without a wrist pose. Then its configuration has the right joints, and any wrist.
        is_released: Whether the robot is disengaged: it brakes, whatever the targets.

    Raises:
        InvalidInputError: If `usual_dt` cannot be used.
    """

    def __init__(self, point_ik: AnySolver, usual_dt: float) -> None:
        self.point_ik = point_ik
        self.usual_dt = check_dt(usual_dt)
        self.placement = Placement.KNOWN
        self.is_released = False
        self._clock = CallerClock()

    @property
    def motion(self) -> Motion:
        """How the robot moves."""
        return self.point_ik.gate.motion

    @property
    def q(self) -> Array:
        """Configuration last commanded, shape (nq,)."""
        return self.motion.q

    @property
    def time(self) -> float:
        """Instant of the last command, on the robot's clock [s]."""
        return self.point_ik.gate.time

    @property
    def moves_in_core(self) -> bool:
        """Whether the core can move the robot by itself from samples on."""
        solver = self.point_ik
        return solver.is_compiled and not (solver.options.tasks or self.is_released)

    # -- when a command is

    def when(self, dt: When | None, time: float | None) -> When:
        """Return when a command is that a caller gives one of these times for, or none.

        Raises:
            InvalidInputError: If they cannot be used.
        """
        if time is None:
            return self.usual_dt if dt is None else check_when(dt)
        expect(dt is None, "time", "either a time or a dt", value=time)
        return self._clock.instant(time, self.usual_dt, self.time)

    def note_time(self, time: float | None, when: When) -> None:
        """Note that a command was made at the instant that the caller gave, if any.

        Args:
            time: The instant on the caller's clock [s].
            when: What `when` returned for it.
        """
        if time is not None:
            self._clock.note(time, when, self.time)

    # -- commands

    def move(self, request: HandRequest, when: When) -> Stages:
        """Move the robot, which has one hand, as that asks; brake if it is disengaged."""
        targets = request.targets
        result = self.follow(targets, request.rest, when, request.speed)
        if not self.is_released:
            targets = structs.replace(targets, points=result.targets)
        return Stages.of(request.pose, targets, result)

    def follow(
        self, targets: Targets, rest: Array, when: When, speed: float
    ) -> IkResult:
        """Move the robot towards targets by the QP; brake if it is disengaged.

        Args:
            targets: The targets. The `wrist` of a robot with h hands has shape (h, 4, 4).
            rest: Joint positions that the QP's rest term pulls to [rad or m], shape (n,).
            when: When the command is.
            speed: Share of the speed limits at which the robot may move.
        """
        if self.is_released:
            return self.point_ik.hold(when)
        return self.point_ik.solve(
            targets.points,
            targets.wrist,
            when,
            rest=rest,
            tasks=targets.tasks,
            margins=targets.margins,
            regularisation=targets.regularisation,
            speed=speed,
        )

    def hold(self, when: When) -> IkResult:
        """Brake, and keep the posture."""
        return self.point_ik.hold(when)

    def views(
        self, make_targets: Callable[[list[Array], bool], Targets], hand: Hand
    ) -> core.StepViews:
        """Return what makes the objects of a core's step; see `step_views`."""
        return step_views(make_targets, hand, self.point_ik.gate.links)

    # -- between commands

    def set_motion(self, motion: Motion) -> None:
        """Go on from where something else has moved the robot; this does not set its clock back."""
        time = max(motion.time, self.time)
        self.point_ik.gate.motion = motion._replace(time=time)
        self.placement = Placement.KNOWN

    def reset(self, q: Array, placement: Placement = Placement.KNOWN) -> None:
        """Put the robot at a configuration (nq,), at rest."""
        self.point_ik.place(q)
        self.placement = placement
        self._clock.reset()

    def put_on_palm(self, q: Array) -> None:
        """Put the robot at the configuration of a reference (nq,), if it has no place yet."""
        if self.placement is Placement.UNKNOWN:
            self.point_ik.place(q)
            self.placement = Placement.KNOWN

    def replace_solver(self, point_ik: AnySolver) -> None:
        """Move by another solver, which has this motion."""
        self.point_ik = point_ik
