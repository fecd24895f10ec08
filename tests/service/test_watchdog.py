"""The watchdog by itself: which event is due when, and how often the stream repeats a command."""

from __future__ import annotations

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
    assert dog.event(state, 1.0 + TIMEOUT, is_at_rest=False) is None
    expected = "silence" if state in ACTIVE else None
    assert dog.event(state, 1.0 + TIMEOUT + 1e-6, is_at_rest=False) is expected


@pytest.mark.parametrize("state", ACTIVE, ids=lambda state: state.name)
def test_a_sample_or_a_reset_postpones_silence(state: SessionState) -> None:
    fed, reset = watchdog(), watchdog()
    fed.feed(5.0)
    reset.last_sample = 5.0
    for dog in (fed, reset):
        assert dog.event(state, 5.0 + 0.99 * TIMEOUT, is_at_rest=False) is None
        assert dog.event(state, 5.0 + 1.01 * TIMEOUT, is_at_rest=False) == "silence"


def held(dog: SessionClock, now: float) -> None:
    """Start a hold."""
    assert dog.event(SessionState.FOLLOWING, now, is_at_rest=False) == "silence"


def test_a_return_is_due_after_the_hold_has_lasted() -> None:
    dog = watchdog()
    held(dog, 10.0)
    hold = SessionState.HOLDING
    assert dog.event(hold, 10.0 + 0.99 * RETURN_AFTER, is_at_rest=False) is None
    assert dog.event(hold, 10.0 + RETURN_AFTER, is_at_rest=False) == "return"
    assert dog.event(hold, 10.0 + RETURN_AFTER, is_at_rest=True) is None
    released = SessionState.HOLDING_RELEASED
    assert dog.event(released, 10.0 + RETURN_AFTER, is_at_rest=False) is None


def test_without_return_after_the_hold_has_no_end() -> None:
    dog = watchdog(None)
    held(dog, 10.0)
    assert dog.event(SessionState.HOLDING, 1e9, is_at_rest=False) is None
    assert not any(dog.will_return(state) for state in SessionState)


def test_a_return_after_no_time_follows_the_silence_at_once() -> None:
    dog, state = watchdog(0.0), SessionState.FOLLOWING
    while event := dog.event(state, 1.0, is_at_rest=False):
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
    assert dog.take_turn(state, now)
    period, last = RETURN_PERIOD if state is SessionState.RETURNING else HEARTBEAT, now
    for wait in waits:
        now += wait
        if dog.take_turn(state, now):
            assert now - last >= period
            last = now
        else:
            assert now - last < period


@pytest.mark.parametrize(
    "state", [SessionState.WAITING, *ACTIVE], ids=lambda state: state.name
)
def test_no_command_is_repeated_while_samples_arrive(state: SessionState) -> None:
    assert not watchdog().take_turn(state, 1e6)


@pytest.mark.parametrize("state", ACTIVE, ids=lambda state: state.name)
def test_the_first_command_of_a_hold_is_due_at_once(state: SessionState) -> None:
    # Shorter than the period of the heartbeats, which started with the last sample.
    dog = watchdog(None, 0.2 * HEARTBEAT)
    dog.feed(5.0)
    now = 5.0 + 0.3 * HEARTBEAT
    assert dog.event(state, now, is_at_rest=False) == "silence"
    assert dog.take_turn(next_state(state, "silence"), now)


@given(
    state=st.sampled_from(SessionState),
    timeout=st.floats(0.01, 10.0),
    share=st.floats(0.0, 0.999),
    is_braking=st.booleans(),
)
def test_nothing_happens_before_the_watchdog_says_that_it_is_due(
    state: SessionState, timeout: float, share: float, is_braking: bool
) -> None:
    dog = watchdog(timeout=timeout)
    dog.feed(3.0)
    due = dog.due(state)
    if state is SessionState.FOLLOWING:
        now = 3.0 + share * (due - 3.0)
        assert dog.event(state, now, is_at_rest=False) is None
        assert not dog.take_turn(state, now, is_braking=is_braking)
    else:
        assert due < 0.0
