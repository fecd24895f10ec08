"""The guard in the compiled core says of every stream what the readable reference says."""

from __future__ import annotations

import copy
import math
import pickle
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from injection import FAULT_KINDS, inject, parse_faults
from pinocchio import exp3

from handmap_qp import load_hand, read_recording
from handmap_qp.hands.hand import Hand
from handmap_qp.human.measure import scaled_human
from handmap_qp.human.recording import Recording, sample_columns
from handmap_qp.human.sample import HumanSample, Verdict
from handmap_qp.ik import core as core_module
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.stream.measurement import without_faults
from handmap_qp.stream.step_table import RULE_NAMES
from handmap_qp.trackers import hand_geometry, plausibility
from handmap_qp.trackers.plausibility import InputCheck

core: Any = core_module.core
if core is None:
    pytest.skip(core_module.description, allow_module_level=True)

HUMAN = load_hand("human", points="landmarks")
DEMO = read_recording("demo", "right")
NAMES = (
    "leap110_free_right",
    "leap_hmd_right",
    "leap_pinch_move_right",
    "quest3_webxr_left",
    "quest3_webxr_right",
    "rgb_mediapipe_right",
)
TURN = np.array([0.3, -0.5, 0.2])
MISTAKES: dict[str, Callable[[HumanSample], HumanSample]] = {
    "mirrored": lambda sample: _moved(sample, lambda p: p * (-1.0, 1.0, 1.0)),
    "millimetres": lambda sample: _moved(sample, lambda p: 1000.0 * p),
    "far": lambda sample: _moved(sample, lambda p: p + 1e8),
    "huge": lambda sample: _moved(sample, lambda p: 1e200 * p),
    "small": lambda sample: _moved(sample, lambda p: 0.6 * p),
    "one place": lambda sample: _moved(sample, lambda p: np.tile(p[:1], (21, 1))),
    "flat": lambda sample: _moved(sample, lambda p: p * (1.0, 1.0, 0.0)),
    "other order": lambda sample: _moved(sample, lambda p: p[[0, *range(20, 0, -1)]]),
    "rounded": lambda sample: _moved(sample, lambda p: np.round(p, 3)),
    "fingers changed": lambda sample: _moved(sample, _exchanged),
    "milliseconds": lambda sample: replace(sample, time=1e3 * sample.time),
    "wrist elsewhere": lambda sample: _with_wrist(sample, exp3(TURN), 1.0),
    "wrist of another convention": lambda sample: _with_wrist(sample, exp3(TURN), 0.0),
    "wrist that stands still": lambda sample: replace(sample, wrist=np.eye(4)),
}


class ReferenceCheck(InputCheck):
    """Runs in Python, as every class that the core does not know."""


class ReferenceGuard(StreamGuard):
    """Runs in Python."""

    def __init__(self, human: Hand) -> None:
        super().__init__(human)
        self._input = ReferenceCheck(self._side)


def _moved(
    sample: HumanSample, change: Callable[[np.ndarray], np.ndarray]
) -> HumanSample:
    return (
        replace(sample, landmarks=change(sample.landmarks)) if sample.valid else sample
    )


def _exchanged(points: np.ndarray) -> np.ndarray:
    found = points.copy()
    found[5:9], found[9:13] = points[9:13], points[5:9]
    return found


def _with_wrist(sample: HumanSample, turn: np.ndarray, shift: float) -> HumanSample:
    if sample.wrist is None:
        return sample
    wrist = sample.wrist.copy()
    wrist[:3, :3] = wrist[:3, :3] @ turn
    wrist[0, 3] += shift
    return replace(sample, wrist=wrist)


def expect_same(found: Verdict, expected: Verdict) -> None:
    assert found[:3] == expected[:3]
    assert found.finding == expected.finding
    assert found.dt == pytest.approx(expected.dt, abs=1e-12)
    assert found.consistency == pytest.approx(
        expected.consistency, rel=1e-9, abs=1e-12, nan_ok=True
    )


def expect_same_stream(
    human: Hand, samples: Iterable[HumanSample], arrivals: Sequence[float | None] = ()
) -> set[str]:
    """Check that both say the same of every sample, and return the rules that they named."""
    fast, slow = StreamGuard(human), ReferenceGuard(human)
    assert fast.core is not None
    assert slow.core is None
    rules = set()
    for i, sample in enumerate(samples):
        arrival = arrivals[i] if arrivals else None
        # Numbers may be too large to be squared.
        with np.errstate(all="ignore"):
            found = fast.check(sample, arrival=arrival)
            expected = slow.check(sample, arrival=arrival)
        expect_same(found, expected)
        rules.add(expected.rule)
    return rules


@pytest.fixture(scope="module", params=NAMES)
def recording(request: pytest.FixtureRequest, recordings: Path) -> Recording:
    whole = read_recording(recordings / f"{request.param}.npz")
    return whole.part(slice(0, 300))


