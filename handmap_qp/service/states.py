"""The states of a session, their transitions, and its owner.

A client moves a session between waiting, following and released. While no samples arrive, the
watchdog moves it to a hold, and by option on to a return to the rest posture. An emergency stop
outlasts everything but its clearing, which leaves the robot released.
"""

from __future__ import annotations

import hashlib
import hmac
from enum import Enum, auto
from typing import Literal, NamedTuple

LEASE = 2.0
"""Time after a request of its owner in which nobody else may have a session [s]."""
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
        return self in (SessionState.HOLDING, SessionState.HOLDING_RELEASED, SessionState.RETURNING)

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
        return f"{kind}:{hashlib.sha256(proof.encode(errors='surrogatepass')).hexdigest()}"


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
