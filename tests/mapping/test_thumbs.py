"""Thumbs: straight where they are open, on the person's finger, and one way to a pinch."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from handmap_core.ik.tasks import AttachedPoints, PointDistances
from handmap_qp import HandMapper, Teleoperation, load_hand
from handmap_qp.hands import THUMB, HumanLengths
from handmap_qp.mapping.methods.teleoperation import BoundTeleoperation
from handmap_qp.reference.teleoperation_targets import least_rotation, pinch_shares
from handmap_qp.se3 import Array, inverse_pose, transform_points

HUMAN = load_hand("human", points="landmarks")
ALLEGRO = load_hand("allegro_right")
BOUND = BoundTeleoperation(Teleoperation(), HUMAN, ALLEGRO)
MODEL = BOUND.model


def thumb_at(share: float) -> Array:
    """Return landmarks of a resting person whose thumb tip is a share of the way to the index.

    At 0 the thumb is beside the palm, far from all fingers, and bent a little; at 1 tips meet.
    """
    points = HUMAN.points(HUMAN.rest)
    base, tip = BOUND.pair.knuckles[0], BOUND.pair.tips[0]
    # From the little finger's side to the index finger's: away from all fingers.
    across = points[BOUND.pair.knuckles[1]] - points[BOUND.pair.knuckles[-1]]
    away = across / np.linalg.norm(across)
    start = points[base] + 0.04 * away
    reached = start + 0.9 * MODEL.human_reach[0] * away
    end = reached + share * (points[BOUND.pair.tips[1]] - reached)
    along = np.linspace(0.0, 1.0, tip - base + 1)[:, None]
    points[base : tip + 1] = start + along * (end - start)
    return points


def asked_extension(points: Array) -> float:
    """Return the share of its reach that Allegro's thumb is asked for."""
    step = HandMapper(HUMAN, ALLEGRO).map_points(points, np.eye(4))
    (rows,) = step.asked.tasks
    assert isinstance(rows, PointDistances)
    return float(rows.distances[0] / BOUND.pair.robot_reach[0])


def test_an_open_thumb_is_asked_for_as_straight_as_the_persons() -> None:
    points = thumb_at(0.0)
    knuckle, tip = points[BOUND.pair.knuckles[0]], points[BOUND.pair.tips[0]]
    persons = np.linalg.norm(tip - knuckle) / MODEL.human_reach[0]
    assert asked_extension(points) == pytest.approx(persons, abs=1e-9)
    assert persons == pytest.approx(0.9)
    # Near a finger, its change from rest is followed, as that of all fingers.
    near = thumb_at(0.8)
    length = np.linalg.norm(near[BOUND.pair.tips[0]] - near[BOUND.pair.knuckles[0]])
    change = MODEL.aim_offsets[0] + MODEL.aim_slopes[0] * length
    asked = asked_extension(near) * BOUND.pair.robot_reach[0]
    assert asked == pytest.approx(
        np.clip(change, MODEL.least_aims[0], MODEL.largest_aims[0]), abs=1e-9
    )


def test_a_thumb_goes_from_open_to_near_without_a_jump() -> None:
    shares = np.linspace(0.0, 1.0, 201)
    asked = np.array([asked_extension(thumb_at(share)) for share in shares])
    # The aim changes by 0.245 of the reach in all, within 40 mm of some 120.
    assert np.abs(np.diff(asked)).max() < 0.02


def test_the_robots_open_thumb_is_straight() -> None:
    mapper = HandMapper(HUMAN, ALLEGRO)
    points = thumb_at(0.0)
    for _ in range(90):
        q = mapper.map_points(points, np.eye(4)).command.q
    chain = BOUND.pair.chains[THUMB]
    configuration = ALLEGRO.configuration()
    configuration.place(ALLEGRO.configuration_vector(q))
    ends = AttachedPoints(ALLEGRO, [chain.knuckle, chain.tip]).positions(configuration)
    assert np.linalg.norm(ends[1] - ends[0]) / chain.reach > 0.85


def rest_of(points: Array) -> Array:
    """Return the posture that Allegro's rest term pulls to."""
    rest = HandMapper(HUMAN, ALLEGRO).map_points(points, np.eye(4)).asked.rest
    assert rest is not None
    return rest


def test_rest_is_the_matched_posture_far_from_a_pinch() -> None:
    np.testing.assert_allclose(rest_of(thumb_at(0.0)), BOUND.pair.matched, atol=1e-12)


