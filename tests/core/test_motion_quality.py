"""`tests/support/motion_quality.py` on motions with known values: fingers, palm, smoothness."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from joint_motion import map_motion
from motion_cases import HUMAN, waving
from motion_quality import (
    FingerMatch,
    assess_quality,
    finger_extensions,
    match_fingers,
    mean_correlation,
    palm_deviation,
    total_range_ratio,
)
from strategies import generators, poses

from handmap_qp import HandMapper, InvalidInputError, load_hand
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.human import HumanMotion
from handmap_qp.se3 import affine


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
    (match,) = match_fingers(
        {"index": human, "ring": human}, {"index": gain * human + offset}
    )
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
        np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]),
        np.array([0.3, 0.4, 0.0]),
    )
    distance, angle = palm_deviation(
        np.array([np.eye(4), move]), np.array([np.eye(4), np.eye(4)])
    )
    np.testing.assert_allclose(distance, [0.0, 0.5], atol=1e-15)
    np.testing.assert_allclose(angle, [0.0, np.pi / 2.0], atol=1e-15)
