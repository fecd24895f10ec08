"""Versions of the messages: clients and servers of different versions work together."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from service_tools import (
    PATIENCE,
    address_of,
    client_of,
    code_of,
    human_q,
    lose_sessions,
    serving,
    skip,
)

from handmap_core.client import messages
from handmap_qp import client as present
from handmap_qp.apps.service.keys import make_keys
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.client import ServiceError

DATA = Path(__file__).resolve().parents[1] / "data" / "clients"


@pytest.fixture(scope="module")
def yesterday() -> Iterator[ModuleType]:
    """Import the client of version 1, as it was."""
    spec = importlib.util.spec_from_file_location(
        "client_of_protocol_1", DATA / "protocol_1.py"
    )
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    yield module
    del sys.modules[spec.name]


def test_the_client_of_version_1_still_works(yesterday: ModuleType) -> None:
    assert yesterday.PROTOCOL == 1
    with (
        serving() as server,
        yesterday.Client(address_of(server), timeout=PATIENCE) as client,
    ):
        opened = client.open("three_finger", name="lab", preset="paper", is_shared=True)
        first = client.step(q=human_q(), wrist=np.eye(4))
        assert first.joint_names == opened.joint_names
        client.release()
        held = client.step(q=human_q(1.0), wrist=np.eye(4))
        assert "released" in held.flags
        assert held.q == first.q
        client.clutch()
        client.configure(ik={"rest_weight": 0.3})
        client.send(q=human_q(0.5), wrist=np.eye(4))
        client.reset()
        assert client.status().about["ik"]["rest_weight"] == 0.3
        with yesterday.Client(address_of(server), timeout=PATIENCE) as watcher:
            watcher.watch("lab")
            watcher.release()
            assert watcher.status().is_released


def test_it_learns_of_a_stop_although_it_does_not_know_one(
    yesterday: ModuleType,
) -> None:
    with (
        serving() as server,
        yesterday.Client(address_of(server), timeout=PATIENCE) as client,
        client_of(server) as button,
    ):
        client.open("three_finger", preset="paper")
        client.step(q=human_q(), wrist=np.eye(4))
        button.stop()
        command = client.step(q=human_q(1.0), wrist=np.eye(4))
        assert command.status == "stopped"
        assert "released" in command.flags
        with pytest.raises(yesterday.ServiceError) as raised:
            client.clutch()
        assert raised.value.error.code == "stopped"


@pytest.mark.parametrize("has_keys", [False, True])
def test_the_client_of_version_1_reopens_a_lost_session(
    yesterday: ModuleType, tmp_path: Path, has_keys: bool
) -> None:
    # It reopens with another secret, so without keys it is a new owner.
    make_keys(tmp_path, ["alice"])
    keys = tmp_path if has_keys else None
    files = (
        (tmp_path / "alice.key_secret", tmp_path / "server.key") if has_keys else None
    )
    with (
        serving(keys=keys) as server,
        yesterday.Client(address_of(server), timeout=PATIENCE, keys=files) as client,
    ):
        client.open("three_finger", name="lab", preset="paper")
        before = client.step(q=human_q(), wrist=np.eye(4))
        lose_sessions(server)
        after = client.step(q=human_q(), wrist=np.eye(4))
        assert client.reopened == 1
        assert (after.epoch == before.epoch) == has_keys
        np.testing.assert_allclose(after.q, before.q, atol=0.02)


@pytest.mark.parametrize("has_keys", [False, True])
def test_after_a_restart_the_client_of_version_1_waits_for_the_lease_without_keys(
    yesterday: ModuleType, free_port: int, tmp_path: Path, has_keys: bool
) -> None:
    make_keys(tmp_path, ["alice"])
    keys = tmp_path if has_keys else None
    files = (
        (tmp_path / "alice.key_secret", tmp_path / "server.key") if has_keys else None
    )
    choices: dict[str, Any] = {
        "port": free_port,
        "keys": keys,
        "state": tmp_path / "state",
    }
    client = yesterday.Client(
        f"tcp://127.0.0.1:{free_port}", timeout=PATIENCE, keys=files
    )
    with serving(**choices):
        client.open("three_finger", name="lab", preset="paper")
        before = client.step(q=human_q(), wrist=np.eye(4))
    with serving(**choices) as server, client:
        if not has_keys:
            with pytest.raises(yesterday.ServiceError, match="busy"):
                client.step(q=human_q(), wrist=np.eye(4))
            skip(server, 2.0 * LEASE)
        after = client.step(q=human_q(), wrist=np.eye(4))
        assert (after.epoch == before.epoch) == has_keys


def test_a_client_of_today_speaks_version_1_with_a_server_of_yesterday(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(messages, "PROTOCOLS", (1,))
    with serving() as server, client_of(server) as client:
        client.open("three_finger", preset="paper")
        client.step(q=human_q(), wrist=np.eye(4))
        with pytest.raises(ServiceError) as raised:
            client.stop()
        assert code_of(raised)[0] == "protocol"
        assert client.step(q=human_q(), wrist=np.eye(4)).q


def test_servers_of_version_1_do_not_say_which_versions_they_answer() -> None:
    client = present.Client()
    old = present.Error(code="protocol", message="expected version 1, got 2")
    assert client._speaks_older(old)
    assert client._protocol == 1
    assert not client._speaks_older(old)


def test_versions_without_a_common_one_end_in_an_error() -> None:
    client = present.Client()
    newer = present.Error(code="protocol", message="", protocols=(7, 8))
    assert not client._speaks_older(newer)


def test_the_server_says_which_versions_it_answers() -> None:
    with serving() as server, client_of(server) as client:
        assert client.status().protocols == messages.PROTOCOLS
        assert max(messages.PROTOCOLS) == messages.PROTOCOL == present.PROTOCOL
        assert min(messages.PROTOCOLS) == messages.PROTOCOLS[0]
