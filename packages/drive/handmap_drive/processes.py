"""Programs in processes of their own: commands of the package, and emulated motors."""

import json
import sys
from signal import SIGINT
from subprocess import PIPE, Popen
from typing import Any

import numpy as np


class Process(Popen[str]):
    """A Python program in a process of its own, which ends with the block of `with`.

    Args:
        module: The program.
        *words: Words of its command line.
        stderr: See `Popen`.
    """

    def __init__(self, module: str, *words: str, stderr: int | None = None) -> None:
        command = [sys.executable, "-m", module, *words]
        super().__init__(command, stdin=PIPE, stdout=PIPE, stderr=stderr, text=True)

    def __exit__(self, exc_type: Any, value: Any, traceback: Any) -> None:
        if self.poll() is None:
            self.end()
        super().__exit__(exc_type, value, traceback)

    def line(self) -> dict[str, Any]:
        """Return the next line that it prints, as JSON."""
        assert self.stdout is not None
        return json.loads(self.stdout.readline())

    def end(self) -> tuple[str, str]:
        """End it; return stdout and stderr."""
        self.send_signal(SIGINT)
        return self.communicate(timeout=30.0)


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
        print(json.dumps(orders), file=self.stdin, flush=True)
        state = {name: np.array(value) for name, value in self.line().items()}
        return state | {"torque": state["limit"] > 0.0}

    def end(self) -> tuple[str, str]:
        """See `Process`; it ends with its stdin."""
        return self.communicate()
