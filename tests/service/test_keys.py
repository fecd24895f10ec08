"""Keys: files that only their owner can read, and the clients admitted while the server runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import zmq
from patience import wait_until
from service_tools import bare_connection, client_of, human_q, serving
from zmq.auth import load_certificate

from handmap_qp.client import KeyFiles
from handmap_qp.errors import InvalidInputError
from handmap_qp.service.keys import ClientKeys, make_keys
from handmap_qp.service.server import Server

WRIST = np.eye(4)


REJECTED = {
    zmq.EVENT_HANDSHAKE_FAILED_AUTH,
    zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL,
    zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,
}


def is_admitted(server: Server, keys: KeyFiles | None) -> bool:
    """Connect; return whether the handshake succeeds."""
    with bare_connection(server, keys) as (_, next_event):
        end = wait_until(lambda: {next_event()} & {zmq.EVENT_HANDSHAKE_SUCCEEDED, *REJECTED})
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
    with pytest.raises(InvalidInputError, match="others can read"), serving(keys=tmp_path / "keys"):
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
    a, b = load_certificate(tmp_path / "a.key")[0], load_certificate(tmp_path / "b.key")[0]
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
        "handmap_qp.service.keys.report",
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
    with pytest.raises(InvalidInputError, match="expected a client's key"), serving(keys=tmp_path):
        pass
