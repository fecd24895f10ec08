"""Programs in processes of their own: commands of the package, and emulated motors."""

import json
import signal
import subprocess
import sys
from typing import Any, Self

import numpy as np


class Process:
    """A Python program in a process of its own; also a context manager.

    Args:
        module: The program.
        *words: Words of its command line.
        stderr: Where its stderr goes, as of `subprocess.Popen`.
    """

    def __init__(self, module: str, *words: str, stderr: int | None = None) -> None:
        self.process = subprocess.Popen(
            [sys.executable, "-m", module, *words],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=stderr,
            text=True,
        )

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.end()

    def line(self) -> dict[str, Any]:
        """Return the next line that it prints, as JSON."""
        assert self.process.stdout is not None
        return json.loads(self.process.stdout.readline())

    def end(self) -> tuple[str, str]:
        """End it; return stdout and stderr."""
        self.process.send_signal(signal.SIGINT)
        return self.process.communicate(timeout=30.0)


class Emulator(Process):
    """Emulated motors; `emulator` says what they take.

    Args:
        kind: What motors they are.
        *options: Further words of the command line.

    Attributes:
        port: Name of the pseudo-terminal, or HOST:PORT.
    """

    def __init__(self, kind: str, *options: str) -> None:
        super().__init__("handmap_drive.emulator", kind, *options)
        self.port = self.line()["port"]

    def order(self, **orders: Any) -> dict[str, np.ndarray]:
        """Send a line of orders, and return the state after it."""
        print(json.dumps(orders), file=self.process.stdin, flush=True)
        state = {name: np.array(value) for name, value in self.line().items()}
        return state | {"torque": state["limit"] > 0.0}

    def end(self) -> tuple[str, str]:
        """See `Process`; it ends with its stdin."""
        return self.process.communicate()
