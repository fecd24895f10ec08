"""How much of its time a server works, and what it does when that is too much.

The load is the share of time in which the event loop does not wait for events. It is measured over
windows of a second, with the samples mapped in it and the time that they had to wait.

- A new session is refused if the load would exceed the limit with it. It is expected to take what
  those of the same robot take on average, or else all.
- If samples wait too long all the same, the sessions opened last are *shed*: their samples are
  answered `busy`, and their robots hold. The session opened first is never shed. Sessions come back
  in the order in which they were opened, as soon as there is room.
- Samples alone are refused. A stop, and every other request, is carried out in any session.
"""

import math
import selectors
import time
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NoReturn

from handmap_core.errors import RefusedError
from .fairness import AccountBuckets

WINDOW = 1.0
"""Time over which the load is measured [s]."""
LATE = 0.02
"""Mean wait of samples above which a server that has no time left is overloaded [s]."""
_SATURATED = 0.95
"""Load at which no time is left; some passes in the selector itself."""
_WINDOWS = 2
"""Windows of overload, or of room, before sessions are shed, or come back."""
_SAID = 10.0
"""Refusals a second that are told in the stream of a session."""
_SHED = 1.0 / 8.0
"""Share of the sessions to shed at once, unless the samples left out tell it."""


class TimedSelector(selectors.DefaultSelector):
    """A selector for an event loop, which adds up the time that it waits for events.

    Args:
        clock: Monotonic clock [s].

    Attributes:
        waited: The time [s].
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        super().__init__()
        self.waited = 0.0
        self._clock = clock

    def select(
        self, timeout: float | None = None
    ) -> list[tuple[selectors.SelectorKey, int]]:
        """Wait for events."""
        began = self._clock()
        try:
            return super().select(timeout)
        finally:
            self.waited += self._clock() - began


@dataclass(frozen=True, slots=True)
class Window:
    """What a server did in a window.

    Attributes:
        load: Share of time in which it did not wait; NaN if that is not measured.
        rate: Samples mapped per second.
        wait: Mean time that they waited [s].
        shares: Share of time that the samples of each session took.
        replaced: Samples replaced by newer ones before they were mapped, for each one mapped.
    """

    load: float = math.nan
    rate: float = 0.0
    wait: float = 0.0
    shares: Mapping[str, float] = field(default_factory=dict)
    replaced: float = 0.0

    @property
    def is_overloaded(self) -> bool:
        """Whether samples wait too long because no time is left."""
        return self.load >= _SATURATED and self.wait > LATE

    @property
    def share_of_one(self) -> float:
        """Share of time that a session takes on average, with its messages."""
        return self.load / len(self.shares) if self.shares else 0.0

    def expected(self, names: Sequence[str]) -> float:
        """Return the share of time that a session takes if it is like others.

        Args:
            names: Those that it is like, whose samples may not have arrived.
        """
        alike = [self.shares[name] for name in names if name in self.shares]
        if not alike:
            return self.share_of_one
        mapping = sum(self.shares.values())
        # Messages take time, too: in proportion to the time that the samples take.
        return max(self.load, mapping) * sum(alike) / len(alike) / mapping


class LoadMeter:
    """Measures the load of a server, and decides whom it serves.

    Args:
        limit: Load above which no session is opened; 1 opens and sheds without a limit.
        clock: Monotonic clock [s].

    Attributes:
        limit: As given.
        waited: Returns the time that the event loop has waited for events [s]; None if that is not
            known, in which case nobody is refused.
        ends: Time at which the present window is over, and `update` is due [s].
        last: The last whole window.
        shed: Names of the sessions whose samples are refused.
    """

    def __init__(
        self, limit: float = 1.0, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.limit = limit
        self.waited: Callable[[], float] | None = None
        self.last = Window()
        self.shed: frozenset[str] = frozenset()
        self._said = AccountBuckets(_SAID, 1.0, clock)
        self._overloaded = 0
        self._roomy = 0
        self._begun = clock()
        self._waited_before = 0.0
        self._begin(self._begun)

    def note(self, name: str, wait: float, took: float) -> None:
        """Count a sample that was mapped.

        Args:
            name: Name of its session.
            wait: Time that it waited [s].
            took: Time that it took [s].
        """
        self._samples += 1
        self._waits += wait
        self._took[name] += took

    def note_replaced(self) -> None:
        """Count a sample that was replaced before it was mapped."""
        self._replaced += 1

    def update(self, now: float, names: Sequence[str]) -> None:
        """End the window if it is over, and decide whose samples are refused in the next one.

        Args:
            now: The present [s].
            names: Names of the open sessions, in the order in which they were opened.
        """
        elapsed = now - self._begun
        if elapsed < WINDOW:
            return
        self.last = Window(
            load=self._share_of(elapsed),
            rate=self._samples / elapsed,
            wait=self._waits / self._samples if self._samples else 0.0,
            shares={name: took / elapsed for name, took in self._took.items()},
            replaced=self._replaced / self._samples if self._samples else 0.0,
        )
        self._begin(now)
        self._decide(names)

    def check_room(self, sessions: int, waiting: int, alike: Sequence[str]) -> None:
        """Refuse a session that the server has no time for.

        Args:
            sessions: Number of open sessions.
            waiting: Number of those that have sent no sample yet, and need room, too.
            alike: Names of those with the same robot.

        Raises:
            RefusedError: `busy`.
        """
        last = self.last
        wanted = last.load + (1 + waiting) * last.expected(alike)
        # A session alone may take all. NaN, of a load that is not measured, is not above a limit.
        if self.limit >= 1.0 or not sessions or not wanted > self.limit:
            return
        message = (
            f"{self._served(sessions)}: a further session would exceed {self.limit:.0%}"
        )
        raise RefusedError("busy", message)

    def may_say(self, name: str) -> bool:
        """Return whether the stream of a session may say once more that its samples are refused."""
        return self._said.take(name)

    def refuse_sample(self, sessions: int) -> NoReturn:
        """Refuse a sample of a session that is shed; raises `RefusedError`, `busy`.

        Args:
            sessions: Number of open sessions.
        """
        message = (
            f"{self._served(sessions)}, of which the {len(self.shed)} opened last are not served: "
            "the robot holds"
        )
        raise RefusedError("busy", message)

    def _served(self, sessions: int) -> str:
        """Return what the server does, in words."""
        last = self.last
        return (
            f"the server works {last.load:.0%} of the time, for {sessions} sessions with "
            f"{last.rate:.0f} samples a second"
        )

    def _begin(self, now: float) -> None:
        """Begin a window."""
        self._begun = now
        self.ends = now + WINDOW
        self._samples = 0
        self._waits = 0.0
        self._replaced = 0
        self._took = defaultdict[str, float](float)

    def _share_of(self, elapsed: float) -> float:
        """Return the load since the last call."""
        if self.waited is None:
            return math.nan
        waited = self.waited()
        share = 1.0 - (waited - self._waited_before) / elapsed
        self._waited_before = waited
        return min(max(share, 0.0), 1.0)

    def _decide(self, names: Sequence[str]) -> None:
        """Shed the sessions opened last, or let the first of those that are shed come back."""
        shed = self.shed.intersection(names)
        last = self.last
        served = [name for name in names if name in last.shares and name not in shed]
        has_room = bool(shed) and last.load + last.share_of_one <= self.limit
        self._overloaded = self._overloaded + 1 if last.is_overloaded else 0
        self._roomy = self._roomy + 1 if has_room else 0
        if self.limit < 1.0 and self._overloaded >= _WINDOWS:
            self._overloaded = 0
            shed = shed.union(served[self._kept(len(served)) :])
        elif self._roomy >= _WINDOWS:
            self._roomy = 0
            shed = shed.difference([name for name in names if name in shed][:1])
        self.shed = shed

    def _kept(self, served: int) -> int:
        """Return how many sessions can be served: one at least."""
        share = min(1.0 - _SHED, 1.0 / (1.0 + self.last.replaced))
        return max(1, math.floor(served * share))
