"""Readers of the core and of Python make one sample of the same numbers, and refuse the same."""

from __future__ import annotations

from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from handmap_core.mapping.readers import JointReader, LandmarkReader
from handmap_qp import HumanLengths
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.method import HumanPose

HUMAN = load_hand(
    "human", points="landmarks", lengths=HumanLengths.from_hand_length(0.19)
)
RNG = np.random.default_rng(5)


def in_python(reader: Any) -> Any:
    """Let a reader run without the core."""
    vars(reader)["core"] = None
    return reader


def wrists() -> list[np.ndarray]:
    """Poses near and far, some off a rotation by rounding."""
    poses = []
    for size in (1e-3, 1.0, 1e3):
        pose = pin.exp6(RNG.normal(size=6)).homogeneous
        pose[:3, 3] *= size
        poses += [pose, pose.astype(np.float32).astype(float)]
    return poses


def assert_same(one: HumanPose, other: HumanPose) -> None:
    assert (one.wrist is None) == (other.wrist is None)
    np.testing.assert_allclose(one.points, other.points, rtol=1e-13, atol=1e-13)
    if one.wrist is not None and other.wrist is not None:
        np.testing.assert_allclose(one.wrist, other.wrist, rtol=1e-13, atol=1e-13)


@pytest.mark.parametrize(
    "kind", [np.array, np.float32, np.ndarray.tolist, np.asfortranarray]
)
def test_joint_angles_make_one_sample(kind: Any) -> None:
    fast = JointReader(HUMAN, 0.25, None)
    slow = in_python(JointReader(HUMAN, 0.25, None))
    for wrist in wrists():
        q = RNG.uniform(HUMAN.lower_limits - 0.1, HUMAN.upper_limits + 0.1)
        # Rounding to float32 leaves it inside.
        inside = np.clip(q, HUMAN.lower_limits + 1e-3, HUMAN.upper_limits - 1e-3)
        for angles in (q, inside):
            one, names = fast.read(kind(angles), wrist)
            other, expected = slow.read(kind(angles), wrist)
            assert_same(one, other)
            assert names == expected
        assert names == ()


@pytest.mark.parametrize(
    "kind", [np.array, np.float32, np.ndarray.tolist, np.asfortranarray]
)
def test_landmarks_make_one_sample(kind: Any) -> None:
    fast = LandmarkReader(HUMAN)
    slow = in_python(LandmarkReader(HUMAN))
    for wrist in (None, *wrists()):
        landmarks = 0.1 * RNG.normal(size=(21, 3))
        (one, names), (other, expected) = (
            reader.read(kind(landmarks), wrist) for reader in (fast, slow)
        )
        assert_same(one, other)
        assert names == expected == ()


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
def test_both_refuse_landmarks_in_the_same_words(landmarks: Any) -> None:
    said = []
    for reader in (LandmarkReader(HUMAN), in_python(LandmarkReader(HUMAN))):
        with pytest.raises(InvalidInputError) as caught:
            reader.read(landmarks)
        said.append(str(caught.value))
    assert said[0] == said[1]


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
def test_both_refuse_a_wrist_in_the_same_words(wrist: np.ndarray) -> None:
    said = []
    for reader in (LandmarkReader(HUMAN), in_python(LandmarkReader(HUMAN))):
        with pytest.raises(InvalidInputError) as caught:
            reader.read(np.zeros((21, 3)), wrist)
        said.append(str(caught.value))
    assert said[0] == said[1]
