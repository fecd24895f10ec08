"""Processes that are started and ended with a command: `start_command`, `end_process`."""

import subprocess
import sys
from collections.abc import Sequence

_END = 5.0
"""Longest wait for a process to end [s]."""


def start_command(
    words: Sequence[str], *, is_read: bool = False
) -> subprocess.Popen[str]:
    """Start a command of `handmap` that Ctrl-C in the terminal does not reach.

    Args:
        words: Words after `handmap`.
        is_read: Whether its output is read here instead of printed.
    """
    return subprocess.Popen(
        [sys.executable, "-m", "handmap_qp.cli", *words],
        stdout=subprocess.PIPE if is_read else None,
        text=True,
        start_new_session=True,
    )


def end_process(process: subprocess.Popen[str]) -> None:
    """End a process of ours, by force if it takes too long."""
    process.terminate()
    try:
        process.wait(_END)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    if process.stdout:
        process.stdout.close()
