"""The gate: limits are exact, and a stop inside them, clear of overlaps, is always possible."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import coal
import numpy as np
import pinocchio as pin
import pytest
from ik_cases import two_joint_hand
from marks import slow
from oracles.shape_distances import MeasuredPairs

from handmap_qp import (
    Hand,
    IkOptions,
    MissingExtraError,
    PointSpec,
    load_hand,
)
from handmap_qp.hands import LONGEST_STOP
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs
from handmap_qp.hands.spec import CollisionSpec
from handmap_qp.ik import Gate, Motion
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
        self.pairs: ShapePairs = all_pairs(self.hand)
        self._limit = MeasuredPairs(self.hand, pairs=self.pairs)
        self._configuration = self.hand.configuration()

    def nearest(self, q: np.ndarray) -> float:
        """Return the smallest signed distance at a configuration [m]."""
        self._configuration.place(q)
        return self._limit.nearest(self._configuration.q)

    def nearest_between(self, before: np.ndarray, after: np.ndarray) -> float:
        """Return the smallest signed distance on the straight way between two configurations."""
        count = max(2, int(np.abs(after - before).max() / 0.03))
        return min(
            self.nearest(before + p * (after - before))
            for p in np.arange(1, count) / count
        )

    def limit(self) -> MeasuredPairs:
        """Return rows of the pairs within 12 mm."""
        return MeasuredPairs(self.hand, pairs=self.pairs, horizon=0.012)

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
        configuration.place(start)
        end = start + hand.spread @ step
        configuration.place(end)
        is_clear = limit.met_on(start, step) is None
        nearest = min(case.nearest_between(start, end), case.nearest(end))
        found[is_clear] += 1
        if is_clear:
            assert nearest > 0.0
        if nearest > 0.05:
            assert is_clear


def test_one_displacement_over_the_whole_range_never_passes_a_link(case: Case) -> None:
    # Without a limit of acceleration, and in a long time, a command may lead anywhere.
    rng, hand = np.random.default_rng(17102), case.hand
    ik = PointIk(hand, IkOptions(max_acceleration=None), contacts=case.pairs)
    moves, reached, nearest = 0, 0, np.inf
    while moves < 200:
        start, goal = (hand.configuration_vector(case.random_q(rng)) for _ in range(2))
        if case.nearest(start) < 1e-3:
            continue
        goal = start + rng.choice([0.1, 0.3, 1.0]) * (goal - start)
        ik.place(start)
        reached += ik.gate.advance(goal, 100.0)
        end = ik.gate.motion.q
        nearest = min(nearest, case.nearest(end), case.nearest_between(start, end))
        moves += 1
    assert reached > 20
    assert nearest > 0.0


def test_the_rows_of_what_met_cut_off_the_way_on_which_it_met(case: Case) -> None:
    rng, limit, hand = np.random.default_rng(5), case.limit(), case.hand
    configuration, cut = hand.configuration(), []
    while len(cut) < 40:
        start = hand.configuration_vector(case.random_q(rng))
        step = 0.03 * rng.normal(size=len(hand.active_columns))
        # Most postures overlap.
        if case.nearest(start) < 2.5e-4:
            continue
        met = limit.met_on(start, step)
        if met is None or not len(met.pairs):
            continue
        configuration.place(start)
        G, h = limit.rows(configuration, met, 5e-4)
        np.testing.assert_allclose(np.linalg.norm(met.found[:, 1:4], axis=1), 1.0)
        cut += (G @ step > h).tolist()
    assert np.mean(cut) > 0.95


def test_no_target_time_or_option_leads_to_an_overlap(case: Case) -> None:
    hand, rng = case.hand, np.random.default_rng(1)
    options = IkOptions()
    ik, elsewhere = PointIk(hand, options, contacts=case.pairs), hand.configuration()
    ik.place(hand.configuration_vector(hand.rest))
    targets, nearest, fastest = ik.configuration.points.copy(), np.inf, 0.0
    last, rested = np.zeros(len(hand.active_columns)), True
    for i in range(500):
        if i % 25 == 0:
            most = ACCELERATIONS[rng.integers(len(ACCELERATIONS))]
            options = options.replaced(
                max_acceleration=most, max_iterations=int(rng.integers(1, 5))
            )
            ik = PointIk(hand, options, ik.gate.motion, contacts=case.pairs)
            rested = bool(rng.integers(2))
            if rested:
                ik.place(ik.configuration.q.copy())
                last = np.zeros_like(last)
        if i % 7 == 0:
            elsewhere.place(hand.configuration_vector(case.random_q(rng)))
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
        angles = after[hand.q_indices]
        assert (angles >= hand.lower_limits).all()
        assert (angles <= hand.upper_limits).all()
    assert nearest > -TOLERANCE
    assert 0.5 < fastest <= 1.0 + 1e-6


def test_the_hand_can_stop_on_its_line_for_any_sample_times(case: Case) -> None:
    # The stop that the solver counts on, taken in random parts, is clear and within all limits.
    hand, rng, most = case.hand, np.random.default_rng(2), 15.0
    ik = PointIk(hand, IkOptions(max_acceleration=most), contacts=case.pairs)
    elsewhere, stops = hand.configuration(), 0
    for _ in range(12):
        ik.place(hand.configuration_vector(hand.rest))
        elsewhere.place(hand.configuration_vector(case.random_q(rng)))
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
            q = q + dt * (hand.spread @ velocity)
            assert case.nearest(q) > 0.0
            angles = q[hand.q_indices]
            assert (angles <= hand.upper_limits + 1e-9).all()
            assert (angles >= hand.lower_limits - 1e-9).all()
    assert stops > 5


def test_an_acceleration_limit_while_moving_does_not_lead_to_an_overlap(
    case: Case,
) -> None:
    # The stop under the limit before counts until one under the new limit is found.
    hand, rng = case.hand, np.random.default_rng(3)
    free, elsewhere = IkOptions(), hand.configuration()
    nearest = np.inf
    for _ in range(15):
        ik = PointIk(hand, free, contacts=case.pairs)
        ik.place(hand.configuration_vector(hand.rest))
        elsewhere.place(hand.configuration_vector(case.random_q(rng)))
        targets = np.tile(elsewhere.points.mean(axis=0), (len(elsewhere.points), 1))
        for i in range(12):
            if i == 3:
                slow = free.replaced(max_acceleration=5.0)
                ik = PointIk(hand, slow, ik.gate.motion, contacts=case.pairs)
            before = ik.configuration.q.copy()
            ik.solve(targets, None, 1.0 / 60.0)
            after = ik.configuration.q
            nearest = min(
                nearest, case.nearest(after), case.nearest_between(before, after)
            )
    assert nearest > -TOLERANCE


def test_links_that_overlap_at_the_start_can_part() -> None:
    case = Case("three_finger")
    hand, rng = case.hand, np.random.default_rng(4)
    for most in (None, 50.0):
        ik = PointIk(hand, IkOptions(max_acceleration=most), contacts=case.pairs)
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
    floating, rng = (
        load_hand(case.hand.name, mount="floating"),
        np.random.default_rng(5),
    )
    pairs = all_pairs(floating)
    ik = PointIk(floating, IkOptions(max_acceleration=30.0), contacts=pairs)
    ik.place(floating.configuration_vector(floating.rest))
    nearest, targets = np.inf, ik.configuration.points.copy()
    for i in range(200):
        if i % 10 == 0:
            targets = ik.configuration.points.mean(axis=0) + 0.05 * rng.normal(
                size=(1, 3)
            )
            targets = np.tile(targets, (len(ik.configuration.points), 1))
        ik.solve(targets, None, 1.0 / 60.0)
        after = case.hand.configuration_vector(ik.configuration.q[floating.q_indices])
        nearest = min(nearest, case.nearest(after))
    assert nearest > -TOLERANCE


def test_a_joint_outside_its_limit_by_a_rounding_does_not_move_into_a_link(
    case: Case, monkeypatch: pytest.MonkeyPatch
) -> None:
    hand, rng, dt = case.hand, np.random.default_rng(7), 0.2
    options = IkOptions(max_iterations=1, formulation="direct")
    ik, found = PointIk(hand, options, contacts=case.pairs), 0
    assert ik.reference
    while found < 5:
        q, joint = case.random_q(rng), rng.integers(len(hand.joint_names))
        q[joint] = np.nextafter(hand.upper_limits[joint], np.inf)
        step = np.zeros(len(q))
        step[hand.joint_columns[joint]] = (
            -rng.uniform(0.3, 1.0) * hand.velocity_limits[joint] * dt
        )
        start = hand.configuration_vector(q)
        if case.nearest(start) < 1e-3 or case.nearest(start + step) > -2e-3:
            continue
        found += 1
        ik.place(start)
        monkeypatch.setattr(ik.reference, "solver", lambda *_, step=step: step)
        ik.solve(ik.configuration.points.copy(), None, dt)
        end = ik.configuration.q
        assert min(case.nearest(end), case.nearest_between(start, end)) > -TOLERANCE


def speed_up(ik: PointIk, targets: np.ndarray, dt: float) -> None:
    """Move towards targets until a joint is faster than 1 rad/s."""
    for _ in range(60):
        ik.solve(targets, None, dt)
        if np.abs(ik.gate.motion.velocity).max() > 1.0:
            return
    pytest.fail("the hand never moved fast")


@pytest.mark.parametrize("avoids", [True, False])
def test_a_limit_lowered_while_moving_breaks_no_limit_and_the_stop_is_bounded(
    case: Case, avoids: bool
) -> None:
    hand, rng, dt = case.hand, np.random.default_rng(8), 1.0 / 60.0
    elsewhere = hand.configuration()
    pairs = case.pairs if avoids else None
    for high, low in ((20.0, 0.5), (100.0, 1.0), (None, 2.0)):
        ik = PointIk(hand, IkOptions(max_acceleration=high), contacts=pairs)
        ik.place(hand.configuration_vector(hand.rest))
        elsewhere.place(hand.configuration_vector(hand.upper_limits))
        speed_up(ik, elsewhere.points, dt)
        for k in range(60):
            if k == 1:
                options = IkOptions(max_acceleration=low)
                ik = PointIk(hand, options, ik.gate.motion, contacts=pairs)
            velocity = ik.gate.motion.velocity
            if rng.random() < 0.3:
                ik.solve(elsewhere.points, None, dt)
            else:
                ik.hold(dt)
            if high is not None:
                change = np.abs(ik.gate.motion.velocity - velocity).max()
                assert change <= high * dt * (1.0 + 1e-9)
            angles = ik.configuration.q[hand.q_indices]
            assert (angles >= hand.lower_limits).all()
            assert (angles <= hand.upper_limits).all()
            assert (ik.gate.motion.stop_times <= 0.5 * (1.0 + 1e-9)).all()
        for _ in range(31):
            ik.hold(dt)
        assert not ik.gate.motion.displacement.any()


def test_a_wrist_with_all_the_room_stops_in_time_too() -> None:
    """After its limit is lowered, no stop that is admitted takes longer than all others."""
    hand, dt = load_hand("three_finger", mount="floating"), 1.0 / 60.0
    ik = PointIk(hand, IkOptions())
    ik.place(hand.configuration_vector(hand.rest))
    far = ik.configuration.wrist.homogeneous
    far[:3, 3] += 10.0
    for k in range(40):
        if k == 20:
            assert np.linalg.norm(ik.gate.motion.velocity[:3]) > 0.5
            ik = PointIk(hand, IkOptions(max_acceleration=0.5), ik.gate.motion)
        ik.solve(ik.configuration.points.copy(), far, dt)
        assert (ik.gate.motion.stop_times <= LONGEST_STOP * (1.0 + 1e-9)).all()


def test_a_stop_takes_no_longer_and_leads_no_farther_than_stated(case: Case) -> None:
    hand, dt = case.hand, 1.0 / 60.0
    elsewhere = hand.configuration()
    elsewhere.place(hand.configuration_vector(hand.upper_limits))
    for most in (0.5, 5.0, 50.0):
        ik = PointIk(hand, IkOptions(max_acceleration=most))
        ik.place(hand.configuration_vector(hand.lower_limits))
        for _ in range(60):
            ik.solve(elsewhere.points, None, dt)
        start, count = ik.configuration.q.copy(), 0
        assert ik.gate.motion.is_braking
        while ik.hold(dt).displacement.any():
            count += 1
        assert count * dt <= LONGEST_STOP
        moved = np.abs(ik.configuration.q - start)[hand.q_indices]
        assert (moved <= hand.stop_distances).all()


def test_a_hand_that_was_held_sets_out_from_rest(case: Case) -> None:
    hand, dt, most = case.hand, 1.0 / 60.0, 10.0
    ik, elsewhere = (
        PointIk(hand, IkOptions(max_acceleration=most)),
        hand.configuration(),
    )
    ik.place(hand.configuration_vector(hand.rest))
    elsewhere.place(hand.configuration_vector(hand.upper_limits))
    speed_up(ik, elsewhere.points, dt)
    velocity = ik.gate.motion.velocity
    for _ in range(40):
        before = ik.configuration.q.copy()
        ik.hold(dt)
        after = (ik.configuration.q - before) / dt
        assert (np.abs(after - velocity) <= most * dt * (1.0 + 1e-9) + 1e-9).all()
        velocity = after
    assert not velocity.any()
    before = ik.configuration.q.copy()
    ik.solve(elsewhere.points, None, dt)
    # From rest, x = a dt^2 in one sample.
    assert (
        0.0 < np.abs(ik.configuration.q - before).max() <= most * dt**2 * (1.0 + 1e-9)
    )


@pytest.mark.parametrize("shortest", [1e-300, 1e-12, 1e-7])
def test_after_a_sample_of_no_time_the_acceleration_limit_still_holds(
    case: Case, shortest: float
) -> None:
    hand, dt, most = case.hand, 1.0 / 60.0, 10.0
    ik, elsewhere = (
        PointIk(hand, IkOptions(max_acceleration=most)),
        hand.configuration(),
    )
    ik.place(hand.configuration_vector(hand.lower_limits))
    elsewhere.place(hand.configuration_vector(hand.upper_limits))
    for _ in range(5):
        ik.solve(elsewhere.points, None, dt)
    before = ik.configuration.q.copy()
    ik.solve(elsewhere.points, None, dt)
    velocity, before = (ik.configuration.q - before) / dt, ik.configuration.q.copy()
    ik.solve(elsewhere.points, None, shortest)
    assert np.abs(ik.configuration.q - before).max() <= 1e-5
    before = ik.configuration.q.copy()
    ik.solve(elsewhere.points, None, dt)
    after = (ik.configuration.q - before) / dt
    # An ulp of an angle in 1 us is a speed of some 1e-10 rad/s.
    assert (np.abs(after - velocity) <= most * (dt + 1e-6) * (1.0 + 1e-6)).all()


def test_a_displacement_that_is_not_a_number_is_not_taken(case: Case) -> None:
    hand = case.hand
    gate = PointIk(hand, IkOptions(max_acceleration=5.0)).gate
    gate.place(hand.configuration_vector(hand.rest))
    bad = np.full(len(hand.joint_names), np.nan)
    taken = gate.admit(bad, bad, 0.01)
    assert (np.abs(taken) <= 5.0 * 0.01**2 * (1.0 + 1e-9)).all()
    assert np.isfinite(gate.motion.q).all()


def distances_of(model: pin.Model, *shapes: tuple[int, pin.SE3, Any]) -> MeasuredPairs:
    """Pair two shapes, each with its joint and its placement there."""
    geometry = pin.GeometryModel()
    for i, (parent, placement, shape) in enumerate(shapes):
        shape.computeLocalAABB()
        geometry.addGeometryObject(
            pin.GeometryObject(f"shape {i}", parent, placement, shape)
        )
    geometry.addCollisionPair(pin.CollisionPair(0, 1))
    spec = SimpleNamespace(collision=None)
    hand: Any = SimpleNamespace(model=model, spread=np.eye(model.nv), spec=spec)
    return MeasuredPairs(hand, ShapePairs(geometry, ()))


def test_the_bound_of_a_way_counts_the_whole_bend() -> None:
    # A pendulum passes a floor: apart at both ends, 2.5 mm inside it between. Its normal never
    # turns, so the bound is as large as the bend itself.
    length, radius, angle, gap = 0.1, 0.01, 0.3, 2e-3
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelRY(), pin.SE3.Identity(), "pivot")
    inertia = pin.Inertia.FromSphere(1.0, radius)
    model.appendBodyToJoint(joint, inertia, pin.SE3.Identity())
    height = -length * np.cos(angle) - radius - gap
    down = pin.SE3(np.eye(3), np.array([0.0, 0.0, -length]))
    floor = pin.SE3(np.eye(3), np.array([0.0, 0.0, height - 0.05]))
    ball, wall = coal.Sphere(radius), coal.Box(1.0, 1.0, 0.1)
    distances = distances_of(model, (joint, down, ball), (0, floor, wall))
    start = np.array([-angle])
    assert distances.within(start).found[0, 0] == pytest.approx(gap, abs=1e-6)
    assert distances.met_on(start, np.array([2.0 * angle])) is not None
    # A part that ends before the floor rises into the path is clear.
    assert distances.met_on(start, np.array([0.02])) is None


def test_the_bound_of_a_way_counts_what_turning_does_to_what_slides() -> None:
    # A ball slides out on an arm that turns, through its pivot. At both ends it is 8 mm above a
    # floor, and 2 mm inside it between, by the Coriolis acceleration alone.
    turn, out, radius, gap = 0.2, 0.05, 0.01, 8e-3
    model = pin.Model()
    pivot = model.addJoint(0, pin.JointModelRZ(), pin.SE3.Identity(), "pivot")
    slide = model.addJoint(pivot, pin.JointModelPX(), pin.SE3.Identity(), "slide")
    model.lowerPositionLimit[1] = -out
    model.upperPositionLimit[1] = out
    top = out * np.sin(turn) - radius - gap
    floor = pin.SE3(np.eye(3), np.array([0.0, top - 0.05, 0.0]))
    ball, wall = coal.Sphere(radius), coal.Box(1.0, 0.1, 1.0)
    here = pin.SE3.Identity()
    distances = distances_of(model, (slide, here, ball), (0, floor, wall))
    start = np.array([-turn, -out])
    assert distances.within(start).found[0, 0] == pytest.approx(gap, abs=1e-6)
    assert distances.within(np.zeros(2)).found[0, 0] < -1e-3
    assert distances.met_on(start, np.array([2.0 * turn, 2.0 * out])) is not None


@pytest.mark.parametrize("half_turn", [0.1, 0.3, 0.7])
@pytest.mark.parametrize("share", [0.5, 0.9, 1.3])
def test_a_fingertip_that_swings_past_a_wall_touches_it_between_the_ends(
    half_turn: float, share: float
) -> None:
    """On its arc a tip comes nearer by `lever (1 - cos(half_turn))` than at both ends."""
    lever, radius = 0.1, 0.005
    arc = lever * (1.0 - np.cos(half_turn))
    clearance = share * arc + 1e-3 * (share > 1.0)
    wall = lever * np.cos(half_turn) + radius + clearance
    urdf = (
        '<robot name="swing"><link name="palm"><collision>'
        f'<origin xyz="{wall + 0.05} 0 0"/><geometry><box size="0.1 1 1"/></geometry></collision>'
        '</link><link name="finger"><collision>'
        f'<origin xyz="{lever} 0 0"/><geometry><sphere radius="{radius}"/></geometry></collision>'
        '</link><joint name="swing" type="revolute"><parent link="palm"/><child link="finger"/>'
        '<axis xyz="0 0 1"/><limit lower="-2" upper="2" velocity="8" effort="1"/></joint>'
        '<link name="other"/><joint name="other" type="revolute"><parent link="palm"/>'
        '<child link="other"/><limit lower="-2" upper="2" velocity="8" effort="1"/></joint></robot>'
    )
    hand = two_joint_hand(
        urdf,
        ("swing", "other"),
        PointSpec("tip", "finger", (lever, 0.0, 0.0)),
        (0.0, 1.0, 0.0),
        CollisionSpec(pairs=(("palm", "finger"),)),
    )
    limit, configuration = MeasuredPairs(hand), hand.configuration()
    distances = []
    for angle in (0.0, half_turn, -half_turn):
        configuration.place(hand.configuration_vector(np.array([angle, 0.0])))
        distances.append(limit.within(configuration.q).found[:, 0][0])
    np.testing.assert_allclose(
        distances, clearance + np.array([-arc, 0.0, 0.0]), atol=1e-7
    )
    turn = 2.0 * half_turn * (hand.configuration_vector(np.array([1.0, 0.0])) == 1.0)
    assert (limit.met_on(configuration.q, turn) is None) == (share > 1.0)


@pytest.mark.parametrize("acceleration", [0.1, 5.0, 200.0])
def test_a_joint_brakes_as_late_as_it_may(acceleration: float) -> None:
    hand = load_hand("allegro_right", mount="fixed")
    dt = 0.01
    change = acceleration * dt * dt
    options = IkOptions(has_velocity_limits=False, max_acceleration=acceleration)
    gate = Gate(hand, Motion.at_rest(pin.neutral(hand.model), hand.model.nv), options)
    joint = 1
    column = hand.joint_columns[joint]
    for distance in np.geomspace(1e-6, 1.0, 20) * min(0.5, 100.0 * change):
        posture = hand.rest.copy()
        posture[joint] = hand.upper_limits[joint] - distance
        q = hand.configuration_vector(posture)
        farthest = np.zeros(hand.model.nv)
        # It accelerates for as long as it may, in one place.
        for _ in range(60):
            gate.motion = Motion(q, farthest, dt, np.zeros(hand.model.nv))
            farthest[column] = gate.bounds(dt)[1, column]
        # Behind a displacement x comes a stop of x^2 / (2 a dt^2).
        x = farthest[column]
        assert x + x * x / (2.0 * change) == pytest.approx(distance, rel=1e-9)
