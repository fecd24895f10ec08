"""Self-collision with acceleration limits: a stop without overlap is possible at all times."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from marks import slow

from handmap_qp import Hand, IkOptions, MissingExtraError, load_hand
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.ik.qp import PointIk

TOLERANCE = 1e-4
"""Largest overlap that counts as none [m]."""
ACCELERATIONS = (None, 5.0, 20.0, 100.0, 1000.0)


class Case:
    """A hand with a fixed wrist, and all pairs of its shapes that may collide."""

    def __init__(self, name: str) -> None:
        try:
            self.hand: Hand = load_hand(name, mount="fixed")
        except MissingExtraError:
            pytest.skip("example-robot-data is not installed")
        self.pairs: ShapePairs = all_pairs(self.hand, find_fingers(self.hand))
        self._limit = CollisionLimit(self.hand, pairs=self.pairs)
        self._configuration = self.hand.configuration()

    def nearest(self, q: np.ndarray) -> float:
        """Return the smallest signed distance at a configuration [m]."""
        self._configuration.place_frames(q)
        return float(self._limit.distances(self._configuration).min())

    def nearest_between(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the smallest signed distance on the straight way between two configurations."""
        count = max(2, int(np.abs(after - before).max() / 0.03))
        return min(self.nearest(before + p * (after - before)) for p in np.arange(1, count) / count)

    def limit(self) -> CollisionLimit:
        """Return rows of the pairs within 12 mm."""
        return CollisionLimit(self.hand, pairs=self.pairs, horizon=0.012)

    def random_q(self, rng: np.random.Generator) -> np.ndarray:
        """Return a random posture inside the limits, shape (n,)."""
        return rng.uniform(self.hand.lower_limits, self.hand.upper_limits)


@pytest.fixture(scope="module", params=["three_finger", "allegro_right"])
def case(request: pytest.FixtureRequest) -> Case:
    return Case(request.param)


def test_a_way_is_clear_only_if_all_of_it_is(case: Case) -> None:
    # Ways of any length from postures without overlap; many end without one and have one between.
    rng, limit, hand = np.random.default_rng(0), case.limit(), case.hand
    found = {True: 0, False: 0}
    configuration = hand.configuration()
    while min(found.values()) < 40:
        start = hand.configuration_vector(case.random_q(rng))
        if case.nearest(start) < 1e-3:
            continue
        step = 10.0 ** rng.uniform(-2, 0.3) * rng.normal(size=len(hand.active_columns))
        configuration.place_with_jacobians(start)
        before = limit.measure(configuration)
        end = start + (step if hand.expansion is None else hand.expansion.matrix @ step)
        configuration.place_frames(end)
        reached = (configuration, None, np.inf, before, step)
        after = limit.measure_end(*reached) if rng.integers(2) else None
        is_clear = limit.path.is_clear(start, before, step, after)
        nearest = min(case.nearest_between(start, end), case.nearest(end))
        found[is_clear] += 1
        if is_clear:
            assert nearest > 0.0
        if nearest > 0.05:
            assert is_clear


def test_no_target_time_or_option_leads_to_an_overlap(case: Case) -> None:
    hand, rng = case.hand, np.random.default_rng(1)
    options = IkOptions()
    ik, elsewhere = PointIk(hand, options, contacts=case.limit()), hand.configuration()
    ik.place(hand.configuration_vector(hand.rest))
    targets, nearest, fastest = ik.configuration.points.copy(), np.inf, 0.0
    last, rested = np.zeros(len(hand.active_columns)), True
    for i in range(500):
        if i % 25 == 0:
            most = ACCELERATIONS[rng.integers(len(ACCELERATIONS))]
            options = replace(
                options, max_acceleration=most, max_iterations=int(rng.integers(1, 5))
            )
            ik, rested = ik.with_options(options), bool(rng.integers(2))
            if rested:
                # From another limit, the hand may come faster than it can brake.
                ik.place(ik.configuration.q.copy())
                last = np.zeros_like(last)
        if i % 7 == 0:
            elsewhere.place_frames(hand.configuration_vector(case.random_q(rng)))
            targets = elsewhere.points.copy()
            if i % 2:
                targets[:] = targets.mean(axis=0)
        dt = 10.0 ** rng.uniform(-4, 0) if i % 5 == 0 else rng.uniform(0.005, 0.03)
        before = ik.configuration.q.copy()
        result = ik.solve(targets, None, dt)
        after = ik.configuration.q.copy()
        nearest = min(nearest, case.nearest(after), case.nearest_between(before, after))
        velocity = result.displacement / dt
        if options.max_acceleration is not None and rested:
            change = np.abs(velocity - last).max() / dt
            fastest = max(fastest, change / options.max_acceleration)
        last = velocity
        outside = np.maximum(hand.lower_limits - after[hand.q_indices], 0.0)
        assert (outside <= 1e-9).all()
    assert nearest > -TOLERANCE
    assert 0.5 < fastest <= 1.0 + 1e-6


