"""Shared by the tests of live sources: commands that run until their sender has sent everything."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import threading
import tomllib
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import wait_until

from handmap_core.human.recording import Recording, sample_columns
from handmap_core.human.sample import HumanSample
from handmap_qp import cli
from handmap_qp.hands import Side
from handmap_qp.trackers.formats import read_recording

SENDER = Path(__file__).parents[1] / "sources" / "sender.py"
PACKAGE = Path(__file__).parents[2] / "packages" / "sources"
GROUP = "handmap_qp.commands"
# Its commands are found where the package is installed; here its folder is only on the path.
ADDED = {
    name: EntryPoint(name, value, GROUP)
    for name, value in tomllib.loads((PACKAGE / "pyproject.toml").read_text())[
        "project"
    ]["entry-points"][GROUP].items()
}


@cache
def demo(side: Side = "right") -> list[HumanSample]:
    """Return samples of the recording that comes with the package."""
    samples = [*sample_columns(read_recording("demo", side=side))]
    return [sample for sample in samples[:200:4] if sample.valid]


def free_port(kind: socket.SocketKind) -> int:
    """Return a port of 127.0.0.1 that nobody has."""
    with socket.socket(type=kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def start(*words: object) -> subprocess.Popen[str]:
    """Start a program of Python."""
    command = [sys.executable, *map(str, words)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, text=True)


class Tracked:
    """What a `track` command printed and wrote.

    Attributes:
        summary: Its summary.
        messages: Its lines on stderr.
        recording: What it wrote.
    """

    def __init__(self, code: int, out: str, err: str, file: Path) -> None:
        assert code == 0, err
        self.summary: dict[str, Any] = json.loads(out)
        self.messages = err.splitlines()
        self.recording: Recording = read_recording(file)

    @property
    def troubles(self) -> dict[str, int]:
        """Troubles but for silence, which depends on how busy the machine is."""
        troubles = self.summary["troubles"]
        return {name: count for name, count in troubles.items() if name != "silent"}


def track(
    words: list[str],
    send: Callable[[], object],
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> Tracked:
    """Run `handmap track` while something is sent beside it, and end it by Ctrl-C.

    Args:
        words: The words of the command after `track`.
        send: Returns when everything was sent.
    """
    out = tmp_path / "tracked.npz"
    code = run_beside(send, "track", *words, "--record", str(out), "--json")
    return Tracked(code, *capsys.readouterr(), out)


def run_beside(send: Callable[[], object], *words: str) -> int:
    """Run a command of `handmap`, and press Ctrl-C after everything was sent."""
    is_over = threading.Event()

    def send_and_end() -> None:
        try:
            send()
            # What has arrived waits in a buffer.
            is_over.wait(0.3)
        finally:
            if not is_over.is_set():
                os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=send_and_end)
    # A shell that runs the tests in the background has Ctrl-C ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread.start()
    try:
        return run(*words)
    finally:
        is_over.set()
        thread.join()
        signal.signal(signal.SIGINT, before)


def run(*words: str) -> int:
    """Run a command of `handmap` with those of the package."""
    with pytest.MonkeyPatch.context() as patch:
        for name, point in ADDED.items():
            patch.setitem(cli.COMMANDS, name, cli._Added(point))
        return cli.main(words)


def wait_for_datagrams(port: int) -> None:
    """Wait until a UDP port of this machine is bound."""
    place = f":{port:04X} "
    wait_until(lambda: place in Path("/proc/net/udp").read_text(), "nobody listens")


def wait_until_read(port: int) -> None:
    """Wait until no datagram is left at a UDP port of this machine."""
    # State, then what is to be sent and what has arrived.
    idle = f":{port:04X} 00000000:0000 07 00000000:00000000 "
    wait_until(lambda: idle in Path("/proc/net/udp").read_text(), "nobody reads")


def assert_same(recording: Recording, samples: list[HumanSample]) -> None:
    """Check that landmarks came through, to 1e-6 m; those of hands that were not seen are none."""
    truth = [sample.landmarks for sample in samples]
    found = recording.landmarks[recording.valid]
    np.testing.assert_allclose(found, truth, atol=1e-6, rtol=0.0)
