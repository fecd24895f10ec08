"""Fidelity of motions with known answers."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from shared_hands import shared_hand_spec, shared_hands_folder

from handmap_qp.apps.offline.compare import with_urdf
from handmap_qp.apps.offline.fidelity import (
    angles_between,
    assess_fidelity,
    gap_metrics,
    key_vector_metrics,
    latency,
    object_metrics,
    palm_metrics,
    pinch_order,
    sample_workspace,
    workspace_share,
)
from handmap_qp.apps.offline.hand_trace import (
    KNUCKLE,
    TIP,
    HandTrace,
    trace_human,
    trace_robot,
)
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.sources import find_mesh, urdf_path

RATE = 100.0


@pytest.fixture(scope="module")
def human() -> Hand:
    return load_hand("human", points="landmarks")


@pytest.fixture(scope="module")
def allegro() -> Hand:
    return load_hand("allegro_right")


def wave(
    hand: Hand, count: int = 300, amount: float = 0.3, lag: float = 0.0
) -> np.ndarray:
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


def changed(trace: HandTrace, finger: str, tip: np.ndarray) -> HandTrace:
    """Replace a fingertip's path."""
    points = trace.points.copy()
    points[:, trace.names.index(finger), TIP] = tip
    return trace._replace(points=points)


def tip_of(trace: HandTrace, finger: str) -> np.ndarray:
    return trace.points[:, trace.names.index(finger), TIP]


def moved(trace: HandTrace, motion: np.ndarray) -> HandTrace:
    """Move a trace by one rigid motion."""
    points = trace.points @ motion[:3, :3].T + motion[:3, 3]
    return trace._replace(points=points, palm=motion @ trace.palm)


def scaled(trace: HandTrace, factor: float) -> HandTrace:
    """Scale a trace about the origin of the world."""
    palm = trace.palm.copy()
    palm[:, :3, 3] *= factor
    return HandTrace(
        trace.names,
        factor * trace.points,
        factor * trace.reach,
        palm,
        factor * trace.size,
    )


def samples(trace: HandTrace, index: np.ndarray) -> HandTrace:
    return trace.part(index, trace.names)


@pytest.fixture(scope="module")
def trace(human: Hand) -> HandTrace:
    return trace_robot(human, wave(human), poses(300))


def times(trace: HandTrace) -> np.ndarray:
    return np.arange(len(trace.palm)) / RATE


def assess(
    one: HandTrace, other: HandTrace, valid: np.ndarray | None = None
) -> dict[str, float]:
    seen = np.ones(len(one.palm), dtype=bool) if valid is None else valid
    return assess_fidelity(one, other, times(one), seen).values


SAME = {
    "extension_correlation": 1.0,
    "thumb_extension_correlation": 1.0,
    "key_cosine": 1.0,
    "key_scale": 1.0,
    "motion_preservation": 1.0,
}
ZERO = (
    "extension_rms",
    "finger_direction_deg",
    "wrist_direction_deg",
    "tip_error_mm",
    "tip_error_knuckles_mm",
    "object_rotation_deg",
    "object_stretch",
    "object_translation_mm",
    "palm_deg",
    "palm_mm",
    "latency_ms",
)


def test_the_same_motion_is_perfect(trace: HandTrace) -> None:
    result = assess(trace, trace)
    assert {key: result[key] for key in SAME} == pytest.approx(SAME, abs=1e-6)
    assert [result[key] for key in ZERO] == pytest.approx([0.0] * len(ZERO), abs=1e-5)


def test_a_larger_hand_that_does_the_same_is_perfect_too(trace: HandTrace) -> None:
    result = assess(trace, scaled(trace, 1.6))
    assert result["extension_correlation"] == pytest.approx(1.0)
    assert result["key_cosine"] == pytest.approx(1.0)
    for key in ("tip_error_mm", "tip_error_knuckles_mm", "finger_direction_deg"):
        assert result[key] == pytest.approx(0.0, abs=1e-5), key


