"""Requests of other clients: anyone may watch a session, and steer it if it is shared."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from patience import wait_until
from service_tools import client_of, code_of, connected, human_q, lose_sessions, serving

from handmap_qp.apps.service.server import Server
from handmap_qp.client import ServiceError

WRIST = np.eye(4)


@pytest.fixture(scope="module")
def server() -> Iterator[Server]:
    with serving() as running:
        yield running


def test_anyone_may_watch_and_only_a_shared_session_may_be_steered(
    server: Server,
) -> None:
    with (
        connected(server, name="shared", is_shared=True) as owner,
        client_of(server) as other,
    ):
        state = other.watch("shared")
        assert state.about is not None
        assert (state.about["robot"], state.about["has_detail"]) == (
            "three_finger",
            False,
        )
        sent = owner.step(q=human_q(), wrist=WRIST, time=3.0)
        seen = wait_until(lambda: other.latest(0.1))
        assert (seen.q, seen.time, seen.detail) == (sent.q, 3.0, None)
        other.configure(
            mapping={"ridge": 0.5}, ik={"rest_weight": 0.0}, has_detail=True
        )
        about = owner.status().about
        assert about is not None
        assert (
            about["mapping"]["ridge"],
            about["ik"]["rest_weight"],
            about["ik"]["damping"],
        ) == (
            0.5,
            0.0,
            0.1,
        )
        assert owner.step(q=human_q(0.2), wrist=WRIST).detail is not None
        other.release()
        assert owner.step(q=human_q(1.0), wrist=WRIST).status == "released"
        other.clutch()
        assert owner.step(q=human_q(1.0), wrist=WRIST).status != "released"


def test_a_session_that_is_not_shared_is_its_clients_alone(server: Server) -> None:
    with (
        connected(server, name="private", watchdog=10.0) as owner,
        client_of(server) as other,
    ):
        owner.step(q=human_q(), wrist=WRIST)
        assert other.watch("private").mode == "following"
        for steer in (
            other.clutch,
            other.release,
            lambda: other.configure(mapping={"ridge": 0.5}),
        ):
            with pytest.raises(ServiceError) as raised:
                steer()
            assert code_of(raised) == ("denied", "name")
        for reach in (other.reset, lambda: other.step(q=human_q(), wrist=WRIST)):
            with pytest.raises(ServiceError) as raised:
                reach()
            assert code_of(raised) == ("invalid", "name")
        assert owner.step(q=human_q(), wrist=WRIST).status == "converged"


def test_watching_needs_a_session_and_a_client_without_one(server: Server) -> None:
    with connected(server) as owner, client_of(server) as other:
        with pytest.raises(ServiceError) as raised:
            other.watch("nobody")
        assert code_of(raised) == ("invalid", "name")
        with pytest.raises(RuntimeError, match="session of its own"):
            owner.watch("nobody")


def test_changes_of_options_are_capped() -> None:
    # One now, and the next one after a quarter of an hour.
    with serving(configures=1e-3) as server, connected(server) as client:
        client.configure(mapping={"ridge": 0.2})
        with pytest.raises(ServiceError) as raised:
            client.configure(mapping={"ridge": 0.3})
        assert code_of(raised)[0] == "rate"


def test_options_survive_a_server_that_has_lost_the_session(server: Server) -> None:
    with connected(server, mapping={"scale": 2.0}) as client:
        client.step(q=human_q(), wrist=WRIST)
        client.configure(mapping={"ridge": 0.3})
        lose_sessions(server)
        client.step(q=human_q(), wrist=WRIST)
        assert client.reopened == 1
        about = client.status().about
        assert about is not None
        assert (about["mapping"]["ridge"], about["mapping"]["scale"]) == (0.3, 2.0)
