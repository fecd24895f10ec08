"""Landmarks to joint angles: exact on a hand like the model's, close on real ones."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from marks import crossed

from handmap_core.human.sample import TIPS, human_name
from handmap_qp import (
    Hand,
    HumanLengths,
    HumanSample,
    InvalidInputError,
    Recording,
    load_hand,
    read_recording,
)
from handmap_qp.hands import OTHER_SIDE, Side
from handmap_qp.human.fit import LandmarkFitter, fit_recording
from handmap_qp.human.measure import measure_hand
from handmap_qp.se3 import affine

ROLLS = np.radians([0.0, -9.0, 4.0, 9.0, 18.0])


def synthetic(
    side: Side, lengths: HumanLengths, count: int = 60
) -> tuple[Recording, np.ndarray, np.ndarray]:
    """Record a hand of known lengths in known motion; return joint angles and wrist poses too."""
    hand = load_hand(human_name(side), points="landmarks", lengths=lengths)
    phase = np.linspace(0.0, 2.0 * np.pi, count)
    swing = 0.3 * np.minimum(
        hand.upper_limits - hand.rest, hand.rest - hand.lower_limits
    )
    q = hand.rest + np.sin(phase[:, None] + np.arange(20)) * swing
    poses = [
        affine(pin.exp3(np.array([s, 0.5 * s, -s])), np.array([0.3 * s, 1.0, 0.1]))
        for s in np.sin(phase)
    ]
    landmarks = np.array(
        [hand.points(angles, pose) for angles, pose in zip(q, poses, strict=True)]
    )
    recording = Recording(
        "synthetic",
        np.arange(count) / 60.0,
        landmarks,
        np.ones(count, dtype=bool),
        side,
    )
    return recording, q, np.array(poses)


@pytest.mark.slow
@pytest.mark.parametrize("side", ["right", "left"])
@settings(max_examples=10)
@given(hand_length=st.floats(0.16, 0.21))
def test_a_hand_is_measured_as_long_as_it_is(side: Side, hand_length: float) -> None:
    lengths = HumanLengths.from_hand_length(hand_length)
    recording, _, _ = synthetic(side, lengths)
    measured = measure_hand(recording)
    np.testing.assert_allclose(measured.segments, lengths.segments, atol=1e-9)
    # The palm's axes are found by fitting its shape to the standard one, so only distances are the
    # person's.
    np.testing.assert_allclose(
        np.linalg.norm(measured.bases, axis=1),
        np.linalg.norm(lengths.bases, axis=1),
        atol=1e-9,
    )


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("size", [0.8, 1.0, 1.25])
def test_a_hand_of_the_standard_shape_is_measured_where_it_is(
    side: Side, size: float
) -> None:
    """Check the position of every palm joint; distances from the wrist do not determine it."""
    standard = HumanLengths.from_urdf(load_hand("human").urdf_text)
    lengths = HumanLengths(size * standard.bases, size * standard.segments, ROLLS)
    measured = measure_hand(synthetic(side, lengths)[0])
    np.testing.assert_allclose(measured.bases, lengths.bases, atol=1e-9)
    np.testing.assert_allclose(measured.segments, lengths.segments, atol=1e-9)
    np.testing.assert_allclose(measured.rolls, ROLLS, atol=1e-9)


def handedness(bases: np.ndarray) -> float:
    """Return the signed volume of thumb base and three knuckles [m^3]; mirroring flips the sign."""
    return float(np.linalg.det(bases[[0, 2, 4]] - bases[1]))


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_palm_that_is_not_flat_is_measured_the_right_way_round(side: Side) -> None:
    """Return a flat palm with the thumb 25 mm below it; otherwise it would be its mirror image."""
    standard = HumanLengths.from_urdf(load_hand("human").urdf_text)
    depth = np.array([-0.025, 0.0, 0.004, 0.002, -0.004])
    bases = standard.bases + depth[:, None] * (0.0, 0.0, 1.0)
    lengths = HumanLengths(bases=bases, segments=standard.segments)
    recording = synthetic(side, lengths)[0]
    measured = measure_hand(recording)
    assert handedness(measured.bases) == pytest.approx(handedness(bases), rel=1e-6)
    # The palm's axes are those of the standard hand, except for the angle of its arch.
    np.testing.assert_allclose(measured.bases, bases, atol=0.006)
    other = OTHER_SIDE[side]
    mirrored = recording.landmarks * (-1.0, 1.0, 1.0)
    again = measure_hand(replace(recording, landmarks=mirrored, side=other))
    np.testing.assert_allclose(again.bases, measured.bases, atol=1e-12)
    np.testing.assert_allclose(again.segments, measured.segments, atol=1e-12)


def errors_of(
    human: Hand, q: np.ndarray, wrist: np.ndarray, landmarks: np.ndarray
) -> np.ndarray:
    """Distances of a fitted hand's landmarks from those measured [m], shape (21,)."""
    return np.linalg.norm(human.points(q, wrist) - landmarks, axis=1)


