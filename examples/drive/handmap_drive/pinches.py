"""Where fingertips meet the thumb's: the second part of the ritual of `handmap tune`."""

from collections.abc import Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from handmap_qp.apps.offline.comparison import own_method, prepare_take
from handmap_qp.apps.offline.fidelity import CLOSED, OPEN
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands import THUMB, Hand
from handmap_qp.mapping import default_preset
from handmap_qp.se3 import Array
from handmap_qp.trackers import DEMO, read_recording
from .drive import APPROACH
from .fit import fit_encoders
from .joints import Tell
from .motion import Motion
from .space import EXACT, TUNED, Space
from .tuning import Joints, Tuning, tuned

_WAYS, _TRIES = 6, 40
"""Ways to close each pinch, and shifts of its joints that are tried for them."""
_SHIFT = 0.12
"""Standard deviation of the shifts [rad]."""
_DEEP = 0.008
"""How deep tips must be in each other at the end of a way by the model, to meet for sure [m]."""
_NEAR = 0.008
"""Gap from which on fingers close slowly [m]."""
_BEYOND = 0.8
"""How much farther than to the closed pinch fingers go until they meet, a share of the way."""
_FREE, _CLOSING = 2.0, 0.2
"""Speeds of fingers on free ways, and where they are going to meet [rad/s]."""
_TURNS = 5
"""Turns over which torques count."""


class Pinch(NamedTuple):
    """A finger that can meet the thumb.

    Attributes:
        finger: The finger.
        opened: Where it is open [rad], shape (n,); the line from home is free.
        ways: Ways to close it: where each begins, where tips are near, and beyond where they meet
            [rad], shape (3, n).
    """

    finger: str
    opened: Array
    ways: list[Array]


def plan_pinches(space: Space, tuning: Tuning, effort: float) -> list[Pinch]:
    """Return pinches of the package's recording, as they are mapped to the hand as it was found.

    Args:
        space: Where the hand can go.
        tuning: How it was found.
        effort: Limit of the torque.
    """
    # A finger that is pushed goes through its play, which must not lead out of its range.
    spec = tuned(space.hand.spec, tuning, effort)
    hand = Hand(spec, mount="fixed")
    meter = GapMeter(hand)
    random = np.random.default_rng(0)
    limits = hand.limits[:, space.own]
    recording = read_recording(DEMO, hand.side)
    take = prepare_take(recording, hand.side)
    method = own_method(default_preset(take.human, hand))
    q = method.map_take(take, hand).q

    def ways(finger: str, opened: Array, shut: Array, moves: Array) -> Iterator[Array]:
        shares = np.linspace(0.0, 1.0 + _BEYOND, 200)[:, None]
        for shift in random.normal(0.0, _SHIFT, (_TRIES, len(moves))):
            line = opened + shares * (shut - opened) + moves * shift
            way = np.clip(line, *limits)
            postures = space.posture(way)
            gaps = meter.pinches(postures)[finger]
            near = np.argmax(gaps < _NEAR)
            if (
                gaps.min() < -_DEEP
                and space.is_free(opened, way[0], TUNED)
                and space.is_free(way[0], way[near], EXACT)
            ):
                yield way[[0, near, -1]]

    pinches = []
    for finger, gaps in meter.pinches(q).items():
        closed = np.flatnonzero(gaps < CLOSED)
        if not closed.size:
            continue
        end = closed[closed.size // 2]
        before = np.flatnonzero(gaps[:end] > OPEN)
        start = before[-1] if before.size else 0
        # Other fingers stay out of the way.
        moves = space.chain(THUMB) | space.chain(finger)
        mapped = q[[start, end]][:, space.own]
        opened, shut = np.where(moves, mapped, space.home)
        if space.is_free(space.home, opened, TUNED):
            found = islice(ways(finger, opened, shut, moves), _WAYS)
            pinches.append(Pinch(finger, opened, [*found]))
    return pinches


def meet(
    motion: Motion, space: Space, joints: Joints, pinches: list[Pinch], tell: Tell
) -> list[tuple[str, Array]]:
    """Close pinches until both tips feel it; return which met, and all joints there [rad]."""
    met = []
    motion.go(space.home, APPROACH)
    for k, pinch in enumerate(pinches):
        tell(70.0 + 30.0 * k / len(pinches), f"thumb and {pinch.finger}")
        chains = space.chain(THUMB), space.chain(pinch.finger)

        def is_pressed(chains: tuple[Array, ...] = chains) -> bool:
            q, torque = motion.mean(_TURNS)
            is_more = joints.meet(torque, space.weights(q[None])[0])
            # The thumb may meet another finger.
            return all(is_more[chain].any() for chain in chains)

        motion.go(pinch.opened, _FREE)
        for first, near, beyond in pinch.ways:
            motion.go(first, _FREE)
            motion.go(near, _FREE)
            motion.rest()
            if motion.go(beyond, _CLOSING, until=is_pressed):
                q, _ = motion.rest()
                met.append((pinch.finger, space.posture(q)))
            motion.go(first, _FREE)
            motion.go(pinch.opened, _FREE)
        motion.go(space.home, _FREE)
    return met


def with_encoders(
    space: Space, joints: Joints, met: list[tuple[str, Array]]
) -> tuple[Joints, dict[str, float]]:
    """Return the joints with their encoders' errors, and by finger the gap that they tell [m]."""
    errors, gaps = fit_encoders(space.hand, met)
    error = errors[space.own]
    # In the limits by the encoder, and by its error too.
    lower = joints.lower + np.maximum(error, 0.0)
    upper = joints.upper + np.minimum(error, 0.0)
    fingers = np.array([finger for finger, _ in met])
    off = {}
    for name, _ in met:
        mean = gaps[fingers == name].mean()
        off[name] = round(float(mean), 4)
    return joints._replace(encoder=error, lower=lower, upper=upper), off
