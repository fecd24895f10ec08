"""Recorder: the file holds the samples that came, whatever happens meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from injection import inject, parse_faults
from live_cases import moving_hand

from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import HumanSample
from handmap_qp import InvalidInputError
from handmap_qp.apps.live.source import Recorder, Replay, Source, run
from handmap_qp.hands import Side
from handmap_qp.trackers.formats import read_recording


class Listed(Source):
    """A source of samples from a list, which ends by an exception if one is given."""

    def __init__(
        self, samples: list[HumanSample], end: BaseException | None = None
    ) -> None:
        self._samples, self._end = samples, end
        self.name, self.rate, self.upright = "listed", 0.0, ""
        self.side: Side = "right"

    def __iter__(self) -> Iterator[HumanSample]:
        yield from self._samples
        if self._end is not None:
            raise self._end


SAMPLES = [*sample_columns(moving_hand())]


@pytest.mark.parametrize("name", ["copy.npz", "copy.csv"])
def test_a_replayed_recording_comes_back(tmp_path: Path, name: str) -> None:
    recording = moving_hand()
    file = tmp_path / name
    summary = run(Replay(recording, speed=100.0), [Recorder(file)])
    copy = read_recording(file)
    assert copy.side == recording.side
    np.testing.assert_array_equal(copy.valid, recording.valid)
    np.testing.assert_array_equal(copy.landmarks, recording.landmarks)
    expected = (recording.time - recording.time[0]) / 100.0
    np.testing.assert_allclose(copy.time, expected, atol=1e-9)
    assert summary["samples"] == summary["recorded"] == len(recording)
    assert summary["hand_seen"] == len(recording) - 1


def test_what_a_file_cannot_hold_is_said(tmp_path: Path) -> None:
    lost = [
        run(Listed(SAMPLES), [Recorder(tmp_path / name, upright="+y up, -z forward")])
        for name in ("copy.npz", "copy.csv")
    ]
    assert lost[0]["lost"] == ""
    assert "which axes are up and forward" in lost[1]["lost"]


def test_samples_out_of_order_are_counted_and_left_out(tmp_path: Path) -> None:
    samples = list(inject(SAMPLES, parse_faults("late@0.2+0.5:0.05,duplicate@0.8+0.1")))
    summary = run(Listed(samples), [Recorder(tmp_path / "ordered.npz")])
    copy = read_recording(tmp_path / "ordered.npz")
    assert (np.diff(copy.time) > 0.0).all()
    assert summary["not_in_order"] > 0
    assert len(copy) == summary["recorded"] == len(samples) - summary["not_in_order"]


@pytest.mark.parametrize(
    "end", [KeyboardInterrupt(), RuntimeError("the source failed")]
)
def test_what_came_before_an_end_is_written(tmp_path: Path, end: BaseException) -> None:
    file = tmp_path / "cut.npz"
    if isinstance(end, KeyboardInterrupt):
        run(Listed(SAMPLES[:20], end), [Recorder(file)])
    else:
        with pytest.raises(RuntimeError, match="the source failed"):
            run(Listed(SAMPLES[:20], end), [Recorder(file)])
    assert len(read_recording(file)) == 20


def test_a_hand_never_seen_is_no_recording(tmp_path: Path) -> None:
    file = tmp_path / "empty.npz"
    file.write_bytes(b"as it was")
    lost = list(inject(SAMPLES, parse_faults("dropout@0+9")))
    for samples in (lost, []):
        with pytest.raises(InvalidInputError, match="not seen"):
            run(Listed(samples), [Recorder(file)])
        with pytest.raises(RuntimeError, match="the source failed"):
            run(Listed(samples, RuntimeError("the source failed")), [Recorder(file)])
    assert file.read_bytes() == b"as it was"
    assert list(tmp_path.iterdir()) == [file]


def test_the_other_hand_is_refused(tmp_path: Path) -> None:
    left = [*sample_columns(moving_hand(side="left"))]
    with pytest.raises(InvalidInputError, match="right hand"):
        run(Listed([*SAMPLES[:5], *left]), [Recorder(tmp_path / "both.npz")])


@pytest.mark.parametrize("name", ["out.txt", "missing/out.npz"])
def test_a_place_that_cannot_be_written_is_refused_first(
    tmp_path: Path, name: str
) -> None:
    with pytest.raises(InvalidInputError, match="--record"):
        Recorder(tmp_path / name, "--record")


def test_every_sink_gets_every_sample(tmp_path: Path) -> None:
    told: list[str] = []
    files = [tmp_path / "a.npz", tmp_path / "b.npz"]
    run(Listed(SAMPLES), [Recorder(file) for file in files], told.append)
    one, other = map(read_recording, files)
    np.testing.assert_array_equal(one.landmarks, other.landmarks)
    assert len(told) == len(SAMPLES)
    assert "60 samples" in told[-1]
    assert "98%" in told[-1]
