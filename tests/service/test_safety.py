"""The commanded robot and the clock: every command respects the limits of the robot."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles.shape_distances import MeasuredPairs
from service_tools import CACHE, opening
from strategies import generators, motion_of, rotations, translations

from handmap_core.ik.motion import SHORTEST_DT
from handmap_core.ik.options import IkOptions
from handmap_qp.apps.service.safety import CommandedRobot, SessionClock
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik.qp import PointIk

ROBOT = CACHE.robot("three_finger", None, None)
FIXED = CACHE.robot("three_finger", None, "fixed")
poses = st.builds(motion_of, rotations, translations)
times = st.floats(min_value=1e-4, max_value=0.1)


def angles(robot: Hand, generator: np.random.Generator) -> np.ndarray:
    return generator.uniform(robot.lower_limits, robot.upper_limits)


def wrist_twist(robot: Hand, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Displacement of the wrist's joint, as the QP bounds it, shape (6,)."""
    start, end = (
        robot.configuration_vector(robot.rest, wrist) for wrist in (before, after)
    )
    return pin.difference(robot.model, start, end)[:6]


@given(generators, times, st.floats(min_value=0.01, max_value=1.0))
def test_no_joint_goes_faster_than_its_share_of_the_limit(
    generator: np.random.Generator, dt: float, share: float
) -> None:
    guard = CommandedRobot(ROBOT, angles(ROBOT, generator), np.eye(4))
    before = guard.q.copy()
    guard.move_to(angles(ROBOT, generator), None, dt, share)
    assert (
        np.abs(guard.q - before) <= ROBOT.velocity_limits * dt * share + 1e-12
    ).all()


@given(generators, poses, poses, times)
def test_the_wrist_keeps_its_limits(
    generator: np.random.Generator, before: np.ndarray, wanted: np.ndarray, dt: float
) -> None:
    guard = CommandedRobot(ROBOT, ROBOT.rest, before)
    guard.move_to(ROBOT.rest, wanted, dt)
    wrist = guard.wrist
    assert wrist is not None
    limits = (
        np.repeat(
            [ROBOT.spec.wrist.max_linear_speed, ROBOT.spec.wrist.max_angular_speed], 3
        )
        * dt
    )
    # The logarithm of a pose loses half its digits near half a turn.
    assert (np.abs(wrist_twist(ROBOT, before, wrist)) <= limits + 1e-7).all()


@given(generators, poses)
def test_what_is_within_the_limits_passes_unchanged(
    generator: np.random.Generator, wrist: np.ndarray
) -> None:
    guard = CommandedRobot(ROBOT, ROBOT.rest, wrist)
    wanted = ROBOT.rest + ROBOT.velocity_limits * 0.01 * generator.uniform(
        -1.0, 1.0, len(ROBOT.rest)
    )
    assert guard.move_to(wanted, wrist, 0.01)
    assert np.array_equal(guard.q, wanted)


@given(generators, poses, poses)
def test_a_far_posture_is_reached_in_the_time_that_the_slowest_needs(
    generator: np.random.Generator, before: np.ndarray, wanted: np.ndarray
) -> None:
    guard, goal = (
        CommandedRobot(ROBOT, angles(ROBOT, generator), before),
        angles(ROBOT, generator),
    )
    joints = np.abs(goal - guard.q) / ROBOT.velocity_limits
    speeds = np.repeat(
        [ROBOT.spec.wrist.max_linear_speed, ROBOT.spec.wrist.max_angular_speed], 3
    )
    slowest = max(
        joints.max(), (np.abs(wrist_twist(ROBOT, before, wanted)) / speeds).max()
    )
    steps = int(np.ceil(slowest / 0.02 - 1e-6)) + 1
    is_there = [guard.move_to(goal, wanted, 0.02) for _ in range(steps)]
    assert is_there[-1]
    assert np.array_equal(guard.q, goal)


