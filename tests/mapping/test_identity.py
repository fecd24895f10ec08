"""A robot hand with the person's own kinematics does what the person does."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin
import pytest
from morphs import Morph, follow_morph, usual_postures

from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.hands import FINGERS, all_pairs, pair_distances
from handmap_qp.mapping import get_preset
from handmap_qp.mapping.hand_pair import hand_pair, match_palms
from handmap_qp.mapping.methods.teleoperation import Teleoperation
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


def reached(mapper: HandMapper, q: Array, settling: int = SETTLING) -> Array:
    """Move the person slowly from rest to a posture; return the robot's joints there."""
    mapper.reset()
    rest = mapper.human.rest
    shares = np.append(np.linspace(0.0, 1.0, MOVING), np.ones(settling))
    joints = rest
    for share in shares:
        joints = mapper.map_step(
            rest + share * (q - rest), np.eye(4), dt=0.02
        ).command.q
    return joints


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


def test_a_hand_like_the_persons_comes_to_rest_with_the_person() -> None:
    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("human"), preset="teleoperation")
    off = [
        reached(mapper, q, settling=2) - q
        for q in postures_without_overlap(load_hand("human"), POSTURES)
    ]
    assert np.percentile(np.degrees(np.abs(off)), 95) < 4.0


def test_only_a_hand_like_the_persons_does_without_damping() -> None:
    human = load_hand("human", points="landmarks")
    own = hand_pair(human, load_hand("human")).regularisation
    np.testing.assert_array_less(own, 0.05)
    other = hand_pair(human, load_hand("allegro_right")).regularisation
    np.testing.assert_array_equal(other, 1.0)


def person() -> Hand:
    """Return a person of medium size."""
    return load_hand("human", points="landmarks", hand_length=0.185)


@pytest.mark.parametrize(
    ("name", "likeness"), [("human", 1.0), ("hey5", 1.0), ("allegro_right", 0.0)]
)
def test_a_thumb_is_like_the_persons_where_it_reaches_places(
    name: str, likeness: float
) -> None:
    pair = hand_pair(person(), load_hand(name))
    assert pair.finger_likeness[0] == pytest.approx(likeness, abs=0.1)


def test_likeness_of_fingers_changes_smoothly_from_hand_to_hand() -> None:
    pair = hand_pair(person(), load_hand("allegro_right"))
    morph = Morph(pair)
    shares = np.linspace(0.0, 1.0, 21)
    found = [
        hand_pair(pair.human, morph.hand_at(share)).finger_likeness for share in shares
    ]
    assert np.abs(np.diff(found, axis=0)).max() < 0.2


def test_errors_grow_smoothly_as_a_hand_becomes_a_robots() -> None:
    human = person()
    postures = usual_postures(human, 3, seed=3)
    steps = list(follow_morph(human, load_hand("allegro_right"), postures, 20))
    assert np.percentile(steps[0].tips, 95) < 2.0
    moved = [after.moved_since(before).max() for before, after in pairwise(steps)]
    # Tips go nowhere at once: a twentieth of the way moves them by less than a fifth of a finger.
    assert max(moved) < 20.0


def test_a_method_and_its_preset_have_the_same_weights() -> None:
    human, robot = person(), load_hand("allegro_right")
    by_name = HandMapper(human, robot, "teleoperation")
    by_method = HandMapper(human, robot, Teleoperation())
    assert by_method.point_ik.options == by_name.point_ik.options
    assert by_name.point_ik.options == get_preset("teleoperation").ik


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
