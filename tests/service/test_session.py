"""A session: its commands under any input. The test sets the clock."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from marks import rotated
from service_tools import (
    CACHE,
    HERE,
    PERIOD,
    RESET,
    Sampler,
    change,
    follow,
    human_q,
    make_session,
    moved_points,
    speeds,
)

from handmap_qp import load_hand
from handmap_qp.client.messages import Configure, Pose
from handmap_qp.errors import InvalidInputError, RefusedError
from handmap_qp.mapping import fist_time

FAR = Pose((5.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))


# Events and the time since the last one: samples with any time stamps, requests, silence.
events = st.lists(
    st.tuples(
        st.sampled_from(
            ["step", "step", "step", "tick", "clutch", "release", "reset", "configure"]
        ),
        st.floats(min_value=1e-4, max_value=0.6),
        st.floats(min_value=-1e9, max_value=1e9),
        st.floats(min_value=-3.0, max_value=3.0),
    ),
    max_size=25,
)


def changes_for(choices: dict[str, Any], phase: float) -> Configure:
    """Return other options of the paper's preset, or another preset."""
    if "preset" in choices:
        presets = ("teleoperation", "object", "paper")
        return change(preset=presets[int(abs(phase)) % 3], ik=choices.get("ik", {}))
    reference = "previous" if phase < 0.0 else "first"
    return change(mapping={"scale": abs(phase), "reference": reference})


@pytest.mark.parametrize(
    "choices",
    rotated(
        [
            {},
            {"ik": {"has_velocity_limits": False}},
            {"return_after": 0.1, "resume": "clutch"},
            {"preset": "teleoperation"},
            {
                "preset": "teleoperation",
                "ik": {"has_velocity_limits": False},
                "return_after": 0.1,
            },
        ],
        2,
    ),
    ids=str,
)
@given(events=events)
def test_joints_keep_their_speed_limits_whatever_comes(
    choices: dict[str, Any], events: list[Any]
) -> None:
    session, sample, now = make_session(**choices), Sampler(), 0.0
    last, moved_at = session.posture[0].copy(), 0.0
    for kind, wait, stamp, phase in events:
        now += wait
        if kind == "reset":
            session.reset(RESET, now)
        elif kind == "configure":
            session.configure(changes_for(choices, phase))
        elif kind in ("clutch", "release"):
            getattr(session, kind)()
        command = (
            session.step(sample(stamp, human_q(phase)), now)
            if kind == "step"
            else session.tick(now)
        )
        if command is not None:
            # Exact up to rounding. No command accounts for more time than has passed, or max_dt.
            assert (
                speeds(session, last, command, min(now - moved_at, 1.0 / 30.0))
                <= 1.0 + 1e-6
            ).all()
            last, moved_at = np.array(command.q), now
        assert np.array_equal(session.posture[0], last)


def test_a_burst_of_samples_moves_no_farther_than_time_allows() -> None:
    session, sample = make_session(), Sampler()
    session.step(sample(0.0, human_q(0.0)), 0.0)
    start = session.posture[0].copy()
    for i in range(50):
        # The time stamps are 1 s apart; the samples arrive within 1 ms.
        session.step(sample(1.0 + i, human_q(1.5)), 1e-5 + 2e-5 * i)
    moved = np.abs(session.posture[0] - start)
    assert (moved <= session.robot.velocity_limits * 1.1e-3).all()


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
    session.reset(RESET, now)
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
    there, epoch = session.robot.rest + 0.1, session.record.epoch
    session.reset(msgspec.structs.replace(RESET, robot_q=tuple(there)), now)
    command = session.step(sample(0.0, human_q(2.0)), now + PERIOD)
    assert command.epoch > epoch
    assert (speeds(session, there, command, PERIOD) <= 1.0 + 1e-6).all()


