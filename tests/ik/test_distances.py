"""Distances of shapes: those that coal gives pair by pair, and no near pair is left out."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from marks import rotated
from oracles.shape_distances import MeasuredPairs

from handmap_qp import Hand, hand_names, load_hand
from handmap_qp.hands.pads import _corners as corners
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs

HORIZON = 0.012


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand("three_finger")


def test_distances_are_those_of_each_pair_measured_alone(hand: Hand) -> None:
    geometry = all_pairs(hand).geometry
    measured = MeasuredPairs(hand, ShapePairs(geometry, ()))
    alone, data = geometry.createData(), hand.model.createData()
    for request in alone.distanceRequests:
        request.gjk_tolerance = request.epa_tolerance = 1e-9
    rng, seen, q = np.random.default_rng(0), set(), hand.rest
    for i in range(60):
        # Leaps, and a small step behind each, where GJK starts from the last result.
        step = rng.normal(scale=0.03, size=len(hand.rest))
        q = q + step if i % 2 else rng.uniform(hand.lower_limits, hand.upper_limits)
        vector = hand.configuration_vector(q, np.eye(4))
        near = measured.within(vector, HORIZON)
        pin.updateGeometryPlacements(hand.model, data, geometry, alone, vector)
        results = [
            pin.computeDistance(geometry, alone, k)
            for k in range(len(geometry.collisionPairs))
        ]
        distances = np.array([result.min_distance for result in results])
        assert set(np.flatnonzero(distances <= HORIZON)) == set(near.pairs)
        assert measured.nearest(vector) == pytest.approx(distances.min(), abs=1e-8)
        np.testing.assert_allclose(near.found[:, 0], distances[near.pairs], atol=1e-8)
        for row, k in zip(near.found, near.pairs, strict=True):
            if row[0] > 1e-4:
                expected = np.concatenate(
                    [results[k].normal, results[k].getNearestPoint1()]
                )
                # GJK starts from another result; on round shapes the normal is less sure.
                np.testing.assert_allclose(row[1:], expected, atol=1e-3)
                seen.add(int(k))
    assert len(seen) > 10


def test_distances_of_all_pairs_do_not_depend_on_what_was_measured_before(
    hand: Hand,
) -> None:
    geometry = all_pairs(hand).geometry
    used, fresh = (MeasuredPairs(hand, ShapePairs(geometry, ())) for _ in range(2))
    for posture in (hand.rest, hand.lower_limits, hand.upper_limits):
        q = hand.configuration_vector(posture, np.eye(4))
        used.within(q, horizon=HORIZON)
    np.testing.assert_allclose(
        used.within(q).found[:, 0], fresh.within(q).found[:, 0], atol=1e-8
    )


def test_a_hand_without_pairs_has_no_distances(hand: Hand) -> None:
    geometry = all_pairs(hand).geometry
    geometry.removeAllCollisionPairs()
    near = MeasuredPairs(hand, ShapePairs(geometry, ())).within(
        hand.configuration().q, horizon=HORIZON
    )
    assert near.pairs.shape == (0,)
    assert near.found.shape == (0, 7)


@pytest.mark.parametrize(
    "name", rotated([n for n in hand_names() if not n.startswith("human")], 3)
)
def test_no_pair_of_any_hand_is_nearer_than_it_is_measured(name: str) -> None:
    # Between two planes across the normal, the shapes are apart by what their own points say.
    hand = load_hand(name)
    geometry = all_pairs(hand).geometry
    measured, placed = (
        MeasuredPairs(hand, ShapePairs(geometry, ())),
        geometry.createData(),
    )
    data, rng = hand.model.createData(), np.random.default_rng(2)
    limits, size = (hand.lower_limits, hand.upper_limits), (8, len(hand.rest))
    for q in rng.uniform(*limits, size):
        vector = hand.configuration_vector(q)
        pin.updateGeometryPlacements(hand.model, data, geometry, placed, vector)
        for k, (distance, *normal) in zip(
            *(part.tolist() for part in measured.within(vector, HORIZON)), strict=True
        ):
            pair = geometry.collisionPairs[k]
            reach = sum(
                support(
                    geometry.geometryObjects[i],
                    placed.oMg[i],
                    sign * np.array(normal[:3]),
                )
                for i, sign in ((pair.first, 1.0), (pair.second, -1.0))
            )
            if distance > 1e-4:
                assert -reach == pytest.approx(distance, abs=1e-6)


def support(shape: pin.GeometryObject, pose: pin.SE3, normal: np.ndarray) -> float:
    """Return how far a placed shape reaches along a unit vector [m]."""
    points, radius = corners(shape.geometry)
    return float(
        (points @ (pose.rotation.T @ normal)).max() + radius + normal @ pose.translation
    )