def test_the_hand_can_stop_on_its_line_for_any_sample_times(case: Case) -> None:
    # The stop that the solver counts on, taken in random parts, is clear and within all limits.
    hand, rng, most = case.hand, np.random.default_rng(2), 15.0
    ik = PointIk(hand, IkOptions(max_acceleration=most), contacts=case.limit())
    elsewhere, stops = hand.configuration(), 0
    for _ in range(12):
        ik.place(hand.configuration_vector(hand.rest))
        elsewhere.place_frames(hand.configuration_vector(case.random_q(rng)))
        for _ in range(int(rng.integers(3, 20))):
            ik.solve(elsewhere.points, None, 1.0 / 90.0)
        motion = ik.gate.motion
        q, velocity, left = motion.q, motion.velocity, float(motion.stop_times.max())
        stops += left > 0.02
        while left > 0.0:
            dt = rng.uniform(0.001, 0.02)
            share = max(0.0, 1.0 - dt / left)
            assert (np.abs(velocity) * (1.0 - share) <= most * dt * (1.0 + 1e-9)).all()
            velocity, left = share * velocity, left - dt
            q = q + dt * (velocity if hand.expansion is None else hand.expansion.matrix @ velocity)
            assert case.nearest(q) > 0.0
            angles = q[hand.q_indices]
            assert (angles <= hand.upper_limits + 1e-9).all()
            assert (angles >= hand.lower_limits - 1e-9).all()
    assert stops > 5


def test_an_acceleration_limit_while_moving_does_not_lead_to_an_overlap(case: Case) -> None:
    # The stop under the limit before counts until one under the new limit is found.
    hand, rng = case.hand, np.random.default_rng(3)
    free, elsewhere = IkOptions(), hand.configuration()
    nearest = np.inf
    for _ in range(15):
        ik = PointIk(hand, free, contacts=case.limit())
        ik.place(hand.configuration_vector(hand.rest))
        elsewhere.place_frames(hand.configuration_vector(case.random_q(rng)))
        targets = np.tile(elsewhere.points.mean(axis=0), (len(elsewhere.points), 1))
        for i in range(12):
            if i == 3:
                ik = ik.with_options(replace(free, max_acceleration=5.0))
            before = ik.configuration.q.copy()
            ik.solve(targets, None, 1.0 / 60.0)
            after = ik.configuration.q
            nearest = min(nearest, case.nearest(after), case.nearest_between(before, after))
    assert nearest > -TOLERANCE


def test_links_that_overlap_at_the_start_can_part() -> None:
    case = Case("three_finger")
    hand, rng = case.hand, np.random.default_rng(4)
    for most in (None, 50.0):
        ik = PointIk(hand, IkOptions(max_acceleration=most), contacts=case.limit())
        while True:
            q = hand.configuration_vector(case.random_q(rng))
            if case.nearest(q) < -0.003:
                break
        ik.place(q)
        for _ in range(300):
            ik.solve(hand.points(hand.rest), None, 1.0 / 60.0)
        assert case.nearest(ik.configuration.q) > 0.0


@slow
def test_a_floating_hand_is_guarded_alike(case: Case) -> None:
    floating, rng = load_hand(case.hand.name, mount="floating"), np.random.default_rng(5)
    pairs = all_pairs(floating, find_fingers(floating))
    ik = PointIk(floating, IkOptions(max_acceleration=30.0), contacts=pairs)
    ik.place(floating.configuration_vector(floating.rest))
    nearest, targets = np.inf, ik.configuration.points.copy()
    for i in range(200):
        if i % 10 == 0:
            targets = ik.configuration.points.mean(axis=0) + 0.05 * rng.normal(size=(1, 3))
            targets = np.tile(targets, (len(ik.configuration.points), 1))
        ik.solve(targets, None, 1.0 / 60.0)
        after = case.hand.configuration_vector(ik.configuration.q[floating.q_indices])
        nearest = min(nearest, case.nearest(after))
    assert nearest > -TOLERANCE
