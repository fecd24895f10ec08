"""The loop between a session and motors: it interpolates, limits, and stops."""

from collections import deque
from collections.abc import Callable
from enum import Enum, auto
from threading import Event
from time import monotonic
from typing import Literal

import numpy as np

from handmap_qp.client import Client, Command
from handmap_qp.errors import expect, warn
from handmap_qp.hands import Values
from .driver import Driver, DriverError, check_places, insisting
from .gate import Gate
from .joint_map import Direct, JointMap
from .loads import FingerLoads
from .recorder import Recorder
from .reports import Report

SILENCE = 0.08
"""Time without a command after which motors only hold [s]."""
HEARTBEAT = 0.1
"""Time between the commands of a session that holds its robot [s]."""
LOST = 0.3
"""Time without a command, or without a turn of the loop, after which motors stop [s]."""
UNREAD = 0.15
"""Time without an answer of the motors after which they stop: they may have been reset [s]."""
UNANSWERED = 0.5
"""Time in which motors are asked without an answer, after which the loop ends [s]."""
_ASKED = 0.1
"""Longest time that one question without an answer counts for [s].

In the rest of a longer turn this computer was late, and asked nothing.
"""
HOLDING = 0.3
"""Share of the limit of torque that is left while motors only hold."""
HOTTEST = 60.0
"""Largest temperature of a motor, unless the user gives another one [degrees Celsius]."""
_BEYOND = 0.05
"""How far beyond the range of its motor a command is reported [rad]."""
_LOGGED = 10_000
"""Turns of which the summary is: the last minutes."""


class State(Enum):
    """What the loop does with the motors."""

    STOPPED = auto()
    """They have no torque, because of a reason, or because nothing was written yet."""
    APPROACHING = auto()
    """Some go slowly from where they were to the command."""
    FOLLOWING = auto()
    """All have met the command, and follow it."""
    HOLDING = auto()
    """Commands are late: they go to the last one, with less torque."""


Change = Literal[
    "fault",  # there is a reason why motors must have no torque
    "clear",  # there is none
    "silence",  # commands are late
    "command",  # commands are not late
    "arrival",  # all motors have met the command
]
"""What changes the state of the loop, in the order in which a turn looks at it."""

_TRANSITIONS: dict[tuple[State, Change], State] = {
    (State.STOPPED, "clear"): State.APPROACHING,
    (State.APPROACHING, "silence"): State.HOLDING,
    (State.APPROACHING, "arrival"): State.FOLLOWING,
    (State.FOLLOWING, "silence"): State.HOLDING,
    (State.HOLDING, "command"): State.APPROACHING,
}
"""The state after a change in a state; other changes leave it."""


def next_state(state: State, change: Change) -> State:
    """Return the state after a change; a fault stops the motors in every state."""
    if change == "fault":
        return State.STOPPED
    return _TRANSITIONS.get((state, change), state)


