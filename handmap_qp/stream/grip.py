"""`GripFollower`: what a thumb and a finger have met is held by a posture and a force.

A pinch that closes around an object asks for pads that touch, as it does without one: the object is
pushed along, and slips. So where the measured gap of the pads stays behind the commanded one, the
measured joints of both fingers are kept, and closing on becomes torques that press along the line
between the pads. The QP pulls to joint positions that press so: its limits hold.

Where it is known at which place the object is, both pads close around it, so that none of them
pushes it away before the other one is there.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any, NamedTuple

import numpy as np
from msgspec import structs
from numpy.typing import ArrayLike

from handmap_qp.errors import expect
from handmap_qp.hands import THUMB, Configuration, PadPair
from handmap_qp.human import HumanSample
from handmap_qp.ik import AttachedPoints, JointPositions, Task, TaskRows
from handmap_qp.mapping import MapStep, Stages, robot_fingers
from handmap_qp.options import Options, Positive
from handmap_qp.se3 import Array, as_floats, lengths, unit
from .follower import Follower, map_with

# Weights that leave other terms little: of a held joint [1/rad], of pads that stay apart, and of
# their middle [1/m].
_HELD = 3000.0
_APART = 6000.0
_CENTRED = 1000.0
# Share of a pinch from which on a person grips, and at which pads close around an object.
_PINCHING = 0.5
_CLOSING = 0.1
# Pads that close feel how far they may go this far before [m]. They go no faster than that depth in
# this time, by which joints are late [s], and have met something where this share is behind.
_EDGE = 0.005
_LATE = 0.07
_BEHIND = 0.5
# Pads so near an object close around it, and do so least at twice the distance [m].
_NEAR = 0.05
# Pads beside an object would push it away. Their gap is at least so many times the distance of
# their middle from it, but no more than this [m], and less and less for this time [s].
_FUNNEL = 4.0
_WIDE = 0.06
_PATIENCE = 0.4
# Pads that move no faster than this for so long have met something [m/s, s].
_STILL = 0.03
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
    """

    stiffness: Positive = 3.0
    force: Positive = 5.0
    gentle: bool = False
    behind: Positive = 0.01
    opens_by: Positive = 0.008


class _Closers(NamedTuple):
    """The thumb and a finger of a hand, by their pads."""

    points: AttachedPoints  # the middles of both
    pads: PadPair
    columns: Array  # columns of q that move both fingers, shape (c,)

    def gap(self, hand: Configuration) -> float:
        """Return the distance between their surfaces, < 0 for pads in each other [m]."""
        return self.pads.gap(self.points.positions(hand))

    def middle(self, hand: Configuration) -> Array:
        """Return the point midway between their surfaces [m], shape (3,)."""
        return self.pads.middle(self.points.positions(hand))

    def slopes(self, hand: Configuration) -> tuple[Array, Array]:
        """Return the derivatives of the gap, shape (nv,), and of the middle, shape (3, nv)."""
        places = self.points.positions(hand)
        thumb, finger = self.points.jacobians(hand)
        gap = unit(places[1] - places[0]) @ (finger - thumb)
        return gap, (thumb + finger) / 2.0