def test_tips_from_the_knuckles_do_not_depend_on_the_palms_origin(
    trace: HandTrace,
) -> None:
    shift = np.eye(4)
    shift[:3, 3] = [0.01, -0.03, 0.02]
    result = assess(trace, trace._replace(palm=trace.palm @ shift))
    assert result["tip_error_mm"] > 30.0
    assert result["tip_error_knuckles_mm"] == pytest.approx(0.0, abs=1e-9)
    # One finger of five is displaced by 5 mm, so only that finger has an error, of 5 mm.
    aside = changed(
        trace, "ring", tip_of(trace, "ring") + np.array([0.003, 0.0, -0.004])
    )
    found = assess_fidelity(trace, aside, times(trace), times(trace) >= 0.0)
    assert found.fingers["ring"]["tip_error_knuckles_mm"] == pytest.approx(5.0)
    assert found.values["tip_error_knuckles_mm"] == pytest.approx(1.0)


def test_tips_from_the_knuckles_are_scaled_by_reach(trace: HandTrace) -> None:
    points = trace.points.copy()
    points[:, :, TIP] = points[:, :, KNUCKLE] + 1.5 * (
        points[:, :, TIP] - points[:, :, KNUCKLE]
    )
    longer = trace._replace(points=points)
    alike, other = (
        assess(trace, longer._replace(reach=1.5 * trace.reach)),
        assess(trace, longer),
    )
    # The knuckles keep their distances, so that some error remains.
    assert alike["tip_error_knuckles_mm"] < 0.6 * other["tip_error_knuckles_mm"]


def test_worlds_that_lie_apart_do_not_matter(trace: HandTrace) -> None:
    result = assess(trace, moved(trace, poses(400)[-1]))
    for key in ("palm_deg", "object_rotation_deg", "object_translation_mm"):
        assert result[key] == pytest.approx(0.0, abs=1e-5), key


def test_a_still_hand_follows_nothing(trace: HandTrace) -> None:
    result = assess(trace, samples(trace, np.zeros(len(trace.palm), dtype=int)))
    assert result["extension_correlation"] == 0.0
    assert result["extension_rms"] > 0.01
    assert result["palm_deg"] > 10.0
    assert np.isnan(result["latency_ms"])


def test_the_first_half_second_and_samples_without_a_hand_do_not_count(
    trace: HandTrace,
) -> None:
    valid = np.ones(len(trace.palm), dtype=bool)
    valid[100:120] = False
    counts = valid & (times(trace) > 0.495)
    points = np.where(counts[:, None, None, None], trace.points, 1.0)
    wrong = trace._replace(points=points)
    assert assess(trace, wrong, valid=valid)["tip_error_mm"] == pytest.approx(
        0.0, abs=1e-9
    )
    assert assess(trace, wrong)["tip_error_mm"] > 1.0


def test_a_turned_palm_gives_its_angle(trace: HandTrace) -> None:
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.0, 0.0, 0.2]).as_matrix()
    palm = trace.palm.copy()
    palm[1:] = palm[1:] @ turn
    found = palm_metrics(trace, trace._replace(palm=palm))
    share = np.sqrt((len(palm) - 1) / len(palm))
    assert found["palm_deg"] == pytest.approx(share * np.degrees(0.2))
    assert found["palm_mm"] == pytest.approx(0.0, abs=1e-9)


def test_a_turned_finger_gives_its_angle() -> None:
    a = np.random.default_rng(0).normal(size=(50, 3))
    axis = np.cross(a, [0.0, 0.0, 1.0])
    axis /= np.linalg.norm(axis, axis=1)[:, None]
    b = Rotation.from_rotvec(0.3 * axis).apply(a)
    assert angles_between(a, 2.0 * b) == pytest.approx(np.degrees(0.3))