@pytest.mark.parametrize("side", ["right", "left"])
def test_joint_angles_are_recovered(side: Side) -> None:
    typical = HumanLengths.from_hand_length(0.19)
    lengths = HumanLengths(typical.bases, typical.segments, ROLLS)
    recording, q, poses = synthetic(side, lengths)
    fitter = LandmarkFitter(side, lengths)
    for i in range(len(recording)):
        angles, pose = fitter.fit(recording.landmarks[i])
        error = errors_of(fitter.human, angles, pose, recording.landmarks[i])
        # The weak pull to rest (0.02 against 10 mm) leaves a fraction of a millimetre and of a
        # degree.
        assert error.max() < 2e-4
        np.testing.assert_allclose(angles, q[i], atol=0.02)
        np.testing.assert_allclose(pose, poses[i], atol=0.005)


def test_what_cannot_be_fitted_exactly_is_fitted_closest_at_the_tips() -> None:
    # A hand a tenth larger than the model.
    recording, _, _ = synthetic("right", HumanLengths.from_hand_length(0.209))
    fitter = LandmarkFitter("right", HumanLengths.from_hand_length(0.19))
    errors = np.array(
        [
            errors_of(fitter.human, *fitter.fit(landmarks), landmarks)
            for landmarks in recording.landmarks[:20]
        ]
    )
    others = np.setdiff1d(np.arange(21), TIPS)
    assert errors[:, TIPS].mean() < 0.8 * errors[:, others].mean()


def test_samples_without_a_hand_hold_the_posture_before() -> None:
    recording, _, _ = synthetic("right", HumanLengths.from_hand_length(0.18))
    valid = recording.valid.copy()
    valid[[0, 1, 20, 21, 59]] = False
    landmarks = recording.landmarks.copy()
    landmarks[~valid] = np.nan
    motion = fit_recording(Recording("gaps", recording.time, landmarks, valid, "right"))
    np.testing.assert_array_equal(motion.valid, valid)
    assert np.isfinite(motion.q).all()
    assert np.isfinite(motion.wrist).all()
    np.testing.assert_array_equal(motion.q[[0, 1]], motion.q[[2, 2]])
    np.testing.assert_array_equal(motion.q[[20, 21]], motion.q[[19, 19]])
    np.testing.assert_array_equal(
        motion.wrist[[0, 1, 20, 21]], motion.wrist[[2, 2, 19, 19]]
    )


@pytest.mark.parametrize(
    "scale", [1000.0, 5.0, 0.1, 0.0], ids=["mm", "picture", "tiny", "zeros"]
)
def test_what_is_not_as_long_as_a_hand_is_not_measured(scale: float) -> None:
    lengths = HumanLengths.from_hand_length(0.19)
    recording, _, _ = synthetic("right", lengths)
    scaled = replace(recording, landmarks=scale * recording.landmarks)
    got = f"{scale * lengths.hand_length:.3g}"
    message = rf"landmarks: expected metres .* 0\.12 to 0\.25 m .* got {got}$"
    for use in (measure_hand, fit_recording):
        with pytest.raises(InvalidInputError, match=message):
            use(scaled)


