"""Sessions of landmarks: the hand is measured first, and implausible landmarks are rejected."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from person_cases import worn
from service_tools import (
    CACHE,
    PERIOD,
    RESET,
    Sampler,
    accelerations,
    follow,
    human_q,
    make_session,
    opening,
    run_now,
)

from handmap_qp import load_hand
from handmap_qp.apps.service.opening import (
    CALIBRATION_SAMPLES,
    Hands,
    prepare_hands,
)
from handmap_qp.apps.service.session import Session
from handmap_qp.client.messages import PROTOCOL, Command, Configure
from handmap_qp.errors import RefusedError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.trackers.formats import read_recording

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

SETTLING_SAMPLES = 10
"""More samples than the guard waits for after a fault."""


def landmarks_of(
    scale: float = 1.0, phase: float = 0.0
) -> tuple[tuple[float, ...], ...]:
    """Return landmarks of the model's hand [m], multiplied by a scale."""
    points = CACHE.human("right", "landmarks").points(human_q(phase), np.eye(4))
    return tuple(map(tuple, (scale * points).tolist()))


def test_options_changed_while_the_hand_is_measured_hold_afterwards() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    session.configure(Configure(protocol=PROTOCOL, seq=99, mapping={"ridge": 0.4}))
    for i in range(40):
        session.step(sample(PERIOD * i, landmarks=landmarks_of()), PERIOD * i)
    about = session.state(1, "", 0, 0.0).about
    assert session.mode == "following"
    assert about is not None
    assert about.mapping["ridge"] == 0.4
    assert about.lengths is not None
    # The landmarks were made from the model's hand.
    own = HumanLengths.from_urdf(CACHE.human("right", None).urdf_text)
    np.testing.assert_allclose(about.lengths.segments, own.segments, atol=1e-6)


def test_landmarks_are_measured_first_and_then_mapped(recordings: Any) -> None:
    recording = read_recording(sorted(recordings.glob("*_right.npz"))[0])
    seen = np.flatnonzero(recording.valid)[:50]
    session, sample = make_session(input="landmarks", has_detail=True), Sampler()
    commands = []
    for i, k in enumerate(seen):
        landmarks = tuple(map(tuple, recording.landmarks[k].tolist()))
        commands.append(
            session.step(sample(i * PERIOD, landmarks=landmarks), i * PERIOD)
        )
    states = [command.status for command in commands]
    assert states[:30] == ["calibrating"] * 30
    assert "calibrating" not in states[31:]
    assert all(command.q == tuple(session.robot.rest) for command in commands[:30])
    assert commands[-1].detail is not None
    assert {len(each.detail.held_by) for each in commands if each.detail} <= {0, 2}


def test_landmarks_that_are_no_hand_are_refused_at_once_and_the_session_is_as_it_was() -> (
    None
):
    session, sample = make_session(input="landmarks"), Sampler()
    good = CALIBRATION_SAMPLES // 2
    for i in range(good):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    before = session.record, session.mode
    for scale in (0.1, 1000.0):
        with pytest.raises(RefusedError, match="expected metres") as raised:
            session.step(sample(1.0 + scale, landmarks=landmarks_of(scale)), 1.0)
        assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    assert (session.record, session.mode) == before
    # The watchdog ignores them, and the samples collected before still count.
    assert session.tick(good * PERIOD + session.request.watchdog) is not None
    for i in range(good, CALIBRATION_SAMPLES + SETTLING_SAMPLES):
        session.step(
            sample(2.0 + i * PERIOD, landmarks=landmarks_of()), 2.0 + i * PERIOD
        )
    assert session.mode == "following"