def test_recordings_and_faults_in_them_have_one_verdict(recording: Recording) -> None:
    human = scaled_human(recording, points="landmarks")
    plain = [*sample_columns(recording)]
    with_wrist = [*sample_columns(recording, recording.wrist)]
    expect_same_stream(human, plain)
    expect_same_stream(human, with_wrist)
    rules = set()
    for k, kind in enumerate(FAULT_KINDS):
        samples = (plain, with_wrist)[k % 2][:260]
        rules |= expect_same_stream(human, inject(samples, parse_faults(f"{kind}@1+2")))
    assert len(rules) > 8


@pytest.mark.parametrize("size", [0.002, 0.005, 0.02])
def test_noise_has_one_verdict(recording: Recording, size: float) -> None:
    random = np.random.default_rng(2)
    landmarks = recording.landmarks + random.normal(
        scale=size, size=recording.landmarks.shape
    )
    valid = recording.valid & (random.random(len(recording)) > 0.2)
    noisy = replace(recording, landmarks=landmarks, valid=valid)
    human = scaled_human(recording, points="landmarks")
    rules = expect_same_stream(human, [*sample_columns(noisy)])
    assert size > 0.01 or rules <= {"", "missing", "settling"}


@pytest.mark.parametrize("name", MISTAKES)
def test_mistakes_are_named_in_the_same_words(name: str) -> None:
    samples = [*sample_columns(DEMO.part(slice(0, 260)))]
    tracked = []
    for i, sample in enumerate(samples):
        wrist = np.eye(4)
        wrist[:3, :3] = exp3(0.004 * i * TURN)
        points = sample.landmarks @ wrist[:3, :3].T
        wrist[:3, 3] = points[0]
        tracked.append(replace(sample, landmarks=points, wrist=wrist))
    for stream in (samples, tracked):
        changed = [MISTAKES[name](sample) for sample in stream]
        expect_same_stream(HUMAN, changed)
        expect_same_stream(HUMAN, [*stream[:100], *changed[100:200], *stream[200:]])


def test_clocks_that_run_at_another_rate_have_one_verdict() -> None:
    samples = [*sample_columns(DEMO.part(slice(0, 260)))]
    start = samples[0].time
    for rate in (0.5, 1.0, 3.0):
        arrivals: list[float | None] = [
            5.0 + (sample.time - start) / rate for sample in samples
        ]
        arrivals[40:44] = [None] * 4
        rules = expect_same_stream(HUMAN, samples, arrivals)
        assert ("time" in rules) == (rate != 1.0)


def test_stamps_that_are_set_back_again_and_again_have_one_verdict() -> None:
    samples = [*sample_columns(DEMO.part(slice(0, 400)))]
    stamps = np.cumsum([-0.9 if i % 46 == 45 else 0.02 for i in range(len(samples))])
    streams = [
        replace(s, time=t) for s, t in zip(samples, stamps.tolist(), strict=True)
    ]
    arrivals: list[float | None] = [5.0 + 4e-3 * i for i in range(len(samples))]
    assert "time" in expect_same_stream(HUMAN, streams, arrivals)


def test_findings_of_a_long_stream_keep_their_words() -> None:
    # A size that changes is another finding in every batch: more than the core keeps.
    samples, start = [], 0.0
    for _ in range(5):
        taken = [*sample_columns(DEMO)]
        for sample in taken:
            time = start + sample.time - taken[0].time
            size = 0.65 - 1e-5 * len(samples) if time > 1.0 else 1.0
            points = size * sample.landmarks
            samples.append(replace(sample, time=time, landmarks=points))
        start = samples[-1].time + 1.0 / 60.0
    assert len(samples) > 1500
    assert "size" in expect_same_stream(HUMAN, samples)


@pytest.mark.parametrize("seed", range(6))
def test_hostile_streams_have_one_verdict(seed: int) -> None:
    random = np.random.default_rng(seed)
    taken = [*sample_columns(DEMO)]
    time, i, scale = 0.0, 0, 1.0
    world = np.eye(3)
    samples = []
    for _ in range(500):
        event = random.random()
        time += random.choice([1 / 90, 1 / 60, 1 / 60, 1 / 60, 0.0, -0.01])
        if event < 0.03:
            time += random.choice([0.3, -0.5, -5.0, 50.0])
        i = int(random.integers(len(taken))) if event > 0.97 else (i + 1) % len(taken)
        if 0.03 < event < 0.05:
            world = exp3(random.normal(size=3)) @ np.diag(
                [1.0, 1.0, random.choice([1, -1])]
            )
        if 0.05 < event < 0.07:
            scale = random.choice([1.0, 1.0, 1.0, 2.5, 1e3, 1e-3])
        points = scale * taken[i].landmarks @ world.T
        points += 10.0 ** random.uniform(-6, -2.5) * random.normal(size=(21, 3))
        if 0.07 < event < 0.09:
            points[random.integers(21)] += random.normal(size=3)
        if 0.09 < event < 0.1:
            points *= random.random((21, 1)) < 0.5
        wrist = np.eye(4)
        wrist[:3, :3], wrist[:3, 3] = exp3(0.1 * random.normal(size=3)), points[0]
        samples.append(
            HumanSample(
                time,
                "right",
                points,
                wrist if seed % 3 or random.random() < 0.5 else None,
                bool(random.random() < 0.98),
                float(
                    random.choice(
                        [0.0, 0.5, 1.0, 1.0, 1.0], p=[0.01, 0.24, 0.25, 0.25, 0.25]
                    )
                ),
            )
        )
    assert len(expect_same_stream(HUMAN, samples)) > 6


