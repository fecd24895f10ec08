"""The code and the commands of the README, and how a reader's shell runs them."""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import time
import urllib.request
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PATIENCE = 1200.0
"""Longest time of one command, on a machine that does much else [s]."""
CODE = re.compile(r"^```python\n(.*?)^```|^    (\w[^\n]*)$", re.DOTALL | re.MULTILINE)
SERVES = "handmap view"
"""Commands that begin so serve a page until they are interrupted."""


class Step(NamedTuple):
    """What a reader types: a command of the shell, or a program in Python."""

    command: str = ""
    program: str = ""


def steps() -> list[Step]:
    """Return all code of the README in its order, without comments of commands."""
    found = []
    for match in CODE.finditer(README):
        program, line = match.groups()
        command = re.split(r"\s+#", line)[0] if line else ""
        found.append(Step(command, program or ""))
    return found


def environment_of(folder: Path) -> dict[str, str]:
    """Return variables of a shell in which an environment is active, and nothing of this one."""
    kept = {
        name: value
        for name, value in os.environ.items()
        if not name.startswith(("PYTHON", "HANDMAP_", "VIRTUAL_ENV", "XDG_"))
    }
    return kept | {
        "PATH": f"{folder / 'bin'}{os.pathsep}{os.environ['PATH']}",
        "XDG_CACHE_HOME": str(folder / "cache"),
        "PYTHONUNBUFFERED": "1",
    }


def run(words: list[str], cwd: Path, environment: dict[str, str]) -> str:
    """Run a command that must succeed, and return what it prints."""
    done = subprocess.run(
        words,
        cwd=cwd,
        env=environment,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert done.returncode == 0, f"{shlex.join(words)}:\n{done.stdout}{done.stderr}"
    return done.stdout


def shows_page(words: list[str], cwd: Path, environment: dict[str, str]) -> bool:
    """Run a command that serves, load the page whose address it prints, and interrupt it."""
    with subprocess.Popen(
        words,
        cwd=cwd,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as process:
        assert process.stdout
        try:
            printed = ""
            address = None
            while not address and (line := process.stdout.readline()):
                printed += line
                address = re.search(r"http://[\w.:]+", line)
            assert address, f"{shlex.join(words)}:\n{printed}"
            return is_page(address.group())
        finally:
            process.send_signal(signal.SIGINT)
            try:
                process.wait(60.0)
            except subprocess.TimeoutExpired:
                process.kill()


def is_page(address: str) -> bool:
    """Tell whether a page comes from an address within a minute."""
    until = time.monotonic() + 60.0
    while True:
        try:
            with urllib.request.urlopen(address, timeout=60.0) as answer:
                return b"<html" in answer.read()
        except OSError:
            if time.monotonic() > until:
                raise
            time.sleep(0.1)


def run_steps(folder: Path, environment: dict[str, str]) -> int:
    """Run all code and commands but those that install or make, in the README's order.

    Args:
        folder: The folder of the shell.
        environment: Variables of the shell.

    Returns:
        How many were run.
    """
    ran = 0
    for command, program in steps():
        if program:
            script = folder / "program.py"
            script.write_text(program, encoding="utf-8")
            assert run(["python", str(script)], folder, environment)
        elif command.startswith(SERVES):
            assert shows_page(shlex.split(command), folder, environment)
        elif command.startswith("handmap"):
            assert run(shlex.split(command), folder, environment)
        else:
            continue
        ran += 1
    return ran


def count_steps() -> int:
    """Return how many steps the README has that `run_steps` must run."""
    commands = [step.command for step in steps()]
    return sum(not line.startswith(("pip ", "make ")) for line in commands)
