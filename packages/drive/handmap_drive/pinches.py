"""Where fingertips meet the thumb's: the second part of `handmap calibrate-actuators`."""

from collections.abc import Iterator
from functools import partial
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
from .fit import fit_encoders
from .gate import APPROACH
from .joints import Progress
from .motion import Motion
from .space import EXACT, TUNED, Space
from .tuning import Joints, Tuning, tuned

_WAYS = 6
"""Ways to close each pinch."""
_TRIES = 40
"""Shifts of its joints that are tried for them."""
_SHIFT = 0.12
"""Standard deviation of the shifts [rad]."""
_DEEP = 0.008
"""How deep tips must be in each other at the end of a way by the model, to meet for sure [m]."""
_NEAR = 0.008
"""Gap from which on fingers close slowly [m]."""
_BEYOND = 0.8
"""How much farther than to the closed pinch fingers go until they meet, a share of the way."""
_FREE = 2.0
"""Speed of fingers on free ways [rad/s]."""
_CLOSING = 0.2
"""Speed of fingers that are going to meet [rad/s]."""
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


def map_recording(hand: Hand, name: str) -> tuple[Array, Array]:
    """Map a recording to a hand by the default preset.

    Args:
        hand: The hand.
        name: The recording.

    Returns:
        Times of its samples [s], shape (T,), and joints [rad], shape (T, n).
    """
    recording = read_recording(name, hand.side)
    take = prepare_take(recording, hand.side)
    method = own_method(default_preset(take.human, hand))
    return take.recording.time, method.map_take(take, hand).q


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
    _, q = map_recording(hand, DEMO)

    def ways(finger: str, line: Array, moves: Array) -> Iterator[Array]:
        opened, *_ = line
        for shift in random.normal(0.0, _SHIFT, (_TRIES, len(moves))):
            way = np.clip(line + moves * shift, *limits)
            gaps = meter.pinches(space.posture(way))[finger]
            near = np.argmax(gaps < _NEAR)
            if (
                gaps.min() < -_DEEP
                and space.is_free(opened, way[0], TUNED)
                and space.is_free(way[0], way[near], EXACT)
            ):
                yield way[[0, near, -1]]

    shares = np.linspace(0.0, 1.0 + _BEYOND, 200)[:, None]
    pinches = []
    for finger, gaps in meter.pinches(q).items():
        closed = np.flatnonzero(gaps < CLOSED)
        if not closed.size:
            continue
        end = closed[closed.size // 2]
        start = max(np.flatnonzero(gaps[:end] > OPEN), default=0)
        # Other fingers stay out of the way.
        moves = space.chain(THUMB) | space.chain(finger)
        mapped = q[[start, end]][:, space.own]
        opened, shut = np.where(moves, mapped, space.home)
        if space.is_free(space.home, opened, TUNED):
            line = opened + shares * (shut - opened)
            found = islice(ways(finger, line, moves), _WAYS)
            pinches.append(Pinch(finger, opened, [*found]))
    return pinches


def meet(
    motion: Motion,
    space: Space,
    joints: Joints,
    pinches: list[Pinch],
    progress: Progress,
) -> list[tuple[str, Array]]:
    """Close pinches until both tips feel it; return which met, and all joints there [rad]."""

    def is_pressed(finger: str) -> bool:
        q, torque = motion.mean(_TURNS)
        is_more = joints.meet(torque, space.weights(q))
        # The thumb may meet another finger.
        return all(is_more[space.chain(each)].any() for each in (THUMB, finger))

    met = []
    motion.go(space.home, APPROACH)
    for k, (finger, opened, ways) in enumerate(pinches):
        progress(70.0 + 30.0 * k / len(pinches), f"thumb and {finger}")
        motion.go(opened, _FREE)
        for first, near, beyond in ways:
            motion.go(first, _FREE)
            motion.go(near, _FREE)
            motion.rest()
            if motion.go(beyond, _CLOSING, partial(is_pressed, finger)):
                q, _ = motion.rest()
                met.append((finger, space.posture(q)))
            motion.go(first, _FREE)
            motion.go(opened, _FREE)
        motion.go(space.home, _FREE)
    return met


def with_encoders(
    space: Space, joints: Joints, met: list[tuple[str, Array]]
) -> tuple[Joints, dict[str, float]]:
    """Return the joints with their encoders' errors, and by finger the gap that they show [m]."""
    errors, gaps = fit_encoders(space.hand, met)
    error = errors[space.own]
    # In the limits by the encoder, and by its error too.
    lower = joints.lower + np.maximum(error, 0.0)
    upper = joints.upper + np.minimum(error, 0.0)
    fingers = np.array([finger for finger, _ in met])
    off = {
        name: round(float(gaps[fingers == name].mean()), 4) for name in fingers.tolist()
    }
    return joints._replace(encoder=error, lower=lower, upper=upper), off