class Ways:
    """Straight ways of a hand, and the distances of its links on them."""

    def __init__(self, hand: Hand) -> None:
        self.hand, self.pairs = hand, all_pairs(hand)
        self._distances, self._placed = (
            MeasuredPairs(hand, pairs=self.pairs),
            hand.configuration(),
        )

    def nearest(self, before: np.ndarray, after: np.ndarray, count: int) -> float:
        """Return the smallest distance on a way, its end included [m]."""
        found = []
        for part in np.arange(1, count + 1) / count:
            q = before + part * (after - before)
            self._placed.place(self.hand.configuration_vector(q))
            found.append(self._distances.nearest(self._placed.q))
        return min(found)

    def ends(self, generator: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
        """Return two postures, clear of overlaps, with another link between them."""
        while True:
            start, goal = angles(self.hand, generator), angles(self.hand, generator)
            is_clear = (
                self.nearest(goal, start, 1) > 0.0
                and self.nearest(start, goal, 1) > 0.0
            )
            if is_clear and self.nearest(start, goal, 12) < -2e-3:
                return start, goal


@pytest.mark.parametrize("most", [None, 20.0])
def test_a_slew_never_leads_through_a_link(most: float | None) -> None:
    ways, generator = Ways(FIXED), np.random.default_rng(3)
    ik = PointIk(FIXED, IkOptions(max_acceleration=most), contacts=ways.pairs)
    worst, fastest, arrivals = np.inf, 0.0, 0
    for _ in range(5):
        start, goal = ways.ends(generator)
        guard, velocity, is_there = (
            CommandedRobot(FIXED, start),
            np.zeros_like(goal),
            False,
        )
        guard.obey(ik)
        for k in range(150):
            before, dt = guard.q, generator.uniform(0.004, 0.03)
            if k % 50 > 45:
                guard.brake(dt)
            else:
                is_there = guard.move_to(goal, None, dt, 0.5)
            worst = min(worst, ways.nearest(before, guard.q, 2))
            last, velocity = velocity, (guard.q - before) / dt
            assert (np.abs(velocity) <= FIXED.velocity_limits * (1.0 + 1e-9)).all()
            fastest = max(fastest, np.abs(velocity - last).max() / dt)
            if is_there:
                break
        arrivals += is_there
    assert worst > -1e-4
    assert arrivals >= 2
    assert most is None or 0.5 * most < fastest <= most * (1.0 + 1e-6)


def test_the_joints_stop_on_their_line_while_the_wrist_still_brakes() -> None:
    # The mapper has found the joints' own stop to be clear, not a longer one.
    most, dt = 20.0, 0.01
    guard = CommandedRobot(ROBOT, ROBOT.rest, np.eye(4))
    pairs = all_pairs(ROBOT)
    guard.obey(PointIk(ROBOT, IkOptions(max_acceleration=most), contacts=pairs))
    far, goal = motion_of(np.eye(3), np.array([0.0, 0.0, 9.0])), guard.q + 0.02
    postures = [guard.q]
    for _ in range(6):
        guard.move_to(goal, far, dt)
        postures.append(guard.q)
    velocity = (postures[-1] - postures[-2]) / dt
    stop = np.abs(velocity).max() / most
    heights = []
    for _ in range(3):
        guard.brake(dt)
        heights.append(np.asarray(guard.wrist)[2, 3])
        expected = postures[-1] + max(0.0, 1.0 - dt / stop) * dt * velocity
        assert np.allclose(guard.q, expected, rtol=0.0, atol=1e-12)
        postures.append(guard.q)
        velocity, stop = max(0.0, 1.0 - dt / stop) * velocity, stop - dt
    assert stop < dt
    assert heights[2] - heights[1] > 1e-3


def test_a_brake_whose_time_rounds_to_zero_stops_at_once() -> None:
    guard = CommandedRobot(FIXED, FIXED.rest)
    guard.obey(PointIk(FIXED, IkOptions(max_acceleration=1e308)))
    guard.move_to(np.nextafter(FIXED.rest, 1.0), None, 10.0)
    before = guard.q
    guard.brake(0.01)
    assert not guard.motion.is_braking
    assert np.array_equal(guard.q, before)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_not_followed(bad: float) -> None:
    guard = CommandedRobot(ROBOT, ROBOT.rest, np.eye(4))
    assert not guard.move_to(np.full_like(ROBOT.rest, bad), np.eye(4), 0.01)
    assert not guard.move_to(ROBOT.rest, np.full((4, 4), bad), 0.01)
    assert np.array_equal(guard.q, ROBOT.rest)


def test_the_first_wrist_places_it() -> None:
    guard = CommandedRobot(ROBOT, ROBOT.rest)
    assert guard.wrist is None
    far = motion_of(np.eye(3), np.array([5.0, 0.0, 0.0]))
    assert guard.move_to(ROBOT.rest, far, 0.001)
    assert np.array_equal(np.asarray(guard.wrist), far)


def test_a_fixed_wrist_stays_where_the_urdf_has_it() -> None:
    guard = CommandedRobot(FIXED, FIXED.rest)
    expected = FIXED.frame_pose("wrist", FIXED.rest)
    guard.move_to(FIXED.rest + 0.01, expected, 0.1)
    assert np.allclose(np.asarray(guard.wrist), expected, atol=1e-15)


@given(
    st.lists(
        st.tuples(st.floats(-1e6, 1e6), st.floats(0.0, 0.2)), min_size=1, max_size=30
    )
)
def test_the_servers_clock_grants_no_more_time_than_has_passed(
    arrivals: list[tuple[float, float]],
) -> None:
    clock, now = SessionClock(opening(max_dt=0.05), 0.0), 0.0
    for stamp, wait in arrivals:
        now += wait
        dt, _ = clock.grant(stamp, now)
        # A sample at the same time is granted the shortest time.
        assert dt <= min(max(wait, SHORTEST_DT), 0.05) + 1e-12


def test_jumps_of_the_clients_clock_are_flagged() -> None:
    clock = SessionClock(opening(max_dt=0.05), 0.0)
    assert clock.grant(100.0, 0.01)[1] == []
    assert clock.grant(100.01, 0.02)[1] == []
    assert clock.grant(50.0, 0.03)[1] == ["time_backwards"]
    assert clock.grant(90.0, 0.04)[1] == ["time_jump"]
    assert clock.grant(90.5, 0.54)[1] == ["dt_clamped"]
    # Clocks may differ by a second between two samples.
    assert clock.grant(91.52, 0.57)[1] == []
    assert clock.grant(92.56, 0.60)[1] == ["time_jump"]


def test_simulated_time_counts_by_the_stamps() -> None:
    clock = SessionClock(opening(max_dt=0.05, time_from="client"), 0.0)
    clock.grant(10.0, 0.0)
    assert clock.grant(10.02, 0.0001)[0] == pytest.approx(0.02, abs=1e-12)
    assert clock.grant(99.0, 0.0002) == (0.05, ["dt_clamped"])
    assert clock.grant(98.0, 5.0) == (SHORTEST_DT, ["time_backwards"])


def test_simulated_time_counts_once_behind_a_late_stamp() -> None:
    clock = SessionClock(opening(max_dt=0.05, time_from="client"), 0.0)
    stamps = [10.0, 10.02, 9.98, 9.99, 10.03, 10.03, 10.05]
    _, *granted = [clock.grant(stamp, 0.0) for stamp in stamps]
    dt = [time for time, _ in granted]
    assert dt == pytest.approx([0.02, *[SHORTEST_DT] * 2, 0.01, SHORTEST_DT, 0.02])
    is_late = ["time_backwards" in flags for _, flags in granted]
    assert is_late == [False, True, True, False, True, False]
    # A simulation that starts again.
    assert clock.grant(0.0, 0.0)[0] == SHORTEST_DT
    assert clock.grant(0.02, 0.0)[0] == pytest.approx(0.02)
