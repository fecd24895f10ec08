"""Recordings judged by column: the guard of live streams says the same, sample by sample."""

from __future__ import annotations

import numpy as np
import pytest
from faulty_recordings import DEMO, faulty

from handmap_qp import load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.trackers.guard import StreamGuard
from handmap_qp.trackers.landmarks import scaled_human
from handmap_qp.trackers.recorded_motion import RecordedSamples
from handmap_qp.trackers.recording import recording_samples

FAULTS = (
    "",
    "dropout@0.3+0.2,jump@0.8+0.2,outlier@1.3+0.05",
    "silence@0.4+0.3,flip@1.2+0.1,zero@1.6+0.1",
    "frozen@0.2+0.5,mirror@1.0+0.3",
    "noise@0.5+0.5:0.02",
)


@pytest.fixture(scope="module")
def human() -> Hand:
    return scaled_human(DEMO, points="landmarks")


@pytest.mark.parametrize("text", FAULTS)
def test_the_guard_says_the_same_by_column(text: str, human: Hand) -> None:
    recording = faulty(text) if text else DEMO.part(slice(0, 240))
    guard = StreamGuard(human)
    live = [guard.check(sample) for sample in recording_samples(recording)]
    recorded = RecordedSamples(recording)
    # Of a person with other bones first: nothing of theirs remains.
    recorded.judged(load_hand("human", points="landmarks"))
    found = recorded.judged(human)
    columns = [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in live]
    assert [[v.rule, v.is_held, v.is_return, v.dt, v.finding] for v in found] == columns
    assert any(verdict.is_held for verdict in live) == bool(text)
    # Recordings without any fault are judged as a whole.
    assert recorded._is_calm == (not text)
    np.testing.assert_allclose(
        [v.consistency for v in found], [v.consistency for v in live], atol=1e-15
    )


def test_motion_by_column_is_that_of_samples(human: Hand) -> None:
    recording = DEMO.part(slice(0, 60))
    guard, samples = StreamGuard(human), recording_samples(recording)
    for sample, sight in zip(samples, RecordedSamples(recording).sights, strict=True):
        guard.check(sample)
        last = guard.state.last
        assert sight is not None
        assert last is not None
        expected = last if sight.change is None else sight.change.track
        for own, other in zip(last, expected, strict=True):
            np.testing.assert_allclose(own, other, rtol=1e-6, atol=1e-9)
