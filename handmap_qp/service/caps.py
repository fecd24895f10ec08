"""What a server allows its clients: caps, and rate limits."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from dataclasses import dataclass

from handmap_qp.errors import InvalidOptionsError

MOST_SESSIONS = 128
"""As many postures are remembered; each open session has to be."""
_MOST_PEERS = 1024


@dataclass(frozen=True, slots=True)
class Caps:
    """What a server allows its clients.

    Attributes:
        sessions: Sessions open at a time, 1 to 128.
        rate: Messages a second from one connection.
        opens: Sessions opened a second, once as many as there may be have been opened.
        configures: Changes of options a second, in all sessions together: each takes about a
            millisecond.
        message_size: Length of a message [bytes].
        idle: A session that is not heard of for so long is closed [s].
        allows_client_time: Whether sessions may count time by the client's stamps (simulations).
    """

    sessions: int = 64
    rate: float = 2000.0
    opens: float = 20.0
    configures: float = 60.0
    message_size: int = 16384
    idle: float = 60.0
    allows_client_time: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be.

        Raises:
            InvalidOptionsError: Naming the cap.
        """
        if not 1 <= self.sessions <= MOST_SESSIONS:
            raise InvalidOptionsError(
                f"sessions: expected 1 to {MOST_SESSIONS}, got {self.sessions}"
            )
        for name in ("rate", "opens", "configures", "message_size", "idle"):
            if not getattr(self, name) > 0.0:
                raise InvalidOptionsError(
                    f"{name}: expected a number > 0, got {getattr(self, name)}"
                )


class Bucket:
    """A rate limit that lets short bursts through.

    Args:
        rate: Events a second.
        now: The present [s].
        burst: Events at once; a quarter of a second's worth if omitted.
    """

    def __init__(self, rate: float, now: float, burst: float | None = None) -> None:
        self._rate = rate
        self._burst = self._left = max(1.0, 0.25 * rate if burst is None else burst)
        self._then = now
        self._told = -1.0

    def take(self, now: float) -> bool:
        """Whether one more is allowed."""
        self._left = min(self._burst, self._left + (now - self._then) * self._rate)
        self._then = now
        if self._left < 1.0:
            return False
        self._left -= 1.0
        return True

    def may_tell(self, now: float) -> bool:
        """Whether the one who is refused should hear of it: ten times a second at most."""
        if now - self._told < 0.1:
            return False
        self._told = now
        return True


class RateLimit:
    """A bucket for every connection; forgets those that were silent for the longest time.

    There is none for all of them together: it would let a few that send too much shut out the
    others.

    Args:
        rate: Messages a second from one connection.
    """

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._peers: OrderedDict[Hashable, Bucket] = OrderedDict()

    def take(self, peer: Hashable, now: float) -> bool:
        """Whether one more message from this connection is allowed."""
        return self._bucket(peer, now).take(now)

    def may_tell(self, peer: Hashable, now: float) -> bool:
        """Whether this connection should hear that it is not."""
        return self._bucket(peer, now).may_tell(now)

    def _bucket(self, peer: Hashable, now: float) -> Bucket:
        bucket = self._peers.get(peer)
        if bucket is None:
            bucket = self._peers[peer] = Bucket(self._rate, now)
            if len(self._peers) > _MOST_PEERS:
                self._peers.popitem(last=False)
        self._peers.move_to_end(peer)
        return bucket
