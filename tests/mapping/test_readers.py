"""Readers: samples are those of Pinocchio and numpy, whatever form the numbers come in."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from handmap_core.mapping.readers import JointReader, LandmarkReader
from handmap_qp import HumanLengths
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.human import PALM
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import rigid_fit, transform_points

HUMAN = load_hand(
    "human", points="landmarks", lengths=HumanLengths.from_hand_length(0.19)
)
COUPLED = load_hand("svh_right")
"""A hand with joints that follow others."""
RNG = np.random.default_rng(5)
FORMS = [np.array, np.float32, np.ndarray.tolist, np.asfortranarray]


def wrists() -> list[np.ndarray]:
    """Poses near and far, some off a rotation by rounding."""
    poses = []
    for size in (1e-3, 1.0, 1e3):
        pose = pin.exp6(RNG.normal(size=6)).homogeneous
        pose[:3, 3] *= size
        poses += [pose, pose.astype(np.float32).astype(float)]
    return poses


def assert_is(pose: HumanPose, points: np.ndarray, wrist: np.ndarray) -> None:
    # A wrist that is off by rounding is replaced by the nearest rotation.
    assert pose.wrist is not None
    np.testing.assert_allclose(pose.wrist, wrist, rtol=1e-6, atol=1e-6)
    turn = pose.wrist[:3, :3]
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(pose.points, points, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("hand", [HUMAN, COUPLED], ids=["human", "coupled"])
@pytest.mark.parametrize("form", FORMS)
def test_joint_angles_place_the_hand_on_its_wrist(hand: Hand, form: Any) -> None:
    reader = JointReader(hand, 0.25, None)
    lower, upper = hand.limits
    placed = hand.configuration()
    for wrist in wrists():
        beyond = RNG.uniform(lower - 0.1, upper + 0.1)
        # Rounding to float32 leaves it inside.
        inside = np.clip(beyond, lower + 1e-3, upper - 1e-3)
        for angles in (beyond, inside):
            given = np.asarray(form(angles), dtype=float)
            pose, names = reader.read(form(angles), wrist)
            placed.place(hand.configuration_vector(given))
            assert pose.wrist is not None
            points = transform_points(pose.wrist, placed.points)
            assert_is(pose, points, wrist)
            is_out = (given < lower) | (given > upper)
            assert names == tuple(np.array(hand.joint_names)[is_out])


@pytest.mark.parametrize("form", FORMS)
def test_landmarks_are_points_and_their_palm_is_the_wrist(form: Any) -> None:
    reader = LandmarkReader(HUMAN)
    for wrist in (None, *wrists()):
        landmarks = 0.1 * RNG.normal(size=(21, 3))
        given = np.asarray(form(landmarks), dtype=float)
        pose, names = reader.read(form(landmarks), wrist)
        if wrist is None:
            wrist = rigid_fit(reader.model.palm, given[PALM], reader.model.weights)
        assert_is(pose, given[reader.model.used], wrist)
        assert names == ()


def test_a_wrist_of_seven_numbers_is_read_as_its_matrix() -> None:
    reader = LandmarkReader(HUMAN, "xyzw")
    landmarks = 0.1 * RNG.normal(size=(21, 3))
    pose, _ = reader.read(landmarks, [1.0, 2.0, 3.0, 0.0, 0.0, 1.0, 0.0])
    turn = pin.SE3(np.diag([-1.0, -1.0, 1.0]), np.array([1.0, 2.0, 3.0]))
    assert_is(pose, landmarks[reader.model.used], turn.homogeneous)


@pytest.mark.parametrize(
    "landmarks",
    [
        np.full((21, 3), np.nan),
        np.full((21, 3), 1e10),
        np.zeros((20, 3)),
        np.zeros(63),
        "hand",
        None,
        np.zeros((21, 3), dtype=complex) + 1j,
    ],
    ids=["nan", "far", "few", "flat", "text", "none", "complex"],
)
def test_wrong_landmarks_are_refused(landmarks: Any) -> None:
    with pytest.raises(InvalidInputError) as caught:
        LandmarkReader(HUMAN).read(landmarks)
    assert caught.value.argument == "landmarks"


@pytest.mark.parametrize(
    "wrist",
    [
        2.0 * np.eye(4),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        np.eye(3),
        np.full((4, 4), np.nan),
    ],
    ids=["scaled", "mirrored", "small", "nan"],
)
def test_a_wrong_wrist_is_refused(wrist: np.ndarray) -> None:
    with pytest.raises(InvalidInputError) as caught:
        LandmarkReader(HUMAN).read(np.zeros((21, 3)), wrist)
    assert caught.value.argument == "wrist_pose"