def test_a_turned_object_gives_its_angle_and_a_moved_one_its_distance(
    trace: HandTrace,
) -> None:
    # After the common reference, all points are rotated about a fixed point and translated.
    motion = np.eye(4)
    motion[:3, :3] = Rotation.from_rotvec([0.15, 0.0, 0.0]).as_matrix()
    first = samples(trace, np.zeros(40, dtype=int))
    centroid = first.points[0, :, 1:].reshape(-1, 3).mean(axis=0)
    motion[:3, 3] = centroid - motion[:3, :3] @ centroid + np.array([0.0, 0.012, 0.0])
    points = moved(first, motion).points
    points[0] = first.points[0]
    found = object_metrics(first, first._replace(points=points))
    share = 39 / 40
    assert found["object_rotation_deg"] == pytest.approx(
        share * np.degrees(0.15), rel=1e-6
    )
    assert found["object_translation_mm"] == pytest.approx(share * 12.0, rel=1e-6)
    assert found["object_stretch"] == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("lag", [0.02, 0.034, -0.03])
def test_a_shifted_signal_gives_its_lag(human: Hand, lag: float) -> None:
    one = trace_robot(human, wave(human), poses(300, 0.0))
    other = trace_robot(human, wave(human, lag=lag), poses(300, 0.0))
    assert latency(one, other, times(one)) == pytest.approx(1e3 * lag, abs=1.0)


def test_joints_outside_limits_and_too_fast_are_counted(
    trace: HandTrace, human: Hand
) -> None:
    q = wave(human)
    q[200:225] = human.upper_limits + 0.01
    step_cpu = np.full(len(q), 0.002)
    motion = RobotMotion(human, times(trace), q, poses(len(q)), step_cpu)
    seen = times(trace) >= 0.0
    found = assess_fidelity(trace, trace, times(trace), seen, motion, q)
    result = found.values
    assert result["step_time_ms"] == pytest.approx(2.0)
    assert result["outside_limits"] == pytest.approx(25 / 250)
    jump = np.abs(np.diff(q, axis=0)) * RATE / human.velocity_limits
    assert result["speed_ratio"] == pytest.approx(jump[50:].max())
    assert result["jerk_ratio"] == pytest.approx(1.0)


def pinching(trace: HandTrace, gap: float) -> HandTrace:
    """Return a trace with given distances between the tips of thumb and index finger."""
    return changed(trace, "index", tip_of(trace, "thumb") + np.array([gap, 0.0, 0.0]))


def test_pinches_are_judged_by_the_surfaces(trace: HandTrace) -> None:
    count = len(trace.palm)
    closed, nearest = np.full(count, 0.0005), np.full(count, 0.01)
    closed[150:200] = 0.004  # Open in 50 of the 250 samples with a human pinch.
    closed[200:250] = -0.002
    nearest[100:150] = -0.0015
    gaps: Any = SimpleNamespace(
        pinches=lambda q: {"index": closed[q]}, nearest=lambda q: nearest[q]
    )
    counts = times(trace) >= 0.5

    def measured(gap: float) -> tuple[int, dict[str, float]]:
        human = samples(pinching(trace, gap), counts)
        return gap_metrics(human, gaps, counts)

    pinch_samples, values = measured(0.01)
    assert pinch_samples == 250
    expected = {
        "pinch_closed": 200 / 250,
        "pinch_gap_mm": 0.5,
        "pinch_gap_p95_mm": 4.0,
        "pinch_depth_mm": 2.0,
        "self_penetration": 50 / 250,
    }
    assert {key: values[key] for key in expected} == pytest.approx(expected)
    assert np.isnan(values["pinch_false"])
    pinch_samples, values = measured(0.05)
    assert pinch_samples == 0
    assert np.isnan(values["pinch_closed"])
    assert values["pinch_false"] == pytest.approx(200 / 250)


def test_order_of_tip_distances(trace: HandTrace) -> None:
    assert pinch_order(trace, trace) == pytest.approx(1.0)
    assert pinch_order(trace, scaled(trace, 2.0)) == pytest.approx(1.0)
    points, thumb = trace.points.copy(), tip_of(trace, "thumb")[:, None]
    points[:, 1:, TIP] = thumb + 0.001 / np.maximum(points[:, 1:, TIP] - thumb, 1e-4)
    assert pinch_order(trace, trace._replace(points=points)) < 0.5


def test_displacements_against_the_humans_are_not_preserved(trace: HandTrace) -> None:
    backwards = samples(trace, np.arange(len(trace.palm))[::-1])
    assert key_vector_metrics(trace, backwards)["motion_preservation"] < 0.5