class Loop:
    """Gives the commands of a session to motors, at the motors' rate.

    Motors have no torque while something is wrong. After that, and at the start, they go slowly
    from where they are to the command. A turn looks at the motors first, and then acts: motors that
    were not read keep their goals.

    Args:
        driver: The motors, connected.
        command: The first command.
        effort: Limit of the torque, a share of the largest.
        hottest: Largest temperature of a motor [degrees Celsius].
        joints: Maps joints to motors; joints do what motors are commanded if omitted.
        recorder: Keeps what joints do while they follow; nothing is kept if omitted.
        loads: Loads of fingers, which the session is told; it is told none if omitted.

    Attributes:
        state: What the loop does with the motors.

    Raises:
        DriverError: If the motors do not answer, are too hot or report a fault.
        InvalidInputError: If a joint is where it cannot be.
    """

    def __init__(
        self,
        driver: Driver,
        command: Command,
        effort: float,
        hottest: float,
        joints: JointMap | None = None,
        recorder: Recorder | None = None,
        loads: FingerLoads | None = None,
    ) -> None:
        self._driver = driver
        self._recorder = recorder
        self._loads = loads
        self._gate = Gate(driver)
        self._joints = joints or Direct(driver)
        self._effort = effort
        self._hottest = hottest
        q, self._torque, health = insisting(self._gate.read)
        health.check(driver.joint_names, hottest)
        self._q = self._joints.angles(q)
        check_places(self._q, driver.joint_names, self._joints.range)
        now = monotonic()
        # Motors: what was read of them and when.
        self._is_read = True
        self._answered = now
        self._looked = now
        self._unanswered = 0.0
        # Where joints come to by the last goals.
        self._expected = self._q
        # The session: a straight line from one command to the next, one interval late.
        self._from = self._q
        self._goal = self._q
        self._span = SILENCE
        self._heard = now
        self._epoch = command.epoch
        self._age = np.nan
        self._is_clipped = False
        # What the session is told.
        self._places = Report("where the joints are")
        self._touches = Report("what the fingers feel")
        # The loop itself.
        self.state = State.STOPPED
        self._problem = ""
        self._acted = now
        self._unread = 0
        self._stops = 0
        # Time of a turn, age of a new command, and errors of following.
        self._log: deque[tuple[float, ...]] = deque(maxlen=_LOGGED)
        self.hear(command, now)

    def run(self, client: Client, is_held: Callable[[], bool], over: Event) -> None:
        """Follow the session that a client watches.

        Args:
            client: The client.
            is_held: Whether the dead man's key is held.
            over: Ends it.

        Raises:
            DriverError: If motors do not answer, are too hot or report a fault.
            InvalidInputError: If a joint is where it cannot be after a stop.
        """
        due = monotonic()
        while not over.is_set():
            due = max(due + 1.0 / self._driver.rate, monotonic() + 0.001)
            while (left := due - monotonic()) > 0.0:
                if command := client.latest(left):
                    self.hear(command, monotonic())
            self.look(monotonic())
            # Reading takes time, and goals move by the time at which they are written.
            self.act(monotonic(), is_held=is_held())
            # Joints that were not read now are not reported as fresh.
            if self._is_read:
                self._tell(client, monotonic())

    def _tell(self, client: Client, now: float) -> None:
        """Say where the joints are and what fingers feel, at a time [s, monotonic]."""
        if self._places.is_due(now):
            self._places.note(client.measured(self.measured), now)
        if self._loads and self._touches.is_due(now):
            efforts = self._loads.of(self._torque)
            self._touches.note(client.touch(efforts=efforts, time=now), now)

    @property
    def measured(self) -> list[float]:
        """Joints of the session as the motors have them; those without one as commanded [rad]."""
        own = zip(self._driver.joint_names, self._q.tolist(), strict=True)
        return [*(self._angles | dict(own)).values()]

    def hear(self, command: Command, now: float) -> None:
        """Take a command, at a time [s, monotonic].

        Raises:
            InvalidInputError: If the session has another robot now, or a joint is not a number.
        """
        angles = dict(zip(command.joint_names, command.q, strict=True))
        names = self._driver.joint_names
        expect(angles.keys() >= {*names}, "SESSION", "the robot that it had at first")
        commanded = np.array([angles[name] for name in names])
        expect(
            np.isfinite(commanded).all(),
            "SESSION",
            "joint angles",
            value=commanded.tolist(),
        )
        self._from = self._path(now)
        self._goal = np.clip(commanded, *self._joints.range)
        self._report_clipping(commanded)
        self._span = np.clip(now - self._heard, 1.0 / self._driver.rate, SILENCE)
        self._command = command
        self._angles = angles
        self._heard = now
        self._age = now - command.server_time

    def _report_clipping(self, commanded: np.ndarray) -> None:
        """Warn once of a command that is beyond the range of a joint."""
        beyond = np.abs(commanded - self._goal)
        i = beyond.argmax()
        if self._is_clipped or beyond[i] <= _BEYOND:
            return
        self._is_clipped = True
        warn(
            f"{self._driver.joint_names[i]}: a command of {commanded[i]:.3g} rad is beyond the "
            f"motor's range: it goes to {self._goal[i]:.3g}"
        )

    def turn(self, now: float, *, is_held: bool = True) -> None:
        """Look at the motors and act, both at one time [s, monotonic]; see `look` and `act`."""
        self.look(now)
        self.act(now, is_held=is_held)

    def look(self, now: float) -> None:
        """Read the motors, at a time [s, monotonic].

        Raises:
            DriverError: If they have not answered for some time, are too hot or report a fault.
        """
        self._is_read = False
        since_look = now - self._looked
        self._looked = now
        try:
            q, torque, health = self._gate.read()
        except DriverError:
            self._unread += 1
            self._unanswered += min(since_look, _ASKED)
            if self._unanswered > UNANSWERED:
                raise
            return
        self._is_read = True
        self._unanswered = 0.0
        self._answered = now
        self._q = self._joints.angles(q)
        self._torque = torque
        health.check(self._driver.joint_names, self._hottest)

    def act(self, now: float, *, is_held: bool = True) -> None:
        """Stop the motors, or give them what is due at a time [s, monotonic].

        Raises:
            InvalidInputError: If a joint is where it cannot be after a stop.
        """
        late = now - self._acted
        self._acted = now
        problem = self._find_problem(now, late, is_held)
        self._report(problem)
        before = self.state
        self.state = self._find_state(problem, now)
        if self._recorder and self.state is not before:
            self._recorder.begin()
        if self.state is State.STOPPED:
            self._stops += before is not State.STOPPED
            self._gate.stop()
            return
        if before is State.STOPPED:
            self._start()
        if self._is_read:
            self._log.append((late, self._age, *np.abs(self._q - self._expected)))
            self._age = np.nan
            self._write(now)

    def _find_problem(self, now: float, late: float, is_held: bool) -> str:
        """Return why the motors must have no torque; nothing if they may."""
        epoch = self._epoch
        self._epoch = self._command.epoch
        unread = now - self._answered
        # A motor that was not read may have been reset since.
        is_unread = unread > UNREAD or (
            self.state is State.STOPPED and not self._is_read
        )
        reasons = {
            "the session is stopped": self._command.status == "stopped",
            "no command arrives": now - self._heard > LOST,
            "the session's robot has jumped": epoch != self._epoch,
            "the dead man's key is not held": not is_held,
            "this computer was late": late > LOST,
            f"torque lost: {', '.join(self._gate.lost)}": bool(self._gate.lost),
            "the motors do not answer": is_unread,
        }
        return next((f"stopped: {text}" for text, so in reasons.items() if so), "")

    def _report(self, problem: str) -> None:
        """Warn where what is wrong changes."""
        if problem != self._problem:
            self._problem = problem
            warn(problem or "driving")

    def _find_state(self, problem: str, now: float) -> State:
        """Return the state after what happened until a time."""
        if problem:
            return next_state(self.state, "fault")
        patience = SILENCE + HEARTBEAT * ("watchdog" in self._command.flags)
        is_silent = now - self._heard >= patience
        changes: list[Change] = ["clear", "silence" if is_silent else "command"]
        if self._gate.has_met.all():
            changes.append("arrival")
        state = self.state
        for change in changes:
            state = next_state(state, change)
        return state

    def _start(self) -> None:
        """Begin where the joints are.

        Raises:
            InvalidInputError: If one is where it cannot be, as after a reset that loses turns.
        """
        check_places(self._q, self._driver.joint_names, self._joints.range)
        self._joints.restart(self._q)
        self._expected = self._q
        # The way from a command before the stop is not one that joints are on.
        self._from = self._goal

    def _path(self, now: float) -> np.ndarray:
        """Return the way between the last two commands at a time, one interval late."""
        share = min((now - self._heard) / self._span, 1.0)
        return self._from + share * (self._goal - self._from)

    def _write(self, now: float) -> None:
        """Move the motors on towards the commands."""
        share = HOLDING if self.state is State.HOLDING else 1.0
        commanded = self._path(now)
        if self._recorder and self.state is State.FOLLOWING:
            effort = self._joints.torques(self._torque)
            self._recorder.add(now, self._q, commanded, effort)
        target = self._joints.command(commanded)
        goal = self._gate.write(target, share * self._effort, now)
        self._expected = self._joints.reached(goal)

    def summary(self) -> Values:
        """Return rate, delays and errors of following."""
        if not self._log:
            return {"stops": self._stops}
        turns, ages, *errors = np.array(self._log).T
        worst = np.max(errors, axis=1)
        return {
            "turns": len(turns),
            "rate [Hz]": 1.0 / turns.mean(),
            "longest turn [ms]": 1e3 * turns.max(),
            "age of commands, median [ms]": 1e3 * np.nanmedian(ages),
            "age of commands, 95 % [ms]": 1e3 * np.nanpercentile(ages, 95),
            "following error, RMS [rad]": np.sqrt(np.mean(np.square(errors))),
            "following error, largest [rad]": worst.max(),
            "largest at": self._driver.joint_names[worst.argmax()],
            "answers lost": self._unread,
            "stops": self._stops,
        }
