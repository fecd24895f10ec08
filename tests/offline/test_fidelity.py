"""Fidelity of motions with known answers."""

from __future__ import annotations

import dataclasses
import importlib
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.offline.fidelity import (
    Fidelity,
    JointMotion,
    angles_between,
    assess_fidelity,
    latency,
    object_motion_error,
    palm_error,
    pinch_order,
    rms_jerk,
)
from handmap_qp.offline.finger_traces import (
    FingerTrace,
    HandTrace,
    trace_human,
    trace_robot,
)
from handmap_qp.offline.key_vectors import compare_key_vectors, sample_workspace
from handmap_qp.offline.surface_gaps import SurfaceGaps, measure_gaps

RATE = 100.0
BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def human() -> Hand:
    return load_hand("human", points="landmarks")


@pytest.fixture(scope="module")
def allegro() -> Hand:
    return load_hand("allegro_right")


def wave(hand: Hand, count: int = 300, amount: float = 0.3, lag: float = 0.0) -> np.ndarray:
    """Return joint angles that oscillate about mid-range, each at its own frequency."""
    middle = 0.5 * (hand.lower_limits + hand.upper_limits)
    half = 0.5 * (hand.upper_limits - hand.lower_limits)
    time = np.arange(count)[:, None] / RATE - lag
    paces = 2.0 + 0.37 * np.arange(len(middle))
    return middle + amount * half * np.sin(paces * time)


def poses(count: int, rate: float = 1.0) -> np.ndarray:
    """Return wrist poses that rotate and translate."""
    time = np.arange(count) / RATE
    pose = np.tile(np.eye(4), (count, 1, 1))
    turns = rate * time[:, None] * np.array([0.3, 0.5, -0.4])
    pose[:, :3, :3] = Rotation.from_rotvec(turns).as_matrix()
    pose[:, :3, 3] = rate * time[:, None] * np.array([0.1, -0.05, 0.02])
    return pose


def moved(trace: HandTrace, motion: np.ndarray, *, fingers: bool = True) -> HandTrace:
    """Move a trace, or its palm only, by one rigid motion."""

    def act(points: np.ndarray) -> np.ndarray:
        return points @ motion[:3, :3].T + motion[:3, 3] if fingers else points

    changed = {
        name: FingerTrace(name, act(f.knuckle), act(f.middle), act(f.tip), f.reach)
        for name, f in trace.fingers.items()
    }
    return HandTrace(changed, motion @ trace.palm, trace.size)


def scaled(trace: HandTrace, factor: float) -> HandTrace:
    """Scale a trace about the origin of the world."""
    palm = trace.palm.copy()
    palm[:, :3, 3] *= factor
    fingers = {
        name: FingerTrace(
            name, factor * f.knuckle, factor * f.middle, factor * f.tip, factor * f.reach
        )
        for name, f in trace.fingers.items()
    }
    return HandTrace(fingers, palm, factor * trace.size)


@pytest.fixture(scope="module")
def trace(human: Hand) -> HandTrace:
    return trace_robot(human, wave(human), poses(300))


def times(trace: HandTrace) -> np.ndarray:
    return np.arange(len(trace.palm)) / RATE


def assess(one: HandTrace, other: HandTrace) -> Fidelity:
    return assess_fidelity(one, other, times(one))


def test_the_same_motion_is_perfect(trace: HandTrace) -> None:
    result = assess(trace, trace)
    assert result.extension_correlation == pytest.approx(1.0)
    assert result.pinch_order is not None
    zeros = ("extension_rms", "finger_direction_deg", "wrist_direction_deg")
    for name in (*zeros, "tip_error_mm", "tip_error_knuckles_mm"):
        assert getattr(result, name) == pytest.approx(0.0, abs=1e-9), name
    for name in ("object_rotation_deg", "object_stretch", "object_translation_mm"):
        assert getattr(result, name) == pytest.approx(0.0, abs=1e-6), name
    assert result.palm_deg == pytest.approx(0.0, abs=1e-5)
    assert result.palm_mm == pytest.approx(0.0, abs=1e-9)
    assert result.latency_ms == pytest.approx(0.0, abs=1e-6)
    vectors = result.key_vectors
    assert vectors is not None
    assert vectors.cosine == pytest.approx(1.0)
    assert vectors.scale == pytest.approx(1.0, abs=1e-6)
    assert vectors.motion_preservation == pytest.approx(1.0)


