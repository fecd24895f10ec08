"""LeRobot itself, run in the environment that has it."""

from __future__ import annotations

import os
import subprocess
from pathlib import Path


def run_lerobot(home: Path, *words: str) -> str:
    """Run a command; it must not ask the network, nor write into the home directory.

    Args:
        home: Folder for what LeRobot keeps.
        words: The command.

    Returns:
        What it prints.
    """
    own = {"HF_HOME": str(home / "hub"), "HF_HUB_OFFLINE": "1", "PYTHONPATH": ""}
    done = subprocess.run(
        words,
        capture_output=True,
        text=True,
        check=False,
        timeout=300,
        env=os.environ | own,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return done.stdout
