"""The states of a session: every state under every event."""

from __future__ import annotations

from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from handmap_qp.apps.service.safety import Event, SessionState, next_state

EVENTS: tuple[Event, ...] = get_args(Event)
WATCHDOG_EVENTS = ("silence", "return", "arrival")
STATES = [state for state in SessionState if state is not SessionState.STOPPED]
every_state = pytest.mark.parametrize("state", STATES, ids=lambda state: state.name)


@every_state
def test_a_sample_ends_silence_and_keeps_a_release(state: SessionState) -> None:
    after = next_state(state, "sample")
    assert not after.is_silent
    assert after is not SessionState.WAITING
    assert after.is_released == state.is_released


@every_state
def test_release_and_clutch_change_the_release_and_nothing_else(
    state: SessionState,
) -> None:
    released, clutched = (
        next_state(state, "release"),
        next_state(state, "clutch"),
    )
    assert released.is_released
    assert not clutched.is_released
    assert released.is_silent == clutched.is_silent == state.is_silent
    assert released is not SessionState.RETURNING


@every_state
def test_a_reset_ends_silence_and_release(state: SessionState) -> None:
    after = next_state(state, "reset")
    expected = (
        SessionState.WAITING
        if state is SessionState.WAITING
        else SessionState.FOLLOWING
    )
    assert after is expected


@every_state
def test_only_silence_of_an_active_session_starts_a_hold(state: SessionState) -> None:
    after = next_state(state, "silence")
    is_active = state in (SessionState.FOLLOWING, SessionState.RELEASED)
    assert after.is_silent == (is_active or state.is_silent)
    assert after.is_released == state.is_released


@every_state
def test_only_an_engaged_hold_starts_a_return(state: SessionState) -> None:
    starts = next_state(state, "return") is SessionState.RETURNING
    assert starts == (state in (SessionState.HOLDING, SessionState.RETURNING))
    arrived = next_state(state, "arrival")
    assert (arrived is not state) == (state is SessionState.RETURNING)


@given(st.lists(st.sampled_from([event for event in EVENTS if event != "stop"])))
def test_the_watchdog_never_acts_before_the_first_sample_or_release(
    events: list[Event],
) -> None:
    state, has_begun = SessionState.WAITING, False
    for event in events:
        state = next_state(state, event)
        has_begun |= event in ("sample", "release")
        assert (state is SessionState.WAITING) == (not has_begun)


@given(st.lists(st.sampled_from(EVENTS)))
def test_a_released_robot_stays_released_until_it_is_clutched_or_reset(
    events: list[Event],
) -> None:
    state = SessionState.RELEASED
    for event in events:
        state = next_state(state, event)
        if event in ("clutch", "reset") and not state.is_stopped:
            break
        assert state.is_released
        assert state is not SessionState.RETURNING


@given(st.sampled_from(SessionState), st.lists(st.sampled_from(EVENTS)))
def test_a_stop_outlasts_everything_but_its_clearing(
    state: SessionState, events: list[Event]
) -> None:
    state = next_state(state, "stop")
    for event in events:
        assert state is SessionState.STOPPED
        assert state.is_released
        state = next_state(state, event)
        if event == "clear":
            # The robot does not move before a clutch as well.
            assert state is SessionState.RELEASED
            break
