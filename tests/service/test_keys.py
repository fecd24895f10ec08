"""Keys: files that only their owner can read, and the clients admitted while the server runs."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zmq
from patience import wait_until
from service_tools import (
    LOCAL,
    bare_connection,
    client_of,
    code_of,
    human_q,
    serving,
    skip,
)
from zmq.auth import load_certificate

from handmap_qp import cli
from handmap_qp.apps.service.keys import ClientKeys, make_keys
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import KeyFiles, ServiceError
from handmap_qp.errors import InvalidInputError, InvalidOptionsError

WRIST = np.eye(4)


REJECTED = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH,
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL,
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,
}


def is_admitted(server: Server, keys: KeyFiles | None) -> bool:
    """Connect; return whether the handshake succeeds."""
    with bare_connection(server, keys) as (_, next_event):
        end = wait_until(
            lambda: {next_event()} & {zmq.EVENT_HANDSHAKE_SUCCEEDED, *REJECTED}
        )
    return not end & REJECTED


def keys_of(folder: Path, name: str) -> KeyFiles:
    """Return the files of a client."""
    return folder / f"{name}.key_secret", folder / "server.key"


def test_only_admitted_keys_connect(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["mine"])
    make_keys(tmp_path / "others", ["theirs"])
    mine, server_key = keys_of(tmp_path / "keys", "mine")
    theirs, other_server_key = keys_of(tmp_path / "others", "theirs")
    with serving(keys=tmp_path / "keys") as server:
        assert not is_admitted(server, None)
        assert not is_admitted(server, (theirs, server_key))
        assert not is_admitted(server, (mine, other_server_key))
        with client_of(server, keys=(mine, server_key)) as client:
            client.open("three_finger")
            client.send(q=human_q(), wrist=WRIST)
            # The stream requires keys too.
            assert wait_until(lambda: client.latest(0.1))


def test_secret_keys_are_for_their_owner_alone_and_stay(tmp_path: Path) -> None:
    written = make_keys(tmp_path / "keys", ["a", "b"])
    assert len(written) == 8
    secrets = [file for file in written if file.suffix == ".key_secret"]
    assert all(file.stat().st_mode & 0o777 == 0o600 for file in secrets)
    before = secrets[0].read_bytes()
    assert len(make_keys(tmp_path / "keys", ["a", "c"])) == 3
    assert secrets[0].read_bytes() == before
    secrets[0].chmod(0o644)
    with (
        pytest.raises(InvalidInputError, match="others can read"),
        serving(keys=tmp_path / "keys"),
    ):
        pass


@pytest.mark.parametrize("name", ["../up", "server", "", "a b"])
def test_names_of_clients_are_file_names(tmp_path: Path, name: str) -> None:
    with pytest.raises(InvalidInputError):
        make_keys(tmp_path / "keys", [name])


def test_keys_come_and_go_while_the_server_runs(tmp_path: Path) -> None:
    make_keys(tmp_path, ["first", "second"])
    clients = tmp_path / "clients"
    with (
        serving(keys=tmp_path) as server,
        client_of(server, keys=keys_of(tmp_path, "first")) as open_before,
    ):
        open_before.open("three_finger", preset="paper")
        make_keys(tmp_path, ["late"])
        assert is_admitted(server, keys_of(tmp_path, "late"))
        (clients / "first.key").unlink()
        assert not is_admitted(server, keys_of(tmp_path, "first"))
        # An open connection stays until it ends.
        assert open_before.step(q=human_q(), wrist=WRIST).status == "converged"
        (clients / "second.key").write_bytes((clients / "late.key").read_bytes())
        assert not is_admitted(server, keys_of(tmp_path, "second"))
        (clients / "second.key").write_bytes((tmp_path / "second.key").read_bytes())
        assert is_admitted(server, keys_of(tmp_path, "second"))


def test_the_keys_are_those_that_lie_in_the_folder_now(tmp_path: Path) -> None:
    make_keys(tmp_path, ["a", "b"])
    clients = tmp_path / "clients"
    keys = ClientKeys(clients)
    a, b = (
        load_certificate(tmp_path / "a.key")[0],
        load_certificate(tmp_path / "b.key")[0],
    )
    assert keys.read() == {a, b}
    assert keys.callback("*", a)
    (clients / "a.key").unlink()
    assert not keys.callback("*", a)
    assert keys.callback("*", b)
    (clients / "b.key").unlink()
    clients.rmdir()
    assert keys.read() == set()
    assert not keys.callback("*", b)


def test_a_file_without_a_key_is_logged_once_and_the_others_count(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_keys(tmp_path, ["a", "b"])
    clients = tmp_path / "clients"
    logged: list[tuple[str, object]] = []
    monkeypatch.setattr(
        "handmap_qp.apps.service.keys.report",
        lambda level, event, **data: logged.append((event, data.get("file"))),
    )
    (clients / "a.key").write_bytes(b"torn")
    (clients / "c.key").mkdir()
    keys = ClientKeys(clients)
    for _ in range(2):
        assert keys.read() == {load_certificate(tmp_path / "b.key")[0]}
    assert sorted(logged) == [
        ("keys", None),
        ("no_key", str(clients / "a.key")),
        ("no_key", str(clients / "c.key")),
    ]


def test_without_a_client_nothing_is_served(tmp_path: Path) -> None:
    make_keys(tmp_path, ["a"])
    (tmp_path / "clients" / "a.key").write_bytes(b"torn")
    with (
        pytest.raises(InvalidInputError, match="expected a client's key"),
        serving(keys=tmp_path),
    ):
        pass


def test_another_key_may_stop_a_robot_but_not_clear_or_lead_it(tmp_path: Path) -> None:
    make_keys(tmp_path, ["alice", "bob", "chief"])
    alice, bob, chief = (keys_of(tmp_path, name) for name in ("alice", "bob", "chief"))
    with (
        serving(keys=tmp_path, supervisor=("chief",)) as server,
        client_of(server, keys=alice) as tracker,
        client_of(server, keys=bob) as other,
        client_of(server, keys=chief) as supervisor,
        client_of(server, keys=alice) as second,
    ):
        tracker.open("three_finger", name="lab", preset="paper")
        tracker.step(q=human_q(), wrist=WRIST)
        other.stop("lab")
        number = tracker.status().stop
        other.watch("lab")
        # Neither now nor after the lease, whether the session is stopped or not.
        for seconds in (0.0, 2.0 * LEASE):
            skip(server, seconds)
            with pytest.raises(ServiceError) as raised:
                other.clear(number)
            assert code_of(raised) == ("denied", "name")
            with (
                client_of(server, keys=bob) as taker,
                pytest.raises(ServiceError) as raised,
            ):
                taker.open("three_finger", name="lab", preset="paper", restore=True)
            assert code_of(raised) == ("denied", "name")
        supervisor.watch("lab")
        with pytest.raises(ServiceError, match="denied"):
            supervisor.clutch()
        supervisor.clear(number)
        # Another process with the owner's key may clear too.
        other.stop("lab")
        second.watch("lab")
        second.clear(second.status().stop)
        tracker.clutch()
        assert tracker.step(q=human_q(), wrist=WRIST).status == "converged"


def test_a_key_is_the_owner_with_another_secret_too(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["alice", "bob"])
    alice, bob = (keys_of(tmp_path / "keys", name) for name in ("alice", "bob"))
    choices: dict[str, Any] = {"keys": tmp_path / "keys", "state": tmp_path / "state"}
    with serving(**choices) as server, client_of(server, keys=alice) as first:
        first.open("three_finger", name="lab", preset="paper")
        before = first.step(q=human_q(), wrist=WRIST)
        with client_of(server, keys=alice) as second:
            # Two processes with one key must not lead one robot.
            with pytest.raises(ServiceError, match="busy"):
                second.open("three_finger", name="lab", preset="paper", restore=True)
            skip(server, 2.0 * LEASE)
            second.open("three_finger", name="lab", preset="paper", restore=True)
            assert second.step(q=human_q(), wrist=WRIST).epoch == before.epoch
            with pytest.raises(ServiceError, match="taken"):
                first.step(q=human_q(), wrist=WRIST)
    with serving(**choices) as server:
        for seconds in (0.0, 2.0 * LEASE):
            skip(server, seconds)
            with (
                client_of(server, keys=bob) as other,
                pytest.raises(ServiceError, match="denied"),
            ):
                other.open("three_finger", name="lab", preset="paper", restore=True)
        with client_of(server, keys=alice) as third:
            third.open("three_finger", name="lab", preset="paper", restore=True)
            assert third.step(q=human_q(), wrist=WRIST).epoch == before.epoch


@pytest.mark.parametrize("name", ["nobody", "", "../server"])
def test_a_supervisor_must_have_a_key(tmp_path: Path, name: str) -> None:
    make_keys(tmp_path, ["alice"])
    asyncio.run(Server(replace(LOCAL, keys=tmp_path, supervisor=("alice",))).stop())
    for keys in (tmp_path, None):
        with pytest.raises(
            InvalidOptionsError,
            match="supervisor: expected the name of a client in keys",
        ):
            Server(Settings(keys=keys, supervisor=("alice", name)))


def test_a_supervisor_without_a_key_is_one_line_at_the_command_line(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert cli.main(["serve", "--supervisor", "nobody"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "supervisor: expected the name of a client in keys" in line
    assert "nobody" in line