def test_a_larger_hand_that_does_the_same_is_perfect_too(trace: HandTrace) -> None:
    result = assess(trace, scaled(trace, 1.6))
    assert result.extension_correlation == pytest.approx(1.0)
    assert result.tip_error_mm == pytest.approx(0.0, abs=1e-9)
    assert result.tip_error_knuckles_mm == pytest.approx(0.0, abs=1e-9)
    assert result.finger_direction_deg == pytest.approx(0.0, abs=1e-5)
    assert result.key_vectors is not None
    assert result.key_vectors.cosine == pytest.approx(1.0)


def test_tips_from_the_knuckles_do_not_depend_on_the_palms_origin(trace: HandTrace) -> None:
    shift = np.eye(4)
    shift[:3, 3] = [0.01, -0.03, 0.02]
    other = HandTrace(trace.fingers, trace.palm @ shift, trace.size)
    result = assess(trace, other)
    assert result.tip_error_mm > 30.0
    assert result.tip_error_knuckles_mm == pytest.approx(0.0, abs=1e-9)
    # One finger of five is displaced by 5 mm, so only that finger has an error, of 5 mm.
    ring = trace.fingers["ring"]
    aside = dataclasses.replace(ring, tip=ring.tip + np.array([0.003, 0.0, -0.004]))
    result = assess(trace, HandTrace({**trace.fingers, "ring": aside}, trace.palm, trace.size))
    assert result.fingers["ring"].tip_error_knuckles_mm == pytest.approx(5.0)
    assert result.tip_error_knuckles_mm == pytest.approx(1.0)


def test_tips_from_the_knuckles_are_scaled_by_reach(trace: HandTrace) -> None:
    longer = {
        name: FingerTrace(
            name, f.knuckle, f.middle, f.knuckle + 1.5 * (f.tip - f.knuckle), 1.5 * f.reach
        )
        for name, f in trace.fingers.items()
    }
    alike = assess(trace, HandTrace(longer, trace.palm, trace.size))
    unscaled = {name: dataclasses.replace(f, reach=f.reach / 1.5) for name, f in longer.items()}
    other = assess(trace, HandTrace(unscaled, trace.palm, trace.size))
    # The knuckles keep their distances, so that some error remains.
    assert alike.tip_error_knuckles_mm < 0.6 * other.tip_error_knuckles_mm


def test_worlds_that_lie_apart_do_not_matter(trace: HandTrace) -> None:
    result = assess(trace, moved(trace, poses(400)[-1]))
    assert result.palm_deg == pytest.approx(0.0, abs=1e-5)
    assert result.object_rotation_deg == pytest.approx(0.0, abs=1e-5)
    assert result.object_translation_mm == pytest.approx(0.0, abs=1e-6)


def test_a_still_hand_follows_nothing(trace: HandTrace) -> None:
    still = trace.at(np.zeros(len(trace.palm), dtype=int))
    result = assess(trace, still)
    assert result.extension_correlation == 0.0
    assert result.extension_rms > 0.01
    assert result.palm_deg > 10.0
    assert np.isnan(result.latency_ms)


def test_the_first_half_second_does_not_count(trace: HandTrace) -> None:
    wrong = {
        name: dataclasses.replace(f, tip=np.where(times(trace)[:, None] < 0.495, 1.0, f.tip))
        for name, f in trace.fingers.items()
    }
    result = assess(trace, HandTrace(wrong, trace.palm, trace.size))
    assert result.tip_error_mm == pytest.approx(0.0, abs=1e-9)


def test_samples_without_a_hand_do_not_count(trace: HandTrace) -> None:
    valid = np.ones(len(trace.palm), dtype=bool)
    valid[100:120] = False
    wrong = {
        name: dataclasses.replace(f, tip=np.where(valid[:, None], f.tip, 1.0))
        for name, f in trace.fingers.items()
    }
    robot = HandTrace(wrong, trace.palm, trace.size)
    result = assess_fidelity(trace, robot, times(trace), valid=valid)
    assert result.tip_error_mm == pytest.approx(0.0, abs=1e-9)
    assert assess(trace, robot).tip_error_mm > 1.0


def test_a_turned_palm_gives_its_angle(trace: HandTrace) -> None:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix()
    palm = trace.palm.copy()
    palm[1:] = palm[1:] @ turn
    degrees, millimetres = palm_error(trace.palm, palm)
    share = np.sqrt((len(palm) - 1) / len(palm))
    assert degrees == pytest.approx(share * np.degrees(0.2))
    assert millimetres == pytest.approx(0.0, abs=1e-9)


