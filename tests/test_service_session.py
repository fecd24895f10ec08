"""A session: what leaves it, under whatever comes in. Time is the test's own."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from service_tools import HERE, SHELF, Sampler, human_q, make_session

from handmap_qp.errors import RefusedError
from handmap_qp.service.messages import PROTOCOL, Command, Configure, Pose, Reset
from handmap_qp.service.session import HEARTBEAT, Posture, Session

RESET = Reset(protocol=PROTOCOL, seq=99)
PERIOD = 1.0 / 60.0
FAR = Pose((5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


def change(**changes: Any) -> Configure:
    return Configure(protocol=PROTOCOL, seq=99, **changes)


def speeds(session: Session, before: np.ndarray, command: Command, time: float) -> np.ndarray:
    """Joint speeds as parts of their limits, shape (n,)."""
    return np.abs(np.array(command.q) - before) / (session.robot.velocity_limits * time)


def moved_points(session: Session, before: Posture) -> float:
    """How far the fingertips have gone [m]: at a new reference not far, though joints may drift towards rest meanwhile."""
    return float(np.linalg.norm(session.robot.points(*session.posture) - session.robot.points(*before), axis=1).max())


def follow(session: Session, sample: Sampler, start: float, count: int = 20) -> float:
    """Steps at 60 Hz; the time of the last one."""
    for i in range(count):
        session.step(sample(i * PERIOD, human_q(0.1 * i)), start + i * PERIOD)
    return start + (count - 1) * PERIOD


# What may come, and how long after the last event: samples with time stamps of any kind, requests, silence.
events = st.lists(
    st.tuples(
        st.sampled_from(["step", "step", "step", "tick", "clutch", "release", "reset", "configure"]),
        st.floats(min_value=1e-4, max_value=0.6),
        st.floats(min_value=-1e9, max_value=1e9),
        st.floats(min_value=-3.0, max_value=3.0),
    ),
    max_size=25,
)


@pytest.mark.parametrize(
    "choices", [{}, {"ik": {"has_velocity_limits": False}}, {"return_after": 0.1, "resume": "clutch"}], ids=str
)
@given(events=events)
def test_joints_keep_their_speed_limits_whatever_comes(choices: dict[str, Any], events: list[Any]) -> None:
    session, sample, now = make_session(**choices), Sampler(), 0.0
    last, moved_at = session.posture[0].copy(), 0.0
    for kind, wait, stamp, phase in events:
        now += wait
        if kind == "reset":
            session.reset(RESET)
        elif kind == "configure":
            session.configure(change(mapping={"scale": abs(phase), "reference": "previous" if phase < 0.0 else "initial"}))
        elif kind in ("clutch", "release"):
            getattr(session, kind)()
        command = session.step(sample(stamp, human_q(phase)), now) if kind == "step" else session.tick(now)
        if command is not None:
            # Guarded to rounding; no command accounts for more time than has passed, nor than max_dt.
            assert (speeds(session, last, command, min(now - moved_at, 1.0 / 30.0)) <= 1.0 + 1e-6).all()
            last, moved_at = np.array(command.q), now
        assert np.array_equal(session.posture[0], last)


def test_a_burst_of_samples_moves_no_farther_than_time_allows() -> None:
    session, sample = make_session(), Sampler()
    session.step(sample(0.0, human_q(0.0)), 0.0)
    start = session.posture[0].copy()
    for i in range(50):
        # Stamped a second apart, come within a millisecond.
        session.step(sample(1.0 + i, human_q(1.5)), 1e-5 + 2e-5 * i)
    moved = np.abs(session.posture[0] - start)
    assert (moved <= session.robot.velocity_limits * 1.1e-3).all()


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


def test_options_change_on_the_way_and_the_robot_does_not_jump() -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    before = session.posture[0].copy()
    session.configure(change(mapping={"deformation_gain": 0.0}, ik={"rest_weight": 1.0}, has_detail=True))
    np.testing.assert_array_equal(session.posture[0], before)
    command = session.step(sample(now, human_q(1.0)), now + PERIOD)
    assert (speeds(session, before, command, session.request.max_dt) <= 1.0 + 1e-6).all()
    assert command.detail is not None
    np.testing.assert_allclose(command.detail.motion_deformation, np.eye(4), atol=0.5)
    about = session.state(1, "", 0, now).about
    assert about is not None
    assert (about.mapping["deformation_gain"], about.mapping["ridge"], about.ik["rest_weight"]) == (0.0, 0.1, 1.0)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"mapping": {"ridges": 1.0}}, "mapping.ridges"),
        ({"mapping": {"ridge": -1.0}}, "mapping.ridge"),
        ({"mapping": {"ridge": "much"}}, "mapping.ridge"),
        ({"mapping": {"scale": 2.0}, "ik": {"damping": 0.0}}, "ik.damping"),
        ({"ik": {"solver": "abacus"}}, "ik.solver"),
        ({"ik": {"max_iterations": 1000}}, "ik.max_iterations"),
        ({"mapping": {"residual_gain": 1.0, "pivot": "point"}}, "mapping"),
    ],
)
def test_options_that_cannot_be_change_nothing(changes: dict[str, Any], field: str) -> None:
    session, sample = make_session(), Sampler()
    follow(session, sample, 0.0)
    before = session.state(1, "", 0, 0.0).about
    with pytest.raises(RefusedError) as raised:
        session.configure(change(**changes))
    assert raised.value.field.startswith(field)
    assert session.state(1, "", 0, 0.0).about == before


def test_with_an_acceleration_limit_a_held_robot_sets_out_from_standstill() -> None:
    limit = 20.0
    session, sample = make_session(ik={"max_acceleration": limit}), Sampler()
    end = follow(session, sample, 0.0)
    session.tick(end + 1.0)
    before = session.posture[0].copy()
    command = session.step(sample(9.0, human_q(2.0)), end + 1.0 + PERIOD)
    # From rest, x = a dt^2 in one sample of the QP's displacement.
    assert (np.abs(np.array(command.q) - before) <= limit * PERIOD**2 + 1e-9).all()


def test_return_to_rest_is_slow_and_ends_there() -> None:
    session, sample = make_session(watchdog=0.1, return_after=0.3, return_speed=0.2), Sampler()
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
    assert session.mode == "hold"


def test_after_a_return_the_next_sample_is_the_reference() -> None:
    session, sample = make_session(watchdog=0.1, return_after=0.0, return_speed=1.0), Sampler()
    now = follow(session, sample, 0.0)
    wrist = session.posture[1]
    for _ in range(400):
        now += 0.01
        session.tick(now)
    # The person is somewhere else entirely; the robot stays at rest, and its wrist where it was.
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


def test_clutch_goes_on_from_where_the_robot_is() -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    session.release()
    session.step(sample(0.0, human_q(1.0)), now + PERIOD)
    before, wrist = session.posture
    session.clutch()
    command = session.step(sample(0.0, human_q(3.0), wrist=FAR), now + 2 * PERIOD)
    assert moved_points(session, (before, wrist)) < 1e-3
    assert (speeds(session, before, command, PERIOD) <= 1.0 + 1e-6).all()


def test_reset_goes_to_rest_within_the_limits() -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    session.reset(RESET)
    flags = []
    for _ in range(120):
        now += PERIOD
        flags.append(session.step(sample(0.0, human_q(2.0)), now).flags)
    assert "slewing" in flags[0]
    assert "slewing" not in flags[-1]
    assert np.allclose(session.posture[0], session.robot.rest, atol=1e-3)


def test_reset_to_where_the_robot_is_said_to_be_starts_there() -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    there = session.robot.rest + 0.1
    session.reset(msgspec.structs.replace(RESET, robot_q=tuple(there)))
    command = session.step(sample(0.0, human_q(2.0)), now + PERIOD)
    assert command.restarts == 1
    assert (speeds(session, there, command, PERIOD) <= 1.0 + 1e-6).all()


def test_a_robot_slightly_outside_its_limits_comes_back_within_them() -> None:
    robot = SHELF.robot("three_finger", None, None)
    outside = robot.upper_limits + 0.05
    session, sample = make_session(robot_q=tuple(outside)), Sampler()
    assert np.array_equal(session.posture[0], outside)
    follow(session, sample, 0.0, 30)
    assert (session.posture[0] <= robot.upper_limits).all()


REFUSED = {
    "too few angles": ({"q": [0.0] * 3}, "q"),
    "an angle out of range": ({"q": [9.0] * 20}, "q"),
    "no wrist": ({"wrist": None}, "wrist"),
    "another kind": ({"points": ((0.0, 0.0, 0.0),)}, "q"),
}


@pytest.mark.parametrize(("change", "field"), REFUSED.values(), ids=REFUSED.keys())
def test_a_bad_sample_changes_nothing(change: dict[str, Any], field: str) -> None:
    disturbed, undisturbed = make_session(), make_session()
    sample, other = Sampler(), Sampler()
    for session, sampler in ((disturbed, sample), (undisturbed, other)):
        follow(session, sampler, 0.0)
    with pytest.raises(RefusedError) as raised:
        disturbed.step(sample(0.5, **change), 0.3333)
    assert (raised.value.code, raised.value.field) == ("invalid", field)
    # The time that the bad sample took is not granted twice; far inside the speed limits that changes nothing.
    commands = [session.step(sampler(0.5, human_q(1.95)), 0.34) for session, sampler in ((disturbed, sample), (undisturbed, other))]
    assert np.allclose(commands[0].q, commands[1].q, atol=1e-9)


def test_a_bad_sample_does_not_feed_the_watchdog() -> None:
    session, sample = make_session(watchdog=0.1), Sampler()
    now = follow(session, sample, 0.0)
    with pytest.raises(RefusedError):
        session.step(sample(0.5, [9.0] * 20), now + 0.09)
    assert session.tick(now + 0.11) is not None
    with pytest.raises(RefusedError):
        session.step(sample(0.5, [9.0] * 20), now + 0.12)
    assert session.mode == "hold"


def test_a_failure_inside_the_mapper_leaves_the_robot_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    before = session.posture
    mapper = session._hands.mapper
    with monkeypatch.context() as patched:
        patched.setattr(mapper, "map_step", lambda *_, **__: 1 / 0)
        with pytest.raises(ZeroDivisionError):
            session.step(sample(0.0), now + PERIOD)
    session.step(sample(0.0, human_q(3.0)), now + 2 * PERIOD)
    assert moved_points(session, before) < 1e-3


def test_points_need_no_joint_angles() -> None:
    session, sample = make_session(input="points", robot_wrist=HERE), Sampler()
    human = SHELF.human("right", None)
    motion = [tuple(map(tuple, human.points(human_q(0.1 * i)).tolist())) for i in range(10)]
    commands = [session.step(sample(points=points, wrist=None), i * PERIOD) for i, points in enumerate(motion)]
    assert {command.status for command in commands} <= {"converged", "unreachable", "limited", "unsettled"}
    assert commands[-1].q != commands[0].q


def test_details_hold_every_stage() -> None:
    session, sample = make_session(has_detail=True), Sampler()
    command = session.step(sample(), 0.1)
    assert command.detail is not None
    assert np.allclose(command.detail.motion, np.eye(4), atol=1e-9)
    assert len(command.detail.targets) == len(command.detail.points) == len(session.robot.reference_points)
    assert command.detail.human_q == pytest.approx(tuple(human_q()))


def test_a_fixed_wrist_is_told_and_not_taken() -> None:
    session, sample = make_session(mount="fixed", mapping={"rigid_from": "none"}), Sampler()
    command = session.step(sample(), 0.1)
    assert command.wrist is not None
    with pytest.raises(RefusedError) as raised:
        session.reset(msgspec.structs.replace(RESET, robot_wrist=HERE))
    assert raised.value.field == "robot_wrist"


OPENINGS = {
    "unknown robot": ({"robot": "nobody"}, "robot"),
    "a path": ({"robot": "/etc/passwd"}, "robot"),
    "a human": ({"robot": "human"}, "robot"),
    "unknown set of points": ({"robot_points": "none"}, "robot"),
    "unknown option": ({"mapping": {"ridg": 1.0}}, "mapping.ridg"),
    "option of another type": ({"mapping": {"ridge": "much"}}, "mapping.ridge"),
    "option out of range": ({"mapping": {"ridge": -1.0}}, "mapping.ridge"),
    "options that contradict": ({"mapping": {"pivot": "point"}}, "mapping"),
    "endless iterations": ({"ik": {"max_iterations": 10**9}}, "ik.max_iterations"),
    "a solver of choice": ({"ik": {"solver": "os"}}, "ik.solver"),
    "too few angles": ({"robot_q": (0.0,)}, "robot_q"),
    "angles far outside": ({"robot_q": (9.0,) * 8}, "robot_q[2]"),
    "lengths twice": ({"hand_length": 0.19, "lengths": msgspec.UNSET}, "lengths"),
}


@pytest.mark.parametrize(("choices", "field"), OPENINGS.values(), ids=OPENINGS.keys())
def test_what_cannot_be_opened_is_refused_by_field(choices: dict[str, Any], field: str) -> None:
    with pytest.raises(RefusedError) as raised:
        make_session(**choices)
    assert raised.value.field == field
    assert "/work" not in str(raised.value)