def test_samples_without_a_hand_do_not_count_in_the_measurement() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    lost: list[dict[str, Any]] = [
        {"landmarks": landmarks_of(0.0)},
        {"landmarks": None, "valid": False},
        {"landmarks": landmarks_of(), "confidence": 0.0},
    ]
    rules = []
    for i in range(2 * CALIBRATION_SAMPLES + 30):
        seen: dict[str, Any] = {"landmarks": landmarks_of(phase=1e-3 * i)}
        human = lost[i // 2 % 3] if i < 20 else seen
        command = session.step(sample(i * PERIOD, **human), i * PERIOD)
        rules.append(command.rule)
        if i < 20:
            assert (command.status, command.flags) == ("calibrating", (command.rule,))
    assert rules[:6] == ["zero", "zero", "missing", "missing", "missing", "missing"]
    assert session.mode == "following"
    about = session.state(1, "", 0, 0.0).about
    assert about is not None
    assert about.lengths is not None
    own = HumanLengths.from_urdf(CACHE.human("right", None).urdf_text)
    np.testing.assert_allclose(about.lengths.segments, own.segments, atol=1e-6)


@pytest.mark.parametrize("mode", ["stopped", "not_following"])
def test_a_lost_hand_does_not_hide_that_the_robot_is_halted(mode: str) -> None:
    session = make_session(input="landmarks", hand_length=0.19)
    sample = Sampler()
    for i in range(CALIBRATION_SAMPLES):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    assert session.mode == "following"
    if mode == "stopped":
        session.stop()
    else:
        session._measured = session._commanded.q
        session._lose()
    for i in range(CALIBRATION_SAMPLES, CALIBRATION_SAMPLES + 5):
        command = session.step(sample(i * PERIOD, valid=False), i * PERIOD)
        # Drivers take the torque away by this word, and give it to the motors of a robot that
        # only holds.
        assert command.status == mode
        assert "missing" in command.flags


def test_a_known_hand_needs_no_measuring() -> None:
    request = opening(input="landmarks", hand_length=0.19)
    hands: Hands = prepare_hands(request, CACHE, defer=run_now)
    assert hands.calibration is None
    assert hands.lengths is not None
    session = Session(request, hands, "test", 0.0)
    landmarks = hands.mapper.human.with_points("landmarks").points(human_q())
    command = session.step(
        Sampler()(landmarks=tuple(map(tuple, landmarks.tolist()))), 0.1
    )
    assert command.status != "calibrating"


TURN = 0.005
"""Time between two looks of the watchdog [s]."""
ACCELERATION_LIMIT = 20.0
"""Limit of the sessions that measure a hand while the robot moves [rad/s^2]."""


def restored_while_moving(
    limit: float, **choices: Any
) -> tuple[Session, list[Command]]:
    """Restore a session that measures the hand, and whose robot moves.

    Args:
        limit: Acceleration limit of both sessions [rad/s^2].
        choices: Further choices of the request.

    Returns:
        The session, and the last two commands of the former one.
    """
    ik = {"max_acceleration": limit}
    former, sample = make_session(ik=ik), Sampler()
    now = follow(former, sample, 0.0, 30)
    commands = []
    for _ in range(5):
        now += PERIOD
        commands.append(former.step(sample(now, human_q(4.5)), now))
    assert np.abs(former.motion.velocity[former.robot.joint_columns]).max() > 0.5
    request = opening(input="landmarks", ik=ik, **choices)
    hands = prepare_hands(request, CACHE, defer=run_now)
    session = Session(
        request, hands, "test", now, former=former.record, motion=former.motion
    )
    return session, commands[-2:]


def run_turns(
    session: Session, start: float, turns: int, period: int, **human: Any
) -> list[Command]:
    """Let the watchdog look in every turn, after the sample if one arrives.

    Args:
        session: The session.
        start: Time before the first turn [s].
        turns: Number of turns.
        period: Turns from sample to sample; 0 for no samples.
        human: Fields of the samples; landmarks of a hand that moves if omitted.

    Returns:
        The commands of samples and watchdog.
    """
    sample, commands = Sampler(), []
    for turn in range(1, turns + 1):
        now = start + turn * TURN
        if period and turn % period == 0:
            seen = human or {"landmarks": landmarks_of(phase=2.0 * (now - start))}
            commands.append(session.step(sample(now, **seen), now))
        if (command := session.tick(now + 0.5 * TURN)) is not None:
            commands.append(command)
    return commands


def assert_brakes_within(commands: list[Command], limit: float) -> None:
    """Assert that no command breaks an acceleration limit [rad/s^2]."""
    assert np.abs(accelerations(commands)).max() <= limit * (1.0 + 1e-6)


@pytest.mark.parametrize("period", [1, 3])
@pytest.mark.parametrize("limit", [5.0, ACCELERATION_LIMIT])
def test_a_robot_that_moves_brakes_while_the_hand_is_measured_and_is_then_led(
    limit: float, period: int
) -> None:
    session, commands = restored_while_moving(limit)
    start = commands[-1].server_time
    commands += run_turns(session, start, 4 * period * CALIBRATION_SAMPLES, period)
    states = [command.status for command in commands[2:]]
    assert states[0] == "calibrating"
    assert session.mode == "following"
    assert "calibrating" not in states[-2 * CALIBRATION_SAMPLES :]
    assert session.counts["steps"] > CALIBRATION_SAMPLES
    assert_brakes_within(commands, limit)


@pytest.mark.parametrize("cause", ["lost", "release", "stop"])
def test_a_robot_that_moves_brakes_whatever_keeps_the_hand_from_being_measured(
    cause: str,
) -> None:
    session, commands = restored_while_moving(ACCELERATION_LIMIT)
    start = commands[-1].server_time
    if cause == "release":
        session.release()
    if cause == "stop":
        session.stop()
    human = {"landmarks": None, "valid": False} if cause == "lost" else {}
    # Fewer samples than the measurement needs.
    turns = 2 * (CALIBRATION_SAMPLES - 1)
    commands += run_turns(session, start, turns, 2, **human)
    assert_brakes_within(commands, ACCELERATION_LIMIT)
    assert not session.motion.is_braking


def test_a_robot_on_its_way_to_rest_brakes_when_the_hand_is_measured() -> None:
    session, commands = restored_while_moving(
        ACCELERATION_LIMIT, watchdog=0.1, return_after=0.1, return_speed=1.0
    )
    session.step(
        Sampler()(landmarks=landmarks_of()), start := commands[-1].server_time + TURN
    )
    commands = run_turns(session, start, 60, 0)
    assert session.mode == "returning"
    assert session.motion.is_braking
    commands += run_turns(session, start + 60 * TURN, CALIBRATION_SAMPLES - 2, 1)
    assert session.mode == "calibrating"
    assert_brakes_within(commands, ACCELERATION_LIMIT)
    assert not session.motion.is_braking


@pytest.mark.parametrize("hand_length", [None, 0.19], ids=["unknown", "known"])
@pytest.mark.parametrize("period", [1, 3])
def test_samples_without_a_hand_do_not_interrupt_a_return_to_rest(
    period: int, hand_length: float | None
) -> None:
    durations = []
    for each in (0, period):
        session, commands = restored_while_moving(
            ACCELERATION_LIMIT,
            watchdog=0.1,
            return_after=0.1,
            return_speed=0.5,
            hand_length=hand_length,
        )
        start = commands[-1].server_time + TURN
        commands.append(session.step(Sampler()(landmarks=landmarks_of()), start))
        commands += run_turns(session, start, 300, each, landmarks=None, valid=False)
        assert_brakes_within(commands, ACCELERATION_LIMIT)
        assert np.array_equal(session.posture[0], session.robot.rest)
        at_rest = [command.q == tuple(session.robot.rest) for command in commands]
        durations.append(commands[at_rest.index(True)].server_time - start)
    without, with_samples = durations
    # The samples divide the way into more commands.
    assert with_samples <= 1.1 * without


def reset_while_measuring(**choices: Any) -> tuple[Session, list[Command]]:
    """Reset a session that measures the hand, whose robot stands away from its rest posture.

    Args:
        choices: Further choices of the request that opened it.

    Returns:
        The session, and the last command before the reset.
    """
    session, _ = restored_while_moving(ACCELERATION_LIMIT, **choices)
    commands = run_turns(session, 10.0, 10, 1)
    assert session.mode == "calibrating"
    assert not session.motion.is_braking
    assert distance_to_rest(session) > 0.2
    session.reset(RESET, commands[-1].server_time)
    return session, commands[-1:]


def distance_to_rest(session: Session) -> float:
    """Return the largest distance of a joint from its rest angle [rad]."""
    return float(np.abs(session.posture[0] - session.robot.rest).max())


def test_a_reset_while_the_hand_is_measured_moves_the_robot_to_rest() -> None:
    session, commands = reset_while_measuring()
    # Samples at 33 Hz, so that the robot arrives before the hand is measured.
    commands += run_turns(session, commands[-1].server_time, 6 * 19, 6)
    assert {command.status for command in commands[1:]} == {"calibrating"}
    assert "slewing" in commands[1].flags
    assert "slewing" not in commands[-1].flags
    assert commands[-1].q == tuple(session.robot.rest)
    assert_brakes_within(commands, ACCELERATION_LIMIT)


def test_a_hand_that_is_measured_on_the_way_to_rest_leads_from_there() -> None:
    session, commands = reset_while_measuring()
    still = landmarks_of()
    commands += run_turns(session, commands[-1].server_time, 300, 1, landmarks=still)
    on_the_way = [command for command in commands if "slewing" in command.flags]
    assert {command.status for command in on_the_way} > {"calibrating"}
    # The first sample is the reference: a hand that stays there leads to rest.
    assert on_the_way[-1] is not commands[-1]
    assert distance_to_rest(session) < 0.02
    assert_brakes_within(commands, ACCELERATION_LIMIT)


@pytest.mark.parametrize("end", ["release", "stop", "engage", "silence"])
def test_what_ends_a_way_to_rest_also_ends_it_while_the_hand_is_measured(
    end: str,
) -> None:
    session, commands = reset_while_measuring(watchdog=0.1, resume="engage")
    commands += run_turns(session, commands[-1].server_time, 5, 1)
    if end == "release":
        session.release()
    if end == "stop":
        session.stop(1)
    if end == "engage":
        session.clutch()
    if end == "silence":
        commands += run_turns(session, commands[-1].server_time, 60, 0)
        assert session.mode == "hold"
    commands += run_turns(session, commands[-1].server_time, 5, 1)
    before = session.posture[0]
    assert distance_to_rest(session) > 0.1
    if end == "stop":
        session.clear(1)
    session.clutch()
    commands += run_turns(session, commands[-1].server_time, 5, 1)
    assert_brakes_within(commands, ACCELERATION_LIMIT)
    np.testing.assert_array_equal(session.posture[0], before)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1000.0, 5.0, 0.1], ids=["mm", "picture", "tiny"])
