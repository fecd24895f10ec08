"""A session without samples: hold, return to rest, and the next engagement."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from service_tools import (
    CACHE,
    PERIOD,
    RESET,
    Sampler,
    change,
    follow,
    human_q,
    make_session,
    opening,
    speeds,
)

from handmap_qp.apps.service.opening import prepare_hands
from handmap_qp.apps.service.safety import HEARTBEAT
from handmap_qp.apps.service.session import Session
from handmap_qp.client.messages import Pose
from handmap_qp.hands import LONGEST_STOP

FAR = Pose((5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def test_the_watchdog_holds_and_says_so() -> None:
    session, sample = make_session(watchdog=0.2), Sampler()
    end = follow(session, sample, 0.0)
    posture = session.posture[0].copy()
    assert session.tick(end + 0.19) is None
    command = session.tick(end + 0.21)
    assert command is not None
    assert (command.status, command.flags) == ("hold", ("watchdog",))
    assert session.mode == "hold"
    assert session.tick(end + 0.21 + 0.5 * HEARTBEAT) is None
    assert session.tick(end + 0.21 + 1.01 * HEARTBEAT) is not None
    assert np.array_equal(session.posture[0], posture)
    assert session.counts["watchdog"] == 1


def test_a_held_robot_follows_again_from_where_it_is() -> None:
    session, sample = make_session(), Sampler()
    end = follow(session, sample, 0.0)
    session.tick(end + 1.0)
    before = session.posture[0].copy()
    command = session.step(sample(9.0, human_q(2.0)), end + 2.0)
    assert "resumed" in command.flags
    assert session.mode == "following"
    assert (speeds(session, before, command, 1.0 / 30.0) <= 1.0 + 1e-6).all()


def test_with_an_acceleration_limit_a_held_robot_sets_out_from_standstill() -> None:
    limit = 20.0
    session, sample = make_session(ik={"max_acceleration": limit}), Sampler()
    end = follow(session, sample, 0.0)
    for i in range(1, 61):
        session.tick(end + i * PERIOD)
    assert session.mode == "hold"
    before = session.posture[0].copy()
    command = session.step(sample(9.0, human_q(2.0)), end + 1.0 + PERIOD)
    # From rest, x = a dt^2 in one sample of the QP's displacement.
    assert (np.abs(np.array(command.q) - before) <= limit * command.dt**2 + 1e-9).all()


def returning_session() -> tuple[Session, Sampler, float]:
    """Return a session whose robot is on its way to rest, its sampler, and the time [s]."""
    session, sample = make_session(watchdog=0.1, return_after=0.1), Sampler()
    now = follow(session, sample, 0.0)
    while session.mode != "returning":
        now += 0.01
        session.tick(now)
    for _ in range(20):
        now += 0.01
        session.tick(now)
    return session, sample, now


def test_a_clutch_on_the_way_back_takes_hold_where_the_robot_is_then() -> None:
    session, sample, now = returning_session()
    session.clutch()
    for _ in range(50):
        now += 0.01
        session.tick(now)
    before = session.robot.points(*session.posture)
    for _ in range(20):
        now += PERIOD
        command = session.step(sample(0.0, human_q(2.0)), now)
        assert "slewing" not in command.flags
    assert (
        np.linalg.norm(session.robot.points(*session.posture) - before, axis=1).max()
        < 1e-3
    )


def test_a_robot_said_to_be_elsewhere_on_the_way_back_waits_there() -> None:
    session, _, now = returning_session()
    there = session.robot.rest + 0.2
    session.reset(msgspec.structs.replace(RESET, robot_q=tuple(there)), now)
    assert session.tick(now + 0.05) is None
    held = session.tick(now + 0.15)
    assert held is not None
    assert (held.status, held.q) == ("hold", tuple(there.tolist()))


def test_a_session_goes_on_from_a_former_one_with_its_epoch_and_released_if_it_was() -> (
    None
):
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    session.release()
    request = opening()
    after = Session(
        request, prepare_hands(request, CACHE), "test", now, former=session.record
    )
    command = after.step(sample(0.0, human_q(2.0)), now + PERIOD)
    assert (command.q, command.epoch, command.status) == (
        session.record.q,
        session.record.epoch,
        "released",
    )
    other = make_session()
    assert other.record.epoch > session.record.epoch
    assert make_session(is_released=True).mode == "released"


def test_return_to_rest_is_slow_and_ends_there() -> None:
    session, sample = (
        make_session(watchdog=0.1, return_after=0.3, return_speed=0.2),
        Sampler(),
    )
    now = follow(session, sample, 0.0)
    assert not np.array_equal(session.posture[0], session.robot.rest)
    last, told, states = session.posture[0].copy(), now, []
    for _ in range(1000):
        now += 0.005
        command = session.tick(now)
        if command is None:
            continue
        assert (speeds(session, last, command, now - told) <= 0.2 + 1e-6).all()
        last, told = np.array(command.q), now
        states.append(command.status)
        if "at_rest" in command.flags:
            break
    assert np.array_equal(last, session.robot.rest)
    assert states[0] == "hold"
    assert states[-1] == "returning"
    later = [session.tick(now + 0.005 * k) for k in range(1, 200)]
    assert {command.status for command in later if command} == {"hold"}
    assert session.mode == "hold"


def test_after_a_return_the_next_sample_is_the_reference() -> None:
    session, sample = (
        make_session(watchdog=0.1, return_after=0.0, return_speed=1.0),
        Sampler(),
    )
    now = follow(session, sample, 0.0)
    wrist = session.posture[1]
    for _ in range(400):
        now += 0.01
        session.tick(now)
    # The hand is far away now. The robot stays at rest, and its wrist where it was.
    command = session.step(sample(0.0, human_q(1.5), wrist=FAR), now + 0.01)
    assert np.allclose(command.q, session.robot.rest, atol=1e-9)
    assert command.wrist is not None
    assert wrist is not None
    assert np.allclose(command.wrist.position, wrist[:3, 3], atol=1e-9)


def test_a_released_robot_does_not_return() -> None:
    session, sample = make_session(watchdog=0.1, return_after=0.0), Sampler()
    now = follow(session, sample, 0.0)
    session.release()
    posture = session.posture[0].copy()
    for _ in range(100):
        now += 0.05
        session.tick(now)
    assert np.array_equal(session.posture[0], posture)
    assert session.step(sample(0.0, human_q(2.0)), now).status == "released"
    assert np.array_equal(session.posture[0], posture)


def test_a_robot_that_was_let_go_is_said_to_be_while_the_watchdog_holds_it() -> None:
    session, sample = make_session(watchdog=0.2), Sampler()
    end = follow(session, sample, 0.0)
    session.release()
    command = session.tick(end + 0.3)
    assert command is not None
    assert (command.status, command.flags) == ("hold", ("watchdog", "released"))
    state = session.state(1, "", 0, end + 0.3)
    assert (state.mode, state.is_released) == ("hold", True)
    session.clutch()
    command = session.tick(end + 0.6)
    assert command is not None
    assert command.flags == ("watchdog",)


def test_a_return_does_not_count_as_a_further_trip_of_the_watchdog() -> None:
    session, _, now = returning_session()
    session.tick(now + 1.0)
    assert session.counts["watchdog"] == 1


@pytest.mark.parametrize("limit", [20.0, 80.0])
def test_a_robot_that_hears_no_samples_brakes_within_its_acceleration_limit(
    limit: float,
) -> None:
    session, sample = make_session(ik={"max_acceleration": limit}), Sampler()
    now = follow(session, sample, 0.0, 30)
    last = np.array(session.posture[0])
    command = session.step(sample(now, human_q(3.5)), now := now + PERIOD)
    velocity, last = (np.array(command.q) - last) / PERIOD, np.array(command.q)
    commanded_at = command.server_time
    assert velocity.any()
    for _ in range(120):
        command = session.tick(now := now + 0.005)
        if command is not None:
            # By the clock, of which a command may be granted a part only.
            since = command.server_time - commanded_at
            after = (np.array(command.q) - last) / since
            assert (np.abs(after - velocity) <= limit * since + 1e-6).all()
            velocity, last = after, np.array(command.q)
            commanded_at = command.server_time
    assert np.abs(velocity).max() < 1e-6
    assert session.mode == "hold"


def test_another_preset_keeps_the_acceleration_limit() -> None:
    session = make_session(ik={"max_acceleration": 20.0, "rest_weight": 0.3})
    session.configure(change(preset="object"))
    about = session.state(1, "", 0, 0.0).about
    assert about is not None
    assert about.ik["max_acceleration"] == 20.0
    assert about.ik["rest_weight"] != 0.3
    session.configure(change(preset="paper", ik={"max_acceleration": None}))
    about = session.state(1, "", 0, 0.0).about
    assert about is not None
    assert about.ik["max_acceleration"] is None


@pytest.mark.parametrize(("high", "low"), [(20.0, 0.5), (100.0, 1.0), (None, 0.5)])
@pytest.mark.parametrize("cause", ["stop", "silence", "step"])
def test_a_limit_lowered_while_the_robot_moves_leads_no_joint_out_of_its_limits(
    high: float | None, low: float, cause: str
) -> None:
    session, sample = make_session(ik={"max_acceleration": high}), Sampler()
    now = follow(session, sample, 0.0, 30)
    for _ in range(5):
        session.step(sample(now, human_q(4.5)), now := now + PERIOD)
    last = np.array(session.posture[0])
    session.step(sample(now, human_q(4.5)), now := now + PERIOD)
    robot, q = session.robot, np.array(session.posture[0])
    velocity, start = (q - last) / PERIOD, q
    commanded_at = now
    assert np.abs(velocity).max() > 0.5
    session.configure(change(ik={"max_acceleration": low}))
    if cause == "stop":
        session.stop()
    for k in range(90):
        now += PERIOD
        command = (
            session.step(sample(now, human_q(4.5)), now)
            if cause == "step"
            else session.tick(now)
        )
        if command is None:
            continue
        last, q = q, np.array(command.q)
        since, commanded_at = now - commanded_at, now
        before, velocity = velocity, (q - last) / since
        assert (q >= robot.lower_limits).all()
        assert (q <= robot.upper_limits).all()
        if high is not None:
            assert np.abs(velocity - before).max() <= high * since * (1.0 + 1e-6)
        if cause == "stop" and k * PERIOD > LONGEST_STOP:
            assert not velocity.any()
    if cause == "stop":
        assert (np.abs(q - start) <= robot.stop_distances).all()


def test_the_bound_of_a_stop_is_told_when_a_session_opens() -> None:
    session = make_session()
    opened = session.opened(1, 0)
    assert opened.stop_time == LONGEST_STOP
    assert opened.stop_distance == tuple(session.robot.stop_distances.tolist())
    ranges = session.robot.upper_limits - session.robot.lower_limits
    assert (np.array(opened.stop_distance) <= ranges).all()


def test_a_takeover_of_a_robot_that_brakes_goes_on_braking() -> None:
    most = 5.0
    session, sample = make_session(ik={"max_acceleration": most}), Sampler()
    now = follow(session, sample, 0.0, 30)
    session.stop()
    command = session.tick(now := now + PERIOD)
    assert command is not None
    last, velocity = (
        np.array(command.q),
        session.motion.velocity[session.robot.joint_columns],
    )
    assert np.abs(velocity).max() > 0.2
    commanded_at = now
    request = opening(ik={"max_acceleration": most})
    after = Session(
        request,
        prepare_hands(request, CACHE),
        "test",
        now,
        former=session.record,
        motion=session.motion,
    )
    for _ in range(40):
        command = after.tick(now := now + PERIOD)
        if command is not None:
            since, commanded_at = now - commanded_at, now
            before, velocity = velocity, (np.array(command.q) - last) / since
            last = np.array(command.q)
            assert np.abs(velocity - before).max() <= most * since * (1.0 + 1e-6)
    assert not velocity.any()


def test_a_return_with_an_acceleration_limit_ends_at_rest_and_stands() -> None:
    session, sample = (
        make_session(
            watchdog=0.1,
            return_after=0.1,
            return_speed=1.0,
            ik={"max_acceleration": 20.0},
        ),
        Sampler(),
    )
    now = follow(session, sample, 0.0)
    flags: list[tuple[str, ...]] = []
    for _ in range(600):
        if (command := session.tick(now := now + PERIOD)) is not None:
            flags.append(command.flags)
    arrival = next(i for i, each in enumerate(flags) if "at_rest" in each)
    assert all("at_rest" in each for each in flags[arrival:])
    assert np.array_equal(session.posture[0], session.robot.rest)
