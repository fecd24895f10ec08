"""Messages and time without sockets: one session's failure is no other's, and the log knows where it was."""

from __future__ import annotations

import asyncio
import io
import json
import logging
from dataclasses import replace
from pathlib import Path

import pytest
from service_tools import LOCAL, SECRET, SHELF, Sampler, make_session

from handmap_qp.service.caps import Caps
from handmap_qp.service.dispatch import Dispatcher
from handmap_qp.service.logs import JsonLines, log
from handmap_qp.service.messages import Command
from handmap_qp.service.metrics import Metrics
from handmap_qp.service.server import Server
from handmap_qp.service.session import Session
from handmap_qp.service.sessions import Entry


@pytest.fixture
def logged(monkeypatch: pytest.MonkeyPatch) -> io.StringIO:
    """What `handmap serve` would write to stderr."""
    text = io.StringIO()
    handler = logging.StreamHandler(text)
    handler.setFormatter(JsonLines())
    monkeypatch.setattr(log, "handlers", [handler])
    monkeypatch.setattr(log, "level", logging.INFO)
    return text


def test_a_session_that_fails_leaves_the_others_their_watchdogs(logged: io.StringIO, monkeypatch: pytest.MonkeyPatch) -> None:
    def burst(now: float) -> Command | None:
        raise ZeroDivisionError(f"at {now}")

    time = 0.0
    dispatcher = Dispatcher(Caps(), SHELF, Metrics(), clock=lambda: time)
    sessions: list[Session] = []
    for secret in ("another-secret-of-the-tests", SECRET):
        sessions.append(make_session(watchdog=0.2))
        sessions[-1].step(Sampler()(), 0.0)
        dispatcher.sessions.entries[secret] = Entry(sessions[-1], 2, b"")
    monkeypatch.setattr(sessions[0], "tick", burst)
    time = 0.3
    dispatcher.tick()
    assert sessions[1].mode == "hold"
    (line,) = [json.loads(text) for text in logged.getvalue().splitlines() if "ZeroDivisionError" in text]
    assert (line["event"], line["level"]) == ("failed", "error")
    assert "in burst" in line["traceback"]


def test_a_server_that_cannot_be_made_leaves_the_state_file_to_others(tmp_path: Path) -> None:
    settings = replace(LOCAL, state=tmp_path / "state")
    with pytest.raises(ValueError, match=r"missing\.yaml"):
        Server(replace(settings, hands=(Path("missing.yaml"),)))
    asyncio.run(Server(settings).stop())
