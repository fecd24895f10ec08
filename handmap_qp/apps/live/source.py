"""`Source` and `Sink`: where human samples come from and go to, and the loop between them.

`Replay` is a recording as a source, `Recorder` a sink that writes one.
"""

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from handmap_core.errors import InvalidInputError, expect
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import HumanSample, Recording, sample_columns
from handmap_qp.output_files import check_output
from handmap_qp.trackers import write_recordings

SPEEDS = (0.01, 100.0)
"""Least and largest speed of a replay."""
SUFFIXES = (".npz", ".csv")
"""Files that hold everything of a sample, and whose writing needs no further package."""
_RATE_SAMPLES = 60
"""Number of samples that the rate is measured over."""


class Source(Protocol):
    """A tracker, a file or anything else that gives human samples in the order of their arrival.

    Attributes:
        name: Name to show.
        side: The hand that all samples are of.
        rate: Samples per second that it gives if nothing fails [Hz]; 0 if not known.
        upright: Axes of the samples' world, as in `Recording`.
    """

    name: str
    side: Side
    rate: float
    upright: str

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield samples as they arrive, until the source ends or its reader leaves."""
        ...

    def summary(self) -> Values:
        """Return what else is to be said at the end, by label."""
        return {}


class Sink(contextlib.AbstractContextManager[Any, Any], Protocol):
    """Takes samples; a context manager that finishes its work at the end of the block."""

    def put(self, sample: HumanSample) -> None:
        """Take one sample; must not wait for long."""
        ...

    def status(self) -> str:
        """Return the present state in a few words."""
        ...

    def summary(self) -> Values:
        """Return what was done, by label."""
        ...


def run(
    source: Source,
    sinks: Sequence[Sink],
    report: Callable[[str], object] = lambda _: None,
) -> Values:
    """Send samples to sinks until the source ends or Ctrl-C.

    Args:
        source: The samples.
        sinks: Where each sample goes, entered and left here.
        report: Called with the present state after every sample.

    Returns:
        What was done, by label: of the source, then of each sink.
    """
    count = seen = 0
    expected = f" of {source.rate:.0f}" if source.rate else ""
    times = deque[float](maxlen=_RATE_SAMPLES)
    with contextlib.ExitStack() as open_sinks:
        for sink in sinks:
            open_sinks.enter_context(sink)
        with contextlib.suppress(KeyboardInterrupt):
            for sample in source:
                count += 1
                seen += bool(sample.valid)
                times.append(sample.time)
                for sink in sinks:
                    sink.put(sample)
                elapsed = times[-1] - times[0]
                rate = (len(times) - 1) / elapsed if elapsed > 0.0 else 0.0
                state = f"{source.name}: {count} samples at {rate:.0f}{expected} Hz"
                state += f", hand seen in {seen / count:.0%}"
                report(" | ".join([state, *(sink.status() for sink in sinks)]))
    summary: Values = {"samples": count, "hand_seen": seen, **source.summary()}
    for sink in sinks:
        summary |= sink.summary()
    return summary


class Replay(Source):
    """A recording that arrives as if it were live.

    Args:
        recording: The recording.
        speed: Factor on the speed of time, from 0.01 to 100; the motion is as much faster.
        loop: Start again at the end, until interrupted.

    Raises:
        InvalidInputError: If the speed is out of its range.
    """

    def __init__(
        self, recording: Recording, *, speed: float = 1.0, loop: bool = False
    ) -> None:
        low, high = SPEEDS
        expected = f"a factor from {low} to {high}"
        expect(low <= speed <= high, "speed", expected, value=speed)
        self.name = recording.name
        self.side = recording.side
        self.upright = recording.upright
        self.rate = speed / float(np.median(recording.steps))
        self._recording = recording
        self._speed = speed
        self._loop = loop

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield each sample at its time, through all loops, stamped by the monotonic clock."""
        recording = self._recording
        offset = -float(recording.time[0])
        start = time.monotonic()
        duration = np.ptp(recording.time) + np.median(recording.steps)
        while True:
            for sample in sample_columns(recording):
                due = start + (sample.time + offset) / self._speed
                if (wait := due - time.monotonic()) > 0.0:
                    time.sleep(wait)
                yield replace(sample, time=due)
            if not self._loop:
                return
            offset += duration


class Recorder(Sink):
    """Collects samples, and writes them to a file at the end.

    Samples whose time stamps do not increase are left out and counted, because recordings are in
    the order of time.

    Args:
        file: The file to write, `.npz` or `.csv`; one that exists is replaced at the end. `handmap
            convert` makes other formats of it.
        argument: Argument or option that names it, for errors.
        upright: Axes of the samples' world, as in `Recording`.

    Raises:
        InvalidInputError: If the file cannot be written there.
    """

    def __init__(self, file: Path, argument: str = "file", upright: str = "") -> None:
        self.file = check_output(argument, file, SUFFIXES)
        self._argument = argument
        self.upright = upright
        self._samples: list[HumanSample] = []
        self._disordered = 0
        self._lost: Names = ()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Write the file; an error if the hand was never seen, or it cannot be written."""
        samples = self._samples
        if not any(sample.valid for sample in samples):
            if kind:
                # The exception of the source comes before the complaint that nothing was seen.
                return
            raise InvalidInputError(
                f"the hand was not seen in any of {len(samples)} samples",
                argument=self._argument,
                advice="nothing was written",
            )
        columns: Values = {
            name: np.array([getattr(sample, name) for sample in samples])
            for name in ("time", "landmarks", "valid", "confidence")
        }
        columns["time"] -= samples[0].time
        recording = Recording(
            name=self.file.stem,
            side=samples[0].side,
            source="handmap track",
            **columns,
            upright=self.upright,
        )
        self._lost = write_recordings([recording], self.file)

    def put(self, sample: HumanSample) -> None:
        """Keep a sample.

        Raises:
            InvalidInputError: If it is of the other hand than the first one.
        """
        before = self._samples or [sample]
        side = before[0].side
        expected = f"samples of the {side} hand"
        expect(sample.side == side, "side", expected, value=sample.side)
        if self._samples and sample.time <= before[-1].time:
            self._disordered += 1
        else:
            self._samples.append(sample)

    def status(self) -> str:
        """Return the number of samples kept."""
        return f"recording {len(self._samples)}"

    def summary(self) -> Values:
        """Return the file, counts, and what the file cannot hold."""
        return {
            "recorded": len(self._samples),
            "not_in_order": self._disordered,
            "record": str(self.file),
            "lost": ", ".join(self._lost),
        }
