"""Limits of what clients may do: caps, and rate limits."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

from handmap_qp.errors import InvalidOptionsError

MOST_SESSIONS = 128
"""Number of postures that the store keeps; every open session must have one."""
_MOST_PEERS = 1024


@dataclass(frozen=True, slots=True)
class Caps:
    """Limits of what clients may do.

    Attributes:
        sessions: Open sessions, 1 to 128.
        rate: Messages per second from one connection.
        opens: Sessions opened per second, after a burst of `sessions`.
        configures: Changes of options per second, in all sessions together. Each takes about 1 ms;
            a change to teleoperation takes up to 10 ms on hands with many links.
        message_size: Length of a message [bytes].
        idle: Time without a request after which a session is closed, and without a message after
            which a WebSocket is that reads no stream [s].
        supervisors: Names of the keys that may clear every emergency stop.
        allows_client_time: Whether sessions may use the client's time stamps for speed limits
            (simulations).
    """

    sessions: int = 64
    rate: float = 2000.0
    opens: float = 20.0
    configures: float = 60.0
    message_size: int = 16384
    idle: float = 60.0
    supervisors: tuple[str, ...] = ()
    allows_client_time: bool = False

    def __post_init__(self) -> None:
        """Reject caps out of range.

        Raises:
            InvalidOptionsError: With the cap at fault.
        """
        if not 1 <= self.sessions <= MOST_SESSIONS:
            raise InvalidOptionsError(
                option="sessions", expected=f"1 to {MOST_SESSIONS}", value=self.sessions
            )
        for name in ("rate", "opens", "configures", "message_size", "idle"):
            value = getattr(self, name)
            # `not a > b` also rejects NaN.
            if not value > 0.0:
                raise InvalidOptionsError(option=name, expected="a number > 0", value=value)


class Bucket:
    """A rate limit that permits short bursts (token bucket).

    Args:
        rate: Events per second.
        now: The present [s].
        burst: Events at once; those of a quarter of a second if omitted.
    """

    def __init__(self, rate: float, now: float, burst: float | None = None) -> None:
        self._rate = rate
        self._burst = self._left = max(1.0, 0.25 * rate if burst is None else burst)
        self._then = now
        self._reported = -1.0

    def take(self, now: float, count: float = 1.0) -> bool:
        """Count events; return whether they are allowed."""
        if self.charge(now, 0.0) < count:
            return False
        self._left -= count
        return True

    def charge(self, now: float, count: float) -> float:
        """Count events that have happened; return how many are left, negative for a debt.

        Args:
            now: The present [s].
            count: Number of events; negative to take them back.
        """
        refilled = min(self._burst, self._left + (now - self._then) * self._rate)
        self._left, self._then = min(self._burst, refilled - count), now
        return self._left

    def may_report(self, now: float) -> bool:
        """Return whether to report a refusal: at most ten times per second."""
        if now - self._reported < 0.1:
            return False
        self._reported = now
        return True


class RateLimit:
    """One bucket per connection; the least recently used ones are dropped.

    There is no common bucket, because a few clients above the rate would shut out the others.

    Args:
        rate: Messages per second from one connection.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._peers: OrderedDict[Hashable, Bucket] = OrderedDict()

    def take(self, peer: Hashable, now: float) -> bool:
        """Count one message of a connection; return whether it is allowed."""
        return self._bucket(peer, now).take(now)

    def may_report(self, peer: Hashable, now: float) -> bool:
        """Return whether to report a refusal to this connection."""
        return self._bucket(peer, now).may_report(now)

    def _bucket(self, peer: Hashable, now: float) -> Bucket:
        bucket = self._peers.get(peer)
        if bucket is None:
            bucket = self._peers[peer] = Bucket(self._rate, now)
            if len(self._peers) > _MOST_PEERS:
                self._peers.popitem(last=False)
        self._peers.move_to_end(peer)
        return bucket
