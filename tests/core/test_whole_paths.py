"""Pages that lead through a whole path: all that they print is run as written, in a new folder.

A block of Python that follows the name of a file, as in "This is `mine.py`:", is written to it.
Other blocks are run. Commands that end with `&` run until the page is done.
"""

from __future__ import annotations

import re
import shlex
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest

# Processes, pictures and whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs"
STARTS = 20.0
"""Time in which a command that runs on may start [s]."""


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


@contextmanager
def background() -> Iterator[list[subprocess.Popen[str]]]:
    """End processes that were started, the last one first."""
    running: list[subprocess.Popen[str]] = []
    try:
        yield running
    finally:
        for process in reversed(running):
            process.terminate()
            process.communicate(timeout=30.0)


def run_page(page: str, folder: Path) -> str:
    """Do what a page says, and return all that was printed.

    Raises:
        AssertionError: If something fails.
    """
    printed = []
    with background() as running:
        for part in parts_of(page):
            if part.kind == "file":
                (folder / part.name).write_text(part.text, encoding="utf-8")
                continue
            words = ["-c", part.text]
            is_left = part.text.endswith("&")
            if part.kind == "command":
                line = part.text.removesuffix("&")
                words = ["-m", "handmap_qp.cli", *shlex.split(line)[1:]]
            program = [sys.executable, *words]
            if is_left:
                running.append(started(program, folder))
                continue
            done = subprocess.run(
                program, cwd=folder, capture_output=True, text=True, check=False
            )
            assert done.returncode == 0, f"{part.text}\n{done.stdout}{done.stderr}"
            printed.append(done.stdout)
    return "\n".join(printed)


def started(program: list[str], folder: Path) -> subprocess.Popen[str]:
    """Start a program that runs on, and wait for its first line."""
    process = subprocess.Popen(
        program, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    assert process.stdout is not None
    since = time.monotonic()
    line = process.stdout.readline()
    assert line, f"{program} ended"
    assert time.monotonic() - since < STARTS
    return process


def test_a_method_is_compared(tmp_path: Path) -> None:
    printed = run_page("compare.md", tmp_path)
    assert (tmp_path / "compared" / "poses.png").is_file()
    assert (tmp_path / "score" / "score.html").is_file()
    assert (tmp_path / "shown" / "demo_right.npz").is_file()
    rows = dict(
        re.findall(r"^ (mine\.py:joints|q) +([-.\d ]+?) *$", printed, re.MULTILINE)
    )
    # By each way, the same joints are measured alike. The last column is the time of a step,
    # which a file does not tell.
    assert rows["q"].split()[:-1] == rows["mine.py:joints"].split()[:-1]


@pytest.mark.parametrize("page", ["compare.md"])
def test_pages_are_short(page: str) -> None:
    text = re.sub(r"```.*?```", "", (DOCS / page).read_text("utf-8"), flags=re.DOTALL)
    assert 250 < len(text.split()) <= 500