def test_flatness_is_the_squared_second_difference(human: Hand) -> None:
    one = trace_robot(human, wave(human), poses(300, 0.0))
    bends = np.square(np.diff(one.local[:, :, TIP], 2, axis=0)).sum(axis=2)
    found = key_vector_metrics(one, one)["flatness_mm2"]
    assert found == pytest.approx(1e6 * np.mean(bends), rel=1e-9)


def test_more_of_the_workspace_is_used_by_a_wider_motion(allegro: Hand) -> None:
    workspace = sample_workspace(allegro, count=2000)
    shares = [
        workspace_share(trace_robot(allegro, wave(allegro, 200, amount)), workspace)
        for amount in (0.0, 0.2, 0.9)
    ]
    assert 0.0 <= shares[0] < shares[1] < shares[2] < 1.0


def test_landmarks_give_the_models_own_trace(human: Hand) -> None:
    q, wrist = wave(human, 60), poses(60)
    landmarks = np.array([human.points(a, w) for a, w in zip(q, wrist, strict=True)])
    lengths = HumanLengths.from_urdf(human.urdf_text)
    one = trace_human(landmarks, lengths)
    other = trace_robot(human, q, wrist)
    assert one.palm == pytest.approx(other.palm, abs=1e-9)
    assert one.size == pytest.approx(other.size, rel=1e-3)
    assert one.names == other.names
    assert one.points == pytest.approx(other.points, abs=1e-9)
    assert one.reach == pytest.approx(other.reach, rel=1e-3)


def test_the_trackers_wrist_carries_the_palm(human: Hand) -> None:
    q, wrist = wave(human, 80), poses(80)
    landmarks = np.array([human.points(a, w) for a, w in zip(q, wrist, strict=True)])
    noisy = landmarks + np.random.default_rng(2).normal(
        scale=0.003, size=landmarks.shape
    )
    lengths = HumanLengths.from_urdf(human.urdf_text)
    truth = trace_robot(human, q, wrist)
    offset = np.eye(4)
    offset[:3, :3] = Rotation.from_rotvec([0.4, 0.2, 1.0]).as_matrix()
    with_wrist = trace_human(noisy, lengths, "right", truth.palm @ offset)
    without = trace_human(noisy, lengths)
    errors = [palm_metrics(truth, t)["palm_deg"] for t in (with_wrist, without)]
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


@pytest.mark.parametrize("name", ["allegro_right", "three_finger", "human"])
def test_knuckles_stay_in_the_palm_and_the_reach_is_the_largest_distance(
    name: str,
) -> None:
    hand = load_hand(name)
    chains = find_fingers(hand)
    assert "thumb" in chains
    random = np.random.default_rng(3)
    q = random.uniform(
        hand.lower_limits, hand.upper_limits, (200, len(hand.joint_names))
    )
    trace = trace_robot(hand, q)
    # Two fingers of `three_finger` spread about the middle of the palm, with their knuckles.
    assert (
        np.ptp(trace.local[:, :, KNUCKLE], axis=0).max() < 1e-9
        or name == "three_finger"
    )
    assert trace.extension.max() <= 1.0 + 1e-3
    stretched = trace_robot(hand, np.array([c.stretched for c in chains.values()]))
    assert np.diag(stretched.extension) == pytest.approx(1.0, abs=1e-6)


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
    gaps = GapMeter(allegro)
    trace = trace_robot(allegro, q)
    pinches = gaps.pinches(q)
    assert set(pinches) == {"index", "middle", "ring"}
    for name, gap in pinches.items():
        apart = np.linalg.norm(tip_of(trace, name) - tip_of(trace, "thumb"), axis=1)
        # Both tips end in spheres of 12 mm; boxes of the last links may be nearer.
        assert (gap <= apart - 0.0239).all()
        assert (gap > 0.0).all()
    assert (gaps.nearest(q) > 0.0).all()


