"""The states of a session, their transitions, the watchdog that brings some about, and the owner.

A client moves a session between waiting, following and released. While no samples arrive, the
watchdog moves it to a hold, and by option on to a return to the rest posture. An emergency stop
outlasts everything but its clearing, which leaves the robot released.
"""

from __future__ import annotations

import hashlib
import hmac
import math
from enum import Enum, auto
from typing import Literal, NamedTuple

LEASE = 2.0
"""Time after a request of its owner in which nobody else may have a session [s]."""
HEARTBEAT = 0.1
"""Time between commands that repeat a hold [s]."""
RETURN_PERIOD = 1.0 / 60.0
"""Time between commands on the way back to rest [s]."""
Mode = Literal["waiting", "following", "released", "hold", "returning", "stopped"]
"""A state as clients read it."""


class SessionState(Enum):
    """What a session does."""

    WAITING = auto()
    """No sample has arrived yet."""
    FOLLOWING = auto()
    """The robot follows the human."""
    RELEASED = auto()
    """The robot holds its posture because a client released it."""
    HOLDING = auto()
    """The robot holds its posture because samples stay away; it follows the next one."""
    HOLDING_RELEASED = auto()
    """As `HOLDING`, but released: the next sample does not move the robot."""
    RETURNING = auto()
    """The robot moves to its rest posture because samples stay away."""
    STOPPED = auto()
    """The robot holds its posture because of an emergency stop, which is latched."""

    @property
    def is_stopped(self) -> bool:
        """Whether an emergency stop is in force."""
        return self is SessionState.STOPPED

    @property
    def is_released(self) -> bool:
        """Whether the robot holds until `clutch`: a client released it, or stopped it."""
        return self in (
            SessionState.RELEASED,
            SessionState.HOLDING_RELEASED,
            SessionState.STOPPED,
        )

    @property
    def is_silent(self) -> bool:
        """Whether the watchdog acts because samples stay away."""
        return self in (
            SessionState.HOLDING,
            SessionState.HOLDING_RELEASED,
            SessionState.RETURNING,
        )

    @property
    def mode(self) -> Mode:
        """The state as clients read it."""
        return _MODES[self]


class Event(Enum):
    """What changes the state of a session."""

    SAMPLE = auto()
    """A sample that can be used."""
    CLUTCH = auto()
    RELEASE = auto()
    RESET = auto()
    SILENCE = auto()
    """The watchdog: no sample for too long."""
    RETURN = auto()
    """The watchdog: the hold has lasted long enough."""
    ARRIVAL = auto()
    """The robot is at its rest posture."""
    STOP = auto()
    """An emergency stop."""
    CLEAR = auto()
    """The emergency stop is cleared on purpose."""


_TRANSITIONS: dict[SessionState, dict[Event, SessionState]] = {
    SessionState.WAITING: {
        Event.SAMPLE: SessionState.FOLLOWING,
        Event.RELEASE: SessionState.RELEASED,
    },
    SessionState.FOLLOWING: {
        Event.RELEASE: SessionState.RELEASED,
        Event.SILENCE: SessionState.HOLDING,
    },
    SessionState.RELEASED: {
        Event.CLUTCH: SessionState.FOLLOWING,
        Event.RESET: SessionState.FOLLOWING,
        Event.SILENCE: SessionState.HOLDING_RELEASED,
    },
    SessionState.HOLDING: {
        Event.SAMPLE: SessionState.FOLLOWING,
        Event.RESET: SessionState.FOLLOWING,
        Event.RELEASE: SessionState.HOLDING_RELEASED,
        Event.RETURN: SessionState.RETURNING,
    },
    SessionState.HOLDING_RELEASED: {
        Event.SAMPLE: SessionState.RELEASED,
        Event.RESET: SessionState.FOLLOWING,
        Event.CLUTCH: SessionState.HOLDING,
    },
    SessionState.RETURNING: {
        Event.SAMPLE: SessionState.FOLLOWING,
        Event.RESET: SessionState.FOLLOWING,
        Event.RELEASE: SessionState.HOLDING_RELEASED,
        Event.ARRIVAL: SessionState.HOLDING,
    },
    SessionState.STOPPED: {
        Event.CLEAR: SessionState.RELEASED,
    },
}
_MODES: dict[SessionState, Mode] = {
    SessionState.WAITING: "waiting",
    SessionState.FOLLOWING: "following",
    SessionState.RELEASED: "released",
    SessionState.HOLDING: "hold",
    SessionState.HOLDING_RELEASED: "hold",
    SessionState.RETURNING: "returning",
    SessionState.STOPPED: "stopped",
}


def next_state(state: SessionState, event: Event) -> SessionState:
    """Return the state after an event; an event that is not in the table changes nothing.

    An emergency stop applies in every state.
    """
    if event is Event.STOP:
        return SessionState.STOPPED
    return _TRANSITIONS[state].get(event, state)


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
        self,
        timeout: float,
        return_after: float | None,
        now: float,
        gap: float = 1.0 / 15.0,
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

    def event(
        self, state: SessionState, now: float, *, is_at_rest: bool
    ) -> Event | None:
        """Return the event that elapsed time brings about, if any.

        Call again after the transition, until nothing is due.

        Args:
            state: State of the session.
            now: The present [s].
            is_at_rest: Whether the robot is at its rest posture.
        """
        if state in (SessionState.FOLLOWING, SessionState.RELEASED):
            if now - self.last_sample <= self._timeout:
                return None
            # The first command of a hold is due at once.
            self._held_since, self._last_command = now, -math.inf
            return Event.SILENCE
        if (
            state is SessionState.HOLDING
            and self._return_after is not None
            and not is_at_rest
        ):
            return (
                Event.RETURN if now - self._held_since >= self._return_after else None
            )
        return None

    def hasten(self) -> None:
        """Make the next command due at once."""
        self._last_command = -math.inf

    def take_turn(
        self, state: SessionState, now: float, *, is_braking: bool = False
    ) -> bool:
        """Return whether a command is due, and note that it is sent.

        Args:
            state: State of the session.
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


class MapperState(Enum):
    """How the posture of the mapper relates to the posture last commanded."""

    ALIGNED = auto()
    """They are the same."""
    SLEWING = auto()
    """The robot is on its way to the mapper's posture, within its speed limits."""
    STALE = auto()
    """The mapper must be reset to the robot's posture before the next sample."""


class Caller(NamedTuple):
    """A client: its address, and the name of its key, empty without keys."""

    address: str = "unknown"
    key: str = ""

    def __str__(self) -> str:
        return f"{self.key}@{self.address}" if self.key else self.address

    def owner(self, secret: str) -> str:
        """Return who owns a session of this client: a digest of its key, or else of the secret."""
        kind, proof = ("key", self.key) if self.key else ("secret", secret)
        return (
            f"{kind}:{hashlib.sha256(proof.encode(errors='surrogatepass')).hexdigest()}"
        )


def refusal(owner: str, client: str, *, is_attended: bool, is_rival: bool) -> str:
    """Return why a client may not continue a session: `busy`, `denied`, or empty if it may.

    Args:
        owner: Owner of the session; empty if its record is older than owners.
        client: Owner that the session would have.
        is_attended: Whether the owner's lease runs.
        is_rival: Whether the session runs under another secret than the client's.
    """
    if hmac.compare_digest(owner, client):
        return "busy" if is_rival and is_attended else ""
    if owner.startswith("key:"):
        return "denied"
    return "busy" if is_attended else ""
