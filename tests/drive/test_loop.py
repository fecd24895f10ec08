"""The loop between a session and motors, with motors that are a list."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import get_args
from unittest.mock import Mock, patch

import numpy as np
import pytest
from handmap_drive.drive import (
    HEARTBEAT,
    HOLDING,
    LOST,
    SILENCE,
    UNANSWERED,
    UNREAD,
    Change,
    Loop,
    State,
    next_state,
)
from handmap_drive.driver import DriverError, Health
from handmap_drive.gate import APPROACH
from handmap_drive.recorder import Recorder

from handmap_core.client.messages import Error
from handmap_qp.apps.datasets.robot_log import read_robot_log
from handmap_qp.client import Command
from handmap_qp.errors import InvalidInputError

NAMES = ("b", "a")
"""The motors' order is another one than that of the commands."""
EFFORT = 0.4


class Motors:
    """Motors that are where they are told to be, and remember everything."""

    joint_names: tuple[str, ...] = NAMES
    range = np.array([[-1.0, -1.0], [1.0, 2.0]])
    rate = 100.0
    speed = 5.0
    effort = EFFORT

    def __init__(self) -> None:
        self.q = np.array([0.1, -0.1])
        self.written: list[np.ndarray] = []
        self.efforts: list[float] = []
        self.health = Health(np.array([30, 40]), ())
        self.is_silent = False
        self.has_torque = False

    def connect(self) -> None: ...

    def read(self) -> tuple[np.ndarray, np.ndarray, Health]:
        if self.is_silent:
            raise DriverError("motor 1: no answer")
        return self.q, np.zeros(2), self.health

    def write(self, q: np.ndarray, effort: float) -> None:
        self.q, self.has_torque = q, True
        self.written.append(q)
        self.efforts.append(effort)

    def stop(self) -> None:
        self.has_torque = False


def command(a: float = 0.0, b: float = 0.0, **more: object) -> Command:
    fields: dict[str, object] = {
        "seq": 1,
        "name": "lab",
        "time": 0.0,
        "server_time": 0.0,
        "joint_names": ("a", "b", "arm"),
        "q": (a, b, 9.0),
        "wrist": None,
        "status": "converged",
    }
    return Command(**(fields | more))  # ty: ignore[invalid-argument-type]


class Drive:
    """A loop and its motors, with a clock of its own."""

    def __init__(
        self,
        first: Command,
        motors: Motors | None = None,
        recorder: Recorder | None = None,
    ) -> None:
        self.motors = motors or Motors()
        with patch("handmap_drive.drive.monotonic", return_value=0.0):
            self.loop = Loop(self.motors, first, EFFORT, 60.0, None, recorder)
        self.now = 0.0

    def go(
        self, seconds: float, heard: Command | None = None, held: bool = True
    ) -> None:
        """Let time pass; the same command arrives in every turn, or none."""
        for _ in range(round(100 * seconds)):
            self.now += 0.01
            if heard:
                self.loop.hear(heard, self.now)
            self.loop.turn(self.now, is_held=held)


@pytest.fixture
def drive() -> Drive:
    """Return a loop that has arrived at its command."""
    drive = Drive(command(a=0.2, b=0.5))
    drive.go(3.0, command(a=0.2, b=0.5))
    np.testing.assert_allclose(drive.motors.q, [0.5, 0.2])
    return drive


