"""Smoothing with look-ahead by parts: the same numbers, in a memory that does not grow."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from long_cases import FORMATS, played, shorten_pieces, traced_peak, without

from handmap_qp.apps.offline import look_ahead as module
from handmap_qp.apps.offline.look_ahead import look_ahead, look_ahead_parts
from handmap_qp.cli import main
from handmap_qp.human import Recording
from handmap_qp.trackers import write_recordings
from handmap_qp.trackers.formats.long import part_of


def noisy(count: int, rate: float = 60.0) -> Recording:
    """Return the hand of the demo with noise, played to and fro."""
    recording = played("played", count, rate=rate, start=0.0)
    noise = np.random.default_rng(5).normal(0.0, 1e-3, recording.landmarks.shape)
    return replace(recording, landmarks=recording.landmarks + noise)


def split(recording: Recording, size: int) -> Iterator[Recording]:
    """Yield a recording by parts of random sizes, in some of which no hand is seen."""
    rng = np.random.default_rng(size)
    start = 0
    while start < len(recording):
        stop = start + int(rng.integers(1, size))
        yield part_of(recording, slice(start, stop))
        start = stop


GAPS = [
    slice(*gap)
    for gap in ((0, 7), (300, 320), (500, 560), (561, 600), (1000, 1029), (1390, 1400))
]
"""At 60 Hz: at the start, short, long with a sample between, just short enough, at the end."""


@pytest.mark.parametrize("size", [2, 37, 400])
def test_parts_of_any_size_give_the_same_numbers(
    size: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "_BLOCK", 200)
    recording = without(noisy(1400), *GAPS)
    if size == 2:
        recording = recording.part(slice(0, 620))
    whole = look_ahead(recording)
    parts = [*look_ahead_parts(split(recording, size))]
    assert len(parts) > 3
    for name in ("time", "landmarks", "valid"):
        found = np.concatenate([getattr(part, name) for part in parts])
        assert found.tobytes() == getattr(whole, name).tobytes(), name


def test_blocks_are_smoothed_as_the_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    recording = without(noisy(1400), *GAPS)
    monkeypatch.setattr(module, "_BLOCK", 10**6)
    whole = look_ahead(recording)
    # The sample alone between two gaps is too little to smooth.
    expected = np.ones(1400, dtype=bool)
    for start, stop in ((0, 7), (500, 560), (561, 600), (1390, 1400)):
        expected[start:stop] = False
    np.testing.assert_array_equal(whole.valid, expected)
    monkeypatch.setattr(module, "_BLOCK", 100)
    blocks = look_ahead(recording)
    np.testing.assert_array_equal(blocks.valid, expected)
    np.testing.assert_allclose(
        blocks.landmarks[expected], whole.landmarks[expected], atol=1e-12
    )
    assert not np.array_equal(blocks.landmarks[expected], whole.landmarks[expected])


@pytest.mark.parametrize("is_seen", [True, False])
def test_memory_does_not_grow(
    monkeypatch: pytest.MonkeyPatch, *, is_seen: bool
) -> None:
    monkeypatch.setattr(module, "_BLOCK", 256)
    peaks: list[int] = []
    for count in (2000, 8000):
        recording = noisy(count)
        if not is_seen:
            recording = without(recording, slice(100, count))
        kept = 0
        with traced_peak(peaks):
            for part in look_ahead_parts(split(recording, 100)):
                kept += len(part)
        assert kept == count
    # A sample has 500 bytes.
    assert peaks[1] - peaks[0] < 50 * 6000


def test_batch_writes_the_same_episode(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shorten_pieces(monkeypatch)
    file = tmp_path / "hours.npz"
    write_recordings([without(noisy(420), slice(100, 110), slice(200, 300))], file)
    found = []
    for name, shortest in (("long", 2), ("short", 10**6)):
        monkeypatch.setattr(f"{FORMATS}.long.SHORTEST", shortest)
        folder = tmp_path / name
        words = ["--robot", "three_finger", "--out", str(folder), "--workers", "0"]
        assert main(["batch", str(file), *words, "--look-ahead"]) == 0
        (episode,) = (folder / "episodes").iterdir()
        manifest = (folder / "manifest.jsonl").read_text()
        found.append((episode.read_bytes(), manifest[manifest.index('"metrics"') :]))
    assert found[0] == found[1]
