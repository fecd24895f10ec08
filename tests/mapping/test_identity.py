"""A robot hand with the person's own kinematics does what the person does."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.hands import FINGERS, all_pairs, pair_distances
from handmap_qp.mapping.hand_pair import match_palms
from handmap_qp.se3 import Array

POSTURES = 12
# Samples in which a posture is reached, and in which the robot may catch up, of 20 ms each.
MOVING, SETTLING = 30, 60


def postures_without_overlap(hand: Hand, count: int) -> list[Array]:
    """Return random postures of a hand in which no links meet, shape (n,) each."""
    geometry = all_pairs(hand).geometry
    random = np.random.default_rng(5)
    found: list[Array] = []
    while len(found) < count:
        share = random.uniform(0.05, 0.95, len(hand.rest))
        q = hand.lower_limits + share * (hand.upper_limits - hand.lower_limits)
        if pair_distances(hand, geometry, q[None]).min() > 2e-3:
            found.append(q)
    return found


def reached(mapper: HandMapper, q: Array) -> Array:
    """Move the person slowly from rest to a posture; return the robot's joints there."""
    mapper.reset()
    rest = mapper.human.rest
    for share in np.linspace(0.0, 1.0, MOVING):
        mapper.map_step(rest + share * (q - rest), np.eye(4), dt=0.02)
    for _ in range(SETTLING):
        step = mapper.map_step(q, np.eye(4), dt=0.02)
    return step.command.q


def test_the_human_model_as_robot_has_the_joints_of_the_person() -> None:
    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("human"), preset="teleoperation")
    off = [
        reached(mapper, q) - q
        for q in postures_without_overlap(load_hand("human"), POSTURES)
    ]
    degrees = np.degrees(np.abs(off))
    assert np.median(degrees) < 1.0
    assert np.percentile(degrees, 95) < 4.0


@pytest.mark.parametrize("size", [0.8, 1.0, 1.25])
def test_palms_are_alike_at_any_size_and_in_any_axes(size: float) -> None:
    bases = human_bases()
    turn = rotation([0.1, 0.2, -0.1])
    robot = size * bases @ turn.T + [0.01, 0.02, 0.0]
    found = match_palms(bases, robot, FINGERS, np.full(5, size))
    assert found.likeness == 1.0
    np.testing.assert_allclose(found.turn, turn, atol=1e-9)
    np.testing.assert_allclose(found.bases, robot, atol=1e-9)


def test_likeness_falls_smoothly_to_nothing_as_a_thumb_moves_away() -> None:
    bases = human_bases()
    before = 1.0
    for shift in np.linspace(0.0, 0.04, 80):
        robot = bases.copy()
        robot[0, 2] += shift
        likeness = match_palms(bases, robot, FINGERS, np.ones(5)).likeness
        assert before >= likeness > before - 0.2
        before = likeness
    assert before == 0.0


@pytest.mark.parametrize(
    "ratios", [[1.0, 1.0, 1.0, 1.0, 1.5], [0.6, 1.0, 1.0, 1.0, 1.0]]
)
def test_fingers_of_other_lengths_are_not_alike(ratios: list[float]) -> None:
    bases = human_bases()
    assert match_palms(bases, bases, FINGERS, np.array(ratios)).likeness == 0.0


def test_three_fingers_say_nothing_about_the_palm() -> None:
    bases = human_bases()[:3]
    found = match_palms(bases, bases, FINGERS[:3], np.ones(3))
    assert found.likeness == 0.0
    np.testing.assert_array_equal(found.turn, np.eye(3))


def human_bases() -> Array:
    """Return the finger bases of a human hand in its palm axes [m], shape (5, 3)."""
    millimetres = [[-28, 20, 5], [-25, 90, 0], [0, 93, 3], [19, 86, 0], [35, 75, -6]]
    return 1e-3 * np.array(millimetres, dtype=float)


def rotation(vector: list[float]) -> Array:
    """Return the rotation by a vector [rad], shape (3, 3)."""
    return pin.exp3(np.array(vector))
