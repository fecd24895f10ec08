"""Recordings made from real ones, for runs over data sets: pieces, warped, noisy, with gaps."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.random import Generator

from handmap_core.human.recording import Recording
from handmap_qp.trackers.formats import read_recording, write_recordings


def make_recordings(
    sources: list[Path], folder: Path, count: int, *, frames: int = 90, seed: int = 0
) -> int:
    """Write recordings made from real ones.

    Each is a piece of a real recording with its time stretched by 0.7 to 1.4 and warped, 0.5 mm of
    noise, a gap in every third, and the whole turned about the vertical.

    Args:
        sources: Real recordings.
        folder: Folder to write to.
        count: How many.
        frames: Mean number of samples.
        seed: Seed.

    Returns:
        Number of samples in all.
    """
    rng = np.random.default_rng(seed)
    real = [read_recording(file) for file in sources]
    folder.mkdir(parents=True, exist_ok=True)
    total = 0
    for i in range(count):
        made = _made(real[i % len(real)], rng, frames, has_gap=i % 3 == 0)
        write_recordings([made], folder / f"set{i // 100:03d}_{i % 100:02d}.npz")
        total += len(made)
    return total


def _made(real: Recording, rng: Generator, frames: int, *, has_gap: bool) -> Recording:
    while True:
        count = min(len(real), int(rng.integers(frames // 2, 3 * frames // 2 + 1)))
        first = int(rng.integers(0, len(real) - count + 1))
        part = slice(first, first + count)
        valid = real.valid[part].copy()
        if has_gap:
            start, length = int(rng.integers(5, count - 15)), int(rng.integers(3, 12))
            valid[start : start + length] = False
        if valid.sum() > count // 2:
            break
    steps = real.steps[part] * rng.uniform(0.7, 1.4)
    warp = 1.0 + 0.3 * np.sin(
        np.linspace(0.0, rng.uniform(2.0, 9.0), count) + rng.uniform(0, 6)
    )
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array(
        [
            [np.cos(angle), 0.0, np.sin(angle)],
            [0.0, 1.0, 0.0],
            [-np.sin(angle), 0.0, np.cos(angle)],
        ]
    )
    landmarks = real.landmarks[part] @ turn.T + rng.normal(0.0, 5e-4, (count, 21, 3))
    return replace(
        real,
        name="made",
        time=np.cumsum(steps * warp),
        landmarks=landmarks,
        valid=valid,
        wrist=None,
        confidence=None,
    )
