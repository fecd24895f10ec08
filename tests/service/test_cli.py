"""`handmap serve` and `handmap keys` as processes and commands."""

from __future__ import annotations

import importlib
import json
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import tyro
import zmq
from patience import PATIENCE
from service_tools import human_q
from zmq.auth import load_certificate

from handmap_qp.apps.service.cli import Keys, Serve
from handmap_qp.client import Client
from handmap_qp.errors import InvalidInputError, InvalidOptionsError, MissingExtraError

PORTS = "port=0, stream_port=0, health_port=0, web=True, web_port=0"


def start(fields: str, before: str = "") -> subprocess.Popen[str]:
    code = (
        f"from pathlib import Path\nfrom handmap_qp.apps.service.cli import Serve\n{before}\n"
        f"Serve({fields}).run()"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_serve_ends_while_it_loads_a_hand() -> None:
    # Loading takes longer than anybody waits.
    process = start(
        PORTS,
        "import time\nfrom handmap_qp.apps.service import sessions\n"
        "def load(*_, **__): print('loading', flush=True); time.sleep(1e6)\n"
        "sessions.prepare_hands = load",
    )
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        request = {"type": "open", "protocol": 1, "seq": 1, "robot": "hey5"}
        with zmq.Context() as context, context.socket(zmq.DEALER) as client:
            client.linger = 0
            client.connect(f"tcp://127.0.0.1:{ready['ports']['requests']}")
            for number in range(2):
                request["session"] = str(number) * 32
                client.send(msgspec.msgpack.encode(request))
            assert process.stdout.readline() == "loading\n"
        process.send_signal(signal.SIGTERM)
        log = process.communicate(timeout=PATIENCE)[1]
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    assert json.loads(log.splitlines()[-1])["event"] == "stopped"


@pytest.mark.slow
def test_serve_reports_readiness_and_ends_on_a_signal() -> None:
    process = start(PORTS)
    try:
        assert process.stdout is not None
        ready = json.loads(process.stdout.readline())
        assert set(ready["ports"]) == {"requests", "stream", "health", "web"}
        with Client(
            f"tcp://127.0.0.1:{ready['ports']['requests']}", timeout=PATIENCE
        ) as client:
            client.open("three_finger", preset="paper")
            assert client.step(q=human_q(), wrist=np.eye(4)).status == "converged"
            # The process above ends by SIGTERM.
            process.send_signal(signal.SIGINT)
            log = process.communicate(timeout=PATIENCE)[1]
            # The server is gone, so closing must not wait.
            client.timeout = 0.0
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0
    events = [json.loads(line)["event"] for line in log.splitlines()]
    # On a busy machine the server also logs that it is late.
    assert [event for event in events if event != "late"] == [
        "ready",
        "opened",
        "closed",
        "stopped",
    ]


def test_the_schema_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    Serve(schema=True).run()
    assert capsys.readouterr().out.startswith("# Messages of the mapping service")
    Serve(json_schema=True).run()
    assert "$defs" in json.loads(capsys.readouterr().out)


def test_keys_are_made_and_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    Keys(tmp_path / "keys", client=("left",)).run()
    assert capsys.readouterr().out.count("wrote") == 5
    (public, secret), (server, _) = (
        load_certificate(tmp_path / "keys" / name)
        for name in ("left.key_secret", "server.key")
    )
    assert [len(key or b"") for key in (public, secret, server)] == [40, 40, 40]


@pytest.mark.parametrize(
    ("choices", "error", "message"),
    [
        ({"host": "0.0.0.0"}, InvalidOptionsError, "keys"),
        ({"web": True, "web_host": "0.0.0.0"}, InvalidOptionsError, "token"),
        (
            {"web": True, "web_token_file": Path("missing")},
            InvalidInputError,
            "cannot be read",
        ),
        ({"hand": (Path("missing.yaml"),)}, ValueError, "cannot be read"),
        ({"keys": Path("missing")}, InvalidInputError, "handmap keys"),
        ({"state": Path("missing/state")}, InvalidInputError, "cannot be used"),
        ({"sessions": 0}, InvalidOptionsError, "^sessions: expected 1 to 128, got 0"),
        (
            {"sessions": 129},
            InvalidOptionsError,
            "^sessions: expected 1 to 128, got 129",
        ),
        (
            {"rate": float("nan")},
            InvalidOptionsError,
            "^rate: expected a number > 0, got nan",
        ),
        ({"port": -1}, InvalidInputError, "^port: expected 0 to 65535, got -1"),
        ({"stream_port": 70000}, InvalidInputError, "^stream_port: expected"),
        ({"health_port": -2}, InvalidInputError, "^health_port: expected"),
        ({"web": True, "web_port": -1}, InvalidInputError, "^web_port: expected"),
        (
            {"web_port": 0, "web_origin": ("https://a.example",)},
            InvalidInputError,
            "^--web-port, --web-origin: requires --web$",
        ),
    ],
    ids=str,
)
def test_mistakes_are_reported_before_anything_listens(
    choices: dict[str, Any],
    error: type[Exception],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    anywhere: dict[str, Any] = {"port": 0, "stream_port": 0, "health_port": -1}
    with pytest.raises(error, match=message):
        Serve(**{**anywhere, **choices}).run()


def test_without_its_packages_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("server", "keys"):
        # They are imported already where other tests ran before.
        importlib.import_module(f"handmap_qp.apps.service.{name}")
        monkeypatch.delitem(sys.modules, f"handmap_qp.apps.service.{name}")
        monkeypatch.delattr(f"handmap_qp.apps.service.{name}")
    for name in ("zmq", "zmq.auth"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(MissingExtraError, match=r"handmap-qp\[service\]"):
        Serve().run()
    with pytest.raises(MissingExtraError, match=r"handmap-qp\[service\]"):
        Keys(Path("keys")).run()


def test_the_words_of_the_command_line_fit() -> None:
    words = [
        "--web",
        "--web-port",
        "0",
        "--hand",
        "a.yaml",
        "b.yaml",
        "--state",
        "state",
        "--rate",
        "500",
    ]
    serve = tyro.cli(Serve, args=words)
    assert (serve.web, serve.hand, serve.state, serve.rate) == (
        True,
        (Path("a.yaml"), Path("b.yaml")),
        Path("state"),
        500.0,
    )
    assert tyro.cli(Keys, args=["keys", "--client", "left", "right"]).client == (
        "left",
        "right",
    )
