"""Emulated motors in a thread: they start at once, where a process takes a second to import."""

from __future__ import annotations

import json
import os
import threading
from types import TracebackType
from typing import Any

import numpy as np

START = 0.3
"""Where motors are at the start, as in `handmap_drive.emulator` [rad]."""


class MotorThread:
    """Emulated motors, used as `handmap_drive.processes.Emulator`; a context manager.

    Args:
        kind: What motors they are.
        count: How many they are; a hand has its own number.
    """

    def __init__(self, kind: str, count: int = 2) -> None:
        # It needs packages/drive and what it installs.
        from handmap_drive.emulator import Bus, emulate

        self._bus = Bus(kind, range(count), START)
        self.port = self._bus.line.port
        taken, given = os.pipe(), os.pipe()
        self._orders, self._answers = os.fdopen(taken[1], "w"), os.fdopen(given[0])
        ends = os.fdopen(taken[0]), os.fdopen(given[1], "w")
        self._ends = ends

        def act() -> None:
            try:
                emulate(self._bus, *ends)
            finally:
                # Who waits for an answer sees that there is none.
                ends[1].close()

        self._thread = threading.Thread(target=act)

    def __enter__(self) -> MotorThread:
        """Let the motors act."""
        self._thread.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Let them end."""
        self._orders.close()
        self._thread.join()
        if self._bus.line.fd >= 0:
            self._bus.line.close()
        for file in (self._answers, *self._ends):
            file.close()

    def order(self, **orders: Any) -> dict[str, np.ndarray]:
        """See `Emulator`."""
        print(json.dumps(orders), file=self._orders, flush=True)
        answer = json.loads(self._answers.readline())
        state = {name: np.array(value) for name, value in answer.items()}
        return state | {"torque": state["limit"] > 0.0}