class _ClosingPads(NamedTuple):
    """Keeps two pads apart, and by their own joints the middle between them at a place."""

    pads: _Closers  # the pads
    own: Array  # whether each column of the velocity moves one of both fingers, shape (nv,)
    centre: Array  # the place [m], shape (3,)
    least: float  # the least gap [m]
    share: float  # share of the weights

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return three rows of the middle, and one of the gap; see `Task.linearise`."""
        more = self.pads.gap(hand) - self.least
        gap, middle = self.pads.slopes(hand)
        near = np.clip(1.0 - more / _EDGE, 0.0, 1.0)
        weights = self.share * np.append(np.full(3, _CENTRED), near * _APART)
        off = np.append(self.pads.middle(hand) - self.centre, min(more, 0.0))
        rows = np.vstack([middle * self.own, gap])
        return TaskRows(weights * off, weights[:, None] * rows)


class _Closing(NamedTuple):
    """Pads that close, and may meet something."""

    finger: int = -1  # number of the finger, in the order of the pinches
    gap: float = 0.0  # measured gap of the pads [m]
    least: float = 0.0  # least gap that presses with no more than the force [m]
    time: float = 0.0  # for how long the person has pinched [s]
    met: float = 0.0  # time since they have met something [s]


class _Grip(NamedTuple):
    """What is held."""

    finger: int  # number of the finger, in the order of the pinches
    columns: Array  # columns of q that move thumb and finger, shape (c,)
    posture: Array  # measured joint positions at the touch [rad], shape (n,)
    levers: Array  # torque of each joint for 1 N between the pads [m], shape (n,)
    force: float  # force that the command had there [N]
    gap: float  # smallest gap of the person's fingers since then [m]
    time: float = 0.0  # time since then [s]
    opening: float = 0.0  # share of the way out, from 0 to 1


class GripFollower:
    """Lets a follower hold what thumb and finger grip, by the measured joints of the robot.

    It is for one hand and the preset `teleoperation`. Without an object, it follows as before.

    Args:
        follower: Follows the samples.
        grip: How what is gripped is held.

    Attributes:
        follower: As given.
        grip: As given.

    Raises:
        InvalidInputError: If `grip` is something else, it is for another preset, or the robot has
            no thumb that turns to a finger.
    """

    def __init__(self, follower: Follower, grip: GripOptions | None = None) -> None:
        self.follower = follower
        self.grip = own = grip or GripOptions()
        expect(isinstance(own, GripOptions), "grip", "a GripOptions", value=own)
        self._mapper = mapper = follower.mapper
        self._hand = hand = mapper.robot
        fingers = robot_fingers(hand)
        names = fingers.names
        has_pinch = (
            hasattr(mapper.method, "pinch_weight")
            and THUMB in names
            and len(names) > 1
            and not fingers.has_jaws
        )
        wanted = "a hand that `teleoperation` moves, whose thumb turns to a finger"
        expect(has_pinch, "follower", wanted, value=hand.name)
        pads = [fingers.pads[name] for name in names]
        used = [fingers.used[name].columns for name in names]
        self._pairs = [
            _Closers(
                AttachedPoints(hand, [pads[0].place, pad.place]),
                PadPair(pads[0], pad),
                np.union1d(used[0], columns),
            )
            for pad, columns in zip(pads[1:], used[1:], strict=True)
        ]
        self._placed = hand.configuration()
        self._let_go()

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    def map_sample(
        self,
        sample: HumanSample,
        measured_q: ArrayLike,
        object_centre: ArrayLike | None = None,
        **times: Any,
    ) -> MapStep:
        """Map one sample of a tracker; see `Follower.map_sample`.

        Args:
            sample: The sample.
            measured_q: Joint positions that the robot has now [rad or m], shape (n,): read anew
                for each sample.
            object_centre: Middle of the object in the robot's world [m], shape (3,), if it is
                known: pads that close near it meet around it. The wrist does not go there.
            **times: `dt` and `arrival` [s].

        Returns:
            The step; its command has the `effort` of a grip.

        Raises:
            InvalidInputError: As there, or if a number here cannot be used.
            InvalidOptionsError: As there, or if the method has no pinches.
        """
        shape = self._hand.rest.shape
        q = as_floats(measured_q, "measured_q", shape=shape, is_finite=True)
        if object_centre is not None:
            object_centre = as_floats(
                object_centre, "object_centre", shape=(3,), is_finite=True
            )
        if self._mapper.reference is not self._reference:
            self._let_go()
        step = map_with(self.follower, self._terms, sample, **times)
        if step.status not in ("held", "released"):
            self._advance(step, q, object_centre)
        if self._grip is None:
            return step
        effort = self._torques(self._grip)
        command = structs.replace(step.command, effort=effort)
        stages = Stages(step.stages.pose, step.asked, step.ik, command)
        return structs.replace(step, stages=stages)

    def _let_go(self) -> None:
        """Grip nothing."""
        self._grip: _Grip | None = None
        self._closing = _Closing()
        # Whether the person's fingers have been apart since: only then they grip.
        self._is_apart = False
        self._reference = self._mapper.reference
        self._terms: tuple[Task, ...] = ()

    def _advance(self, step: MapStep, q: Array, centre: Array | None) -> None:
        """Go on with a grip, or see whether there is one."""
        dt = self._mapper.motion.dt
        gaps = step.named("gaps")
        self._terms = ()
        if self._grip is None:
            self._close(step, q, gaps, centre, dt)
        else:
            self._grip = self._held(self._grip, gaps, dt)
        grip = self._grip
        if grip is None:
            return
        if grip.opening >= 1.0:
            self._let_go()
            return
        positions = grip.posture + self._torques(grip) / self.grip.stiffness
        weight = _HELD * (1.0 - grip.opening) ** 2
        held = JointPositions(self._hand, grip.columns, positions, weight)
        self._terms = (held,)

    def _close(
        self, step: MapStep, q: Array, gaps: Array, centre: Array | None, dt: float
    ) -> None:
        """Close pads, around a place if it is known, until they have met something."""
        finger = int(gaps.argmin())
        pinching = step.named("pinching")[finger]
        self._is_apart |= pinching <= _PINCHING
        if pinching <= 0.0:
            self._closing = _Closing()
            return
        pads = self._pairs[finger]
        # Where the hand is, by its measured joints; then where it is commanded.
        placed = self._placed
        # A fixed hand takes no wrist.
        wrists = step.ik.wrists[: self._hand.is_floating]
        placed.place(self._hand.configuration_vector(q, *wrists))
        gap = pads.gap(placed)
        middle = pads.middle(placed)
        slopes, _ = pads.slopes(placed)
        levers = -slopes[self._hand.joint_columns]
        stiffness = self.grip.stiffness
        # How far the command is in what the pads meet, where they press with the force.
        depth = self.grip.force / stiffness * (levers @ levers)
        placed.place(step.ik.q)
        commanded = pads.gap(placed)
        before = self._closing
        if finger != before.finger:
            before = _Closing(finger, np.inf, commanded, before.time)
        # Not at once: joints that are late would let it jump.
        pressing = max(gap - depth, before.least - depth * dt / _LATE)
        least = pressing if self.grip.gentle else -np.inf
        behind = self.grip.behind
        if self.grip.gentle:
            behind = min(behind, _BEHIND * depth)
        if centre is not None:
            beside = min(_FUNNEL * lengths(middle - centre), _WIDE)
            least = max(least, beside * (1.0 - before.time / _PATIENCE))
            share = min(pinching / _CLOSING, 1.0)
            self._terms = self._around(pads, centre, least, share)
        is_met = (
            pinching > _PINCHING
            and self._is_apart
            and abs(gap - before.gap) < _STILL * dt
            and gap - commanded > behind
        )
        met = is_met * (before.met + dt)
        time = before.time + dt * (pinching > _PINCHING)
        self._closing = _Closing(finger, gap, pressing, time, met)
        if met >= _TOUCHED:
            pressed = stiffness * levers @ (step.command.q - q)
            force = np.clip(pressed / (levers @ levers), 0.0, self.grip.force)
            self._grip = _Grip(finger, pads.columns, q, levers, force, gaps[finger])

    def _around(
        self, pads: _Closers, centre: Array, least: float, share: float
    ) -> tuple[Task, ...]:
        """Return the term by which pads close around a place, if the command is near it."""
        hand = self._placed
        off = lengths(pads.middle(hand) - centre)
        near = np.clip(2.0 - off / _NEAR, 0.0, 1.0)
        own = np.isin(np.arange(hand.nv), self._hand.joint_columns[pads.columns])
        term = _ClosingPads(pads, own, centre, least, near * share)
        return (term,) if near > 0.0 else ()

    def _held(self, grip: _Grip, gaps: Array, dt: float) -> _Grip:
        """Return a grip after a sample of the person's gaps."""
        gap = gaps[grip.finger]
        way = dt if gap > grip.gap + self.grip.opens_by else -dt
        return grip._replace(
            gap=min(grip.gap + _FORGETS * dt, gap),
            time=grip.time + dt,
            opening=max(grip.opening + way / _LET_GO, 0.0),
        )

    def _torques(self, grip: _Grip) -> Array:
        """Return the torques with which a grip presses [N m], shape (n,)."""
        share = min(grip.time / _RAISED, 1.0)
        force = grip.force + share * (self.grip.force - grip.force)
        return (1.0 - grip.opening) * force * grip.levers
