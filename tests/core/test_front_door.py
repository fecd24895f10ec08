"""All that the README tells a reader to type works, in its order, after its own install line.

The environment is fresh: the package's wheel with the extras that the line names, and nothing else.
`make demo` and `make test` make the environment that these tests run in.
"""

from __future__ import annotations

import os
import re
import shlex
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path
from typing import NamedTuple

import pytest
from paths.fresh import wheel

# Half a gigabyte of packages is installed.
pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
MOST_WORDS = 700
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


COMMANDS = [step.command for step in steps() if step.command]
(INSTALL,) = (line for line in COMMANDS if line.startswith("pip install"))


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


@pytest.fixture(scope="module")
def environment(
    tmp_path_factory: pytest.TempPathFactory,
) -> dict[str, str]:
    """An environment that has what the README's install line installs."""
    folder = tmp_path_factory.mktemp("environment")
    variables = environment_of(folder)
    run([sys.executable, "-m", "venv", str(folder)], folder, variables)
    what = shlex.split(INSTALL)[2:]
    (requirement,) = what
    # The checkout as a wheel, which other tests have perhaps built.
    built = requirement.replace(".", str(wheel()), 1)
    pip = [str(folder / "bin" / "python"), "-m", "pip", "install", "--quiet"]
    run([*pip, built], folder, variables)
    return variables


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


def test_every_step_works_in_the_order_of_the_page(
    environment: dict[str, str], tmp_path: Path
) -> None:
    ran = 0
    for command, program in steps():
        if program:
            script = tmp_path / "program.py"
            script.write_text(program, encoding="utf-8")
            assert run(["python", str(script)], tmp_path, environment)
        elif command.startswith(SERVES):
            assert shows_page(shlex.split(command), tmp_path, environment)
        elif command.startswith("handmap"):
            assert run(shlex.split(command), tmp_path, environment)
        else:
            continue
        ran += 1
    assert ran == len(steps()) - len([INSTALL]) - README.count("\n    make ")
    assert (tmp_path / "demo" / "gestures.png").is_file()
    assert (tmp_path / "hand_allegro_right.npz").is_file()


def test_the_page_is_short() -> None:
    assert len(README.split()) <= MOST_WORDS


def test_commands_outside_of_blocks_exist(environment: dict[str, str]) -> None:
    for words in set(re.findall(r"`handmap ([a-z ]+)`", README)):
        run(["handmap", *words.split(), "--help"], Path.cwd(), environment)