def test_one_pinch_moves_the_rest_of_its_own_fingers() -> None:
    pair = BOUND.pair
    points = thumb_at(0.0)
    # The other fingertips are far away; the gap of the index finger is 60 mm: half of the way.
    tip = points[pair.tips[1]]
    points[pair.tips[0]] = tip + 0.06 * np.array([0.0, 0.0, 1.0])
    points[pair.tips[2:]] = tip + np.array([0.0, 0.0, -0.3])
    found = rest_of(points)
    posture = pair.measured.pinches_by_finger["index"]
    expected = pair.matched.copy()
    for name in (THUMB, "index"):
        columns = pair.chains[name].columns
        expected[columns] += 0.5 * (posture - pair.matched)[columns]
    np.testing.assert_allclose(found, expected, atol=1e-12)
    others = np.concatenate([pair.chains[name].columns for name in ("middle", "ring")])
    np.testing.assert_array_equal(found[others], pair.matched[others])


def test_rest_is_the_mean_of_pinches_that_are_closed_at_once() -> None:
    pair = BOUND.pair
    points = thumb_at(0.0)
    points[pair.tips[[0, 1, 2]]] = points[pair.tips[1]]
    points[pair.tips[3]] += 0.3
    found = rest_of(points)
    both = [pair.measured.pinches_by_finger[name] for name in ("index", "middle")]
    thumb = pair.chains[THUMB].columns
    np.testing.assert_allclose(found[thumb], np.mean(both, axis=0)[thumb], atol=1e-12)


@pytest.mark.parametrize("name", ["human", "panda_gripper"])
def test_hands_like_the_persons_and_jaws_have_one_rest(name: str) -> None:
    bound = BoundTeleoperation(Teleoperation(), HUMAN, load_hand(name))
    np.testing.assert_array_equal(bound.model.pinch_rests, 0.0)


MIDDLE = 2
"""The finger that a thumb is laid on."""


def thumb_on(height: float, turn: float = 0.0) -> Array:
    """Return landmarks of a person whose thumb tip is at a height above a bent middle finger [m].

    It is above the middle of the middle bone, turned about that from the front of the palm [rad].
    """
    points = HUMAN.points(HUMAN.rest)
    knuckle, pip, dip, tip = BOUND.pair.bones[MIDDLE - 1]
    along = points[dip] - points[pip]
    length = np.linalg.norm(along)
    along /= length
    # Bent by a right angle to the palm's side, so that tips are far from each other.
    front = np.cross(along, points[BOUND.pair.knuckles[1]] - points[knuckle])
    front /= np.linalg.norm(front)
    points[tip] = points[dip] - 0.05 * along
    side = np.cross(along, front)
    off = np.cos(turn) * front + np.sin(turn) * side
    points[BOUND.pair.tips[0]] = points[pip] + 0.5 * length * along + height * off
    return points


def asked_points(points: Array) -> Array:
    """Return the places that Allegro's points are asked for, in its palm axes [m]."""
    step = HandMapper(HUMAN, ALLEGRO).map_points(points, np.eye(4))
    palm = step.asked.wrist @ inverse_pose(ALLEGRO.wrist_to_palm)
    return transform_points(inverse_pose(palm), step.asked.points)


def test_a_thumb_on_a_finger_is_asked_to_touch_the_robots_on_the_same_side() -> None:
    skin = MODEL.skin_gap
    touching = MODEL.segment_touching[0]
    offsets = []
    for turn in (-0.5, 0.0, 0.5):
        points = thumb_on(skin, turn)
        asked = asked_points(points)
        (segment,) = np.flatnonzero(
            MODEL.segment_starts == BOUND.pair.bones[MIDDLE - 1][1]
        )
        ends = asked[[MODEL.segment_from[segment], MODEL.segment_to[segment]]]
        offsets.append(asked[0] - ends.mean(axis=0))
        # Its neighbours pull a little: they are 20 mm and more away.
        assert np.linalg.norm(offsets[-1]) == pytest.approx(touching, abs=0.003)
        along = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        assert abs(offsets[-1] @ along) < 0.003
    turned = [angle_between(a, b) for a, b in pairwise(offsets)]
    np.testing.assert_allclose(turned, 0.5, atol=0.15)


