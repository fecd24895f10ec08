"""The emergency stop: any client sets it, nothing but a clearing on purpose ends it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from service_tools import (
    CACHE,
    HERE,
    LOCAL,
    PERIOD,
    RESET,
    Sampler,
    client_of,
    code_of,
    connected,
    follow,
    human_q,
    make_session,
    opening,
    serving,
    skip,
)

from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.session import Session
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.apps.service.store import PostureStore
from handmap_qp.client import ServiceError
from handmap_qp.errors import RefusedError

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def test_a_stopped_robot_holds_whatever_comes_until_it_is_cleared_and_clutched() -> (
    None
):
    session, sample = make_session(watchdog=0.1, return_after=0.1), Sampler()
    now = follow(session, sample, 0.0)
    session.stop()
    posture = session.posture[0].copy()
    number = session.state(1, "", 0, now).stop
    assert number > 0
    for i in range(60):
        now += 0.05
        session.tick(now)
        command = session.step(sample(now, human_q(0.3 * i)), now)
        assert np.array_equal(command.q, posture)
        assert command.status == "stopped"
        assert "stopped" in command.flags
        session.release()
        with pytest.raises(RefusedError, match="clear"):
            session.clutch()
        with pytest.raises(RefusedError, match="clear"):
            session.reset(RESET, now)
    with pytest.raises(RefusedError, match="in force"):
        session.clear(number + 1)
    session.stop()
    session.clear(number)
    assert np.array_equal(session.step(sample(now, human_q(1.0)), now).q, posture)
    session.clutch()
    command = session.step(sample(now, human_q()), now := now + PERIOD)
    for i in range(20):
        command = session.step(sample(now, human_q(0.1 * i)), now := now + PERIOD)
    assert command.status != "stopped"
    assert not np.array_equal(command.q, posture)


@settings(max_examples=8)
@given(st.integers(0, 40), st.sampled_from([5.0, 20.0, 60.0]))
def test_a_stop_brakes_within_the_acceleration_limit_on_a_straight_line(
    count: int, limit: float
) -> None:
    choices = {"max_acceleration": limit, "avoids_self_collision": True}
    session, sample = make_session(ik=choices), Sampler()
    now = follow(session, sample, 0.0, count + 3)
    q, velocity = [np.array(session.posture[0])], None
    command = session.step(sample(now, human_q(2.0)), now := now + PERIOD)
    q.append(np.array(command.q))
    session.stop()
    before = (q[1] - q[0]) / PERIOD
    commanded_at = now
    for _ in range(2 * int(np.abs(before).max() / limit / PERIOD) + 12):
        command = session.tick(now := now + PERIOD)
        if command is None:
            continue
        assert command.status == "stopped"
        since, commanded_at = now - commanded_at, now
        velocity = (np.array(command.q) - q[-1]) / since
        assert (np.abs(velocity - before) <= limit * since + 1e-6).all()
        q.append(np.array(command.q))
        before = velocity
    assert velocity is not None
    assert np.abs(velocity).max() < 1e-6
    # On the line that the hand moved on, which the mapper found clear of overlaps.
    moved, whole = q[-1] - q[1], q[1] - q[0]
    length = np.linalg.norm(whole)
    if length > 1e-6:
        across = moved - whole * (moved @ whole) / length**2
        assert np.abs(across).max() < 1e-9


def test_without_an_acceleration_limit_the_robot_stops_at_once() -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    posture = session.posture[0].copy()
    session.stop()
    command = session.tick(now)
    assert command is not None
    assert np.array_equal(command.q, posture)
    # It is repeated, so that drivers that listen later learn of it.
    assert session.tick(now + 0.05) is None
    assert session.tick(now + 0.11) is not None


def test_a_stop_outlives_session_client_and_server(tmp_path: Path) -> None:
    with serving(state=tmp_path / "state") as server:
        with connected(server, name="lab") as client:
            client.step(q=human_q(), wrist=np.eye(4))
            client.stop(reason="test")
            number = client.status().stop
        with client_of(server) as second:
            second.open("three_finger", name="lab", restore=True)
            assert second.status().mode == "stopped"
    with serving(state=tmp_path / "state") as server, client_of(server) as third:
        skip(server, 2.0 * LEASE)
        third.open("three_finger", name="lab", restore=True)
        assert third.status().stop == number
        with pytest.raises(ServiceError) as raised:
            third.clutch()
        assert code_of(raised)[0] == "stopped"
        third.clear(number)
        third.clutch()
        assert third.status().mode == "following"


def test_any_client_may_stop_any_session_but_not_clear_it() -> None:
    with (
        serving() as server,
        connected(server, name="lab") as client,
        connected(server, name="other") as other,
        client_of(server) as stranger,
    ):
        other.stop("lab")
        number = client.status().stop
        assert number
        assert not other.status().stop
        stranger.watch("lab")
        assert stranger.status().stop == number
        with pytest.raises(ServiceError) as raised:
            stranger.clear(number)
        assert code_of(raised)[0] == "denied"
        client.clear(number)
        assert not client.status().stop


def test_a_stop_without_a_name_stops_all() -> None:
    with (
        serving() as server,
        connected(server, name="lab") as client,
        connected(server, name="other") as other,
        client_of(server) as button,
    ):
        button.stop(reason="button")
        assert client.status().mode == other.status().mode == "stopped"


def test_a_record_of_yesterday_has_no_stop(tmp_path: Path) -> None:
    session = make_session()
    with PostureStore(tmp_path / "state") as store:
        store.note(session.record)
    with PostureStore(tmp_path / "state") as store:
        found = store.find("test", "three_finger", len(session.robot.joint_names))
    assert found is not None
    request = opening(restore=True)
    again = Session(request, prepare_hands(request, CACHE), "test", 0.0, former=found)
    assert again.mode == "waiting"
    assert HERE is not None
    assert LOCAL.audit is None
