"""A hand in this process that does not do what it is commanded: `--driver simulated`."""

from itertools import compress
from pathlib import Path

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands import (
    Names,
    ShapePairs,
    all_pairs,
    load_hand,
    pair_ends,
    paired,
)
from handmap_qp.ik import Gate, Motion
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.reference import solve_by_daqp
from handmap_qp.se3 import Array
from .driver import Health
from .tuning import SIDES, Delayed

_DELAY = 0.12
"""The longest delay [s]."""
_COUNT = 2.0 * np.pi / 4096
"""Resolution of encoders [rad]."""
_NOISE = 0.002
"""Noise of torques, a share of the largest."""
_FARTHEST = np.pi
"""No joint turns farther at once [rad]."""


class Simulated:
    """Joints with hidden parameters; attributes as in `Driver`, and arrays of each joint.

    A turn of the drive, `goal = gain u(t - delay) + zero`, pulls its joint by a tendon with play:
    `effort = dead(goal - q, backlash / 2) / stretch`. The joint moves where that is more than its
    friction, as far as its stops and the contacts of thumb and fingers let it. Encoders are at the
    joints, and err by `encoder`. Each `write` is a turn of `1 / rate` seconds.

    Args:
        port: Name of a hand or its hand.yaml, and a seed, as in `leap_right:3`.
        joints: Joints of the session.
        file: Not used.

    Attributes:
        gain: Angle by which a joint moves per angle that it is commanded.
        zero: Where it is when it is commanded to be at 0 [rad].
        delay: Time from a command to its turn [s].
        backlash: Play of the tendon [rad].
        stretch: Of the tendon, by the largest torque [rad].
        friction: Torque below which the joint stands still.
        sticks: Friction of a joint that stands still, by that of one that moves.
        exponent: Tendons are longer by this power of the torque.
        encoder: What encoders miss of the joints [rad].
        stops: Where joints stop, as encoders tell it [rad], shape (2, n).
        q: Where joints are, as encoders tell it [rad].
    """

    rate = 100.0
    speed = 6.0
    effort = 0.3
    sticks = exponent = 1.0

    def __init__(self, port: str, joints: Names, file: Path | None = None) -> None:
        name, _, seed = port.rpartition(":")
        expect(seed.isdecimal(), "--port", "HAND:SEED of a simulated hand", value=port)
        self._hand = hand = load_hand(name, mount="fixed")
        self.joint_names = tuple(n for n in hand.joint_names if n in joints)
        self._own = own = [*map(hand.joint_names.index, self.joint_names)]
        self.range = hand.limits[:, own]
        shapes, fingers, *_ = all_pairs(hand)
        pinching = paired(shapes, [*compress(pair_ends(shapes), fingers)])
        at_rest = hand.configuration_vector(hand.rest)
        self._gate = Gate(
            hand,
            Motion.at_rest(at_rest, len(hand.active_columns)),
            collisions=CollisionLimit(hand, ShapePairs(pinching, ())),
        )
        self._touching = np.zeros(len(self._gate.links) - 1)
        self._random = random = np.random.default_rng(int(seed))
        n = len(own)
        self.gain = random.uniform(0.8, 1.1, n)
        self.zero = random.uniform(-0.02, 0.02, n)
        self.delay = random.uniform(0.02, _DELAY, n)
        self.backlash = np.radians(random.uniform(2.0, 4.0, n))
        self.stretch = random.uniform(0.1, 0.4, n)
        self.friction = random.uniform(0.03, 0.08, n)
        self.encoder = random.uniform(-0.025, 0.025, n)
        width = np.diff(self.range, axis=0)
        shares = random.uniform(-0.05, 0.05, (2, n))
        self.stops = self.range + shares * width
        self.q = np.clip(hand.rest[own], *self.stops)
        self._delayed = Delayed(self.delay * self.rate, self.q)
        self._torque = np.zeros(n)
        self._moves = np.zeros(n, bool)

    @property
    def posture(self) -> Array:
        """Where all joints of the hand are in truth [rad]."""
        posture = self._hand.rest.copy()
        posture[self._own] = self.q + self.encoder
        return posture

    def connect(self) -> None:
        """See `Driver`."""

    def read(self) -> tuple[Array, Array, Health]:
        """See `Driver`."""
        n = len(self.q)
        q = np.round(self.q / _COUNT) * _COUNT
        noise = _NOISE * self._random.standard_normal(n)
        health = Health(np.full(n, 30.0), ())
        return q, self._torque + noise, health

    def write(self, q: Array, effort: float) -> None:
        """See `Driver`."""
        goal = self.turned(q)
        half = 0.5 * self.backlash
        longest = self.stretch * self.effort
        held = np.where(self._moves, 1.0, self.sticks) * self.friction
        # Joints stand still between these torques.
        ends = self.load() + SIDES * held
        slack = np.copysign(half, ends)
        least, most = slack + longest * _power(ends / self.effort, self.exponent)
        free = np.clip(self.q, goal - most, goal - least)
        free = np.where(effort > np.abs(ends).max(axis=0), free, self.q)
        step = self._allowed(free - self.q)
        self.q = self.q + step
        self._moves = step != 0.0
        pull = goal - self.q
        tight = pull - np.clip(pull, -half, half)
        torque = self.effort * _power(tight / longest, 1.0 / self.exponent)
        self._torque = np.clip(torque, -effort, effort)

    def turned(self, q: Array) -> Array:
        """Return where drives are that were commanded to go to q, in the joints' angles [rad]."""
        return self.gain * self._delayed(q) + self.zero

    def load(self) -> Array:
        """Return the torques that hold the joints against weights."""
        return np.zeros(len(self.q))

    def _allowed(self, step: Array) -> Array:
        """Return the step that stops and tips leave, each joint as its tendon gives way [rad]."""
        gate = self._gate
        gate.place(self._hand.configuration_vector(self.posture))
        most = np.full(gate.limits.size, _FARTHEST)
        posed = gate.rows(1.0 / self.rate, -most, most, self._touching)
        assert posed is not None
        nearing, apart = posed.behind(np.zeros(len(most)))
        rows = nearing[:, self._hand.joint_columns[self._own]], apart
        lower, upper = self.stops - np.clip(self.q, *self.stops)
        stiffness = np.diag(1.0 / self.stretch)
        found = solve_by_daqp(stiffness, -step / self.stretch, lower, upper, rows)
        return np.zeros_like(step) if found is None else found

    def stop(self) -> None:
        """See `Driver`."""
        self._torque = np.zeros(len(self.q))


def _power(values: Array, exponent: float) -> Array:
    """Return powers with the values' signs."""
    return np.copysign(np.abs(values) ** exponent, values)