def test_a_hand_in_other_units_is_not_measured_and_one_in_metres_is_thereafter(
    scale: float,
) -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    for i in range(CALIBRATION_SAMPLES):
        with pytest.raises(RefusedError, match="expected metres") as raised:
            session.step(sample(i * PERIOD, landmarks=landmarks_of(scale)), i * PERIOD)
        assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    assert session.mode == "waiting"
    for i in range(CALIBRATION_SAMPLES, 4 * CALIBRATION_SAMPLES):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    assert session.mode == "following"


@pytest.mark.slow
@pytest.mark.parametrize("is_known", [True, False], ids=["known", "measured"])
@pytest.mark.parametrize("scale", [1000.0, 2.5, 0.3], ids=["mm", "large", "small"])
def test_a_hand_of_another_size_is_not_mapped(scale: float, is_known: bool) -> None:
    lengths: dict[str, Any] = {"hand_length": 0.19} if is_known else {}
    session, sample = make_session(input="landmarks", **lengths), Sampler()
    for i in range(CALIBRATION_SAMPLES + 3):
        session.step(sample(i * PERIOD, landmarks=landmarks_of()), i * PERIOD)
    before, counts = session.posture[0].copy(), session.counts["steps"]
    with pytest.raises(RefusedError, match="expected metres") as raised:
        session.step(sample(0.9, landmarks=landmarks_of(scale, 1.0)), 0.9)
    assert (raised.value.code, raised.value.field) == ("invalid", "landmarks")
    np.testing.assert_array_equal(session.posture[0], before)
    times = [1.0 + i * PERIOD for i in range(SETTLING_SAMPLES)]
    commands = [
        session.step(sample(time, landmarks=landmarks_of()), time) for time in times
    ]
    assert commands[-1].status == "converged"
    assert session.counts["steps"] > counts


