"""Pages that lead through a whole path: all that they print is run as written, in a new folder.

A block of Python that follows the name of a file, as in "This is `mine.py`:", is written to it.
Other blocks are run. Commands that end with `&` run until the page is done.
"""

from __future__ import annotations

import json
import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from patience import PATIENCE, wait_until

from handmap_qp.client import Client

# Processes, pictures and whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs"


class Part(NamedTuple):
    """One thing that a page says to do.

    Attributes:
        kind: `file`, `python` or `command`.
        text: Its text.
        name: Name of the file.
    """

    kind: str
    text: str
    name: str = ""


def parts_of(page: str) -> list[Part]:
    """Return what a page says to do, in its order."""
    pattern = re.compile(
        r"(?:`(?P<name>[\w.]+\.(?:py|yaml))`[^\n]*:\n\n)?^```python\n(?P<code>.*?)^```"
        r"|^    +(?P<command>handmap .+?(?:\\\n.+?)*)$",
        re.MULTILINE | re.DOTALL,
    )
    parts = []
    for found in pattern.finditer((DOCS / page).read_text("utf-8")):
        if command := found["command"]:
            parts.append(Part("command", command.split(" #")[0].strip()))
        elif name := found["name"]:
            parts.append(Part("file", found["code"], name))
        else:
            parts.append(Part("python", found["code"]))
    return parts


class Runner:
    """Does what a page says, in a folder.

    The service of a page listens on free ports, because others on this machine may use the usual
    ones. Its address replaces the one that the page names.

    Args:
        folder: The folder.

    Attributes:
        running: Processes that run on, by the first words of their commands.
        printed: What the others have printed.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.running: dict[str, subprocess.Popen[str]] = {}
        self.printed = ""
        self._port = 0

    def do(self, part: Part) -> None:
        """Do one thing.

        Raises:
            AssertionError: If it fails.
        """
        if part.kind == "file":
            (self.folder / part.name).write_text(part.text, encoding="utf-8")
        elif part.text.endswith("&"):
            self._start(part.text.removesuffix("&"))
        else:
            done = subprocess.run(
                self._program(part),
                cwd=self.folder,
                capture_output=True,
                text=True,
                timeout=3.0 * PATIENCE,
                check=False,
            )
            assert done.returncode == 0, f"{part.text}\n{done.stdout}{done.stderr}"
            self.printed += done.stdout

    def end(self, name: str) -> str:
        """End a process by Ctrl-C, and return what it printed."""
        process = self.running.pop(name)
        process.send_signal(signal.SIGINT)
        return process.communicate(timeout=PATIENCE)[0]

    @property
    def client(self) -> Client:
        """A client of the page's service."""
        return Client(f"tcp://127.0.0.1:{self._port}")

    def _program(self, part: Part) -> list[str]:
        address = f"127.0.0.1:{self._port}"
        if part.kind == "python":
            text = part.text.replace("Client()", f"Client('tcp://{address}')")
            return [sys.executable, "-c", text]
        words = shlex.split(part.text)[1:]
        if words[0] == "serve":
            words += ["--port", "0", "--stream-port", "0", "--health-port", "-1"]
        if words[0] == "drive":
            words += ["--from", address]
        words = [address if word == "127.0.0.1" else word for word in words]
        return [sys.executable, "-m", "handmap_qp.cli", *words]

    def _start(self, line: str) -> None:
        """Start a command that runs on, and wait until it works."""
        name = shlex.split(line)[1]
        process = subprocess.Popen(
            self._program(Part("command", line)),
            cwd=self.folder,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        self.running[name] = process
        if name == "serve":
            assert process.stdout is not None
            ready = json.loads(process.stdout.readline())
            self._port = ready["ports"]["requests"]
        elif name == "track":
            with self.client as client:
                wait_until(lambda: client.status().names)


@contextmanager
def page_done(page: str, folder: Path) -> Iterator[Runner]:
    """Do all that a page says; what runs on is ended with the block."""
    runner = Runner(folder)
    try:
        for part in parts_of(page):
            runner.do(part)
        yield runner
    finally:
        for process in reversed(runner.running.values()):
            process.kill()
            process.communicate(timeout=PATIENCE)


def test_a_hand_is_teleoperated(tmp_path: Path) -> None:
    with page_done("teleoperate.md", tmp_path) as runner:
        assert [*runner.running] == ["serve", "track", "view", "drive"]
        # The program of the page has printed a command.
        assert "th_cmc" in runner.printed
        # How the motors followed is printed at the end, once the driver's loop has turned. It says
        # nothing before: a busy machine gets more time.
        (drive,) = (
            part for part in parts_of("teleoperate.md") if " drive " in part.text
        )
        for seconds in (8.0, 30.0, PATIENCE):
            time.sleep(seconds)
            assert runner.running["drive"].poll() is None
            if "following error" in runner.end("drive"):
                break
            runner.do(drive)
        else:
            pytest.fail("the motors did not follow")
        assert runner.running["view"].poll() is None


def test_recordings_become_robot_data(tmp_path: Path) -> None:
    with page_done("data.md", tmp_path) as runner:
        frames = re.search(
            r"^(\d+) frames: observation.state", runner.printed, re.MULTILINE
        )
        assert frames
        assert int(frames[1]) > 800
        assert runner.printed.count("(431, 16) joint_0.0") == 2
    assert (tmp_path / "right.html").stat().st_size > 100_000
    assert (tmp_path / "mapped" / "report" / "report.md").is_file()


def test_a_method_is_compared(tmp_path: Path) -> None:
    with page_done("compare.md", tmp_path) as runner:
        printed = runner.printed
    assert (tmp_path / "compared" / "poses.png").is_file()
    assert (tmp_path / "score" / "score.html").is_file()
    assert (tmp_path / "shown" / "demo_right.npz").is_file()
    rows = dict(
        re.findall(r"^ (mine\.py:joints|q) +([-.\d ]+?) *$", printed, re.MULTILINE)
    )
    # By each way, the same joints are measured alike. The last column is the time of a step,
    # which a file does not tell.
    assert rows["q"].split()[:-1] == rows["mine.py:joints"].split()[:-1]


@pytest.mark.parametrize("page", ["teleoperate.md", "data.md", "compare.md"])
def test_pages_are_short(page: str) -> None:
    text = re.sub(r"```.*?```", "", (DOCS / page).read_text("utf-8"), flags=re.DOTALL)
    assert 250 < len(text.split()) <= 500
