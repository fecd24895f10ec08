"""`nearest_posture`: a minimum within the limits, with exact derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from marks import slow
from oracles.nearest_posture import distance

from handmap_qp import load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.nearest_posture import nearest_posture

REST_COST = 0.05


def case(name: str, seed: int) -> tuple[Hand, np.ndarray, np.ndarray]:
    """A hand, targets near a random posture but out of reach, and costs."""
    hand, rng = load_hand(name), np.random.default_rng(seed)
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    arm = len(hand.joint_names) - len(hand.spec.joints)
    q[:arm] = hand.rest[:arm]
    targets = hand.points(q) + rng.normal(0.0, 0.02, (len(hand.reference_points), 3))
    return hand, targets, 100.0 * np.sqrt(rng.uniform(0.5, 1.0, len(targets)))


# Coupled joints, an arm, and a hand of three fingers.
@pytest.mark.parametrize(
    "name", ["allegro_right", "hey5", *map(slow, ["ur5_allegro", "g1_left"])]
)
@pytest.mark.parametrize("seed", range(3))
def test_nothing_nearby_is_better(name: str, seed: int) -> None:
    hand, targets, costs = case(name, seed)
    q = nearest_posture(hand, targets, costs, REST_COST, hand.rest)
    assert ((q >= hand.lower_limits) & (q <= hand.upper_limits)).all()
    terms_at = distance(hand, targets, costs, REST_COST)
    free = ~hand.moves_wrist
    assert free.sum() == len(hand.spec.joints)
    np.testing.assert_array_equal(q[~free], hand.rest[~free])
    found = terms_at(q)
    # The slope vanishes, or leads out of the limits.
    at_lower = q <= hand.lower_limits + 1e-12
    at_upper = q >= hand.upper_limits - 1e-12
    slope = np.where(at_lower, np.minimum(found.gradient, 0.0), found.gradient)
    slope = np.where(at_upper, np.maximum(slope, 0.0), slope)
    assert np.abs(slope).max() < 1e-6 * np.abs(found.hessian).max()
    inside = ~(at_lower | at_upper)
    assert np.linalg.eigvalsh(found.hessian[np.ix_(inside, inside)])[0] > 0.0
    assert found.value <= terms_at(hand.rest).value


@pytest.mark.parametrize("name", ["allegro_right", "hey5", "ur5_allegro"])
def test_derivatives_are_those_of_the_value(name: str) -> None:
    hand, targets, costs = case(name, 0)
    terms_at = distance(hand, targets, costs, REST_COST)
    found, step, free = terms_at(hand.rest), 1e-6, ~hand.moves_wrist
    # Joints that move the wrist stay: nothing but the pull to rest is known of them.
    assert not found.gradient[~free].any()
    assert not found.hessian[np.ix_(free, ~free)].any()
    moves = step * np.eye(len(free))[free]
    ahead, behind = (
        [terms_at(hand.rest + s * move) for move in moves] for s in (1, -1)
    )
    slopes = [
        0.5 * (a.value - b.value) / step for a, b in zip(ahead, behind, strict=True)
    ]
    np.testing.assert_allclose(
        slopes, found.gradient[free], atol=1e-6 * np.abs(found.gradient).max()
    )
    turns = [
        0.5 * (a.gradient - b.gradient) / step
        for a, b in zip(ahead, behind, strict=True)
    ]
    np.testing.assert_allclose(
        turns, found.hessian[free], atol=1e-7 * np.abs(found.hessian).max()
    )


def test_a_posture_is_found_again() -> None:
    hand = load_hand("allegro_right")
    q = 0.6 * hand.rest + 0.4 * (hand.upper_limits + hand.lower_limits) / 2.0
    costs = np.full(len(hand.reference_points), 100.0)
    found = nearest_posture(hand, hand.points(q), costs, 0.0, hand.rest)
    np.testing.assert_allclose(hand.points(found), hand.points(q), atol=1e-6)
