"""Distances of shapes: those that coal gives pair by pair, and no near pair is left out."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from handmap_qp import Hand, load_hand
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik.distances import ShapeDistances

HORIZON = 0.012


@pytest.fixture(scope="module")
def hand() -> Hand:
    return load_hand("three_finger")


def test_distances_and_wrenches_are_those_of_each_pair_measured_alone(hand: Hand) -> None:
    geometry = all_pairs(hand, find_fingers(hand)).geometry
    measured = ShapeDistances(hand.model, geometry)
    alone, configuration = geometry.createData(), hand.configuration()
    for request in alone.distanceRequests:
        request.gjk_tolerance = request.epa_tolerance = 1e-9
    rng, seen, q, near = np.random.default_rng(0), set(), hand.rest, None
    for i in range(100):
        # Leaps, and a small step behind each, where bounds take the place of most distances.
        step = rng.normal(scale=0.03, size=len(hand.rest))
        q = q + step if i % 2 else rng.uniform(hand.lower_limits, hand.upper_limits)
        configuration.place_frames(hand.configuration_vector(q, np.eye(4)))
        near = measured.measure(configuration, HORIZON, near)
        pin.updateGeometryPlacements(hand.model, configuration.data, geometry, alone)
        results = [
            pin.computeDistance(geometry, alone, k) for k in range(len(geometry.collisionPairs))
        ]
        distances = np.array([result.min_distance for result in results])
        assert set(np.flatnonzero(distances <= HORIZON)) <= set(near.pairs)
        assert (near.bounds <= distances + 1e-8).all()
        np.testing.assert_allclose(near.distances, distances[near.pairs], atol=1e-8)
        for wrench, distance, k in zip(near.wrenches, near.distances, near.pairs, strict=True):
            if distance > 1e-4:
                normal, point = results[k].normal, results[k].getNearestPoint1()
                expected = np.concatenate([normal, np.cross(point, normal)])
                # GJK starts from another result; on round shapes the normal is less sure.
                np.testing.assert_allclose(wrench, expected, atol=1e-3)
                seen.add(int(k))
    assert len(seen) > 10


def test_distances_of_all_pairs_do_not_depend_on_what_was_measured_before(hand: Hand) -> None:
    geometry = all_pairs(hand, find_fingers(hand)).geometry
    used, fresh = (ShapeDistances(hand.model, geometry) for _ in range(2))
    configuration = hand.configuration()
    for q in (hand.rest, hand.lower_limits, hand.upper_limits):
        configuration.place_frames(hand.configuration_vector(q, np.eye(4)))
        used.measure(configuration, HORIZON)
    np.testing.assert_allclose(
        used.measure_all(configuration), fresh.measure_all(configuration), atol=1e-8
    )


def test_a_hand_without_pairs_has_no_distances(hand: Hand) -> None:
    geometry = all_pairs(hand, find_fingers(hand)).geometry
    geometry.removeAllCollisionPairs()
    near = ShapeDistances(hand.model, geometry).measure(hand.configuration(), HORIZON)
    assert near.distances.shape == (0,)
    assert near.wrenches.shape == (0, 6)
