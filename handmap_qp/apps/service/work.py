"""The order of requests: stops first, then one mapping at a time, the sessions in turn.

A mapping takes from a fraction of a millisecond to some ten. So it waits in a queue, and the event
loop reads the messages that have arrived before it runs the next one. A stop therefore waits for
the mapping that runs, and for no other. Only where messages take longer to read than samples to
map, as many are mapped at once as take the same time, up to 5 ms. So a flood of messages leaves
half of the time to the samples.
"""

import asyncio
from collections import deque
from collections.abc import Callable, Hashable
from dataclasses import dataclass

from handmap_core.errors import RefusedError

MOST_WAITING = 64
"""Requests of a session that may wait."""
_TURNS = 4
"""Turns of the event loop in which a message passes the sockets, between two mappings."""
_TURNS_PER_SECOND = 1e3
"""Further turns for each second of a mapping: longer ones leave more messages behind."""
_LONGEST_TURNS = 0.002
"""Time after which these turns are enough [s]."""
_MOST_MAPPING = 0.005
"""Time after which messages are read again, once the mapping is done that runs [s]."""

Schedule = Callable[[Callable[[], None]], object]
"""Calls a function in a later turn of the event loop, as `in_next_turn` does."""


def in_next_turn(call: Callable[[], None]) -> None:
    """Call a function in the next turn of the running event loop."""
    asyncio.get_running_loop().call_soon(call)


@dataclass(eq=False, slots=True)
class _Job:
    """A request that waits: how it is carried out, and since when it waits [s]."""

    run: Callable[[], None]
    since: float
    is_mapping: bool


class WorkQueue:
    """Requests that wait for their turn, by session.

    Requests of one session keep their order. Sessions take turns (round robin), so that one that
    sends much does not delay the others.

    Args:
        clock: Monotonic clock [s].

    Attributes:
        waited: Time that the request has waited which is carried out now [s]; 0 for one that has
            not waited.
    """

    def __init__(self, clock: Callable[[], float]) -> None:
        self.waited = 0.0
        self._clock = clock
        # The session whose turn is next is first. Sessions without work are left out.
        self._jobs: dict[Hashable, deque[_Job]] = {}
        self._turns = 0
        # Since when messages are read while samples wait [s].
        self._reading = 0.0
        self._is_scheduled = False

    def __len__(self) -> int:
        """Return the number of requests that wait."""
        return sum(map(len, self._jobs.values()))

    def is_waiting(self, key: Hashable) -> bool:
        """Return whether requests of a session wait."""
        return key in self._jobs

    def add(
        self,
        key: Hashable,
        run: Callable[[], None],
        schedule: Schedule,
        *,
        is_mapping: bool,
    ) -> None:
        """Let a request wait behind those of its session.

        Args:
            key: The session.
            run: Carries the request out; it must not raise.
            schedule: Calls the queue back.
            is_mapping: Whether it maps a sample, which stops overtake.

        Raises:
            RefusedError: `busy` if too many requests of the session wait.
        """
        jobs = self._jobs.get(key, ())
        if len(jobs) >= MOST_WAITING:
            message = f"{MOST_WAITING} requests of this session wait: send fewer"
            raise RefusedError("busy", message)
        self._append(key, _Job(run, self._clock(), is_mapping), schedule)

    def put(self, key: Hashable, run: Callable[[], None], schedule: Schedule) -> bool:
        """Let the newest sample wait; return whether it replaced one that waited.

        Args:
            key: What holds one sample at a time.
            run: Maps the sample; it must not raise.
            schedule: Calls the queue back.
        """
        if waiting := self._jobs.get(key):
            waiting[0].run = run
            return True
        self._append(key, _Job(run, self._clock(), is_mapping=True), schedule)
        return False

    def overtake(self, key: Hashable) -> None:
        """Make way for a stop: carry out what waits of a session, except its mappings.

        What arrived before a stop, such as a clearing, must not undo it afterwards.
        """
        jobs = self._jobs.get(key, ())
        due = [job for job in jobs if not job.is_mapping]
        if due:
            self._jobs[key] = deque(job for job in jobs if job.is_mapping)
            if not self._jobs[key]:
                del self._jobs[key]
        for job in due:
            job.run()

    def overtake_all(self) -> None:
        """Make way for a stop of all sessions."""
        for key in list(self._jobs):
            self.overtake(key)

    def _append(self, key: Hashable, job: _Job, schedule: Schedule) -> None:
        if not self._jobs:
            self._reading = job.since
        self._jobs.setdefault(key, deque()).append(job)
        self._go_on(schedule)

    def _go_on(self, schedule: Schedule) -> None:
        """Run once more while requests wait."""
        if self._jobs and not self._is_scheduled:
            self._is_scheduled = True
            schedule(lambda: self._turn(schedule))

    def _turn(self, schedule: Schedule) -> None:
        """Carry out what is due, unless messages must be read first."""
        self._is_scheduled = False
        began = now = self._clock()
        spent = began - self._reading
        if self._turns and spent < _LONGEST_TURNS:
            self._turns -= 1
        else:
            until = began + min(spent, _MOST_MAPPING)
            while self._jobs:
                now = self._run_next(now)
                if now >= until:
                    break
            took = now - began
            self._turns = _TURNS + int(took * _TURNS_PER_SECOND) if self._jobs else 0
            self._reading = now
        self._go_on(schedule)

    def _run_next(self, now: float) -> float:
        """Carry out the first request of the session whose turn it is; return the time then."""
        key = next(iter(self._jobs))
        jobs = self._jobs.pop(key)
        job = jobs.popleft()
        if jobs:
            # Its next turn comes after those of all others.
            self._jobs[key] = jobs
        self.waited = now - job.since
        job.run()
        self.waited = 0.0
        return self._clock()
