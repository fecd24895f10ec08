"""Rate limits of what clients may do."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable

_MOST_PEERS = 1024


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
