"""Thumbs: as straight as the person's where they are open, and one way to a pinch from anywhere."""

from __future__ import annotations

import numpy as np
import pytest

from handmap_core.ik.tasks import AttachedPoints, PointDistances
from handmap_qp import HandMapper, Teleoperation, load_hand
from handmap_qp.hands.fingers import THUMB
from handmap_qp.mapping.methods.teleoperation import BoundTeleoperation
from handmap_qp.se3 import Array

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