def test_a_release_during_the_measurement_holds_after_it() -> None:
    session, sample = make_session(input="landmarks"), Sampler()
    session.step(sample(0.0, landmarks=landmarks_of()), 0.0)
    session.release()
    before = session.posture[0].copy()
    commands = [
        session.step(
            sample(i * PERIOD, landmarks=landmarks_of(phase=0.05 * i)), i * PERIOD
        )
        for i in range(1, CALIBRATION_SAMPLES + 10)
    ]
    assert commands[-1].status == "released"
    session.clutch()
    now = (CALIBRATION_SAMPLES + 10) * PERIOD
    command = session.step(sample(now, landmarks=landmarks_of(phase=0.05 * 30)), now)
    # The reference is this sample, so the robot has nowhere to go.
    assert "slewing" not in command.flags
    np.testing.assert_allclose(session.posture[0], before, atol=1e-3)


def test_touches_correct_the_contact_gap_of_a_session() -> None:
    record = worn(600, gap=0.019)
    session, sample = make_session(**TELEOPERATION, hand_length=0.18), Sampler()
    gaps, last = [], np.array(session.robot.rest)
    for time, points in zip(record.time.tolist(), record.landmarks, strict=True):
        landmarks = tuple(map(tuple, points.tolist()))
        command = session.step(sample(time, landmarks=landmarks), time)
        step = np.abs(np.array(command.q) - last) / session.robot.velocity_limits
        assert step.max() <= PERIOD * (1.0 + 1e-6) or time == 0.0
        last = np.array(command.q)
        gaps.append(contact_gap_of(session))
    assert gaps[0] == 0.013
    assert gaps[-1] == pytest.approx(0.014)
    assert len(set(gaps)) == 2


