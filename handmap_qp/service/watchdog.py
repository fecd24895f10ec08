"""The watchdog: what silence of a client does, and when the stream repeats a command."""

from __future__ import annotations

import math

from handmap_qp.service.states import Event, SessionState

HEARTBEAT = 0.1
"""Time between commands that repeat a hold [s]."""
RETURN_PERIOD = 1.0 / 60.0
"""Time between commands on the way back to rest [s]."""


class Watchdog:
    """Turn elapsed time into events of a session.

    It keeps times only; the session keeps the state. Times are of one monotonic clock [s].

    Args:
        timeout: Time without a sample after which the robot holds [s].
        return_after: Time of a hold after which the robot returns to rest [s]; None for never.
        now: The present [s].
        gap: Time without a command after which a robot that follows brakes, if it must [s].

    Attributes:
        last_sample: Time of the last sample that could be used, or of the last reset [s].
    """

    def __init__(
        self, timeout: float, return_after: float | None, now: float, gap: float = 1.0 / 15.0
    ) -> None:
        self._timeout, self._gap = timeout, gap
        self._return_after = return_after
        self._held_since = self._last_command = self.last_sample = now

    def feed(self, now: float) -> None:
        """Note a sample that can be used, and the command that answers it."""
        self.last_sample = self._last_command = now

    def restart(self, now: float) -> None:
        """Count silence from now on, as after a reset."""
        self.last_sample = now

    def event(self, state: SessionState, now: float, *, is_at_rest: bool) -> Event | None:
        """Return the event that elapsed time brings about, if any.

        Call again after the transition, until nothing is due.

        Args:
            state: SessionState of the session.
            now: The present [s].
            is_at_rest: Whether the robot is at its rest posture.
        """
        if state in (SessionState.FOLLOWING, SessionState.RELEASED):
            if now - self.last_sample <= self._timeout:
                return None
            # The first command of a hold is due at once.
            self._held_since, self._last_command = now, -math.inf
            return Event.SILENCE
        if state is SessionState.HOLDING and self._return_after is not None and not is_at_rest:
            return Event.RETURN if now - self._held_since >= self._return_after else None
        return None

    def hasten(self) -> None:
        """Make the next command due at once."""
        self._last_command = -math.inf

    def take_turn(self, state: SessionState, now: float, *, is_braking: bool = False) -> bool:
        """Return whether a command is due, and note that it is sent.

        Args:
            state: SessionState of the session.
            now: The present [s].
            is_braking: Whether the robot must still come to a stop.
        """
        if is_braking and state is SessionState.FOLLOWING:
            is_braking = now - self.last_sample > self._gap
        if not (state.is_silent or state.is_stopped or is_braking):
            return False
        is_moving = is_braking or state is SessionState.RETURNING
        period = RETURN_PERIOD if is_moving else HEARTBEAT
        if now - self._last_command < period:
            return False
        self._last_command = now
        return True

    def will_return(self, state: SessionState) -> bool:
        """Return whether silence would make the robot return to rest from this state."""
        return self._return_after is not None and state in (
            SessionState.FOLLOWING,
            SessionState.HOLDING,
            SessionState.RETURNING,
        )