def test_samples_that_are_not_of_the_hands_size_hold_the_posture_before() -> None:
    recording, _, _ = synthetic("left", HumanLengths.from_hand_length(0.18))
    spoilt = recording.landmarks.copy()
    spoilt[[0, 20]] *= 1000.0
    spoilt[[1, 21]] = 0.0
    motion = fit_recording(replace(recording, landmarks=spoilt))
    np.testing.assert_array_equal(np.flatnonzero(~motion.valid), [0, 1, 20, 21])
    np.testing.assert_array_equal(motion.q[[0, 1, 20, 21]], motion.q[[2, 2, 19, 19]])
    assert recording.valid.all()


def test_a_size_that_no_sample_bears_out_is_no_hand(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    recording, _, _ = synthetic("right", HumanLengths.from_hand_length(0.1))
    # Medians of a tracker that has lost the hand may be like this.
    monkeypatch.setattr(
        "handmap_qp.human.fit.measure_hand",
        lambda _: HumanLengths.from_hand_length(0.3),
    )
    with pytest.raises(
        InvalidInputError, match="landmarks: expected a hand that keeps its size"
    ):
        fit_recording(recording)


BAD = {
    "text": "x",
    "digits": [["1"] * 3] * 21,
    "None": None,
    "ragged": [[0.0], [0.0, 1.0]],
    "complex": np.full((21, 3), 1j),
    "objects": np.full((21, 3), None),
    "infinite": np.full((21, 3), np.inf),
    "shape": np.zeros((20, 3)),
    "nan": np.full((21, 3), np.nan),
    "zeros": np.zeros((21, 3)),
    "one place": np.full((21, 3), 0.3),
    "mm": 1000.0
    * load_hand("human", points="landmarks").points(load_hand("human").rest),
}


class Fitters(NamedTuple):
    """Return fitters and two samples; both warm fitters have fitted the first sample."""

    samples: np.ndarray
    disturbed: LandmarkFitter
    calm: LandmarkFitter
    cold: LandmarkFitter


@pytest.fixture(scope="module")
def fitters() -> Fitters:
    recording, _, _ = synthetic("right", HumanLengths.from_hand_length(0.18))
    made = Fitters(recording.landmarks[:2], *(LandmarkFitter() for _ in range(3)))
    for fitter in (made.disturbed, made.calm):
        fitter.fit(made.samples[0])
    return made


@pytest.mark.parametrize("bad", BAD.values(), ids=BAD.keys())
def test_bad_landmarks_are_rejected_and_change_nothing(
    fitters: Fitters, bad: Any
) -> None:
    for fitter in (fitters.disturbed, fitters.cold):
        with pytest.raises(InvalidInputError, match="landmarks: expected") as caught:
            fitter.fit(bad)
        assert caught.value.argument == "landmarks"
    for sample in fitters.samples:
        np.testing.assert_array_equal(
            fitters.disturbed.fit(sample)[0], fitters.calm.fit(sample)[0]
        )


def test_other_arguments_are_named() -> None:
    calls: dict[str, Callable[[], Any]] = {
        "side": lambda: LandmarkFitter("up"),  # ty: ignore[invalid-argument-type]
        "lengths": lambda: LandmarkFitter("right", 0.19),  # ty: ignore[invalid-argument-type]
        "recording": lambda: measure_hand("x"),  # ty: ignore[invalid-argument-type]
    }
    for argument, call in calls.items():
        with pytest.raises(InvalidInputError) as caught:
            call()
        assert caught.value.argument == argument
    with pytest.raises(InvalidInputError, match="recording: expected a Recording"):
        fit_recording(None)  # ty: ignore[invalid-argument-type]


@pytest.mark.slow
def test_real_hands_are_fitted_within_their_limits(recordings: Path) -> None:
    for path in sorted(recordings.glob("*.npz")):
        recording = read_recording(path)
        motion = fit_recording(recording)
        np.testing.assert_array_equal(motion.valid, recording.valid)
        assert (motion.q >= motion.human.lower_limits - 1e-9).all()
        assert (motion.q <= motion.human.upper_limits + 1e-9).all()
        # Measured: 0.5 to 2.1 mm, the most on the noisy video.
        seen = np.flatnonzero(motion.valid)[::4]
        poses = zip(motion.q[seen], motion.wrist[seen], strict=True)
        samples = zip(poses, recording.landmarks[seen], strict=True)
        errors = [errors_of(motion.human, *pose, points) for pose, points in samples]
        assert np.mean(np.array(errors)[:, TIPS]) < 3e-3, path.stem


@pytest.mark.parametrize("side", ["right", "left"])
def test_a_fit_of_noisy_landmarks_has_converged(side: Side) -> None:
    lengths = HumanLengths.from_hand_length(0.19)
    recording, _, _ = synthetic(side, lengths)
    noise = np.random.default_rng(0).normal(scale=0.002, size=recording.landmarks.shape)
    landmarks = recording.landmarks + noise
    fitter = LandmarkFitter(side, lengths)
    moves = []
    for sample in landmarks:
        first = fitter.fit(sample)[0]
        fitter.fit(sample)
        moves.append(np.abs(fitter.fit(sample)[0] - first).max())
    # Going on from there turns no joint any further, so these are optima.
    assert np.mean(np.array(moves) < 0.02) > 0.95


@settings(max_examples=8)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_first_sample_of_any_posture_is_fitted_exactly(seed: int) -> None:
    random = np.random.default_rng(seed)
    hand = load_hand("human", points="landmarks")
    # Near 90 degrees of flexion at the MCP joint, abduction does not move the finger.
    shares = random.uniform(0.1, 0.75, size=20)
    landmarks = hand.points(
        hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits)
    )
    q, pose = LandmarkFitter("right").fit(landmarks)
    assert errors_of(hand, q, pose, landmarks).max() < 1e-3
    np.testing.assert_allclose(pose, np.eye(4), atol=1e-9)


