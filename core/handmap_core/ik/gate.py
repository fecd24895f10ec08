"""The gate: every displacement of a robot passes it, whoever asks.

Following, holding, stopping, slewing, both hands of a robot and grips all move the robot through
it. What it admits, and why a stop is always possible behind that, is in `handmap/gate.hpp`.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Generic, Protocol, TypeVar

from handmap_core.core import core
from handmap_core.hands import Hand, Names
from handmap_core.models import BoxLimits, CollisionModel, encoded
from handmap_core.se3 import Array
from .limits import box_limits
from .motion import Interval, Motion, When
from .options import IkOptions, ik_model

if TYPE_CHECKING:
    from handmap_core import _core

Rows = tuple[Array, Array]
"""G, shape (r, n), and h, shape (r,), of `G x <= h`."""


class PairBounds(Protocol):
    """What never changes of pairs of shapes that are kept apart."""

    def __hash__(self) -> int:
        """Two are equal only if they are the same one."""

    @property
    def core(self) -> _core.PairBounds:
        """The core's own."""

    @property
    def links(self) -> tuple[Names, ...]:
        """Links of both shapes of each pair; at -1, there are none."""

    def moving_columns(self, spread: Array) -> Array:
        """Return which active coordinates move shapes against each other, shape (k,)."""


class Collisions(Protocol):
    """Pairs of shapes that are kept apart, and how."""

    @property
    def bounds(self) -> PairBounds:
        """The pairs."""

    @property
    def model(self) -> CollisionModel:
        """How they are kept apart."""


def moving_columns(levers: Array, spread: Array) -> Array:
    """Return which active coordinates move the shapes of any pair against each other, shape (k,).

    Args:
        levers: `PairsModel.levers`, shape (p, nv).
        spread: `Hand.spread`, shape (nv, k).
    """
    return (levers > 0.0).any(axis=0) @ (spread != 0.0)


Kept = TypeVar("Kept", bound=Collisions)


@lru_cache(maxsize=32)
def _limits_of(hand: Hand, options: IkOptions, bounds: PairBounds | None) -> BoxLimits:
    """Return the limits of a hand that keeps pairs of shapes apart; people share them."""
    together = None if bounds is None else bounds.moving_columns(hand.spread)
    return box_limits(hand, options, together)