def test_a_turned_finger_gives_its_angle() -> None:
    a = np.random.default_rng(0).normal(size=(50, 3))
    axis = np.cross(a, [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    b = Rotation.from_rotvec(0.3 * axis).apply(a)
    assert angles_between(a, 2.0 * b) == pytest.approx(np.degrees(0.3))


def test_a_turned_object_gives_its_angle_and_a_moved_one_its_distance(trace: HandTrace) -> None:
    # After the common reference, all points are rotated about a fixed point and translated.
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.15, 0.0, 0.0]).as_matrix()
    first = trace.at(np.zeros(40, dtype=int))
    centroid = np.mean([p[0] for f in first.fingers.values() for p in (f.tip, f.middle)], axis=0)
    motion[:3, 3] = centroid - motion[:3, :3] @ centroid + np.array([0.0, 0.012, 0.0])
    later = moved(first, motion)
    mixed = {
        name: FingerTrace(
            name,
            f.knuckle,
            np.vstack([f.middle[:1], later.fingers[name].middle[1:]]),
            np.vstack([f.tip[:1], later.fingers[name].tip[1:]]),
            f.reach,
        )
        for name, f in first.fingers.items()
    }
    robot = HandTrace(mixed, first.palm, first.size)
    angle, stretch, distance = object_motion_error(first, robot, list(first.fingers))
    share = 39 / 40
    assert angle == pytest.approx(share * np.degrees(0.15), rel=1e-6)
    assert distance == pytest.approx(share * 12.0, rel=1e-6)
    assert stretch == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("lag", [0.02, 0.034, -0.03])
def test_a_shifted_signal_gives_its_lag(human: Hand, lag: float) -> None:
    one = trace_robot(human, wave(human), poses(300, 0.0))
    other = trace_robot(human, wave(human, lag=lag), poses(300, 0.0))
    assert latency(one, other, times(one)) == pytest.approx(1e3 * lag, abs=1.0)


def test_jerk_of_a_cubic_is_constant_at_uneven_instants() -> None:
    time = np.cumsum(np.random.default_rng(1).uniform(0.005, 0.02, 100))
    q = np.column_stack([time**3, 2.0 * time**3])
    usable = np.ones(100, dtype=bool)
    expected = np.sqrt((6.0**2 + 12.0**2) / 2.0)
    assert rms_jerk(q, time, usable) == pytest.approx(expected, rel=1e-6)
    usable[::3] = False
    assert np.isnan(rms_jerk(q, time, usable))


def test_joints_outside_limits_and_too_fast_are_counted(trace: HandTrace, human: Hand) -> None:
    q, time = wave(human), times(trace)
    q[200:225] = human.upper_limits + 0.01
    joints = JointMotion(q, human.lower_limits, human.upper_limits, human.velocity_limits)
    result = assess_fidelity(trace, trace, time, joints=joints, human_q=q)
    assert result.outside_limits == pytest.approx(25 / 250)
    jump = np.abs(np.diff(q, axis=0)) * RATE / human.velocity_limits
    assert result.speed_ratio == pytest.approx(jump[50:].max())
    assert result.jerk_ratio == pytest.approx(1.0)


def pinching(trace: HandTrace, gap: float) -> HandTrace:
    """Return a trace with given distances between the tips of thumb and index finger."""
    thumb = trace.fingers["thumb"].tip
    index = dataclasses.replace(trace.fingers["index"], tip=thumb + np.array([gap, 0.0, 0.0]))
    return HandTrace({**trace.fingers, "index": index}, trace.palm, trace.size)


def test_pinches_are_judged_by_the_surfaces(trace: HandTrace) -> None:
    count = len(trace.palm)
    closed, nearest = np.full(count, 0.0005), np.full(count, 0.01)
    closed[150:200] = 0.004  # Open in 50 of the 250 samples with a human pinch.
    closed[200:250] = -0.002
    nearest[100:150] = -0.0015
    gaps = SurfaceGaps({"index": closed}, nearest)
    result = assess_fidelity(pinching(trace, 0.01), trace, times(trace), gaps=gaps)
    assert result.pinch_samples == 250
    assert result.pinch_closed == pytest.approx(200 / 250)
    assert result.pinch_gap_mm == pytest.approx(0.5)
    assert result.pinch_gap_p95_mm == pytest.approx(4.0)
    assert result.pinch_depth_mm == pytest.approx(2.0)
    assert np.isnan(result.pinch_false)
    assert result.self_penetration == pytest.approx(50 / 250)
    apart = assess_fidelity(pinching(trace, 0.05), trace, times(trace), gaps=gaps)
    assert apart.pinch_samples == 0
    assert np.isnan(apart.pinch_closed)
    assert apart.pinch_false == pytest.approx(200 / 250)