@pytest.mark.parametrize(
    "given", [{"contact_gap": 0.013}, {"teleoperation": {"contact_gap": 0.013}}]
)
def test_a_contact_gap_that_is_given_is_not_measured(given: dict[str, Any]) -> None:
    session = make_session(**TELEOPERATION, hand_length=0.18, **given)
    assert contact_gap_of(session) == 0.013
    assert session._hands.gap_meter is None


TELEOPERATION: dict[str, Any] = {
    "input": "landmarks",
    "robot": "allegro_right",
    "preset": "teleoperation",
}


def contact_gap_of(session: Session) -> float:
    options = session._hands.choice.method
    assert isinstance(options, Teleoperation)
    return options.contact_gap


@pytest.mark.parametrize(
    ("time_from", "is_found"), [("server", True), ("client", False)]
)
def test_stamps_that_run_faster_than_samples_arrive_are_named_on_the_servers_clock(
    time_from: str, is_found: bool
) -> None:
    session = make_session(input="landmarks", hand_length=0.19, time_from=time_from)
    sample, person = Sampler(), HumanLengths.from_hand_length(0.19)
    human = load_hand("human", points="landmarks", lengths=person)
    rules = []
    for i in range(150):
        points = human.points(
            human.rest + 0.1 * np.sin(0.1 * i) * (human.upper_limits - human.rest)
        )
        landmarks = tuple(map(tuple, points.tolist()))
        rules.append(
            session.step(sample(2.0 * i * PERIOD, landmarks=landmarks), i * PERIOD).rule
        )
    assert set(rules) == ({"", "time"} if is_found else {""})
    if is_found:
        assert 0.5 < rules.index("time") * PERIOD < 1.6
        assert rules[-1] == "time"
