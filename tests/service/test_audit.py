"""The audit log: who did what, one line each."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from service_tools import WEB, client_of, connected, human_q, serving
from websockets.sync.client import connect

from handmap_qp.apps.service.keys import make_keys
from handmap_qp.apps.service.logs import AuditLog
from handmap_qp.errors import InvalidInputError


def lines(file: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]


def test_who_opened_changed_and_stopped_a_session_is_kept(tmp_path: Path) -> None:
    keys, file = tmp_path / "keys", tmp_path / "audit.jsonl"
    make_keys(keys, ["alice", "bob"])
    alice, bob = (
        (keys / f"{name}.key_secret", keys / "server.key") for name in ("alice", "bob")
    )
    with (
        serving(keys=keys, audit=file) as server,
        client_of(server, keys=alice) as client,
    ):
        client.open("three_finger", name="lab", preset="paper", is_shared=True)
        client.step(q=human_q(), wrist=np.eye(4))
        client.configure(ik={"rest_weight": 0.3})
        with client_of(server, keys=bob) as other:
            other.stop("lab", reason="smoke")
        client.clear(client.status().stop)
        client.clutch()
    found = lines(file)
    assert [(entry["event"], entry["by"].partition("@")[0]) for entry in found] == [
        ("started", "server"),
        ("opened", "alice"),
        ("configure", "alice"),
        ("stop", "bob"),
        ("clear", "alice"),
        ("clutch", "alice"),
        ("closed", "alice"),
    ]
    assert all(entry["session"] == "lab" for entry in found[1:])
    assert found[2]["ik"] == {"rest_weight": 0.3}
    assert found[3]["reason"] == "smoke"
    assert found[1]["by"] == "alice@127.0.0.1"
    # No secret of a session, and readable for its owner only.
    assert "secret" not in file.read_text(encoding="utf-8")
    assert file.stat().st_mode & 0o077 == 0


def test_clients_without_keys_are_known_by_their_address(tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    with serving(audit=file, **WEB) as server:
        with connected(server):
            pass
        with connect(f"ws://127.0.0.1:{server.ports['web']}") as page:
            page.send(json.dumps({"type": "stop", "protocol": 2, "seq": 1}))
            page.recv()
    found = lines(file)
    assert [entry["by"] for entry in found] == [
        "server",
        "127.0.0.1",
        "127.0.0.1",
        "web@127.0.0.1",
    ]
    assert found[-1]["event"] == "stop"
    assert found[-1]["session"] == ""


def test_a_flood_is_cut_but_never_a_stop(tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    log = AuditLog(file)
    for _ in range(5000):
        log.note("clutch", "alice", session="lab")
    log.note("stop", "bob", session="lab")
    log.close()
    found = lines(file)
    assert len(found) < 600
    assert found[-1]["event"] == "stop"
    assert sum(entry.get("count", 0) for entry in found) + len(found) >= 5000
    log.note("clutch", "alice")


def test_it_is_appended_to(tmp_path: Path) -> None:
    file = tmp_path / "audit.jsonl"
    for _ in range(2):
        log = AuditLog(file)
        log.note("started", "server")
        log.close()
    assert len(lines(file)) == 2


def test_a_file_that_cannot_be_written_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="cannot be written"):
        AuditLog(tmp_path)