def test_a_session_that_refuses_is_told_rarely_and_warns_once(
    drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    client = Mock()
    client.measured.return_value = None
    for i in range(3000):
        # The session is shared for a second, not for 15 s, and then again.
        is_denied = 100 <= i < 1600
        refusal = (
            Error(seq=i, code="denied", message="not shared") if is_denied else None
        )
        client.measured.return_value = refusal
        drive.loop._tell(client, drive.now + 0.01 * i)
        if i in (99, 1599):
            told, client.measured.call_count = client.measured.call_count, 0
            assert told == (100 if i == 99 else 2)
    assert 900 <= client.measured.call_count <= 1400
    assert capsys.readouterr().err.count("does not take where the joints are") == 1


def test_other_refusals_do_not_end_what_is_told(
    drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    client = Mock()
    client.measured.return_value = Error(seq=1, code="no_session", message="ended")
    for i in range(100):
        drive.loop._tell(client, drive.now + 0.01 * i)
    assert client.measured.call_count == 100
    assert not capsys.readouterr().err


def test_joints_without_a_motor_are_where_they_are_commanded(drive: Drive) -> None:
    drive.motors.q = np.array([0.4, 0.1])
    drive.go(0.01)
    # In the order of the session: the motors have b before a.
    assert drive.loop.measured == pytest.approx([0.1, 0.4, 9.0], abs=0.1)
    assert drive.loop.measured[2] == 9.0


def speeds(written: list[np.ndarray]) -> np.ndarray:
    return 100.0 * np.abs([after - before for before, after in pairwise(written)])


def test_motors_approach_slowly_from_where_they_are_and_follow_quickly_then() -> None:
    drive = Drive(command(a=0.9))
    start = drive.motors.q
    drive.go(1.0, command(a=0.9, b=0.1))
    first = drive.motors.written
    assert np.abs(first[0] - start).max() <= APPROACH / 100 + 1e-12
    assert speeds(first).max() == pytest.approx(APPROACH)
    # The other one is there from the start, and free.
    drive.go(0.5, command(a=0.9, b=-0.5))
    assert drive.motors.q[0] == -0.5
    assert speeds(drive.motors.written[100:])[:, 1].max() == pytest.approx(APPROACH)
    drive.go(2.0, command(a=0.9))
    count = len(drive.motors.written)
    drive.go(1.0, command(a=-0.9))
    assert speeds(drive.motors.written[count:]).max() == pytest.approx(Motors.speed)
    np.testing.assert_allclose(drive.motors.q, [0.0, -0.9])


def test_slow_motors_approach_no_faster_than_they_can() -> None:
    motors = Motors()
    motors.speed = 0.2
    drive = Drive(command(a=0.9), motors)
    drive.go(1.0, command(a=0.9, b=0.1))
    assert speeds(motors.written).max() == pytest.approx(0.2)


def test_the_way_between_commands_is_even(drive: Drive) -> None:
    count = len(drive.motors.written)
    # Commands at 25 Hz, turns at 100 Hz.
    for i in range(40):
        drive.loop.hear(command(a=0.2 + 0.01 * i, b=0.5), drive.now)
        drive.go(0.04)
    steps = speeds(drive.motors.written[count + 8 :])[:, 1]
    np.testing.assert_allclose(steps, 0.25, rtol=1e-6)


def test_a_turn_takes_its_state_from_one_table() -> None:
    states = {
        State.STOPPED: {"clear": State.APPROACHING},
        State.APPROACHING: {"silence": State.HOLDING, "arrival": State.FOLLOWING},
        State.FOLLOWING: {"silence": State.HOLDING},
        State.HOLDING: {"command": State.APPROACHING},
    }
    assert states.keys() == {*State}
    for state, changes in states.items():
        for change in get_args(Change):
            expected = State.STOPPED if change == "fault" else state
            assert next_state(state, change) is changes.get(change, expected)


def test_the_loop_says_what_it_does(drive: Drive) -> None:
    here = command(a=0.2, b=0.5)
    assert drive.loop.state is State.FOLLOWING
    drive.go(SILENCE + 0.02)
    assert drive.loop.state is State.HOLDING
    drive.go(0.01, here)
    assert drive.loop.state is State.FOLLOWING
    drive.go(0.01, here, held=False)
    assert drive.loop.state is State.STOPPED
    drive.go(0.01, command(a=0.9, b=0.5))
    assert drive.loop.state is State.APPROACHING


def test_a_motor_that_lost_its_torque_is_a_stop_and_an_approach(
    drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    motors, here = drive.motors, command(a=0.2, b=0.5)
    count = len(motors.written)
    # It falls, and the session goes on.
    motors.q = fallen = np.array([0.5, -0.9])
    motors.health = motors.health._replace(unpowered=("a",))
    drive.go(0.01, here)
    assert not motors.has_torque
    assert len(motors.written) == count
    motors.health = motors.health._replace(unpowered=())
    drive.go(1.0, here)
    assert speeds([fallen, *motors.written[count:]]).max() == pytest.approx(APPROACH)
    assert drive.loop.summary()["stops"] == 1
    text = "handmap: stopped: torque lost: a\nhandmap: driving\n"
    assert capsys.readouterr().err == text


def test_a_joint_that_is_where_it_cannot_be_after_a_stop_ends_it(drive: Drive) -> None:
    motors = drive.motors
    count = len(motors.written)
    # An encoder that counts turns has lost them.
    motors.q = np.array([0.5, 0.2 + 2.0 * np.pi])
    motors.health = motors.health._replace(unpowered=("a",))
    with pytest.raises(InvalidInputError, match=r"a: expected .* got 6.48: compare id"):
        drive.go(0.05, command(a=0.2, b=0.5))
    assert len(motors.written) == count


def test_motors_that_were_not_read_keep_their_goals_and_stop_soon(
    drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    motors = drive.motors
    count = len(motors.written)
    motors.is_silent = True
    drive.go(UNREAD - 0.02, command(a=0.9, b=0.5))
    assert len(motors.written) == count
    assert motors.has_torque
    drive.go(0.05, command(a=0.9, b=0.5))
    assert not motors.has_torque
    assert capsys.readouterr().err == "handmap: stopped: the motors do not answer\n"
    # They were reset meanwhile, and fell.
    motors.is_silent = False
    motors.q = fallen = np.array([-0.5, -0.8])
    drive.go(1.0, command(a=0.9, b=0.5))
    way = [fallen, *motors.written[count:]]
    assert speeds(way).max() == pytest.approx(APPROACH)


def test_after_a_jump_of_the_session_motors_approach_slowly(drive: Drive) -> None:
    count = len(drive.motors.written)
    way = [drive.motors.q]
    # The way between the commands of both sides of the jump is none to follow.
    drive.go(0.5, command(a=1.2, b=0.5, epoch=7))
    way += drive.motors.written[count:]
    assert speeds(way).max() == pytest.approx(APPROACH)


def test_a_late_turn_makes_no_large_step(drive: Drive) -> None:
    motors = drive.motors
    drive.go(0.02, command(a=-0.9, b=0.5))
    before = motors.q
    drive.now += LOST - 0.02
    drive.go(0.01, command(a=-0.9, b=0.5))
    # The time of two turns.
    assert np.abs(motors.q - before).max() <= 0.02 * Motors.speed + 1e-12


def test_a_stop_that_changes_its_reason_is_one_stop(drive: Drive) -> None:
    here = command(a=0.2, b=0.5)
    drive.go(0.05, here, held=False)
    drive.go(0.05, command(a=0.2, b=0.5, status="stopped"))
    drive.go(0.05, here, held=False)
    drive.go(0.05, here)
    assert drive.loop.summary()["stops"] == 1


REASONS = {
    "stopped": "the session is stopped",
    "epoch": "the session's robot has jumped",
    "silence": "no command arrives",
    "key": "the dead man's key is not held",
    "late": "this computer was late",
}


@pytest.mark.parametrize("reason", REASONS)
def test_motors_lose_torque_for_each_reason_and_approach_again(
    reason: str, drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    here, motors = command(a=0.2, b=0.5), drive.motors
    changed = command(a=0.2, b=0.5, epoch=7)
    match reason:
        case "stopped":
            drive.go(0.01, command(a=0.2, b=0.5, status="stopped"))
        case "epoch":
            drive.go(0.01, changed)
            here = changed
        case "silence":
            drive.go(LOST + 0.02)
        case "key":
            drive.go(0.01, here, held=False)
        case "late":
            drive.now += LOST
            drive.go(0.01, here)
    assert not motors.has_torque
    assert capsys.readouterr().err == f"handmap: stopped: {REASONS[reason]}\n"
    # The hand sags while it has no torque.
    motors.q = sagged = np.array([-0.5, -0.5])
    count = len(motors.written)
    if reason in ("stopped", "key"):
        drive.go(1.0, command(status="stopped"), held=reason != "key")
        assert len(motors.written) == count
    drive.loop.turn(drive.now, is_held=False)
    drive.go(1.0, here)
    assert motors.has_torque
    way = [sagged, *motors.written[count:]]
    assert speeds(way).max() == pytest.approx(APPROACH)
    assert capsys.readouterr().err.endswith("handmap: driving\n")


def test_late_commands_leave_motors_holding_with_less_torque(drive: Drive) -> None:
    motors = drive.motors
    drive.go(0.1, command(a=0.3, b=0.5))
    assert motors.efforts[-1] == EFFORT
    drive.go(SILENCE + 0.02)
    goal = motors.q
    assert motors.efforts[-1] == HOLDING * EFFORT
    drive.go(0.1)
    np.testing.assert_array_equal(motors.q, goal)
    assert motors.has_torque
    drive.go(0.01, command(a=0.3, b=0.5))
    assert motors.efforts[-1] == EFFORT
    # A session that holds its robot sends less often.
    drive.go(0.01, command(a=0.3, b=0.5, flags=("watchdog",)))
    drive.go(HEARTBEAT)
    assert motors.efforts[-1] == EFFORT
    drive.go(SILENCE + 0.02)
    assert motors.efforts[-1] == HOLDING * EFFORT


def test_one_lost_answer_is_nothing_and_many_end_it(drive: Drive) -> None:
    here = command(a=0.2, b=0.5)
    drive.motors.is_silent = True
    drive.go(0.05, here)
    drive.motors.is_silent = False
    drive.go(0.05, here)
    assert drive.loop.summary()["answers lost"] == 5
    drive.motors.is_silent = True
    with pytest.raises(DriverError, match="motor 1: no answer"):
        drive.go(UNANSWERED + 0.05, here)


def test_the_time_in_which_this_computer_was_late_is_not_the_motors_silence(
    drive: Drive,
) -> None:
    here = command(a=0.2, b=0.5)
    for _ in range(4):
        drive.now += 2.0 * UNANSWERED
        drive.motors.is_silent = True
        drive.go(0.01, here)
        # Motors that were not read for so long may have been reset.
        assert drive.loop.state is State.STOPPED
        drive.motors.is_silent = False
        drive.go(3.0, here)
        assert drive.loop.state is State.FOLLOWING
    assert drive.loop.summary()["answers lost"] == 4


@pytest.mark.parametrize(
    ("health", "text"),
    [
        (Health(np.array([30, 61]), ()), "a: 61 degrees, more than 60"),
        (Health(np.array([30, 30]), ("b: overload",)), "b: overload"),
        (Health(np.array([np.nan, 60.5]), ()), "a: 60.5 degrees, more than 60"),
    ],
)
def test_hot_and_faulty_motors_end_it(health: Health, text: str, drive: Drive) -> None:
    drive.motors.health = health
    with pytest.raises(DriverError, match=text):
        drive.go(0.02, command(a=0.2, b=0.5))
    # Before they get any torque, too.
    motors = Motors()
    motors.health = health
    with pytest.raises(DriverError, match=text):
        Drive(command(), motors)
    assert not motors.written


def test_motors_that_tell_no_temperature_are_driven(drive: Drive) -> None:
    drive.motors.health = Health(np.full(2, np.nan), ())
    drive.go(0.1, command(a=0.2, b=0.5))
    assert drive.motors.has_torque


def test_goals_stay_in_the_range_of_the_motors(
    drive: Drive, capsys: pytest.CaptureFixture[str]
) -> None:
    drive.go(1.0, command(a=2.5, b=-1.5))
    np.testing.assert_array_equal(drive.motors.q, [-1.0, 2.0])
    assert capsys.readouterr().err == (
        "handmap: b: a command of -1.5 rad is beyond the motor's range: it goes to -1\n"
    )


def test_one_lost_answer_at_the_start_is_nothing() -> None:
    motors = Motors()
    answers = iter([DriverError("lost"), DriverError("lost"), motors.read()])
    with patch.object(motors, "read", Mock(side_effect=answers)):
        drive = Drive(command(), motors)
    drive.go(0.1, command())
    assert motors.has_torque


def test_motors_that_are_where_the_hand_cannot_be_are_refused() -> None:
    motors = Motors()
    motors.q = np.array([0.0, 2.3])
    with pytest.raises(InvalidInputError, match=r"a: expected .* got 2.3: compare id"):
        Drive(command(), motors)


def test_a_session_that_moves_another_robot_ends_it(drive: Drive) -> None:
    with pytest.raises(InvalidInputError, match=r"SESSION: expected the robot that"):
        drive.go(0.01, command(joint_names=("a", "c", "arm")))


def test_a_command_that_is_not_a_number_ends_it(drive: Drive) -> None:
    with pytest.raises(InvalidInputError, match=r"SESSION: expected joint angles"):
        drive.go(0.01, command(a=np.nan))
    assert np.isfinite(drive.motors.q).all()


def test_the_summary_is_of_what_was_driven(drive: Drive) -> None:
    rows = drive.loop.summary()
    assert rows["rate [Hz]"] == pytest.approx(100.0)
    assert rows["following error, largest [rad]"] == 0.0
    assert rows["turns"] == len(drive.motors.written)
    assert rows["stops"] == 0


def test_a_log_has_what_joints_did_while_they_followed(tmp_path: Path) -> None:
    recorder = Recorder(NAMES)
    drive = Drive(command(a=0.2, b=0.5), recorder=recorder)
    drive.go(3.0, command(a=0.2, b=0.5))
    # The key is let go, and the way back is an approach.
    drive.go(0.5, command(a=0.2, b=0.5), held=False)
    drive.go(3.0, command(a=0.3, b=0.5))
    recorder.save(tmp_path / "take.npz", "leap", "lift a cup")
    log = read_robot_log(tmp_path / "take.npz")
    assert (log.joint_names, log.robot, log.task) == (NAMES, "leap", "lift a cup")
    # Goals that have arrived: no row is of an approach.
    assert np.abs(log.q - log.action).max() < 0.01
    numbers = np.unique(log.episode)
    assert len(numbers) == 2
    for number, told in zip(numbers, (0.2, 0.3), strict=True):
        own = log.episode == number
        np.testing.assert_allclose(log.action[own][-1], [0.5, told], atol=1e-6)
        assert np.diff(log.time[own]).max() == pytest.approx(0.01)
    # Motors say shares of their torque, and nobody knows how much that is.
    assert not log.known_efforts.any()


def test_a_log_without_a_motion_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    Recorder(NAMES).save(tmp_path / "take.npz", "leap")
    assert "take.npz is not written" in capsys.readouterr().err
    assert not [*tmp_path.iterdir()]


def test_a_log_keeps_what_a_driver_writes_over(tmp_path: Path) -> None:
    """A driver may answer with the same array again and again."""
    recorder = Recorder(NAMES)
    q, effort = np.zeros(2), np.zeros(2)
    for turn in range(3):
        q[:] = effort[:] = turn
        recorder.add(0.01 * turn, q, q, effort)
    recorder.save(tmp_path / "take.npz", "leap")
    log = read_robot_log(tmp_path / "take.npz")
    for column in (log.q, log.action, log.effort):
        np.testing.assert_array_equal(column, np.outer(range(3), np.ones(2)))


def test_a_log_that_cannot_be_written_names_the_option(tmp_path: Path) -> None:
    recorder = Recorder(NAMES)
    for turn in range(2):
        recorder.add(0.01 * turn, np.zeros(2), np.zeros(2), np.zeros(2))
    with pytest.raises(InvalidInputError, match="--log"):
        recorder.save(tmp_path / "gone" / "take.npz", "leap")