@pytest.mark.parametrize(
    ("bend", "spread"),
    crossed([0.3, 0.6, 0.9, 1.2], [(-1.2, 0.5), (0.5, -1.2), (-1.0, 0.6)], every=3),
)
def test_a_finger_that_changes_its_side_at_90_degrees_is_not_caught_there(
    spread: tuple[float, float], bend: float
) -> None:
    hand = load_hand("human", points="landmarks")
    abduction = hand.joint_names.index("little_MCP_abduction")
    fitter = LandmarkFitter("right")
    q = fitted = hand.rest
    for share in np.linspace(0.0, 1.0, 9):
        q = hand.rest.copy()
        q[abduction] = spread[int(share >= 0.5)]
        q[abduction + 1] = np.interp(share, [0.0, 0.5, 1.0], [0.2, np.pi / 2, 0.2])
        q[abduction + 2] = bend
        q = np.clip(q, hand.lower_limits, hand.upper_limits)
        fitted, _ = fitter.fit(hand.points(q))
    np.testing.assert_allclose(fitted, q, atol=1e-3)


@pytest.mark.parametrize("wrong", [None, "1", [0.5], np.array([0.5]), 1j])
@pytest.mark.parametrize("name", ["time", "confidence"])
def test_a_sample_has_numbers_for_time_and_confidence(name: str, wrong: Any) -> None:
    landmarks = np.zeros((21, 3))
    single: dict[str, Any] = {"time": np.float32(1.0), "confidence": np.float32(0.5)}
    HumanSample(side="right", landmarks=landmarks, **single)
    values: dict[str, Any] = {"time": 0.0, name: wrong}
    with pytest.raises(InvalidInputError) as error:
        HumanSample(side="right", landmarks=landmarks, **values)
    assert error.value.argument == name
