"""Recordings of seconds that count as long ones, for tests of what is read by pieces."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from handmap_qp import read_recording
from handmap_qp.human import Recording

PIECE = 50
"""Samples of a piece in these tests."""
FORMATS = "handmap_qp.trackers.formats"


def shorten_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let recordings of seconds be long ones, of many pieces."""
    monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", 2)
    for module in (f"{FORMATS}.csv_files", f"{FORMATS}.long"):
        monkeypatch.setattr(f"{module}.PIECE", PIECE)
    monkeypatch.setattr("handmap_qp.apps.offline.long_summary.PIECE", PIECE)


def played(
    name: str, count: int, *, rate: float = 30.0, start: float = 5.0
) -> Recording:
    """Return the right hand of the demo, played to and fro, and seen all the time.

    Args:
        name: Name of the recording.
        count: Number of samples.
        rate: Samples a second.
        start: First instant [s].
    """
    demo = read_recording("demo", "right")
    seen = demo.landmarks[demo.valid]
    points = np.resize(np.concatenate([seen, seen[::-1]]), (count, 21, 3))
    time = start + np.arange(count) / rate
    return Recording(name, time, points, np.ones(count, dtype=bool), "right")


def without(recording: Recording, *gaps: slice) -> Recording:
    """Return a recording in which the hand is not seen in some samples."""
    valid = recording.valid.copy()
    for gap in gaps:
        valid[gap] = False
    landmarks = np.where(valid[:, None, None], recording.landmarks, np.nan)
    return replace(recording, landmarks=landmarks, valid=valid)


@contextmanager
def traced_peak(peaks: list[int]) -> Iterator[None]:
    """Append the most memory that Python and numpy held at once in the block [bytes]."""
    tracemalloc.start()
    try:
        yield
        peaks.append(tracemalloc.get_traced_memory()[1])
    finally:
        tracemalloc.stop()
