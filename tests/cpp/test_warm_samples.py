"""A warm sample of the library asks nothing of the system: no memory, no lock, no system call."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from library_in_c import ROOT, linked_program, run
from run_cases import FAULTS, mapper_of, recording_with

from handmap_core.human.recording import Recording
from handmap_qp import load_hand
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.human import PALM, landmarks_at_rest
from handmap_qp.se3 import Array, rigid_fit
from handmap_qp.trackers import read_recording, write_recordings

# A compiler's work, once for the module.
pytestmark = pytest.mark.slow
SOURCE = ROOT / "core" / "tests" / "warm_samples.cpp"
WARM_UP = 2
"""Samples that may take memory: the first is the reference, the second has the first motion."""
HANDS = ("allegro_right", "three_finger", "shadow_right")
"""Before memory was used again, batches of the input check took most with the last: 179 blocks."""


class Counts(NamedTuple):
    """What `warm_samples` prints."""

    samples: int
    held: int
    blocks: int
    locks: int
    end: str


@pytest.fixture(scope="module")
def program(prefix: Path, folder: Path) -> Path:
    """Return the program that counts."""
    if platform.system() != "Linux" or platform.libc_ver()[0] != "glibc":
        pytest.skip("needs Linux and glibc")
    return linked_program(SOURCE, prefix, folder)


@pytest.fixture(scope="module")
def hand_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the file of a hand."""
    return written_hand("allegro_right", tmp_path_factory.mktemp("hand"))


def written_hand(name: str, folder: Path) -> Path:
    """Write a hand that keeps its links apart; return the file."""
    file = folder / f"{name}.hand"
    file.write_bytes(saved_bytes(mapper_of(name, "teleoperation")))
    return file


def written(parts: Sequence[Recording], file: Path) -> Path:
    """Write recordings as one, each behind the one before."""
    starts = np.cumsum([0.0] + [part.time[-1] - part.time[0] + 0.02 for part in parts])
    wrists = [part.wrist for part in parts if part.wrist is not None]
    shares = [part.confidence for part in parts if part.confidence is not None]
    assert len(wrists) in {0, len(parts)}
    assert len(shares) == len(parts)
    whole = Recording(
        name="parts",
        time=np.concatenate(
            [
                part.time - part.time[0] + start
                for part, start in zip(parts, starts[:-1], strict=True)
            ]
        ),
        landmarks=np.concatenate([part.landmarks for part in parts]),
        valid=np.concatenate([part.valid for part in parts]),
        side="right",
        wrist=np.concatenate(wrists) if wrists else None,
        confidence=np.concatenate(shares),
    )
    write_recordings([whole], file)
    return file


def demo() -> Recording:
    """Return the whole demo, with a confidence as its faulty parts have."""
    whole = read_recording("demo", "right")
    return Recording(
        name="demo",
        time=whole.time,
        landmarks=whole.landmarks,
        valid=whole.valid,
        side="right",
        confidence=np.ones(len(whole)),
    )


def with_wrists(recording: Recording) -> Recording:
    """Return a recording with the wrist poses that its palms show."""
    palm = landmarks_at_rest(load_hand("human"))[PALM]
    wrists: Array = rigid_fit(palm, recording.landmarks[:, PALM])
    return Recording(
        name="wrists",
        time=recording.time,
        landmarks=recording.landmarks,
        valid=recording.valid,
        side="right",
        wrist=wrists,
        confidence=recording.confidence,
    )


def counted(program: Path, hand: Path, samples: Path, *spoilt_by: str) -> Counts:
    """Run the program; return its counts."""
    words = run(program, hand, samples, str(WARM_UP), *spoilt_by).split()
    assert words[0:8:2] == ["samples", "held", "blocks", "locks"]
    return Counts(*(int(word) for word in words[1:8:2]), " ".join(words[8:]))


def expect_nothing(counts: Counts) -> None:
    """Check that nothing was asked of the system."""
    assert (counts.blocks, counts.locks) == (0, 0)
    if counts.end == "exit 77":
        pytest.skip("needs a kernel with seccomp")
    assert counts.end == "exit 0"


@pytest.mark.parametrize("name", HANDS)
def test_a_warm_sample_asks_nothing_of_the_system(
    name: str, program: Path, tmp_path: Path
) -> None:
    """Whatever it does: examine a batch, look ahead, hold, glide back or be refused."""
    plain = [recording_with(fault) for fault in FAULTS if fault != "quaternion"]
    samples = written([demo(), *plain], tmp_path / "samples.csv")
    counts = counted(program, written_hand(name, tmp_path), samples)
    assert counts.samples > 1000
    assert counts.held > 100
    expect_nothing(counts)


def test_nor_does_one_with_a_wrist(
    program: Path, hand_file: Path, tmp_path: Path
) -> None:
    parts = [with_wrists(demo()), recording_with("quaternion")]
    counts = counted(program, hand_file, written(parts, tmp_path / "samples.csv"))
    assert 100 < counts.held < counts.samples - 300
    expect_nothing(counts)


@pytest.mark.parametrize(
    ("spoilt_by", "blocks", "locks", "end"),
    [("block", 2, 0, "exit 0"), ("lock", 0, 1, "exit 0"), ("call", 0, 0, "signal 31")],
)
def test_each_of_them_is_noticed(
    spoilt_by: str,
    blocks: int,
    locks: int,
    end: str,
    program: Path,
    hand_file: Path,
    tmp_path: Path,
) -> None:
    samples = written([recording_with("")], tmp_path / "samples.csv")
    counts = counted(program, hand_file, samples, spoilt_by)
    assert (counts.blocks, counts.locks) == (blocks, locks)
    assert counts.end in {end, "exit 77"}
