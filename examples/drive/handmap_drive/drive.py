"""The loop between a session and motors: it interpolates, limits, and stops."""

from collections import deque
from collections.abc import Callable
from threading import Event
from time import monotonic

import numpy as np

from handmap_qp.client import Client, Command
from handmap_qp.errors import expect, warn
from handmap_qp.hands import Values
from .driver import Driver, DriverError, check_places, insisting

SILENCE = 0.08
"""Time without a command after which motors only hold [s]."""
HEARTBEAT = 0.1
"""Time between the commands of a session that holds its robot [s]."""
LOST = 0.3
"""Time without a command, or without a turn of the loop, after which motors stop [s]."""
UNANSWERED = 0.5
"""Time without an answer of the motors after which the loop ends [s]."""
HOLDING = 0.3
"""Share of the limit of torque that is left while motors only hold."""
APPROACH = 0.5
"""Speed of the way from where the motors are to the commands [rad/s]."""
NEAR = 0.05
"""How far a motor is from the commands when its way ends [rad]."""
HOTTEST = 60.0
"""Largest temperature of a motor, unless the user gives another one [degrees Celsius]."""


class Loop:
    """Gives the commands of a session to motors, at the motors' rate.

    Motors have no torque while something is wrong. After that, and at the start, they go slowly
    from where they are to the command.

    Args:
        driver: The motors, connected.
        command: The first command.
        effort: Limit of the torque, a share of the largest.
        hottest: Largest temperature of a motor [degrees Celsius].

    Raises:
        DriverError: If the motors do not answer, are too hot or report a fault.
        InvalidInputError: If a joint is where it cannot be.
    """

    def __init__(
        self, driver: Driver, command: Command, effort: float, hottest: float
    ) -> None:
        self._driver, self._effort, self._hottest = driver, effort, hottest
        self._q, _, health = insisting(driver.read)
        health.check(driver.joint_names, hottest)
        self._from = self._goal = self._written = self._q
        check_places(self._q, driver.joint_names, driver.range)
        self._turned = self._heard = self._answered = monotonic()
        self._span, self._epoch = SILENCE, command.epoch
        self._problem, self._age = "", np.nan
        self._is_near, self._is_clipped = np.zeros_like(self._q, bool), False
        self._lost = self._stops = 0
        # Of the last minutes: time of a turn, age of a new command, and errors of following.
        self._log = deque(maxlen=10_000)
        self.hear(command, self._heard)

    def run(self, client: Client, is_held: Callable[[], bool], over: Event) -> None:
        """Follow the session that a client watches.

        Args:
            client: The client.
            is_held: Whether the dead man's key is held.
            over: Ends it.

        Raises:
            DriverError: If motors do not answer, are too hot or report a fault.
        """
        due = monotonic()
        while not over.is_set():
            due = max(due + 1.0 / self._driver.rate, monotonic() + 0.001)
            while (left := due - monotonic()) > 0.0:
                if command := client.latest(left):
                    self.hear(command, monotonic())
            self.turn(monotonic(), is_held=is_held())
            # Joints that were not read now are not told as fresh.
            if self._answered == self._turned:
                client.measured(self.measured)

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
        asked = np.array([angles[name] for name in names])
        expect(
            np.isfinite(asked).all(), "SESSION", "joint angles", value=asked.tolist()
        )
        self._from = self._path(now)
        self._goal = np.clip(asked, *self._driver.range)
        beyond = np.abs(asked - self._goal)
        if beyond.max() > NEAR and not self._is_clipped:
            self._is_clipped = True
            i = beyond.argmax()
            warn(
                f"{names[i]}: a command of {asked[i]:.3g} rad is beyond the motor's range: it goes "
                f"to {self._goal[i]:.3g}"
            )
        self._span = np.clip(now - self._heard, 1.0 / self._driver.rate, SILENCE)
        self._command, self._angles, self._heard = command, angles, now
        self._age = now - command.server_time

    def turn(self, now: float, *, is_held: bool = True) -> None:
        """Give the motors what is due at a time [s, monotonic], and look at them."""
        late, self._turned = now - self._turned, now
        problem = self._trouble(now, late, is_held)
        if problem != self._problem:
            self._problem = problem
            self._stops += bool(problem)
            warn(problem or "driving")
        if problem:
            self._driver.stop()
            self._is_near = np.zeros_like(self._q, bool)
        else:
            self._advance(now, late)
        self._look(now, late)

    def _trouble(self, now: float, late: float, is_held: bool) -> str:
        """Return why the motors must have no torque; nothing if they may."""
        epoch, self._epoch = self._epoch, self._command.epoch
        reasons = {
            "the session is stopped": self._command.status == "stopped",
            "no command arrives": now - self._heard > LOST,
            "the session's robot has jumped": epoch != self._epoch,
            "the dead man's key is not held": not is_held,
            "this computer was late": late > LOST,
        }
        return next((f"stopped: {text}" for text, so in reasons.items() if so), "")

    def _path(self, now: float) -> np.ndarray:
        """Return the way between the last two commands at a time, one interval late."""
        share = min((now - self._heard) / self._span, 1.0)
        return self._from + share * (self._goal - self._from)

    def _advance(self, now: float, dt: float) -> None:
        """Go on towards the commands; only hold where they are late."""
        patience = SILENCE + HEARTBEAT * ("watchdog" in self._command.flags)
        share = 1.0 if now - self._heard < patience else HOLDING
        away = self._path(now) - self._written
        self._is_near = self._is_near | (np.abs(away) < NEAR)
        fastest = self._driver.speed
        speed = np.where(self._is_near, fastest, min(APPROACH, fastest))
        step = dt * speed
        self._written = self._written + np.clip(away, -step, step)
        self._driver.write(self._written, share * self._effort)

    def _look(self, now: float, late: float) -> None:
        """Read the motors.

        Raises:
            DriverError: If they have not answered for some time, are too hot or report a fault.
        """
        try:
            self._q, _, health = self._driver.read()
        except DriverError:
            self._lost += 1
            if now - self._answered > UNANSWERED:
                raise
            return
        self._answered = now
        health.check(self._driver.joint_names, self._hottest)
        if self._problem:
            self._written = self._q
            return
        self._log.append((late, self._age, *np.abs(self._q - self._written)))
        self._age = np.nan

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
            "answers lost": self._lost,
            "stops": self._stops,
        }
