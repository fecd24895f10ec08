"""Quality of a mapped motion: fingers, palm and smoothness of motions with known values."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from strategies import generators, poses

from handmap_qp import HandMapper, InvalidInputError, load_hand
from handmap_qp.offline.quality import (
    FingerMatch,
    assess_quality,
    finger_extensions,
    finger_tips,
    match_fingers,
    mean_correlation,
    palm_deviation,
    rms_derivative,
    total_range_ratio,
)
from handmap_qp.offline.trajectory import Trajectory, map_motion, map_recording
from handmap_qp.trackers.recording import HumanMotion, Recording
from handmap_qp.transform import affine

HUMAN = load_hand("human", points="joints")


def waving(count: int = 40) -> HumanMotion:
    """Record a hand that opens and closes while its wrist moves."""
    time = np.linspace(0.0, 1.0, count)
    way = 0.5 - 0.5 * np.cos(2.0 * np.pi * time)
    q = HUMAN.rest + 0.4 * way[:, None] * (HUMAN.upper_limits - HUMAN.rest)
    turns = np.array(
        [
            [[np.cos(a), -np.sin(a), 0.0], [np.sin(a), np.cos(a), 0.0], [0.0, 0.0, 1.0]]
            for a in 0.3 * way
        ]
    )
    wrist = np.array(
        [affine(turn, np.array([0.2 * x, 0.0, 0.1])) for turn, x in zip(turns, way, strict=True)]
    )
    dt = np.full(count, time[1])
    return HumanMotion(HUMAN, time, dt, q, wrist, np.ones(count, dtype=bool), np.zeros((count, 21)))


def same_motion(motion: HumanMotion) -> Trajectory:
    """Return the trajectory of a robot that equals the human hand and moves alike."""
    mapped = map_motion(HandMapper(HUMAN, HUMAN, "paper"), motion)
    still = np.zeros_like(mapped.point_error)
    return replace(
        mapped,
        q=motion.q,
        wrist=motion.wrist,
        point_error=still,
        at_limit=np.zeros_like(mapped.at_limit),
    )


def test_the_same_motion_is_perfectly_faithful() -> None:
    motion = waving()
    quality = assess_quality(motion, same_motion(motion))
    assert [match.finger for match in quality.fingers] == [
        "thumb",
        "index",
        "middle",
        "ring",
        "little",
    ]
    assert quality.correlation == pytest.approx(1.0, abs=1e-12)
    assert quality.range_ratio == pytest.approx(1.0, abs=1e-12)
    assert quality.wrist_distance == pytest.approx(0.0, abs=1e-12)
    # Near the identity, the error of the angle is the square root of the rounding error.
    assert quality.wrist_angle == pytest.approx(0.0, abs=1e-7)
    assert (quality.speed, quality.jerk) == (quality.human_speed, quality.human_jerk)
    assert quality.share_at_limit == 0.0


def test_only_seen_samples_count_for_the_share_at_a_limit() -> None:
    motion = waving()
    seen = np.ones(len(motion.time), dtype=bool)
    seen[10:20] = False
    at_limit = np.zeros((len(seen), len(HUMAN.joint_names)), dtype=bool)
    at_limit[10:20] = True
    at_limit[20:26, 3] = True
    at_limit[23:26, 4] = True
    motion, robot = replace(motion, valid=seen), same_motion(motion)
    quality = assess_quality(motion, replace(robot, valid=seen, at_limit=at_limit))
    assert quality.share_at_limit == pytest.approx(6 / 30)


def test_the_motions_sample_times_bound_the_speed() -> None:
    # Samples are 1 to 20 ms apart; the mapper's own sample time would allow any displacement.
    motion = waving()
    dt = np.where(np.arange(len(motion.time)) % 2 == 0, 0.001, 0.02)
    motion = replace(motion, time=np.cumsum(dt), dt=dt)
    robot, tracked = load_hand("three_finger"), load_hand("human", points="landmarks")
    landmarks = [tracked.points(q, at) for q, at in zip(motion.q, motion.wrist, strict=True)]
    recording = Recording("waving", motion.time, np.array(landmarks), motion.valid, "right")
    for mapped in (
        map_motion(HandMapper(HUMAN, robot, "paper", dt=1e3), motion),
        map_recording(HandMapper(tracked, robot, "paper", dt=1e3), recording),
    ):
        displacement = np.abs(np.diff(mapped.q, axis=0))
        assert (displacement <= dt[1:, None] * robot.velocity_limits + 1e-9).all()
        assert displacement.max() > 0.5 * 0.001 * robot.velocity_limits.min()


def test_a_robot_that_does_nothing_is_not_faithful() -> None:
    motion = waving()
    trajectory = same_motion(motion)
    frozen = replace(
        trajectory,
        q=np.tile(motion.q[0], (len(motion.q), 1)),
        wrist=np.tile(motion.wrist[0], (len(motion.q), 1, 1)),
    )
    quality = assess_quality(motion, frozen)
    assert (quality.correlation, quality.range_ratio, quality.speed, quality.jerk) == (
        0.0,
        0.0,
        0.0,
        0.0,
    )
    assert quality.wrist_distance > 0.05


def test_samples_that_are_not_valid_do_not_count() -> None:
    motion = waving()
    trajectory = same_motion(motion)
    valid = motion.valid.copy()
    valid[[7, 8, 30]] = False
    spoilt = trajectory.q.copy()
    spoilt[[7, 8, 30]] += 1.0
    quality = assess_quality(
        replace(motion, valid=valid), replace(trajectory, q=spoilt, valid=valid)
    )
    assert quality.correlation == pytest.approx(1.0, abs=1e-12)
    assert quality.speed == quality.human_speed


def test_as_many_samples_are_expected_as_the_motion_has() -> None:
    motion = waving()
    with pytest.raises(InvalidInputError, match="expected 39 samples"):
        assess_quality(waving(39), same_motion(motion))


@pytest.mark.parametrize(
    ("name", "tips"),
    [
        (
            "human",
            {finger: f"{finger}_tip" for finger in ("thumb", "index", "middle", "ring", "little")},
        ),
        ("three_finger", {"thumb": "finger1_tip", "middle": "finger2_tip", "index": "finger3_tip"}),
        (
            "allegro_right",
            {finger: f"{finger}_tip" for finger in ("thumb", "index", "middle", "ring")},
        ),
    ],
)
@pytest.mark.parametrize("points", [None, "fingertips_middle"])
def test_tips_are_found_whatever_points_are_in_use(
    name: str, tips: dict[str, str], points: str | None
) -> None:
    assert finger_tips(load_hand(name, points=points)) == tips


def test_an_extension_is_the_distance_from_tip_to_palm() -> None:
    hand = load_hand("allegro_left", points=("ring_tip",))
    q = np.array([hand.rest, hand.upper_limits])
    palm = hand.frame_pose("palm", hand.rest)[:3, 3]
    expected = [np.linalg.norm(hand.points(angles)[0] - palm) for angles in q]
    np.testing.assert_allclose(finger_extensions(hand, q)["ring"], expected, atol=1e-15)


@given(generator=generators, gain=st.floats(0.1, 10.0), offset=st.floats(-1.0, 1.0))
def test_a_scaled_finger_follows_fully_and_in_proportion(
    generator: np.random.Generator, gain: float, offset: float
) -> None:
    human = generator.normal(size=50)
    (match,) = match_fingers({"index": human, "ring": human}, {"index": gain * human + offset})
    assert match.correlation == pytest.approx(1.0, abs=1e-9)
    assert match.range_ratio == pytest.approx(gain, rel=1e-9)
    (mirrored,) = match_fingers({"index": human}, {"index": offset - gain * human})
    assert mirrored.correlation == pytest.approx(-1.0, abs=1e-9)


def test_fingers_count_by_how_much_the_human_moved_them() -> None:
    matches = [
        FingerMatch("thumb", -1.0, 0.01, 0.05),
        FingerMatch("index", 1.0, 0.09, 0.04),
        FingerMatch("ring", 0.0, 0.0, 0.01),
    ]
    assert mean_correlation(matches) == pytest.approx(0.8)
    assert total_range_ratio(matches) == pytest.approx(1.0)
    assert np.isnan(matches[2].range_ratio)
    assert np.isnan(mean_correlation([]))
    assert np.isnan(total_range_ratio(matches[2:]))


def test_a_glitch_does_not_make_the_range() -> None:
    human = np.sin(np.linspace(0.0, 20.0, 1000))
    glitch = human.copy()
    glitch[500] = 50.0
    (match,) = match_fingers({"index": human}, {"index": glitch})
    assert match.range_ratio == pytest.approx(1.0, abs=1e-2)


@given(human=poses, robot=poses, generator=generators)
def test_palms_that_move_alike_deviate_nowhere_wherever_the_worlds_lie(
    human: np.ndarray, robot: np.ndarray, generator: np.random.Generator
) -> None:
    turns, _ = np.linalg.qr(generator.normal(size=(5, 3, 3)))
    turns *= np.sign(np.linalg.det(turns))[:, None, None]
    moves = np.array([affine(turn, generator.normal(size=3)) for turn in turns])
    distance, angle = palm_deviation(human @ moves, robot @ moves)
    np.testing.assert_allclose(distance, 0.0, atol=1e-12)
    np.testing.assert_allclose(angle, 0.0, atol=1e-6)


def test_a_palm_that_stays_deviates_by_what_the_other_does() -> None:
    move = affine(
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([0.3, 0.4, 0.0])
    )
    distance, angle = palm_deviation(np.array([np.eye(4), move]), np.array([np.eye(4), np.eye(4)]))
    np.testing.assert_allclose(distance, [0.0, 0.5], atol=1e-15)
    np.testing.assert_allclose(angle, [0.0, np.pi / 2.0], atol=1e-15)


@given(generator=generators, cubic=st.floats(-10.0, 10.0))
def test_the_jerk_of_a_cubic_is_exact_at_uneven_instants(
    generator: np.random.Generator, cubic: float
) -> None:
    time = np.cumsum(generator.uniform(0.5, 1.5, size=20))
    values = np.column_stack([cubic * time**3 - time**2 + 3.0, np.full(20, 7.0)])
    # Third differences of numbers near 1e5 lose ten digits.
    jerk = rms_derivative(values, time, np.ones(20, dtype=bool), order=3)
    assert jerk == pytest.approx(6.0 * abs(cubic) / np.sqrt(2.0), abs=1e-8)


def test_a_derivative_takes_only_samples_in_a_row() -> None:
    time, values = np.arange(6.0), np.array([0.0, 1.0, 2.0, 50.0, 10.0, 12.0])[:, None]
    valid = np.array([True, True, True, False, True, True])
    assert rms_derivative(values, time, valid, order=1) == pytest.approx(
        np.sqrt((1.0 + 1.0 + 4.0) / 3.0)
    )
    assert np.isnan(rms_derivative(values, time, valid, order=3))