def test_order_of_tip_distances(trace: HandTrace) -> None:
    assert pinch_order(trace, trace) == pytest.approx(1.0)
    assert pinch_order(trace, scaled(trace, 2.0)) == pytest.approx(1.0)
    thumb = trace.fingers["thumb"].tip
    turned = {
        name: dataclasses.replace(f, tip=thumb + 0.001 / np.maximum(f.tip - thumb, 1e-4))
        for name, f in trace.fingers.items()
    }
    assert pinch_order(trace, HandTrace(turned, trace.palm, trace.size)) < 0.5


def test_displacements_against_the_humans_are_not_preserved(trace: HandTrace) -> None:
    backwards = trace.at(np.arange(len(trace.palm))[::-1])
    assert compare_key_vectors(trace, trace).motion_preservation == pytest.approx(1.0)
    assert compare_key_vectors(trace, backwards).motion_preservation < 0.5


def test_flatness_is_the_squared_second_difference(human: Hand) -> None:
    one = trace_robot(human, wave(human), poses(300, 0.0))
    bends = [
        np.square(np.diff(one.in_palm(f.tip), 2, axis=0)).sum(axis=1) for f in one.fingers.values()
    ]
    found = compare_key_vectors(one, one).flatness_mm2
    assert found == pytest.approx(1e6 * np.mean(bends), rel=1e-9)


def test_more_of_the_workspace_is_used_by_a_wider_motion(allegro: Hand) -> None:
    workspace = sample_workspace(allegro, count=2000)
    shares = []
    for amount in (0.0, 0.2, 0.9):
        robot = trace_robot(allegro, wave(allegro, 200, amount))
        shares.append(compare_key_vectors(robot, robot, workspace=workspace).workspace)
    assert 0.0 <= shares[0] < shares[1] < shares[2] < 1.0


def test_landmarks_give_the_models_own_trace(human: Hand) -> None:
    q, wrist = wave(human, 60), poses(60)
    landmarks = np.array([human.points(a, w) for a, w in zip(q, wrist, strict=True)])
    lengths = HumanLengths.from_urdf(human.urdf_text)
    one = trace_human(landmarks, lengths)
    other = trace_robot(human, q, wrist)
    assert one.palm == pytest.approx(other.palm, abs=1e-9)
    assert one.size == pytest.approx(other.size, rel=1e-3)
    for name, finger in one.fingers.items():
        assert finger.knuckle == pytest.approx(other.fingers[name].knuckle, abs=1e-9)
        assert finger.middle == pytest.approx(other.fingers[name].middle, abs=1e-9)
        assert finger.tip == pytest.approx(other.fingers[name].tip, abs=1e-9)
        assert finger.reach == pytest.approx(other.fingers[name].reach, rel=1e-3)


def test_the_trackers_wrist_carries_the_palm(human: Hand) -> None:
    q, wrist = wave(human, 80), poses(80)
    landmarks = np.array([human.points(a, w) for a, w in zip(q, wrist, strict=True)])
    noisy = landmarks + np.random.default_rng(2).normal(scale=0.003, size=landmarks.shape)
    lengths = HumanLengths.from_urdf(human.urdf_text)
    truth = trace_robot(human, q, wrist)
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_rotvec([0.4, 0.2, 1.0]).as_matrix()
    with_wrist = trace_human(noisy, lengths, "right", truth.palm @ offset)
    without = trace_human(noisy, lengths)
    errors = [palm_error(truth.palm, t.palm)[0] for t in (with_wrist, without)]
    # The mean pose of the palm on the wrist averages the noise of all samples.
    assert errors[0] < 0.3
    assert errors[1] > 1.0


def test_the_left_hands_palm_is_a_frame_of_its_own(human: Hand) -> None:
    left = load_hand("human_left", points="landmarks")
    q, wrist = wave(left, 20), poses(20)
    landmarks = np.array([left.points(a, w) for a, w in zip(q, wrist, strict=True)])
    lengths = HumanLengths.from_urdf(human.urdf_text)
    found = trace_human(landmarks, lengths, "left").palm
    assert found == pytest.approx(trace_robot(left, q, wrist).palm, abs=1e-9)


