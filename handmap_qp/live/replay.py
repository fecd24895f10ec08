"""`Replay`: a recording as a live source, at any speed, with faults put in on purpose."""

from __future__ import annotations

import time
from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording, recording_samples
from handmap_qp.human.sample import HumanSample
from handmap_qp.trackers.injection import Fault, inject

SPEEDS = (0.01, 100.0)
"""Least and largest speed of a replay."""


class Replay:
    """A recording that arrives as if it were live.

    Args:
        recording: The recording.
        speed: Factor on the speed of time, from 0.01 to 100; the motion is as much faster.
        loop: Start again at the end, until interrupted.
        faults: Faults to put in; their times count from the first sample of the replay.
        seed: Seed of the faults' random numbers.

    Raises:
        InvalidInputError: If the speed is out of its range.
    """

    def __init__(
        self,
        recording: Recording,
        *,
        speed: float = 1.0,
        loop: bool = False,
        faults: tuple[Fault, ...] = (),
        seed: int = 0,
    ) -> None:
        low, high = SPEEDS
        if not low <= speed <= high:
            raise InvalidInputError(
                argument="speed", expected=f"a factor from {low} to {high}", value=speed
            )
        self._recording, self._speed, self._loop = recording, speed, loop
        self._faults, self._seed = faults, seed

    @property
    def name(self) -> str:
        """Name of the recording."""
        return self._recording.name

    @property
    def side(self) -> Side:
        """The recorded hand."""
        return self._recording.side

    @property
    def rate(self) -> float:
        """Median rate of the recording, times the speed [Hz]."""
        return self._speed / float(np.median(self._recording.steps))

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield each sample when its time has come.

        Time stamps are on this machine's monotonic clock, unless a fault changes them.
        """
        return inject(_paced(self._timed()), self._faults, self._seed)

    def _timed(self) -> Iterator[HumanSample]:
        """Yield samples with time stamps that start at 0 and keep increasing through all loops."""
        recording, offset = self._recording, 0.0
        duration = recording.time[-1] - recording.time[0] + np.median(recording.steps)
        while True:
            for sample in recording_samples(recording):
                elapsed = sample.time - recording.time[0] + offset
                yield replace(sample, time=float(elapsed / self._speed))
            if not self._loop:
                return
            offset += duration


def _paced(samples: Iterable[HumanSample]) -> Iterator[HumanSample]:
    """Yield each sample at its time after the first one, stamped by the monotonic clock."""
    start = time.monotonic()
    for sample in samples:
        due = start + sample.time
        if (wait := due - time.monotonic()) > 0.0:
            time.sleep(wait)
        yield replace(sample, time=due)