def test_fingers_that_reach_into_each_other_are_seen(allegro: Hand) -> None:
    q = allegro.rest.copy()
    index = [allegro.joint_names.index(f"joint_{i}.0") for i in range(3)]
    q[index] = allegro.upper_limits[index]
    spread = allegro.joint_names.index("joint_0.0")
    deepest = []
    for angle in (allegro.lower_limits[spread], allegro.upper_limits[spread]):
        q[spread] = angle
        deepest.append(GapMeter(allegro).nearest(q[None])[0])
    assert min(deepest) < 0.0


_SIZES = {
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "box": ("size",),
    "mesh": ("scale",),
}


def with_larger_shapes(hand: Hand, factor: float, folder: Path) -> Path:
    """Write a hand's URDF with collision shapes that are larger by a factor, in their places."""
    source = urdf_path(hand.spec)
    tree = ElementTree.parse(source)
    for shape in tree.iterfind(".//collision/geometry/*"):
        for key in _SIZES[shape.tag]:
            sizes = shape.get(key, "1 1 1").split()
            shape.set(key, " ".join(str(factor * float(size)) for size in sizes))
        if "filename" in shape.attrib:
            shape.set(
                "filename", str(find_mesh(shape.attrib["filename"], source.parent))
            )
    file = folder / f"larger_{factor}.urdf"
    tree.write(file)
    return file


def test_surfaces_of_another_description_are_measured_and_named(
    allegro: Hand, tmp_path: Path
) -> None:
    rng = np.random.default_rng(3)
    q = rng.uniform(*allegro.limits, (20, len(allegro.joint_names)))
    own = GapMeter(allegro)
    assert allegro.name in own.whose
    same = GapMeter(
        allegro, with_urdf(allegro, with_larger_shapes(allegro, 1.0, tmp_path))
    )
    file = with_larger_shapes(allegro, 1.1, tmp_path)
    larger = GapMeter(allegro, with_urdf(allegro, file))
    assert file.name in larger.whose
    assert larger.whose != own.whose
    for finger, gaps in own.pinches(q).items():
        np.testing.assert_allclose(same.pinches(q)[finger], gaps, atol=1e-9)
        # Boxes and spheres of tips grow on all sides, by at least a tenth of a sphere of 12 mm.
        assert (larger.pinches(q)[finger] < gaps - 1e-3).all()


def test_shapes_of_another_hand_are_refused(allegro: Hand, tmp_path: Path) -> None:
    other = load_hand("three_finger")
    with pytest.raises(InvalidInputError, match="--shapes: expected a URDF with the"):
        with_urdf(allegro, urdf_path(other.spec))
    renamed = tmp_path / "renamed.urdf"
    text = urdf_path(allegro.spec).read_text().replace('"joint_15.0"', '"joint_16.0"')
    renamed.write_text(text)
    with pytest.raises(InvalidInputError, match="joint_16"):
        with_urdf(allegro, renamed)


@pytest.mark.parametrize("name", ["leap_right", "svh_right"])
def test_hands_of_the_shared_folder_are_described(name: str) -> None:
    if shared_hands_folder() is None:
        pytest.skip("no folder with shared hands")
    hand = load_hand(shared_hand_spec(name))
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)[None]
    trace = trace_robot(hand, stretched)
    local = dict(zip(trace.names, trace.local[0], strict=True))
    for finger, points in local.items():
        direction = points[TIP] - points[KNUCKLE]
        if finger != "thumb":
            # Stretched, the fingers point in the distal direction of the palm.
            assert direction[1] / np.linalg.norm(direction) > 0.99, finger
    thumb, index = local["thumb"][KNUCKLE], local["index"][KNUCKLE]
    assert thumb[1] < index[1]
    assert index[0] < 0.0  # The radial side of a right hand.


def test_traces_that_do_not_fit_are_rejected(trace: HandTrace) -> None:
    time = times(trace)
    for robot, valid, argument in (
        (samples(trace, np.arange(10)), time >= 0.0, "robot"),
        (trace, time < 0.0, "time"),
        (trace, time[1:] >= 0.0, "valid"),
        (trace.part(np.arange(len(time)), ()), time >= 0.0, "robot"),
    ):
        with pytest.raises(InvalidInputError) as caught:
            assess_fidelity(trace, robot, time, valid)
        assert caught.value.argument == argument