def test_a_robot_slightly_outside_its_limits_comes_back_within_them() -> None:
    robot = CACHE.robot("three_finger", None, None)
    outside = robot.upper_limits + 0.05
    session, sample = make_session(robot_q=tuple(outside)), Sampler()
    assert np.array_equal(session.posture[0], outside)
    follow(session, sample, 0.0, 30)
    assert (session.posture[0] <= robot.upper_limits).all()


REFUSED = {
    "too few angles": ({"q": [0.0] * 3}, "q"),
    "an angle out of range": ({"q": [9.0] * 20}, "q[8]"),
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
    # The time of the bad sample is not granted again, which has no effect far inside the limits.
    commands = [
        session.step(sampler(0.5, human_q(1.95)), 0.34)
        for session, sampler in ((disturbed, sample), (undisturbed, other))
    ]
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


def test_a_failure_inside_the_mapper_leaves_the_robot_where_it_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
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


def test_a_sample_that_fails_half_way_does_not_make_the_robot_jump(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session, sample = make_session(), Sampler()
    now = follow(session, sample, 0.0)
    before, mapper = session.posture[0].copy(), session._hands.mapper
    mapped = mapper.map_step

    def refused(*arguments: Any, **choices: Any) -> None:
        mapped(*arguments, **choices)
        raise InvalidInputError(argument="human_q", problem="refused late")

    with monkeypatch.context() as patched:
        patched.setattr(mapper, "map_step", refused)
        for _ in range(5):
            with pytest.raises(RefusedError):
                session.step(sample(0.0, human_q(3.0)), now := now + PERIOD)
    command = session.step(sample(0.0, human_q(3.0)), now := now + PERIOD)
    assert (speeds(session, before, command, PERIOD) <= 1.0 + 1e-6).all()


def test_points_need_no_joint_angles() -> None:
    session, sample = make_session(input="points", robot_wrist=HERE), Sampler()
    human = CACHE.human("right", None)
    motion = [
        tuple(map(tuple, human.points(human_q(0.1 * i)).tolist())) for i in range(10)
    ]
    commands = [
        session.step(sample(points=points, wrist=None), i * PERIOD)
        for i, points in enumerate(motion)
    ]
    assert {command.status for command in commands} <= {
        "converged",
        "unreachable",
        "limited",
        "unsettled",
    }
    assert commands[-1].q != commands[0].q


def test_details_hold_every_stage() -> None:
    session, sample = make_session(has_detail=True), Sampler()
    command = session.step(sample(), 0.1)
    assert command.detail is not None
    assert np.allclose(command.detail.motion, np.eye(4), atol=1e-9)
    assert (
        len(command.detail.targets)
        == len(command.detail.points)
        == len(session.robot.reference_points)
    )
    assert command.detail.human_q == pytest.approx(tuple(human_q()))


@pytest.mark.parametrize(
    ("robot", "is_slow"), [("svh_right", True), ("three_finger", False)]
)
def test_a_session_says_how_long_its_robot_takes_for_a_fist(
    robot: str, is_slow: bool
) -> None:
    """Whatever the person, the kind of samples and the points: it is the hand's own time."""
    told = []
    different: list[dict[str, Any]] = [
        {},
        {"hand_length": 0.22, "input": "landmarks"},
        {"human_points": "fingertips_middle", "preset": "object"},
    ]
    for choices in different:
        session = make_session(robot=robot, **choices)
        opened = session.opened(1, 0)
        assert opened.fist == session.state(2, "0", 0, 0.0).fist
        told.append(opened.fist)
    expected = fist_time(load_hand("human"), load_hand(robot))
    assert told[0] is not None
    assert told[0].time == pytest.approx(expected.time)
    assert told[0].joint == expected.joint
    assert told[0].is_slow is is_slow
    assert told == told[:1] * 3


def test_answers_of_servers_that_do_not_know_the_fist_are_read() -> None:
    session = make_session()
    for reply in (session.opened(1, 0), session.state(2, "0", 0, 0.0)):
        sent = msgspec.to_builtins(reply)
        assert sent["fist"]["joint"] in session.robot.joint_names
        former = {name: value for name, value in sent.items() if name != "fist"}
        assert msgspec.convert(former, type(reply)).fist is None
        read = msgspec.json.decode(msgspec.json.encode(reply), type=type(reply))
        assert read.fist == reply.fist


def test_a_fixed_wrist_is_told_and_not_taken() -> None:
    session, sample = (
        make_session(mount="fixed", mapping={"rigid_from": "none"}),
        Sampler(),
    )
    command = session.step(sample(), 0.1)
    assert command.wrist is not None
    with pytest.raises(RefusedError) as raised:
        session.reset(msgspec.structs.replace(RESET, robot_wrist=HERE), 0.1)
    assert raised.value.field == "robot_wrist"


OPENINGS = {
    "unknown robot": ({"robot": "nobody"}, "robot"),
    "a path": ({"robot": "/etc/passwd"}, "robot"),
    "a human": ({"robot": "human"}, "robot"),
    "unknown set of points": ({"robot_points": "none"}, "robot"),
    "unknown option": ({"mapping": {"ridg": 1.0}}, "options.ridg"),
    "option of another type": ({"mapping": {"ridge": "much"}}, "options.ridge"),
    "option out of range": ({"mapping": {"ridge": -1.0}}, "options.ridge"),
    "options that contradict": ({"mapping": {"pivot": "point"}}, "options.pivot_point"),
    "endless iterations": ({"ik": {"max_iterations": 10**9}}, "ik.max_iterations"),
    "a solver of choice": ({"ik": {"solver": "os"}}, "ik.solver"),
    "too few angles": ({"robot_q": (0.0,)}, "robot_q"),
    "angles far outside": ({"robot_q": (9.0,) * 8}, "robot_q[2]"),
    "lengths twice": ({"hand_length": 0.19, "lengths": msgspec.UNSET}, "lengths"),
}


@pytest.mark.parametrize(("choices", "field"), OPENINGS.values(), ids=OPENINGS.keys())
def test_what_cannot_be_opened_is_refused_by_field(
    choices: dict[str, Any], field: str
) -> None:
    with pytest.raises(RefusedError) as raised:
        make_session(**choices)
    assert raised.value.field == field
    assert "/work" not in str(raised.value)


@pytest.mark.parametrize("choices", [{}, {"preset": "teleoperation"}], ids=str)
def test_the_posture_of_a_session_is_that_of_its_motion(
    choices: dict[str, Any],
) -> None:
    session = make_session(**choices)
    sample = Sampler()
    for i in range(10):
        follow(session, sample, i * 20 * PERIOD)
        q, wrist = session.posture
        placed = session.robot.configuration()
        placed.place(session.motion.q)
        np.testing.assert_array_equal(q, session.motion.q[session.robot.q_indices])
        assert wrist is not None
        np.testing.assert_allclose(wrist, placed.wrist.homogeneous, atol=1e-12)
        # Reading the motion changes nothing.
        np.testing.assert_array_equal(q, session.posture[0])


def test_a_robot_moves_as_its_mapper_until_something_else_moves_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    session, sample = make_session(preset="teleoperation"), Sampler()
    now = follow(session, sample, 0.0)
    mapper = session._hands.mapper
    gate = mapper.point_ik.gate
    assert session._commanded.moves_as(gate)
    moved: list[Any] = []
    monkeypatch.setattr(mapper, "_was_moved", lambda: moved.append(mapper))
    # Other options do not move the robot.
    session.configure(change(ik={"rest_weight": 0.1}))
    now = follow(session, sample, now + PERIOD)
    assert not moved
    session._commanded.brake(PERIOD)
    assert not session._commanded.moves_as(gate)
    follow(session, sample, now + PERIOD)
    assert len(moved) == 1
