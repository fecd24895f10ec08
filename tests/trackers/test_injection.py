"""Faults put into samples: each does what its name says, and nothing else."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from injection import (
    FAULT_KINDS,
    Fault,
    inject,
    parse_faults,
)

from handmap_core.human.sample import PALM, HumanSample
from handmap_qp import HandmapError
from handmap_qp.hands.library import load_hand
from handmap_qp.se3 import rigid_fit

PERIOD = 1.0 / 50.0
START = 100.0


def make_samples(count: int = 100) -> list[HumanSample]:
    """Return samples of a hand that closes and moves, with wrist poses, at 50 Hz."""
    human = load_hand("human", points="landmarks")
    samples = []
    for i in range(count):
        share = 0.5 + 0.5 * math.sin(0.1 * i)
        q = human.rest + 0.3 * share * (human.upper_limits - human.rest)
        wrist = np.eye(4)
        wrist[:3, 3] = 0.002 * i, 0.3, -0.1
        samples.append(
            HumanSample(
                START + i * PERIOD, "right", human.points(q, wrist), wrist=wrist
            )
        )
    return samples


SAMPLES = make_samples()


def injected(text: str, seed: int = 0) -> list[HumanSample]:
    return list(inject(SAMPLES, parse_faults(text), seed))


def is_same(a: HumanSample, b: HumanSample) -> bool:
    assert a.wrist is not None
    assert b.wrist is not None
    return (
        a.time == b.time
        and a.valid == b.valid
        and np.array_equal(a.landmarks, b.landmarks)
        and np.array_equal(a.wrist, b.wrist)
    )


def lengths(sample: HumanSample) -> np.ndarray:
    """Return all distances between landmarks [m], shape (21, 21)."""
    return np.linalg.norm(sample.landmarks[:, None] - sample.landmarks, axis=2)


@pytest.mark.parametrize("name", FAULT_KINDS)
def test_a_fault_acts_within_its_time_and_nowhere_else(name: str) -> None:
    active = range(25, 35)  # 0.5 s to 0.7 s
    result = injected(f"{name}@0.499+0.2")
    count = {"silence": 0, "duplicate": 2}.get(name, 1) * len(active)
    assert len(result) == len(SAMPLES) - len(active) + count
    before, after = SAMPLES[:25], SAMPLES[35:]
    assert all(map(is_same, result[:25], before))
    assert all(map(is_same, result[25 + count :], after))
    if name == "duplicate":
        assert all(
            is_same(result[25 + 2 * i], result[26 + 2 * i]) for i in range(len(active))
        )
    elif count:
        changed = [not _equal(result[i], SAMPLES[i]) for i in active]
        # Only every second sample is late, at random.
        assert any(changed) if name == "late" else all(changed)


def _equal(a: HumanSample, b: HumanSample) -> bool:
    return a.time == b.time and np.array_equal(a.landmarks, b.landmarks)


def test_a_dropout_is_not_valid_and_has_no_numbers() -> None:
    lost = injected("dropout@0.5+0.1")[27]
    assert not lost.valid
    assert np.isnan(lost.landmarks).all()
    assert lost.wrist is None
    assert lost.confidence == 0.0


def test_frozen_data_repeat_the_last_sample_with_new_times() -> None:
    result = injected("frozen@0.5+0.2")
    for i in range(26, 34):
        assert result[i].time == SAMPLES[i].time
        np.testing.assert_array_equal(result[i].landmarks, SAMPLES[24].landmarks)


def test_frozen_data_are_what_was_sent_last() -> None:
    result = injected("jump@0+0.499,frozen@0.499+0.2")
    assert not np.array_equal(result[24].landmarks, SAMPLES[24].landmarks)
    np.testing.assert_array_equal(result[30].landmarks, result[24].landmarks)
    lost = injected("dropout@0.299+0.2,frozen@0.499+0.2")
    np.testing.assert_array_equal(lost[30].landmarks, SAMPLES[14].landmarks)


@pytest.mark.parametrize("size", [0.2, 1.5])
def test_a_jump_moves_the_whole_hand_by_its_size(size: float) -> None:
    result = injected(f"jump@0.5+0.2:{size}")
    moved = np.array(
        [result[i].landmarks - SAMPLES[i].landmarks for i in range(26, 34)]
    )
    np.testing.assert_allclose(np.linalg.norm(moved, axis=2), size, rtol=1e-12)
    np.testing.assert_allclose(
        moved, np.broadcast_to(moved[0, 0], moved.shape), atol=1e-12
    )
    wrist, was = result[30].wrist, SAMPLES[30].wrist
    assert wrist is not None
    assert was is not None
    np.testing.assert_allclose(wrist[:3, 3] - was[:3, 3], moved[0, 0], atol=1e-12)


def test_a_flip_turns_the_hand_by_half_a_turn_about_its_length() -> None:
    result = injected("flip@0.5+0.1")
    was, now = SAMPLES[27], result[27]
    np.testing.assert_allclose(lengths(now), lengths(was), atol=1e-12)
    turn = rigid_fit(was.landmarks, now.landmarks)
    assert np.trace(turn[:3, :3]) == pytest.approx(-1.0, abs=1e-9)
    np.testing.assert_allclose(now.landmarks[[0, 9]], was.landmarks[[0, 9]], atol=1e-12)
    assert now.wrist is not None
    assert was.wrist is not None
    np.testing.assert_allclose(now.wrist, turn @ was.wrist, atol=1e-9)


def test_a_mirrored_hand_keeps_its_lengths_and_is_the_other_hand() -> None:
    was, now = SAMPLES[27], injected("mirror@0.5+0.1")[27]
    np.testing.assert_allclose(lengths(now), lengths(was), atol=1e-12)
    fit = rigid_fit(was.landmarks, now.landmarks)
    left_over = now.landmarks - (was.landmarks @ fit[:3, :3].T + fit[:3, 3])
    assert np.abs(left_over).max() > 0.01  # no rotation explains it
    # The palm is nearly flat, so it stays where it is.
    assert np.abs(now.landmarks[PALM] - was.landmarks[PALM]).max() < 0.02


def test_zeros_are_called_valid() -> None:
    result = injected("zero@0.5+0.1")[27]
    assert result.valid
    assert not result.landmarks.any()
    np.testing.assert_array_equal(result.wrist, np.eye(4))


def test_an_outlier_is_one_landmark() -> None:
    result = injected("outlier@0.5+0.2:0.1")
    moved = np.array(
        [
            np.linalg.norm(result[i].landmarks - SAMPLES[i].landmarks, axis=1)
            for i in range(26, 34)
        ]
    )
    assert (np.count_nonzero(moved, axis=1) == 1).all()
    assert len({int(row.argmax()) for row in moved}) == 1
    np.testing.assert_allclose(moved.max(axis=1), 0.1, rtol=1e-12)


def test_noise_has_its_standard_deviation() -> None:
    result = injected("noise@0:0.004")
    noise = np.array(
        [a.landmarks - b.landmarks for a, b in zip(result, SAMPLES, strict=True)]
    )
    assert noise.std() == pytest.approx(
        0.004, rel=0.05
    )  # 6300 numbers: 0.9 % is one sigma


def test_faults_of_the_clock_change_times_only() -> None:
    for text, size in (("clock@1:5", 5.0), ("clock@1:-3", -3.0)):
        result = injected(text)
        shifts = [a.time - b.time for a, b in zip(result, SAMPLES, strict=True)]
        np.testing.assert_allclose(shifts[:50], 0.0, atol=1e-9)
        np.testing.assert_allclose(shifts[51:], size, atol=1e-9)
    late = [
        a.time - b.time for a, b in zip(injected("late@0+9:0.05"), SAMPLES, strict=True)
    ]
    assert {round(shift, 6) for shift in late} == {0.0, -0.05}
    jitter = [
        a.time - b.time
        for a, b in zip(injected("jitter@0:0.002"), SAMPLES, strict=True)
    ]
    assert np.std(jitter) == pytest.approx(0.002, rel=0.3)


def test_the_seed_decides() -> None:
    text = "noise@0,jump@0.5+1"
    assert all(map(is_same, injected(text, 3), injected(text, 3)))
    assert not any(map(is_same, injected(text, 3), injected(text, 4)))


def test_faults_act_together() -> None:
    result = injected("clock@0:2,dropout@0.5+0.2")
    assert result[30].time == SAMPLES[30].time + 2.0
    assert not result[30].valid


def test_a_lost_hand_stays_lost() -> None:
    for name in FAULT_KINDS:
        if name not in ("frozen", "zero"):
            result = injected(f"dropout@0,{name}@0.1+0.1")
            assert not any(sample.valid for sample in result[6:9]), name


@pytest.mark.parametrize("name", ["flip", "mirror", "jump", "noise"])
def test_a_lost_hand_may_lie_in_one_place(name: str) -> None:
    lost = HumanSample(0.0, "right", np.zeros((21, 3)), valid=False)
    (result,) = inject([lost], parse_faults(f"{name}@0"))
    assert not result.valid


@given(
    name=st.sampled_from([*FAULT_KINDS]),
    start=st.floats(0.0, 1e3),
    duration=st.floats(1e-3, 1e3),
    size=st.floats(-10.0, 10.0),
)
def test_the_text_of_a_fault_is_read(
    name: str, start: float, duration: float, size: float
) -> None:
    kind = FAULT_KINDS[name]
    text = f"{name}@{start}+{duration}" + (f":{size}" if kind.unit else "")
    fault = Fault(kind, start, duration, size if kind.unit else 0.0)
    assert parse_faults(f"{text}, {text}") == (fault, fault)


def test_usual_values_are_filled_in() -> None:
    assert parse_faults("jump@4") == (Fault(FAULT_KINDS["jump"], 4.0, 0.5, 0.2),)
    assert parse_faults("clock@4")[0].duration == math.inf


@pytest.mark.parametrize(
    "text",
    [
        "",
        "dropout",
        "dropout@",
        "dropout@x",
        "dropout@-1",
        "dropout@1.2.3",
        "dropout@1+0",
        "dropout@1:0.3",
        "jump@1:nan",
        "jump@1:1e9",
        "fall@1",
        "jump@1,,jump@2",
        "jump@1;jump@2",
        "jump@inf",
        "jump@nan",
        "jump@0+nan",
        "jump@0:inf",
    ],
)
def test_a_wrong_text_is_one_line(text: str) -> None:
    with pytest.raises(HandmapError) as raised:
        parse_faults(text)
    assert "\n" not in str(raised.value)
