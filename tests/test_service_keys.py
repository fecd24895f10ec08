"""Keys: files for their owners alone, and who comes in with them, also while the server is running."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from service_tools import address_of, human_q, serving
from zmq.auth import load_certificate

from handmap_qp.client import Client, ServiceTimeoutError
from handmap_qp.errors import InvalidInputError
from handmap_qp.service.keys import ClientKeys, make_keys
from handmap_qp.service.server import Server

WRIST = np.eye(4)


def comes_in(server: Server, folder: Path, name: str, patience: float = 5.0) -> bool:
    """Whether a client that connects now is answered."""
    keys = folder / f"{name}.key_secret", folder / "server.key"
    with Client(address_of(server), timeout=patience, keys=keys) as client:
        try:
            client.status()
        except ServiceTimeoutError:
            return False
        return True


def test_only_admitted_keys_come_in(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["mine"])
    make_keys(tmp_path / "others", ["theirs"])
    server_key = tmp_path / "keys" / "server.key"
    mine = tmp_path / "keys" / "mine.key_secret", server_key
    theirs = tmp_path / "others" / "theirs.key_secret", server_key
    wrong_server = tmp_path / "keys" / "mine.key_secret", tmp_path / "others" / "server.key"
    with serving(keys=tmp_path / "keys") as server:
        for keys in (None, theirs, wrong_server):
            with Client(address_of(server), timeout=0.4, keys=keys) as client, pytest.raises(ServiceTimeoutError):
                client.status()
        with Client(address_of(server), keys=mine) as client:
            client.open("three_finger")
            client.latest(0.2)
            client.send(q=human_q(), wrist=WRIST)
            assert client.latest(1.0) is not None


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
        Client(address_of(server), timeout=3.0, keys=(tmp_path / "first.key_secret", tmp_path / "server.key")) as open_before,
    ):
        open_before.open("three_finger")
        make_keys(tmp_path, ["late"])
        assert comes_in(server, tmp_path, "late")
        (clients / "first.key").unlink()
        assert not comes_in(server, tmp_path, "first", patience=0.4)
        # What is open stays until it ends.
        assert open_before.step(q=human_q(), wrist=WRIST).status == "converged"
        (clients / "second.key").write_bytes((clients / "late.key").read_bytes())
        assert not comes_in(server, tmp_path, "second", patience=0.4)
        (clients / "second.key").write_bytes((tmp_path / "second.key").read_bytes())
        assert comes_in(server, tmp_path, "second")


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


def test_a_file_without_a_key_is_told_once_and_the_others_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    make_keys(tmp_path, ["a", "b"])
    clients = tmp_path / "clients"
    told: list[tuple[str, object]] = []
    monkeypatch.setattr("handmap_qp.service.keys.report", lambda level, event, **data: told.append((event, data.get("file"))))
    (clients / "a.key").write_bytes(b"torn")
    (clients / "c.key").mkdir()
    keys = ClientKeys(clients)
    for _ in range(2):
        assert keys.read() == {load_certificate(tmp_path / "b.key")[0]}
    assert sorted(told) == [("keys", None), ("no_key", str(clients / "a.key")), ("no_key", str(clients / "c.key"))]


def test_without_a_client_nothing_is_served(tmp_path: Path) -> None:
    make_keys(tmp_path, ["a"])
    (tmp_path / "clients" / "a.key").write_bytes(b"torn")
    with pytest.raises(InvalidInputError, match="nobody could come in"), serving(keys=tmp_path):
        pass