def test_a_thumb_comes_to_lie_on_a_finger_without_a_jump() -> None:
    heights = np.linspace(0.06, 0.008, 201)
    asked = np.array([asked_points(thumb_on(height))[0] for height in heights])
    steps = np.linalg.norm(np.diff(asked, axis=0), axis=1)
    assert steps.max() < 0.004
    # It is led by the segment at the end, and not at the start.
    whole = np.linalg.norm(asked[-1] - asked[0])
    assert whole > 0.03


def test_a_tip_that_is_tracked_across_a_bone_does_not_throw_the_thumb() -> None:
    heights = np.linspace(0.012, -0.012, 241)
    asked = np.array([asked_points(thumb_on(height))[0] for height in heights])
    steps = np.linalg.norm(np.diff(asked, axis=0), axis=1)
    # Twice the robot's thickness over the person's skin gap, and some for the neighbours.
    steepest = 2.0 * MODEL.segment_touching[0] / MODEL.skin_gap
    assert steps.max() < 1.5 * steepest * 1e-4


def test_a_lying_thumb_is_asked_less_for_an_extension() -> None:
    step = HandMapper(HUMAN, ALLEGRO).map_points(thumb_on(0.012), np.eye(4))
    (rows,) = step.asked.tasks
    assert isinstance(rows, PointDistances)
    left = MODEL.lying_extension * MODEL.extension_weights[0]
    assert rows.weights[0] == pytest.approx(left, abs=1e-12)
    far = HandMapper(HUMAN, ALLEGRO).map_points(thumb_on(0.05), np.eye(4))
    (rows,) = far.asked.tasks
    assert isinstance(rows, PointDistances)
    assert rows.weights[0] == pytest.approx(MODEL.extension_weights[0])


def test_a_pinch_leads_a_thumb_that_is_at_a_fingertip() -> None:
    points = thumb_on(0.012)
    points[BOUND.pair.tips[MIDDLE]] = points[BOUND.pair.tips[0]]
    step = HandMapper(HUMAN, ALLEGRO).map_points(points, np.eye(4))
    (rows,) = step.asked.tasks
    assert isinstance(rows, PointDistances)
    assert rows.weights[0] == pytest.approx(MODEL.extension_weights[0])


@pytest.mark.parametrize("extension", [0.5, 1.0])
def test_a_straight_finger_begins_to_pinch_later(extension: float) -> None:
    straight = extension == 1.0
    closed, half, wide = pinch_shares(MODEL, np.array([0.02, 0.0325, 0.056]), extension)
    assert closed == pytest.approx(1.0)
    assert half == pytest.approx(0.5 if straight else 0.84375)
    assert bool(wide == 0.0) is straight


def test_least_rotations_turn_one_direction_onto_another() -> None:
    rng = np.random.default_rng(5)
    for human, robot in rng.normal(size=(20, 2, 3)):
        R = least_rotation(human, robot)
        turned = R @ human / np.linalg.norm(human)
        if human @ robot / np.linalg.norm(human) / np.linalg.norm(robot) > -0.9:
            np.testing.assert_allclose(
                turned, robot / np.linalg.norm(robot), atol=1e-12
            )
            np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
            axis = np.cross(human, robot)
            np.testing.assert_allclose(R @ axis, axis, atol=1e-12)
    opposite = least_rotation(np.array([1.0, 0, 0]), np.array([-1.0, 0, 0]))
    assert np.isfinite(opposite).all()


def angle_between(first: Array, second: Array) -> float:
    """Return the angle between two vectors [rad]."""
    cosine = first @ second / np.linalg.norm(first) / np.linalg.norm(second)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)))


@pytest.mark.parametrize("size", [0.17, 0.19, 0.21])
def test_a_thumb_that_reaches_all_places_is_as_straight_as_anyones(size: float) -> None:
    human = HUMAN.with_lengths(HumanLengths.from_hand_length(size))
    reaching = BoundTeleoperation(Teleoperation(), human, load_hand("g1_right"))
    assert reaching.pair.is_placed[0]
    assert reaching.model.aim_offsets[0] == 0.0
    followed = Teleoperation(thumb_direction=0.0)
    other = BoundTeleoperation(followed, human, load_hand("g1_right")).model
    assert other.aim_offsets[0] != 0.0
    allegro = BoundTeleoperation(Teleoperation(), human, ALLEGRO)
    assert not allegro.pair.is_placed[0]
    assert allegro.model.aim_offsets[0] < -0.02
