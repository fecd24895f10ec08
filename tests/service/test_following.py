"""Measured joints: what does not follow is found, and the robot goes on from where it is."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace
from patience import wait_until
from service_tools import (
    HERE,
    RESET,
    Sampler,
    client_of,
    code_of,
    connected,
    human_q,
    in_loop,
    make_session,
    serving,
)

from handmap_qp import FollowingCheck, InvalidInputError, load_hand
from handmap_qp.apps.service.session import Session
from handmap_qp.client import ServiceError
from handmap_qp.client.messages import PROTOCOL, Measured
from handmap_qp.errors import RefusedError

TICK = 0.005
ALLOWED = 0.3


def measured(q: Any) -> Measured:
    return Measured(protocol=PROTOCOL, seq=1, name="test", measured_q=tuple(q))


class Motors:
    """Joints that follow their commands with a time constant of 40 ms, up to 8 rad/s."""

    def __init__(self, q: np.ndarray) -> None:
        self.q = q.copy()
        self.worst = 0.0  # largest error that was told

    def move(self, command: np.ndarray) -> None:
        step = (command - self.q) * TICK / 0.04
        self.q += np.clip(step, -8.0 * TICK, 8.0 * TICK)


def run(session: Session, motors: Motors, fault: Any, begins: float, end: float) -> Any:
    """Lead a session at 100 Hz by a hand that closes and opens, with motors that get a fault.

    Args:
        session: The session.
        motors: Its motors.
        fault: Called after each step with the motors, the joints at its beginning and the time
            since; returns what the encoders say, None for nothing.
        begins: When the fault begins [s].
        end: Longest time [s].

    Returns:
        The times from the fault and from the first large error at which the session held, NaN if
        it did not; and the last command.
    """
    sample = Sampler()
    command = None
    off = np.nan
    stuck = motors.q.copy()
    for i in range(round(end / TICK)):
        now = TICK * i
        if i % 2 == 0:
            command = session.step(sample(now, human_q(4.0 * now)), now)
        told = session.tick(now)
        command = told or command
        assert command is not None
        goal = np.array(command.q)
        motors.worst = max(motors.worst, *np.abs(command.following_error), 0.0)
        if now < begins:
            motors.move(goal)
            stuck = motors.q.copy()
            said = motors.q
        else:
            said = fault(motors, goal, stuck, now - begins)
            if np.isnan(off) and np.abs(motors.q - goal).max() > ALLOWED:
                off = now
        if said is not None:
            session.measure(measured(said), now)
        if command.status == "not_following":
            return now - begins, now - off, command
    return np.nan, np.nan, command


def jammed(motors: Motors, goal: np.ndarray, stuck: np.ndarray, time: float) -> Any:
    motors.move(goal)
    motors.q[:] = stuck
    return motors.q


def dead(motors: Motors, goal: np.ndarray, stuck: np.ndarray, time: float) -> Any:
    """One motor without torque: a spring opens the joint."""
    motors.move(goal)
    motors.q[0] = stuck[0] + 3.0 * time
    return motors.q


def pushed(motors: Motors, goal: np.ndarray, stuck: np.ndarray, time: float) -> Any:
    motors.move(goal)
    motors.q[3] = goal[3] - 4.0 * min(time, 0.3)
    return motors.q


def silent(motors: Motors, goal: np.ndarray, stuck: np.ndarray, time: float) -> Any:
    motors.move(goal)
    return None


def sound(motors: Motors, goal: np.ndarray, stuck: np.ndarray, time: float) -> Any:
    motors.move(goal)
    return motors.q


def watched(**choices: Any) -> tuple[Session, Motors]:
    session = make_session(following_error=ALLOWED, **choices)
    return session, Motors(session.posture[0])


@pytest.mark.parametrize("fault", [jammed, dead, pushed])
def test_a_joint_that_does_not_follow_is_found_within_200_ms(fault: Any) -> None:
    session, motors = watched()
    _, since, command = run(session, motors, fault, 0.6, 3.0)
    assert since <= 0.2
    assert session.counts["not_following"] == 1
    # The robot is where it is, and nothing winds up.
    np.testing.assert_allclose(
        command.q, np.clip(motors.q, *session.robot.limits), atol=0.15
    )


def test_late_encoders_are_found_within_200_ms() -> None:
    session, motors = watched()
    since, _, _ = run(session, motors, silent, 0.6, 3.0)
    assert 0.1 < since <= 0.2


def test_joints_may_be_where_they_were_commanded_50_ms_ago_at_1_khz() -> None:
    hand = load_hand("three_finger")
    check = FollowingCheck(hand, error=ALLOWED)
    path = hand.rest + np.linspace(0.0, 0.2, 200)[:, None]
    for k, command in enumerate(path):
        check.command(command, 1e-3 * k)
        check.measure(path[max(k - 48, 0)], 1e-3 * k)
        np.testing.assert_allclose(check.error, 0.0, atol=1e-12)


def test_motors_that_lag_are_not_taken_for_lost() -> None:
    session, motors = watched()
    since, _, _ = run(session, motors, sound, 0.6, 4.0)
    assert np.isnan(since)
    assert 0.0 < motors.worst < ALLOWED
    assert session.counts["not_following"] == 0


def test_without_a_limit_errors_are_only_told() -> None:
    session = make_session()
    motors = Motors(session.posture[0])
    since, _, _ = run(session, motors, jammed, 0.6, 2.0)
    assert np.isnan(since)
    assert motors.worst > ALLOWED


@pytest.mark.parametrize("way", ["clutch", "reset"])
def test_engaging_again_begins_at_what_is_measured(way: str) -> None:
    session, motors = watched()
    _, _, lost = run(session, motors, jammed, 0.6, 3.0)
    sample = Sampler()
    # It is pushed on while it holds; samples do not move it.
    lower, upper = session.robot.limits
    moved = np.clip(motors.q + 0.2, lower, upper)
    for i in range(20):
        now = 5.0 + 0.01 * i
        session.measure(measured(moved), now)
        held = session.step(sample(now, human_q()), now)
        assert held.status == "not_following"
        np.testing.assert_array_equal(held.q, lost.q)
        assert held.epoch == lost.epoch
    if way == "clutch":
        session.clutch()
    else:
        session.reset(RESET, 5.2)
    before = moved
    for i in range(40):
        now = 5.21 + 0.01 * i
        session.measure(measured(before), now)
        command = session.step(sample(now, human_q(0.05 * i)), now)
        assert command.epoch > lost.epoch
        speeds = np.abs(np.array(command.q) - before) / session.robot.velocity_limits
        assert np.all(speeds <= command.dt * (1.0 + 1e-6))
        before = np.array(command.q)
    assert np.abs(before - moved).max() > 0.01


def test_a_stop_counts_more_than_joints_that_do_not_follow() -> None:
    session, motors = watched()
    run(session, motors, jammed, 0.6, 3.0)
    session.stop()
    assert session.mode == "stopped"
    with pytest.raises(RefusedError, match="clear the stop"):
        session.clutch()


def test_a_heartbeat_goes_on_without_samples() -> None:
    session, motors = watched()
    run(session, motors, jammed, 0.6, 3.0)
    commands = [session.tick(4.0 + 0.01 * i) for i in range(100)]
    assert {command.status for command in commands if command} == {"not_following"}
    assert sum(command is not None for command in commands) >= 9


def test_a_driver_tells_by_the_sessions_name() -> None:
    with (
        serving() as server,
        connected(server, name="lab", following_error=0.2, is_shared=True) as tracker,
        client_of(server) as driver,
    ):
        driver.watch("lab")
        q = np.array(tracker.step(q=human_q(), wrist=HERE).q)

        def lead() -> Any:
            driver.measured(q + 0.5)
            command = tracker.step(q=human_q(), wrist=HERE)
            return command if command.status == "not_following" else None

        command = wait_until(lead)
        assert tracker.opened is not None
        inside = np.clip(q + 0.5, tracker.opened.lower, tracker.opened.upper)
        np.testing.assert_allclose(command.q, inside, atol=1e-12)
        metrics = server.dispatcher.sessions.metrics
        assert in_loop(server, lambda: metrics.counts["not_following"]) == 1
        assert driver.status().mode == "not_following"


def test_a_stranger_does_not_tell_where_a_robot_is() -> None:
    with (
        serving() as server,
        connected(server, name="lab", following_error=0.2) as tracker,
        client_of(server) as stranger,
    ):
        stranger.watch("lab")
        q = np.array(tracker.step(q=human_q(), wrist=HERE).q)
        refusals = []
        for _ in range(20):
            refusals.append(stranger.measured(q + 0.5))
            command = tracker.step(q=human_q(), wrist=HERE)
        # The answer is to an earlier call.
        assert refusals[0] is None
        refusal = wait_until(lambda: stranger.measured(q))
        assert (refusal.code, refusal.field) == ("denied", "name")
        assert command.status != "not_following"
        assert command.following_error == ()


@pytest.mark.parametrize("is_placed", [False, True])
def test_a_session_whose_encoders_stay_away_is_lost_again(is_placed: bool) -> None:
    session, motors = watched()
    run(session, motors, silent, 0.6, 3.0)
    if is_placed:
        session.reset(replace(RESET, robot_q=tuple(motors.q)), 5.0)
    else:
        session.clutch()
    assert session.mode == "following"
    session.tick(5.0)
    assert session.mode == "not_following"


def test_a_robot_that_was_lost_and_stopped_begins_at_what_is_measured() -> None:
    session, motors = watched()
    _, _, lost = run(session, motors, jammed, 0.6, 3.0)
    session.stop()
    moved = np.clip(motors.q + 0.3, *session.robot.limits)
    session.measure(measured(moved), 4.0)
    session.clear(session.record.stop)
    session.clutch()
    np.testing.assert_array_equal(session.posture[0], moved)
    command = session.step(Sampler()(4.1, human_q()), 4.01)
    assert command.epoch > lost.epoch


def test_joints_in_samples_may_pause_with_them() -> None:
    session, motors = watched()
    sample = Sampler()
    for i in range(20):
        q = tuple(motors.q)
        session.step(replace(sample(0.01 * i), measured_q=q), 0.01 * i)
    commands = [session.tick(0.2 + 0.01 * i) for i in range(60)]
    assert session.mode == "hold"
    assert any(command and "watchdog" in command.flags for command in commands)


def test_measurements_of_another_robot_are_refused() -> None:
    session, _ = watched()
    with pytest.raises(RefusedError) as raised:
        session.measure(measured([0.0]), 0.0)
    assert raised.value.field == "measured_q"
    with serving() as server, connected(server) as client:
        with pytest.raises(ServiceError) as refused:
            client.step(q=human_q(), wrist=HERE, measured_q=[0.0])
        assert code_of(refused) == ("invalid", "measured_q")


def test_errors_are_the_distance_to_the_nearest_command_of_late() -> None:
    robot = load_hand("three_finger")
    check = FollowingCheck(robot, 0.1, 0.05)
    rng = np.random.default_rng(0)
    commands = rng.normal(size=(40, len(robot.joint_names)))
    for i, command in enumerate(commands):
        now = i / 64
        check.command(command, now)
        q = rng.normal(size=len(robot.joint_names))
        check.measure(q, now)
        # The command that was in force 50 ms ago still counts.
        late = commands[max(0, i - 4) : i + 1]
        nearest = np.clip(q, late.min(axis=0), late.max(axis=0))
        np.testing.assert_allclose(check.error, q - nearest)
    with pytest.raises(InvalidInputError, match="measured_q"):
        check.measure(np.full(len(robot.joint_names), np.nan), 1.0)


def test_a_short_error_is_none() -> None:
    robot = load_hand("three_finger")
    check = FollowingCheck(robot, 0.1, 0.05)
    check.command(robot.rest, 0.0)
    for now, off in ((0.0, 0.2), (0.04, 0.2), (0.06, 0.0), (0.07, 0.2), (0.11, 0.2)):
        check.measure(robot.rest + off, now)
        assert not check.is_lost(now)
    check.measure(robot.rest + 0.2, 0.13)
    assert check.is_lost(0.13)


def test_a_gripper_in_metres_has_half_of_its_range() -> None:
    robot = load_hand("panda_gripper")
    check = FollowingCheck(robot)
    lower, upper = robot.limits
    check.command(lower, 0.0)
    for now in (0.0, 0.1):
        check.measure(lower + 0.6 * (upper - lower), now)
    assert check.is_lost(0.1)
