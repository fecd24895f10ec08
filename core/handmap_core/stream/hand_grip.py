"""`HandGrip`: what the thumb and a finger of one hand have met is held by a posture and a force.

A pinch that closes around an object asks for pads that touch, as it does without one: the object is
pushed along, and slips. So where the measured gap of the pads stays behind the commanded one, the
measured joints of both fingers are kept, and closing on becomes torques that press along the line
between the pads. The QP pulls to joint positions that press so: its limits hold.

Where it is known at which place the object is, both pads close around it, so that none of them
pushes it away before the other one is there: as far as the place is certain. Those of thumb and
first finger gather around it while the person's fingers are still open, because a closing lasts
some 0.2 s, and is over before slow joints have moved both pads there. In the open hand they gather
along the line between them alone: they come from elsewhere to where they meet, and bringing them to
the place across that line stretches the fingers, so that other links push the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from handmap_core.hands import (
    SLIDING_STIFFNESS,
    STIFFNESS,
    GraspFinger,
    Hand,
    PadPair,
)
from handmap_core.ik import AttachedPoints, JointPositions, Task
from handmap_core.mapping import MapStep
from handmap_core.mapping.bound_method import BoundMethod
from handmap_core.mapping.target_source import TargetSource
from handmap_core.mapping.teleoperation import BoundTeleoperation
from handmap_core.options import Options, Positive
from handmap_core.se3 import Array, lengths, unit
from .closing_pads import ClosingPads, FingerPads, PadsState
from .object_place import ObjectPlace

# Weights of a held joint, which leave other terms little, of one that turns [1/rad] and of one that
# slides [1/m]: both are as strict where a pad is 50 mm from its joint.
_HELD = 3000.0
_HELD_SLIDING = 6e4
# A person pinches where thumb and finger are nearer than the first gap, and has an open hand from
# the second one on [m]. Shares of a method's pinch rows do not tell: rows may act on wider gaps,
# those of jaws on any.
_PINCHED, _OPENED = 0.045, 0.07
# As the gap of the person's fingers falls from the first to the second of these [m], pads gather
# around a known place along their line: both are wider than any object that they could grip. Across
# the line they come to the place as the gap falls from there to `_OPENED`.
_GATHER_FROM, _GATHERED = 0.13, 0.1
# Pads that close feel how far they may go. They go no faster than that depth in this time, by which
# joints are late [s], and have met something where this share is behind.
_LATE = 0.07
_BEHIND = 0.5
# Pads so near an object close around it, and do so least at twice the distance [m].
_NEAR = 0.05
# Pads beside an object would push it away. Their gap is at least so many times the distance of
# their middle from it, but no more than this [m], and less and less for this time [s]. Distances
# count beyond so many standard deviations of the place.
_FUNNEL = 4.0
_WIDE = 0.06
_PATIENCE = 0.4
_CERTAIN = 2.0
# Pads whose gap stays within this for so long have met something [m, s]. An object that they push
# along on the way lets the gap tremble from sample to sample.
_STILL = 0.003
_TOUCHED = 0.1
# Time over which a force is raised, and a grip is let go [s].
_RAISED = 0.1
_LET_GO = 0.1
# A grip forgets the smallest gap of the person's fingers this fast [m/s]: trackers tremble.
_FORGETS = 0.02


class GripOptions(Options, frozen=True):
    """How what is gripped is held.

    Attributes:
        stiffness: Stiffness of the fingers' position control [N m/rad].
        force: Force with which thumb and finger press [N].
        gentle: Whether pads close no farther, near an object whose place is known, than presses
            with the force. That makes them slow, too: for what breaks.
        behind: How far the measured gap of the pads stays behind the commanded one where they have
            met something [m]; at most half of what presses with the force if they close gently.
        opens_by: How much farther apart than in the grip a person's fingers let go [m].
        sliding_stiffness: Stiffness of the position control of jaws that slide [N/m].
    """

    stiffness: Positive = STIFFNESS
    force: Positive = 5.0
    gentle: bool = False
    behind: Positive = 0.01
    opens_by: Positive = 0.008
    sliding_stiffness: Positive = SLIDING_STIFFNESS


class _Closing(NamedTuple):
    """Pads that close, and may meet something."""

    finger: int = -1  # number of the finger, in the order of the pinches
    gap: float = 0.0  # measured gap of the pads from which on they are still [m]
    least: float = 0.0  # least gap that presses with no more than the force [m]
    time: float = 0.0  # for how long the person has pinched [s]
    met: float = 0.0  # time since they have met something [s]


class Gathering(NamedTuple):
    """Shares of the weights by which pads come to a place, from 0 to 1.

    Attributes:
        along: Along the line between the pads.
        across: Of that, across the line.
    """

    along: float
    across: float


class _Grip(NamedTuple):
    """What is held."""

    finger: int  # number of the finger, in the order of the pinches
    columns: Array  # columns of q that move thumb and finger, shape (c,)
    posture: Array  # measured joint positions at the touch [rad or m], shape (n,)
    levers: Array  # torque of each joint for 1 N between the pads [m], shape (n,)
    force: float  # force that the command had there [N]
    gap: float  # smallest gap of the person's fingers since then [m]
    time: float = 0.0  # time since then [s]
    opening: float = 0.0  # share of the way out, from 0 to 1


AnySource = TargetSource[Hand, BoundMethod]


def has_pinches(source: AnySource) -> bool:
    """Return whether the method of a source has pinches, which a grip begins with."""
    return isinstance(source.bound, BoundTeleoperation)


def can_grip(source: AnySource, fingers: Sequence[GraspFinger]) -> bool:
    """Return whether a `HandGrip` can hold what the robot hand of a source meets.

    It can by a method with pinches, and a hand with a thumb and a finger, or two jaws.

    Args:
        source: Makes the targets of the hand.
        fingers: What grips; empty for a hand that has no thumb and no jaws.
    """
    return has_pinches(source) and len(fingers) > 1


class HandGrip:
    """Finds what thumb and finger meet by measured joints, and says how the QP holds it.

    Args:
        source: Makes the targets of the hand; see `can_grip`.
        fingers: What grips, the thumb first.
        options: How what is gripped is held.

    Attributes:
        options: As given; may be changed between samples.
        terms: Further terms of the QP's cost for the next sample.
        is_seen: Whether it is known where the object is now.
        place: Where it was seen last; None before that.
    """

    def __init__(
        self, source: AnySource, fingers: Sequence[GraspFinger], options: GripOptions
    ) -> None:
        self.options = options
        self._source = source
        self._hand = hand = source.robot
        thumb, *others = fingers
        self._pairs = [
            FingerPads(
                AttachedPoints(hand, [thumb.pad.place, finger.pad.place]),
                PadPair(thumb.pad, finger.pad),
                np.union1d(thumb.columns, finger.columns),
            )
            for finger in others
        ]
        self._slides = np.zeros(len(hand.joint_names), dtype=bool)
        for finger in fingers:
            self._slides[finger.columns] |= finger.is_jaw
        self._placed = hand.configuration()
        self._has_pinches = True
        self.let_go()

    @property
    def effort(self) -> Array | None:
        """Torques with which a grip presses [N m or N], shape (n,); None without one."""
        return None if self._grip is None else self._torques(self._grip)

    @property
    def is_idle(self) -> bool:
        """Whether nothing is held, closed or known: a sample without `q` changes nothing."""
        return (
            self._grip is None
            and self.place is None
            and self._closing.finger < 0
            and not self._is_apart
        )

    def let_go(self) -> None:
        """Grip nothing, and forget where the object is."""
        self._grip: _Grip | None = None
        self._closing = _Closing()
        self.is_seen = False
        self.place: ObjectPlace | None = None
        # Whether the person's fingers have been apart since: only then they grip.
        self._is_apart = False
        self._reference = self._source.reference
        self.terms: tuple[Task, ...] = ()

    def prepare(self) -> None:
        """Let go where the source has another reference, or a method without pinches by now."""
        source = self._source
        self._has_pinches = has_pinches(source)
        if source.reference is not self._reference or not self._has_pinches:
            self.let_go()

    def see(self, centre: Array, deviation: float) -> None:
        """Take where the object is.

        Args:
            centre: Middle of the object in the robot's world [m], shape (3,).
            deviation: Standard deviation of that along each axis [m].
        """
        self.is_seen = True
        if self.place is None:
            self.place = ObjectPlace.first(centre, deviation)
        else:
            self.place = self.place.at(centre, deviation)

    def advance(self, step: MapStep, q: Array | None, dt: float) -> None:
        """Go on with a grip, or see whether there is one.

        Args:
            step: The step of the hand, which was not held.
            q: Joint positions that were measured before it [rad or m], shape (n,); None where they
                were not read. What is held then stays held, and nothing else is met.
            dt: Time that its command took [s].
        """
        self.terms = ()
        if self._grip is None and q is None:
            self._closing = _Closing()
            return
        if not self._has_pinches:
            return
        gaps = step.named("gaps")
        if self._grip is not None:
            self._grip = self._held(self._grip, gaps, dt)
        elif q is not None:
            self._close(step, q, gaps, dt)
        grip = self._grip
        if grip is None:
            return
        if grip.opening >= 1.0:
            place = self.place
            self.let_go()
            # What was touched may be gripped again.
            self.place = place
            return
        positions = grip.posture + self._torques(grip) / self._stiffness
        weights = np.where(self._slides[grip.columns], _HELD_SLIDING, _HELD)
        weights = weights * (1.0 - grip.opening) ** 2
        self.terms = (JointPositions(self._hand, grip.columns, positions, weights),)

    @property
    def _stiffness(self) -> Array:
        """Stiffness of the joints [N m/rad or N/m], shape (n,)."""
        options = self.options
        return np.where(self._slides, options.sliding_stiffness, options.stiffness)

    def _close(self, step: MapStep, q: Array, gaps: Array, dt: float) -> None:
        """Close pads, around a place if it is known, until they have met something."""
        finger = int(gaps.argmin())
        is_pinching = bool(gaps[finger] < _PINCHED)
        is_opened = bool(gaps[finger] >= _OPENED)
        self._is_apart |= not is_pinching
        if is_opened:
            self._closing = _Closing()
            # Any tip may be the nearest in an open hand. People take things with the first finger.
            finger = 0
        gathering = self._gathering(gaps[finger])
        if is_opened and gathering.along == 0.0:
            return
        pads = self._pairs[finger]
        # Where the hand is, by its measured joints; then where it is commanded.
        placed = self._placed
        # A fixed hand takes no wrist.
        wrists = step.ik.wrists[: self._hand.is_floating]
        placed.place(self._hand.configuration_vector(q, *wrists))
        gap, middle, line = pads.state(placed)
        slopes, _ = pads.slopes(placed, line)
        levers = np.zeros_like(q)
        # An arm moves both pads alike, but for rounding.
        levers[pads.columns] = -slopes[self._hand.joint_columns[pads.columns]]
        # How far the command is in what the pads meet, where they press with the force.
        depth = self.options.force * (levers @ (levers / self._stiffness))
        placed.place(step.ik.q)
        commanded = pads.state(placed)
        before = self._closing
        if finger != before.finger:
            before = _Closing(finger, np.inf, commanded.gap, before.time)
        # Not at once: joints that are late would let it jump.
        pressing = max(gap - depth, before.least - depth * dt / _LATE)
        behind = self.options.behind
        if self.options.gentle:
            behind = min(behind, _BEHIND * depth)
        if self.is_seen and self.place is not None:
            least = max(
                pressing if self.options.gentle else -np.inf,
                _funnel(self.place, middle, before.time),
            )
            self.terms = self._around(pads, self.place, commanded, least, gathering)
        is_met = (
            is_pinching
            and self._is_apart
            and abs(gap - before.gap) < _STILL
            and gap - commanded.gap > behind
            and self._is_between(middle, line)
        )
        still, met = (before.gap, before.met + dt) if is_met else (gap, 0.0)
        time = before.time + dt * is_pinching
        self._closing = _Closing(finger, still, pressing, time, met)
        if met < _TOUCHED:
            return
        pressed = levers @ (self._stiffness * (step.command.q - q))
        force = np.clip(pressed / (levers @ levers), 0.0, self.options.force)
        self._grip = _Grip(finger, pads.columns, q, levers, force, gaps[finger])
        if self.is_seen and self.place is not None:
            self.place = self.place.touched(middle, line)

    def _is_between(self, middle: Array, line: Array) -> bool:
        """Return whether an object whose place is known may be between the pads.

        Args:
            middle: The measured middle between the pads [m], shape (3,).
            line: Direction from the thumb's pad to the finger's, shape (3,).
        """
        if not self.is_seen or self.place is None:
            return True
        return self.place.is_midway(middle, line)

    def _gathering(self, gap: float) -> Gathering:
        """Return how pads gather around an object.

        Args:
            gap: Gap of the person's fingers [m].
        """
        if not self.is_seen or self.place is None:
            return Gathering(0.0, 0.0)
        along = (_GATHER_FROM - gap) / (_GATHER_FROM - _GATHERED)
        across = (_GATHERED - gap) / (_GATHERED - _OPENED)
        return Gathering(*np.clip([along, across], 0.0, 1.0).tolist())

    def _around(
        self,
        pads: FingerPads,
        place: ObjectPlace,
        commanded: PadsState,
        least: float,
        gathering: Gathering,
    ) -> tuple[Task, ...]:
        """Return the term by which pads close around a place, if the command is near it.

        Args:
            pads: The pads.
            place: The place.
            commanded: Where the pads are commanded.
            least: Least gap of the pads [m].
            gathering: How they gather around it.
        """
        off = lengths(commanded.middle - place.centre)
        near = float(np.clip(2.0 - off / _NEAR, 0.0, 1.0))
        if near <= 0.0:
            return ()
        columns = self._hand.joint_columns[pads.columns]
        own = np.isin(np.arange(self._placed.nv), columns)
        shares = place.shares_beside(commanded.line, gathering.across)
        share = near * gathering.along
        return (ClosingPads(pads, own, place.centre, shares, least, share),)

    def _held(self, grip: _Grip, gaps: Array, dt: float) -> _Grip:
        """Return a grip after a sample of the person's gaps."""
        gap = gaps[grip.finger]
        way = dt if gap > grip.gap + self.options.opens_by else -dt
        return grip._replace(
            gap=min(grip.gap + _FORGETS * dt, gap),
            time=grip.time + dt,
            opening=max(grip.opening + way / _LET_GO, 0.0),
        )

    def _torques(self, grip: _Grip) -> Array:
        """Return the torques with which a grip presses [N m or N], shape (n,)."""
        share = min(grip.time / _RAISED, 1.0)
        force = grip.force + share * (self.options.force - grip.force)
        return (1.0 - grip.opening) * force * grip.levers


def _funnel(place: ObjectPlace, middle: Array, time: float) -> float:
    """Return the least gap of pads beside a place [m]; -inf for pads that may be around it.

    Args:
        place: Where the object is.
        middle: The measured middle between the pads [m], shape (3,).
        time: For how long the person has pinched [s].
    """
    away = middle - place.centre
    off = float(lengths(away)) - _CERTAIN * place.deviation_along(unit(away))
    if off <= 0.0:
        return -np.inf
    return min(_FUNNEL * off, _WIDE) * (1.0 - time / _PATIENCE)
