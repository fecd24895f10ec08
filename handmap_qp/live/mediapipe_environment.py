"""The environment of MediaPipe, apart from this one: made once by `handmap track mediapipe`.

MediaPipe 0.10.21 is the last version that brings its hand model, so that it works offline. It needs
numpy below 2 and about 1 GB of packages, so it gets a virtual environment of its own.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

from handmap_qp.errors import InvalidInputError

VARIABLE = "HANDMAP_MEDIAPIPE"
"""Environment variable that names another folder."""
REQUIREMENTS = ("mediapipe==0.10.21", "numpy<2")
"""What the environment holds."""
PYTHONS = ((3, 10), (3, 12))
"""First and last Python that MediaPipe 0.10.21 and our program run on."""
_OTHER_PYTHONS = ("python3.12", "python3.11", "python3.10")


def environment_folder() -> Path:
    """Return the folder: of `HANDMAP_MEDIAPIPE`, or `handmap/mediapipe` in the user's data."""
    if named := os.environ.get(VARIABLE):
        return Path(named).resolve()
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(data) / "handmap" / "mediapipe"


def environment_python() -> Path:
    """Return the environment's interpreter.

    Raises:
        InvalidInputError: If the environment has not been made.
    """
    python = environment_folder() / "bin" / "python"
    if not python.exists():
        raise InvalidInputError(
            problem=f"MediaPipe is not installed in {environment_folder()}",
            advice="install it once (1 GB) by handmap track mediapipe --install",
        )
    return python


def install_environment(report: Callable[[str], object]) -> Path:
    """Make the environment, or make it again.

    Args:
        report: Called with a line before each step.

    Returns:
        Its folder.

    Raises:
        InvalidInputError: If there is no Python that MediaPipe runs on, or pip fails.
    """
    folder = environment_folder()
    python = _find_python()
    report(f"making {folder}")
    folder.parent.mkdir(parents=True, exist_ok=True)
    _run([python, "-m", "venv", "--clear", str(folder)], "the environment cannot be made")
    report(f"installing {' '.join(REQUIREMENTS)} (about 1 GB)")
    pip = [str(folder / "bin" / "python"), "-m", "pip", "--disable-pip-version-check", "install"]
    try:
        _run([*pip, "--quiet", *REQUIREMENTS], "pip cannot install MediaPipe")
    except InvalidInputError:
        # Half an environment would pass for a whole one.
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return folder


def _find_python() -> str:
    low, high = PYTHONS
    if low <= sys.version_info[:2] <= high:
        return sys.executable
    for name in _OTHER_PYTHONS:
        if found := shutil.which(name):
            return found
    raise InvalidInputError(
        argument="--install",
        expected=f"Python {low[0]}.{low[1]} to {high[0]}.{high[1]} for MediaPipe",
        got=f"{sys.version_info[0]}.{sys.version_info[1]} and none of {', '.join(_OTHER_PYTHONS)}",
    )


def _run(command: list[str], problem: str) -> None:
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False)
    except OSError as error:
        raise InvalidInputError(argument="--install", problem=f"{problem}: {error}") from error
    if done.returncode:
        lines = (done.stderr.strip() or done.stdout.strip() or "no message").splitlines()
        errors = [line for line in lines if line.startswith("ERROR:")]
        raise InvalidInputError(argument="--install", problem=f"{problem}: {(errors or lines)[-1]}")