class Gate(Generic[Kept]):
    """Owns the motion of a robot and its time, and admits its displacements.

    Args:
        hand: The robot.
        motion: How it moves; it may come from the gate of another limit.
        options: Say whether speed limits hold, and limit the acceleration.
        collisions: Pairs of shapes to keep apart; none if omitted.

    Attributes:
        hand: As given.
        options: As given.
        limits: Of position, speed and acceleration.
        collisions: As given.
        links: Links of each pair; at -1, there are none.
        core: The gate of the compiled core, which decides.
    """

    core: _core.Gate

    def __init__(
        self,
        hand: Hand,
        motion: Motion,
        options: IkOptions = IkOptions(),
        collisions: Kept | None = None,
    ) -> None:
        self.hand = hand
        self.collisions = collisions
        bounds = collisions.bounds if collisions else None
        self.limits = _limits_of(hand, options, bounds)
        self.links: tuple[Names, ...] = collisions.bounds.links if collisions else ((),)
        self.options = options
        self.core = self._make_core()
        self.motion = motion

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy goes on from, with a workspace of its own."""
        state = {**vars(self), "motion": self.motion}
        del state["core"]
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Go on as a copy."""
        motion = state.pop("motion")
        vars(self).update(state)
        self.core = self._make_core()
        self.motion = motion

    def _make_core(self) -> _core.Gate:
        """Return the core's gate of this robot."""
        limits = encoded(self.limits)
        return core.Gate(self.hand.tree, limits, *self._pairs())

    def _pairs(self) -> tuple[_core.PairBounds | None, bytes | None]:
        """Return the pairs that the core keeps apart, and how; None for none."""
        if self.collisions is None:
            return None, None
        return self.collisions.bounds.core, encoded(self.collisions.model)

    @property
    def motion(self) -> Motion:
        """How the robot moves: a copy, which writing to does not change."""
        return Motion(*self.core.motion)

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self.core.set_motion(*motion)

    @property
    def time(self) -> float:
        """Instant of the last command, on the robot's clock [s]."""
        return self.core.time

    @property
    def commands(self) -> int:
        """How many commands have passed this gate, or that whose motion it has taken over."""
        return self.core.commands

    @property
    def stamp(self) -> int:
        """A number that no other command of this process has, of any robot."""
        return self.core.stamp

    @property
    def held_by(self) -> int:
        """Index of the pair of shapes that held the last displacement back; -1 if none did."""
        return self.core.held_by

    def follow(self, leader: Gate) -> None:
        """Take over the motion of another gate of the same robot."""
        self.core.follow(leader.core)

    def moves_as(self, other: Gate) -> bool:
        """Tell whether both gates have the motion of one and the same command."""
        return self.core.stamp == other.core.stamp

    def place(self, q: Array) -> None:
        """Put the robot at a configuration of Pinocchio, shape (nq,), at rest.

        Its clock goes on.
        """
        self.motion = Motion.at_rest(q, self.limits.size, self.time)

    def interval(self, when: When) -> Interval:
        """Return the time of the next command; `SHORTEST_DT` if it is not later than the last."""
        return Interval(*self.core.interval(when))

    def bounds(self, when: When, share: float = 1.0) -> Array:
        """Return the lower and upper bounds of the next displacement, shape (2, nv).

        Args:
            when: When the next command is.
            share: Share of the speed limits to use, as far as braking allows.
        """
        return self.core.bounds(when, share)

    def rows(
        self, when: When, lower: Array, upper: Array, margins: Array | None = None
    ) -> _core.PosedRows | None:
        """Return the rows of a QP that is posed elsewhere; None if no shapes are kept apart.

        Args:
            when: When the next command is.
            lower: Lower bounds of its displacement, shape (nv,).
            upper: Upper bounds, likewise.
            margins: Distance that each pair keeps [m], shape (k,); the hand's own if omitted.
        """
        if self.collisions is None:
            return None
        return core.PosedRows(self.core, when, lower, upper, margins)

    def admit(
        self,
        wanted: Array,
        first: Array,
        when: When,
        rows: _core.PosedRows | None = None,
        around: Callable[[Rows], Array] | None = None,
    ) -> Array:
        """Move the robot by a displacement, or by another one that is admitted.

        Args:
            wanted: Displacement in the active coordinates, shape (nv,).
            first: Another one that is shortened if the wanted one is not admitted, likewise.
            when: When the command is.
            rows: What `rows` returned for this command; goes with `around`.
            around: Finds another one in place of both, of rows G and h which keep apart what meets
                on the line of the wanted one.

        Returns:
            The displacement taken: `wanted` itself if it is admitted.
        """
        if rows and around:
            return rows.admit(wanted, first, around)
        return self.core.admit(wanted, first, when)

    def brake(self, when: When) -> Array:
        """Take the stop that was admitted last, for one command; return the displacement."""
        return self.core.brake(when)

    def advance(
        self, goal: Array, when: When, share: float = 1.0, *, stops: bool = False
    ) -> bool:
        """Move towards a configuration as far as is admitted; return whether it is reached.

        Where links are kept apart, they slide along each other instead of meeting.

        Args:
            goal: Pinocchio configuration, shape (nq,).
            when: When the command is.
            share: Share of the speed limits to use.
            stops: Whether the robot must be able to stop there at once.

        Returns:
            False, and the robot brakes, if the configuration is not finite.
        """
        return self.core.advance(goal, when, share, stops)


class IkGate(Gate[Kept]):
    """The gate of a hand that the core's QPs move, too."""

    # Nothing else than `_make_core` sets it.
    core: _core.Ik  # ty: ignore[incompatible-mutable-override]

    def _make_core(self) -> _core.Ik:
        """Return the core's `Ik` of this hand, which is a gate."""
        options = encoded(ik_model(self.hand, self.options))
        limits = encoded(self.limits)
        return core.Ik(self.hand.tree, options, limits, *self._pairs())
