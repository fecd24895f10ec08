"""The watchdog by itself: which event is due when, and how often the stream repeats a command."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import opening

from handmap_qp.apps.service.safety import (
    HEARTBEAT,
    RETURN_PERIOD,
    SessionClock,
    SessionState,
    next_state,
)

TIMEOUT, RETURN_AFTER = 0.25, 1.0
ACTIVE = (SessionState.FOLLOWING, SessionState.RELEASED)
BRAKING: Any = SimpleNamespace(motion=SimpleNamespace(is_braking=True))
STILL: Any = SimpleNamespace(motion=SimpleNamespace(is_braking=False))
SILENT = (SessionState.HOLDING, SessionState.HOLDING_RELEASED, SessionState.RETURNING)


def watchdog(
    return_after: float | None = RETURN_AFTER, timeout: float = TIMEOUT
) -> SessionClock:
    return SessionClock(opening(watchdog=timeout, return_after=return_after), 0.0)


@pytest.mark.parametrize("state", SessionState, ids=lambda state: state.name)
def test_silence_is_due_after_the_timeout_and_only_in_active_states(
    state: SessionState,
) -> None:
    dog = watchdog(None)
    dog.feed(1.0)
    assert dog.event(state, 1.0 + TIMEOUT) is None
    expected = "silence" if state in ACTIVE else None
    assert dog.event(state, 1.0 + TIMEOUT + 1e-6) is expected


@pytest.mark.parametrize("state", ACTIVE, ids=lambda state: state.name)
def test_a_sample_or_a_reset_postpones_silence(state: SessionState) -> None:
    fed, reset = watchdog(), watchdog()
    fed.feed(5.0)
    reset.last_sample = 5.0
    for dog in (fed, reset):
        assert dog.event(state, 5.0 + 0.99 * TIMEOUT) is None
        assert dog.event(state, 5.0 + 1.01 * TIMEOUT) == "silence"


def held(dog: SessionClock, now: float) -> None:
    """Start a hold."""
    assert dog.event(SessionState.FOLLOWING, now) == "silence"


def test_a_return_is_due_after_the_hold_has_lasted() -> None:
    dog = watchdog()
    held(dog, 10.0)
    hold = SessionState.HOLDING
    assert dog.event(hold, 10.0 + 0.99 * RETURN_AFTER) is None
    assert dog.event(hold, 10.0 + RETURN_AFTER) == "return"
    released = SessionState.HOLDING_RELEASED
    assert dog.event(released, 10.0 + RETURN_AFTER) is None


def test_without_return_after_the_hold_has_no_end() -> None:
    dog = watchdog(None)
    held(dog, 10.0)
    assert dog.event(SessionState.HOLDING, 1e9) is None
    assert not any(dog.will_return(state) for state in SessionState)


def test_a_return_after_no_time_follows_the_silence_at_once() -> None:
    dog, state = watchdog(0.0), SessionState.FOLLOWING
    while event := dog.event(state, 1.0):
        state = next_state(state, event)
    assert state is SessionState.RETURNING


def test_a_session_that_is_released_or_waits_will_not_return() -> None:
    will = {state for state in SessionState if watchdog().will_return(state)}
    assert will == {
        SessionState.FOLLOWING,
        SessionState.HOLDING,
        SessionState.RETURNING,
    }


@pytest.mark.parametrize("state", SILENT, ids=lambda state: state.name)
@given(
    waits=st.lists(st.floats(min_value=1e-3, max_value=0.3), min_size=1, max_size=40)
)
def test_commands_are_repeated_once_a_period(
    state: SessionState, waits: list[float]
) -> None:
    dog, now = watchdog(), 100.0
    held(dog, now)
    assert dog.take_turn(state, now, STILL)
    period, last = RETURN_PERIOD if state is SessionState.RETURNING else HEARTBEAT, now
    for wait in waits:
        now += wait
        if dog.take_turn(state, now, STILL):
            assert now - last >= period
            last = now
        else:
            assert now - last < period


@pytest.mark.parametrize(
    "state", [SessionState.WAITING, *ACTIVE], ids=lambda state: state.name
)
def test_no_command_is_repeated_while_samples_arrive(state: SessionState) -> None:
    assert not watchdog().take_turn(state, 1e6, STILL)


@pytest.mark.parametrize("state", ACTIVE, ids=lambda state: state.name)
def test_the_first_command_of_a_hold_is_due_at_once(state: SessionState) -> None:
    # Shorter than the period of the heartbeats, which started with the last sample.
    dog = watchdog(None, 0.2 * HEARTBEAT)
    dog.feed(5.0)
    now = 5.0 + 0.3 * HEARTBEAT
    assert dog.event(state, now) == "silence"
    assert dog.take_turn(next_state(state, "silence"), now, STILL)


@pytest.mark.parametrize("robot", [STILL, BRAKING], ids=["still", "braking"])
@pytest.mark.parametrize("state", SessionState, ids=lambda state: state.name)
def test_a_robot_that_brakes_gets_commands_unless_samples_lead_it(
    state: SessionState, robot: Any
) -> None:
    dog = watchdog()
    dog.feed(3.0)
    is_silent = state.is_silent or state.is_stopped
    # Two samples of the longest time.
    soon, late = 3.0 + 0.99 / 15.0, 3.0 + 1.01 / 15.0
    is_led = state is SessionState.FOLLOWING
    is_due = is_silent or (robot is BRAKING and not is_led)
    is_moving = robot is BRAKING or state is SessionState.RETURNING
    assert bool(dog.take_turn(state, soon, robot)) == (is_due and is_moving)
    dog.feed(3.0)
    assert bool(dog.take_turn(state, late, robot)) == (
        is_moving and (is_silent or robot is BRAKING)
    )
