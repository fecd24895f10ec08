"""The speed guard and the clock: every command respects the limits of the robot."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import CACHE
from strategies import generators, motion_of, rotations, translations

from handmap_qp.hands.hand import Hand
from handmap_qp.service.safety import SHORTEST_DT, SpeedGuard, StepClock

ROBOT = CACHE.robot("three_finger", None, None)
FIXED = CACHE.robot("three_finger", None, "fixed")
poses = st.builds(motion_of, rotations, translations)
times = st.floats(min_value=1e-4, max_value=0.1)


def angles(robot: Hand, generator: np.random.Generator) -> np.ndarray:
    return generator.uniform(robot.lower_limits, robot.upper_limits)


def wrist_twist(robot: Hand, before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Displacement of the wrist's joint, as the QP bounds it, shape (6,)."""
    start, end = (robot.configuration_vector(robot.rest, wrist) for wrist in (before, after))
    return pin.difference(robot.model, start, end)[:6]


@given(generators, times, st.floats(min_value=0.01, max_value=1.0))
def test_no_joint_goes_faster_than_its_share_of_the_limit(
    generator: np.random.Generator, dt: float, share: float
) -> None:
    guard = SpeedGuard(ROBOT, angles(ROBOT, generator), np.eye(4))
    before = guard.q.copy()
    guard.advance(angles(ROBOT, generator), None, dt, share)
    assert (np.abs(guard.q - before) <= ROBOT.velocity_limits * dt * share + 1e-12).all()


@given(generators, poses, poses, times)
def test_the_wrist_keeps_its_limits(
    generator: np.random.Generator, before: np.ndarray, wanted: np.ndarray, dt: float
) -> None:
    guard = SpeedGuard(ROBOT, ROBOT.rest, before)
    guard.advance(ROBOT.rest, wanted, dt)
    wrist = guard.wrist
    assert wrist is not None
    limits = (
        np.repeat([ROBOT.spec.wrist.max_linear_speed, ROBOT.spec.wrist.max_angular_speed], 3) * dt
    )
    # The logarithm of a pose loses half its digits near half a turn.
    assert (np.abs(wrist_twist(ROBOT, before, wrist)) <= limits + 1e-7).all()


@given(generators, poses)
def test_what_is_within_the_limits_passes_unchanged(
    generator: np.random.Generator, wrist: np.ndarray
) -> None:
    guard = SpeedGuard(ROBOT, ROBOT.rest, wrist)
    wanted = ROBOT.rest + ROBOT.velocity_limits * 0.01 * generator.uniform(
        -1.0, 1.0, len(ROBOT.rest)
    )
    assert guard.advance(wanted, wrist, 0.01)
    assert np.array_equal(guard.q, wanted)


@given(generators, poses, poses)
def test_a_far_posture_is_reached_in_the_time_that_the_slowest_needs(
    generator: np.random.Generator, before: np.ndarray, wanted: np.ndarray
) -> None:
    guard, goal = SpeedGuard(ROBOT, angles(ROBOT, generator), before), angles(ROBOT, generator)
    joints = np.abs(goal - guard.q) / ROBOT.velocity_limits
    speeds = np.repeat([ROBOT.spec.wrist.max_linear_speed, ROBOT.spec.wrist.max_angular_speed], 3)
    slowest = max(joints.max(), (np.abs(wrist_twist(ROBOT, before, wanted)) / speeds).max())
    steps = int(np.ceil(slowest / 0.02 - 1e-6)) + 1
    is_there = [guard.advance(goal, wanted, 0.02) for _ in range(steps)]
    assert is_there[-1]
    assert np.array_equal(guard.q, goal)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_not_followed(bad: float) -> None:
    guard = SpeedGuard(ROBOT, ROBOT.rest, np.eye(4))
    assert not guard.advance(np.full_like(ROBOT.rest, bad), np.eye(4), 0.01)
    assert not guard.advance(ROBOT.rest, np.full((4, 4), bad), 0.01)
    assert np.array_equal(guard.q, ROBOT.rest)


def test_the_first_wrist_places_it() -> None:
    guard = SpeedGuard(ROBOT, ROBOT.rest)
    assert guard.wrist is None
    far = motion_of(np.eye(3), np.array([5.0, 0.0, 0.0]))
    assert guard.advance(ROBOT.rest, far, 0.001)
    assert np.array_equal(np.asarray(guard.wrist), far)


def test_a_fixed_wrist_stays_where_the_urdf_has_it() -> None:
    guard = SpeedGuard(FIXED, FIXED.rest)
    expected = FIXED.frame_pose("wrist", FIXED.rest)
    guard.advance(FIXED.rest + 0.01, expected, 0.1)
    assert np.allclose(np.asarray(guard.wrist), expected, atol=1e-15)


@given(st.lists(st.tuples(st.floats(-1e6, 1e6), st.floats(0.0, 0.2)), min_size=1, max_size=30))
def test_the_servers_clock_grants_no_more_time_than_has_passed(
    arrivals: list[tuple[float, float]],
) -> None:
    clock, now = StepClock(0.05, "server", 0.0), 0.0
    for stamp, wait in arrivals:
        now += wait
        dt, _ = clock.grant(stamp, now)
        # A sample at the same time is granted the shortest time.
        assert dt <= min(max(wait, SHORTEST_DT), 0.05) + 1e-12


def test_jumps_of_the_clients_clock_are_flagged() -> None:
    clock = StepClock(0.05, "server", 0.0)
    assert clock.grant(100.0, 0.01)[1] == []
    assert clock.grant(100.01, 0.02)[1] == []
    assert clock.grant(50.0, 0.03)[1] == ["time_backwards"]
    assert clock.grant(90.0, 0.04)[1] == ["time_jump"]
    assert clock.grant(90.5, 0.54)[1] == ["dt_clamped"]


def test_simulated_time_counts_by_the_stamps() -> None:
    clock = StepClock(0.05, "client", 0.0)
    clock.grant(10.0, 0.0)
    assert clock.grant(10.02, 0.0001)[0] == pytest.approx(0.02, abs=1e-12)
    assert clock.grant(99.0, 0.0002) == (0.05, ["dt_clamped"])
    assert clock.grant(98.0, 5.0) == (SHORTEST_DT, ["time_backwards"])
