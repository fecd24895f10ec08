"""Speeds and accelerations of commands by their time stamps, and streams of both hands."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from handmap_core.human.sample import HumanSample, human_name
from handmap_qp import Hand, load_hand
from handmap_qp.hands import Side

SHORTEST = 1e-6
"""A command that is not later than the one before counts as later by this [s]."""
SIDES: tuple[Side, ...] = ("left", "right")
HUMANS: dict[Side, Hand] = {
    side: load_hand(human_name(side), points="landmarks") for side in SIDES
}


class Event(NamedTuple):
    """Hands that have a sample at an instant [s]."""

    time: float
    sides: tuple[Side, ...]


def in_turns(
    rates: Sequence[float], duration: float, phase: float = 0.5
) -> list[Event]:
    """Return one sample an event, of the left and the right hand at rates of their own [Hz]."""
    left = np.arange(0.0, duration, 1.0 / rates[0])
    right = np.arange(phase / rates[1], duration, 1.0 / rates[1])
    events = [Event(float(time), ("left",)) for time in left]
    events += [Event(float(time), ("right",)) for time in right]
    return sorted(events)


def without(
    events: Sequence[Event], side: Side, start: float, end: float
) -> list[Event]:
    """Leave the samples of one hand out from one instant to another [s]."""
    return [
        event
        for event in events
        if not (side in event.sides and start <= event.time < end)
    ]


def landmarks_at(side: Side, time: float) -> np.ndarray:
    """Return landmarks of a hand that moves and turns faster than an arm can [m], shape (21, 3)."""
    human = HUMANS[side]
    sign = 1.0 if side == "left" else -1.0
    share = 0.5 - 0.5 * np.cos(9.0 * time + sign)
    q = human.rest + share * (0.6 * human.upper_limits - human.rest)
    angle = 1.2 * np.sin(7.0 * time + sign)
    wrist = np.eye(4)
    wrist[:2, :2] = np.array(
        [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
    )
    wrist[:3, 3] = (
        0.25 * np.sin(8.0 * time),
        0.3 * sign + 0.1 * np.sin(6.0 * time),
        0.25 * np.sin(7.0 * time + 1.0),
    )
    return human.points(np.clip(q, human.lower_limits, human.upper_limits), wrist)


def samples_of(
    events: Sequence[Event], clocks: dict[Side, float] | None = None
) -> Iterator[dict[Side, HumanSample]]:
    """Yield the samples of events, in clocks that are ahead of the true time [s]."""
    ahead = clocks or {}
    for event in events:
        yield {
            side: HumanSample(
                event.time + ahead.get(side, 0.0),
                side,
                landmarks_at(side, event.time),
                None,
                True,
                1.0,
            )
            for side in event.sides
        }


class Worst(NamedTuple):
    """The largest speed over its limit, and the largest acceleration [rad/s^2]."""

    speed: float
    acceleration: float


def judge(robot: Hand, time: Sequence[float], q: Sequence[np.ndarray]) -> Worst:
    """Judge commands by first and second differences over the differences of their time stamps.

    The velocity of a step is its difference over its time, and the acceleration the change of the
    velocity over the time of the later step: in that a motor has to change it.

    Args:
        robot: The robot.
        time: Time stamp of each command [s], shape (T,).
        q: Joint positions of each [rad], shape (T, n).
    """
    instants = [time[0]]
    for stamp in time[1:]:
        instants.append(max(stamp, instants[-1] + SHORTEST))
    steps = np.diff(instants)[:, None]
    velocity = np.diff(np.array(q), axis=0) / steps
    change = np.abs(np.diff(velocity, axis=0))
    # Rounding of positions and instants is an acceleration in the shortest steps.
    noise = 1e-12 * (1.0 / steps[1:] + 1.0 / steps[:-1]) + 1e-9
    return Worst(
        float((np.abs(velocity) / robot.velocity_limits).max()),
        float(((change - noise) / steps[1:]).max()),
    )
