"""When commands are: times that callers give, checked and related to the robot's clock."""

from __future__ import annotations

import math

from handmap_core.errors import InvalidInputError, expect
from handmap_core.ik import BEHIND, LONGEST_STEP, Instant, When
from handmap_core.se3 import is_real


def own_time(when: When) -> float:
    """Return the longest time that a command may take, in which filters of a hand count [s]."""
    return when.longest if isinstance(when, Instant) else when


def check_when(when: When) -> When:
    """Reject a time since the robot's last command that is not positive and finite.

    Likewise an instant that is not finite, or a longest time that is not positive.

    Raises:
        InvalidInputError: With the argument `dt`.
    """
    if not isinstance(when, Instant):
        return check_dt(when)
    time, longest = when
    is_time = is_real(longest) or longest == math.inf
    expect(
        is_real(time) and is_time and longest > 0.0,
        "dt",
        "an instant that is finite, and a longest time > 0 s",
        value=when,
    )
    return when


def check_dt(dt: float) -> float:
    """Reject a time that is not positive and finite.

    Raises:
        InvalidInputError: With the argument `dt`.
    """
    if not (is_real(dt) and dt > 0.0):
        raise InvalidInputError(argument="dt", expected="a time > 0 s", value=dt)
    return dt


class CallerClock:
    """Relates the clock of a caller, who gives instants, to the robot's clock."""

    def __init__(self) -> None:
        # The robot's clock minus the caller's [s]; None until the caller gives a first instant.
        self._offset: float | None = None
        # Whether the robot was reset since the last instant.
        self._was_reset = False

    def reset(self) -> None:
        """Let an instant that is much earlier than the last one begin another clock."""
        self._was_reset = True

    def instant(self, time: float, usual_dt: float, now: float) -> When:
        """Return when the command is that a caller gives an instant for; this changes nothing.

        Args:
            time: The instant on the caller's clock [s].
            usual_dt: Time of a command for the first instant of a clock [s].
            now: Instant of the robot's last command, on its clock [s].

        Raises:
            InvalidInputError: If `time` cannot be used.
        """
        expect(is_real(time), "time", "an instant [s]", value=time)
        if self._offset is None:
            return usual_dt
        instant = time + self._offset
        if self._was_reset and instant < now - BEHIND:
            # Such as that of the next recording.
            return usual_dt
        return Instant(instant, LONGEST_STEP * usual_dt)

    def note(self, time: float, when: When, now: float) -> None:
        """Note that the command for an instant was made.

        Args:
            time: The instant on the caller's clock [s].
            when: What `instant` returned for it.
            now: Instant of the command, on the robot's clock [s].
        """
        self._was_reset = False
        if not isinstance(when, Instant):
            # The first instant of a clock.
            self._offset = now - time
