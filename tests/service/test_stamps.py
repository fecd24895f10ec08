"""Time stamps of commands: readers of a stream can order them, and judge limits by them."""

from __future__ import annotations

from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
import pytest
from limit_judge import HUMANS, judge
from marks import rotated
from service_tools import (
    CACHE,
    PERIOD,
    Sampler,
    human_q,
    make_session,
    opening,
    run_now,
)

from handmap_core.ik.motion import SHORTEST_DT
from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.client.messages import Command

LIMIT = 30.0
"""Acceleration limit of the sessions [rad/s^2]."""
GAPS = (0.0, 0.0, 0.3 * SHORTEST_DT, SHORTEST_DT, 1e-4, 0.004, PERIOD, 0.05, 0.15)
"""Times from one event of a session to the next [s]; many events are at one instant."""
LOST: dict[str, Any] = {"landmarks": None, "valid": False}
"""Fields of a sample without a hand, at which a robot holds."""


def session_that_returns() -> Session:
    """Return a session whose robot goes to rest soon after the last sample."""
    return make_session(
        input="landmarks",
        hand_length=0.19,
        watchdog=0.1,
        return_after=0.05,
        return_speed=0.2,
        ik={"max_acceleration": LIMIT},
    )


def landmarks_at(phase: float) -> tuple[tuple[float, ...], ...]:
    """Return landmarks of the human hand as messages have them [m]."""
    human = HUMANS["right"]
    q = np.clip(human_q(phase), *human.limits)
    return tuple(map(tuple, human.points(q, np.eye(4)).tolist()))


def assert_keeps_limits_by_stamps(session: Session, commands: list[Command]) -> None:
    """Assert that stamps rise, and that no pair of commands is too fast for theirs."""
    times = [command.server_time for command in commands]
    assert np.diff(times).min() > 0.0
    worst = judge(session.robot, times, [np.array(each.q) for each in commands])
    # Times of a clock are rounded: by 1e-5 of the shortest interval.
    assert worst.speed <= 1.0 + 1e-4
    assert worst.acceleration <= LIMIT * (1.0 + 1e-4)


def test_a_held_sample_and_the_watchdog_at_one_instant_are_two_commands_in_order() -> (
    None
):
    session, sample = session_that_returns(), Sampler()
    now = 100.0
    commands = []
    for i in range(40):
        now += PERIOD
        commands.append(session.step(sample(now, landmarks=landmarks_at(0.1 * i)), now))
    while session.mode != "returning":
        now += 0.005
        if command := session.tick(now):
            commands.append(command)
    for _ in range(20):
        now += 0.02
        held = session.step(sample(now, **LOST), now)
        repeated = session.tick(now)
        assert repeated is not None
        assert session.mode == "returning"
        commands += held, repeated
    assert_keeps_limits_by_stamps(session, commands)


@pytest.mark.slow
@pytest.mark.parametrize("seed", rotated(range(6), 2))
def test_commands_of_a_random_session_keep_the_limits_by_their_stamps(
    seed: int,
) -> None:
    random = Random(seed)
    session, sample = session_that_returns(), Sampler()
    now = 1e4
    phase = 0.0
    commands: list[Command] = []

    def seen() -> Command:
        nonlocal phase
        phase += random.uniform(0.0, 0.5)
        return session.step(sample(now, landmarks=landmarks_at(phase)), now)

    def lost() -> Command:
        return session.step(sample(now, **LOST), now)

    def stop_and_engage() -> Command | None:
        session.stop(1)
        command = session.tick(now)
        session.clear(1)
        session.clutch()
        return command

    events: list[Callable[[], Command | None]] = [
        *[seen] * 6,
        *[lost] * 3,
        *[lambda: session.tick(now)] * 6,
        *[session.clutch] * 3,
        session.release,
        stop_and_engage,
    ]
    modes = set()
    for _ in range(1500):
        now += random.choice(GAPS)
        if command := random.choice(events)():
            commands.append(command)
            modes.add(session.mode)
    assert_keeps_limits_by_stamps(session, commands)
    assert modes >= {"following", "released", "hold", "returning"}
    moved = np.ptp([command.q for command in commands], axis=0)
    assert moved.max() > 0.1


def test_a_session_that_goes_on_at_the_same_instant_is_stamped_later() -> None:
    request = opening()
    hands = prepare_hands(request, CACHE, defer=run_now)
    former, sample = Session(request, hands, "test", 1.0), Sampler()
    last = former.step(sample(1.0), 2.0)
    session = Session(
        request, hands, "test", 2.0, former=former.record, motion=former.motion
    )
    assert session.step(sample(1.0), 2.0).server_time > last.server_time
