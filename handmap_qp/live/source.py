"""`Source` and `Sink`: where human samples come from and go to, and the loop between them."""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from types import TracebackType
from typing import Any, Protocol

from handmap_qp.hands.spec import Side
from handmap_qp.human.sample import HumanSample

_RATE_SAMPLES = 60
"""Number of samples that the rate is measured over."""


class Source(Protocol):
    """A tracker, a file or anything else that gives human samples in the order of their arrival.

    Iterating waits for the next sample, ends when the source ends, and may be left at any time.
    """

    @property
    def name(self) -> str:
        """Name to show."""
        ...

    @property
    def side(self) -> Side:
        """The hand that all samples are of."""
        ...

    @property
    def rate(self) -> float:
        """Samples per second that it gives if nothing fails [Hz]; 0 if not known."""
        ...

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield the samples."""
        ...


class Sink(Protocol):
    """Takes samples; a context manager that finishes its work at the end of the block."""

    def put(self, sample: HumanSample) -> None:
        """Take one sample; must not wait for long."""
        ...

    def status(self) -> str:
        """Return the present state in a few words."""
        ...

    def summary(self) -> dict[str, Any]:
        """Return what was done, by label."""
        ...

    def __enter__(self) -> Sink:
        """Start."""
        ...

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
        /,
    ) -> None:
        """Finish, also after an exception."""
        ...


class _Tally:
    """Counts and rate of the samples that passed."""

    def __init__(self, expected_rate: float) -> None:
        self.count = self.seen = 0
        self._expected = f" of {expected_rate:.0f}" if expected_rate else ""
        self._times: deque[float] = deque(maxlen=_RATE_SAMPLES)

    def add(self, sample: HumanSample) -> None:
        """Count a sample."""
        self.count += 1
        self.seen += sample.valid
        self._times.append(sample.time)

    @property
    def rate(self) -> float:
        """Rate of the last samples by their time stamps [Hz]; 0 before the second."""
        elapsed = self._times[-1] - self._times[0] if self._times else 0.0
        return (len(self._times) - 1) / elapsed if elapsed > 0.0 else 0.0

    def __str__(self) -> str:
        share = f", hand seen in {self.seen / self.count:.0%}" if self.count else ""
        return f"{self.count} samples at {self.rate:.0f}{self._expected} Hz{share}"


def run(
    source: Source, sinks: Sequence[Sink], report: Callable[[str], object] = lambda _: None
) -> dict[str, Any]:
    """Lead samples to sinks until the source ends or Ctrl-C.

    Args:
        source: The samples.
        sinks: Where each sample goes, entered and left here.
        report: Called with the present state after every sample.

    Returns:
        What was done, by label: of the source, then of each sink.
    """
    tally = _Tally(source.rate)
    with contextlib.ExitStack() as open_sinks:
        for sink in sinks:
            open_sinks.enter_context(sink)
        with contextlib.suppress(KeyboardInterrupt):
            for sample in source:
                tally.add(sample)
                for sink in sinks:
                    sink.put(sample)
                report(" | ".join([f"{source.name}: {tally}", *(s.status() for s in sinks)]))
    summary: dict[str, Any] = {"samples": tally.count, "hand_seen": tally.seen}
    for sink in sinks:
        summary |= sink.summary()
    return summary
