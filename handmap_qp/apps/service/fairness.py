"""What one account may take of what all share: sessions, rates, the opening worker, memory.

An *account* is whom a share belongs to: the key of a client, or else its address
(`Caller.account`). Each limit of the service that one client could use up is divided here, so that
a client that floods is refused before the others are.
"""

import time
from collections import Counter, deque
from collections.abc import Callable, Hashable, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from threading import Lock
from typing import ParamSpec, TypeVar

from .safety import Bucket

_MOST_ACCOUNTS = 1024
"""Accounts whose rates are remembered; the one unheard of for longest is forgotten."""

Account = TypeVar("Account", bound=Hashable)
P = ParamSpec("P")
T = TypeVar("T")


def has_share(held: int, free: int) -> bool:
    """Return whether an account may take one more of a number of equal things.

    The limit is the number that is free (dynamic threshold; Choudhury and Hahne 1998). So an
    account alone gets a half of all, the next one a half of the rest, and an account that has none
    gets one as long as one is free.

    Args:
        held: Number that the account has.
        free: Number that nobody has.
    """
    return held < free


def largest_account(accounts: Iterable[Account]) -> Account:
    """Return the account that occurs most often, of several the one that occurs first."""
    ((account, _),) = Counter(accounts).most_common(1)
    return account


def crowded_accounts(
    accounts: Iterable[Account], newcomer: Account
) -> frozenset[Account]:
    """Return the accounts that have most, together with one more of a newcomer."""
    counts = Counter([*accounts, newcomer])
    most = max(counts.values())
    return frozenset(account for account, count in counts.items() if count == most)


class AccountBuckets:
    """A rate limit for each account.

    Args:
        rate: Events of an account per second.
        burst: Events at once.
        clock: Monotonic clock [s].
    """

    def __init__(
        self, rate: float, burst: float, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._rate = rate
        self._burst = burst
        self._clock = clock
        # Least recently used first.
        self._buckets: dict[str, Bucket] = {}

    def __len__(self) -> int:
        """Return the number of accounts that are remembered."""
        return len(self._buckets)

    def take(self, account: str) -> bool:
        """Count an event of an account; return whether it is allowed."""
        bucket = self._buckets.pop(account, None)
        if bucket is None:
            bucket = Bucket(self._rate, self._burst, self._clock)
        self._buckets[account] = bucket
        if len(self._buckets) > _MOST_ACCOUNTS:
            del self._buckets[next(iter(self._buckets))]
        return bucket.take()


class FairWorker:
    """A single thread that works for accounts in turn (round robin).

    A single one, so that opening sessions cannot starve running ones.
    """

    def __init__(self) -> None:
        self._executor = ThreadPoolExecutor(1, "handmap-open")
        self._lock = Lock()
        # The account whose turn is next is first. Accounts without work are left out.
        self._waiting: dict[str, deque[Callable[[], None]]] = {}
        self._futures: set[Future] = set()

    def submit(
        self, account: str, work: Callable[P, T], *args: P.args, **kwargs: P.kwargs
    ) -> Future[T]:
        """Call a function when it is the account's turn.

        Args:
            account: The account.
            work: The function.
            *args: Its arguments.
            **kwargs: Its keyword arguments.

        Returns:
            The future result.

        Raises:
            RuntimeError: If the worker is closed.
        """
        future: Future[T] = Future()

        def job() -> None:
            if not future.set_running_or_notify_cancel():
                return
            try:
                future.set_result(work(*args, **kwargs))
            except BaseException as error:
                future.set_exception(error)

        with self._lock:
            self._executor.submit(self._run_next)
            self._waiting.setdefault(account, deque()).append(job)
            self._futures.add(future)
        future.add_done_callback(self._futures.discard)
        return future

    def close(self) -> None:
        """Cancel what waits; do not wait for what runs."""
        self._executor.shutdown(wait=False, cancel_futures=True)
        for future in [*self._futures]:
            future.cancel()

    def _run_next(self) -> None:
        """Do the first work of the account whose turn it is."""
        with self._lock:
            account = next(iter(self._waiting))
            jobs = self._waiting.pop(account)
            job = jobs.popleft()
            if jobs:
                # Its next turn comes after those of all others.
                self._waiting[account] = jobs
        job()