@pytest.mark.parametrize(
    "way", [copy.deepcopy, lambda g: pickle.loads(pickle.dumps(g))]
)
def test_a_copy_goes_on_with_what_was_seen(way: Callable[[Any], Any]) -> None:
    taken = [*sample_columns(DEMO.part(slice(0, 300)))]
    samples = list(inject(taken, parse_faults("mirror@1+2")))
    guard, check = StreamGuard(HUMAN), InputCheck("right")
    copied_guard, copied_check = way(guard), way(check)
    kinds = set()
    for k, sample in enumerate(samples):
        if k % 23 == 0:
            copied_guard, copied_check = way(copied_guard), way(copied_check)
        verdict = guard.check(sample)
        expect_same(copied_guard.check(sample), verdict)
        finding = check.update(sample.time, sample.landmarks)
        assert copied_check.update(sample.time, sample.landmarks) == finding
        kinds |= {finding and finding.kind, verdict.finding and verdict.finding.kind}
    assert kinds == {None, "side"}


def test_a_sample_is_forgotten_but_not_what_the_input_was() -> None:
    samples = [*sample_columns(DEMO.part(slice(0, 80)))]
    fast, slow = StreamGuard(HUMAN), ReferenceGuard(HUMAN)
    for k, sample in enumerate(samples):
        expect_same(fast.check(sample), slow.check(sample))
        if k % 7 == 0:
            fast.forget()
            slow.forget()
            # The same stamp again is new.
            expect_same(fast.check(sample), slow.check(sample))


def test_recordings_are_judged_at_once_as_sample_by_sample(
    recording: Recording,
) -> None:
    human = scaled_human(recording, points="landmarks")
    gaps = replace(
        recording,
        valid=recording.valid & (np.arange(len(recording)) % 50 > 3),
        confidence=np.where(np.arange(len(recording)) % 70 > 2, 1.0, 0.0),
    )
    for taken in (recording, gaps, replace(gaps, landmarks=0.6 * gaps.landmarks)):
        slow = ReferenceGuard(human)
        expected = [slow.check(sample) for sample in sample_columns(taken)]
        np.testing.assert_array_equal(
            StreamGuard(human).holds(taken), [each.is_held for each in expected]
        )
        judge: Any = StreamGuard(human).core
        columns = judge.judge(taken)
        names = RULE_NAMES
        for rule, *rest, verdict in zip(*columns, expected, strict=True):
            expect_same(Verdict(names[rule], *rest), verdict)
        for part in (taken, taken.part(slice(0, 40))):
            found = InputCheck(part.side).examine(part)
            assert found == ReferenceCheck(part.side).examine(part)
    assert len(without_faults(recording)) == len(recording)


def test_the_core_has_the_rules_of_python() -> None:
    assert RULE_NAMES == core.RULES


def test_the_input_check_has_one_finding_alone(recording: Recording) -> None:
    fast, slow = InputCheck(recording.side), ReferenceCheck(recording.side)
    mirrored = recording.landmarks * (-1.0, 1.0, 1.0)
    for i in np.flatnonzero(recording.valid).tolist():
        points = mirrored[i] if 100 <= i < 200 else recording.landmarks[i]
        wrist = None if recording.wrist is None else recording.wrist[i]
        if i == 250:
            fast.alert()
            slow.alert()
        time = float(recording.time[i])
        assert fast.update(time, points, wrist) == slow.update(time, points, wrist)
        assert fast.finding == slow.finding
        assert fast.is_wrist_proven == slow.is_wrist_proven
    assert fast.finish() == slow.finish()


def test_ordinary_batches_need_no_python(
    recording: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any) -> None:
        pytest.fail("a batch was examined in Python")

    monkeypatch.setattr(InputCheck, "_examine", fail)
    monkeypatch.setattr(plausibility, "_find_time_unit", fail)
    monkeypatch.setattr(hand_geometry, "misfit", fail)
    guard = StreamGuard(scaled_human(recording, points="landmarks"))
    guard.holds(recording)
    InputCheck(recording.side).examine(recording)
    assert math.isfinite(guard.check([*sample_columns(recording)][-1]).dt)