@pytest.mark.parametrize("name", ["allegro_right", "three_finger", "human", "g1_right"])
def test_knuckles_stay_in_the_palm_and_the_reach_is_the_largest_distance(name: str) -> None:
    hand = load_hand(name)
    chains = find_fingers(hand)
    assert "thumb" in chains
    random = np.random.default_rng(3)
    q = random.uniform(hand.lower_limits, hand.upper_limits, (200, len(hand.joint_names)))
    trace = trace_robot(hand, q, None, chains)
    for finger in trace.fingers.values():
        knuckle = trace.in_palm(finger.knuckle)
        # Two fingers of `three_finger` spread about the middle of the palm, with their knuckles.
        assert np.ptp(knuckle, axis=0).max() < 1e-9 or name == "three_finger"
        assert finger.extension.max() <= 1.0 + 1e-3
    for finger, chain in chains.items():
        stretched = trace_robot(hand, chain.stretched[None], None, chains).fingers[finger]
        assert stretched.extension[0] == pytest.approx(1.0, abs=1e-6)


def test_allegros_points(allegro: Hand) -> None:
    chains = find_fingers(allegro)
    names = allegro.model.names
    assert [names[chains["index"].knuckle[0]], names[chains["index"].middle[0]]] == [
        "joint_1.0",
        "joint_2.0",
    ]
    assert names[chains["thumb"].knuckle[0]] == "joint_12.0"
    # 54 + 38.4 + 26.7 mm of the index finger's links.
    assert chains["index"].reach == pytest.approx(0.119, abs=1e-3)


def test_gaps_are_those_of_the_surfaces(allegro: Hand) -> None:
    q = np.tile(allegro.rest, (2, 1))
    gaps = measure_gaps(allegro, q)
    tips = trace_robot(allegro, q).fingers
    assert set(gaps.pinches) == {"index", "middle", "ring"}
    for name, gap in gaps.pinches.items():
        apart = np.linalg.norm(tips[name].tip - tips["thumb"].tip, axis=1)
        # Both tips end in spheres of 12 mm; boxes of the last links may be nearer.
        assert (gap <= apart - 0.0239).all()
        assert (gap > 0.0).all()
    assert (gaps.nearest > 0.0).all()


def test_fingers_that_reach_into_each_other_are_seen(allegro: Hand) -> None:
    q = allegro.rest.copy()
    index = [allegro.joint_names.index(f"joint_{i}.0") for i in range(3)]
    q[index] = allegro.upper_limits[index]
    spread = allegro.joint_names.index("joint_0.0")
    deepest = []
    for angle in (allegro.lower_limits[spread], allegro.upper_limits[spread]):
        q[spread] = angle
        deepest.append(measure_gaps(allegro, q[None]).nearest[0])
    assert min(deepest) < 0.0


@pytest.mark.parametrize("name", ["leap_right", "svh_right"])
def test_hands_of_the_shared_folder_are_described(name: str) -> None:
    sys.path.insert(0, str(BENCHMARKS))
    try:
        shared = importlib.import_module("shared_hands")
    finally:
        sys.path.remove(str(BENCHMARKS))
    if shared.shared_hands_folder() is None:
        pytest.skip("no folder with shared hands")
    hand = load_hand(shared.shared_hand_spec(name))
    chains = find_fingers(hand)
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)[None]
    trace = trace_robot(hand, stretched, None, chains)
    for finger, points in trace.fingers.items():
        direction = trace.in_palm(points.tip)[0] - trace.in_palm(points.knuckle)[0]
        if finger != "thumb":
            # Stretched, the fingers point in the distal direction of the palm.
            assert direction[1] / np.linalg.norm(direction) > 0.99, finger
    thumb, index = (trace.in_palm(trace.fingers[f].knuckle)[0] for f in ("thumb", "index"))
    assert thumb[1] < index[1]
    assert index[0] < 0.0  # The radial side of a right hand.


def test_traces_that_do_not_fit_are_rejected(trace: HandTrace) -> None:
    time = times(trace)
    with pytest.raises(InvalidInputError) as caught:
        assess_fidelity(trace, trace.at(np.arange(10)), time)
    assert caught.value.argument == "robot"
    with pytest.raises(InvalidInputError) as caught:
        assess_fidelity(trace, trace, time, valid=np.zeros(len(time), dtype=bool))
    assert caught.value.argument == "time"
    nobody = HandTrace({}, trace.palm, trace.size)
    with pytest.raises(InvalidInputError) as caught:
        assess_fidelity(trace, nobody, time)
    assert caught.value.argument == "robot"
    with pytest.raises(InvalidInputError) as caught:
        trace_human(np.zeros((3, 20, 3)), HumanLengths.from_hand_length(0.19))
    assert caught.value.argument == "landmarks"
