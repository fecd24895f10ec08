"""`RobotFollower`: a robot follows the samples of both hands of a person that make sense.

`handmap_core.stream.robot_follower` follows; here its guards know the orders of all layouts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Literal

from handmap_core.se3 import Array
from handmap_core.stream import robot_follower
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.smoothing import Smoothing
from handmap_qp.hands import Side
from handmap_qp.human import HumanSample, Recording, newest_at, sample_columns
from handmap_qp.mapping import RobotMapper
from .guard import BEHIND, StreamGuard


class RobotFollower(robot_follower.RobotFollower[RobotMapper]):
    """Lets a robot follow the samples of a tracker of both hands.

    A hand whose sample makes no sense, or that has been without one for a quarter
    of a second, holds its side of the robot; the other one is followed.

    Args:
        mapper: Maps the samples; its human hands must be scaled to the person.
        rejoin: As of `Follower`.
        smoothing: Likewise.

    Attributes:
        mapper: As given.
        hands: The follower of each hand, by side.
    """

    def __init__(
        self,
        mapper: RobotMapper,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        guards = {
            side: StreamGuard(source.human) for side, source in mapper.sources.items()
        }
        super().__init__(mapper, guards, rejoin=rejoin, smoothing=smoothing)


def paired(recordings: Mapping[Side, Recording]) -> Iterator[dict[Side, HumanSample]]:
    """Yield the samples of both hands at the instants of the one that has most.

    The other one's are the newest at each instant, and used once. At the first instant, one that is
    more than `BEHIND` older is left out: it would say that the hands have different clocks.
    """
    leading = max(recordings, key=lambda side: len(recordings[side]))
    parts = {side: iter([each]) for side, each in recordings.items()}
    for _, samples in paired_parts(parts, leading):
        yield from samples


def paired_parts(
    parts: Mapping[Side, Iterator[Recording]], leading: Side
) -> Iterator[tuple[Array, Iterator[dict[Side, HumanSample]]]]:
    """Pair the samples of both hands as `paired`, of recordings that are read by parts.

    Args:
        parts: Consecutive parts of the recording of each hand.
        leading: The hand whose instants count.

    Yields:
        The instants of each part of the leading hand [s], shape (T,), and its T pairs, which must
        be taken before the next part is.
    """
    sides = [*parts]
    others = {side: _Newest(parts[side]) for side in sides if side != leading}
    before: dict[Side, int] = {}
    for part in map(sample_columns, parts[leading]):
        if not before:
            stale = part.time[0] - BEHIND
            before = {s: each.index_at(stale, "left") for s, each in others.items()}
        yield part.time, _pairs(part, sides, others, before)


def _pairs(
    part: Recording,
    sides: Sequence[Side],
    others: Mapping[Side, _Newest],
    before: dict[Side, int],
) -> Iterator[dict[Side, HumanSample]]:
    """Yield the samples of both hands at the instants of a part of the leading one.

    Args:
        part: The part.
        sides: All hands, in their order.
        others: The other hands.
        before: Index of the newest sample of each that was taken, which is kept up to date.
    """
    for i, time in enumerate(part.time):
        pair: dict[Side, HumanSample] = {}
        for side in sides:
            if side not in others:
                pair[side] = part.sample(i)
                continue
            newest = others[side].index_at(time, "right")
            if newest > before[side]:
                pair[side] = others[side].sample(newest)
            before[side] = newest
        yield pair


class _Newest:
    """Finds the newest sample of a hand at instants that do not go back.

    Args:
        parts: Consecutive parts of its recording; two of them are in the memory at once.
    """

    def __init__(self, parts: Iterator[Recording]) -> None:
        self._parts = map(sample_columns, parts)
        self._part = next(self._parts)
        self._following = next(self._parts, None)
        # Index of the first sample of the part.
        self._first = 0

    def index_at(self, time: float, side: Literal["left", "right"]) -> int:
        """Return the index of the newest sample at an instant [s]; -1 if there is none.

        Args:
            time: The instant.
            side: Whether a sample at that instant counts: `right` if it does.
        """
        while self._following is not None and self._following.time[0] <= time:
            self._first += len(self._part)
            self._part = self._following
            self._following = next(self._parts, None)
        return self._first + int(newest_at(self._part.time, time, side))

    def sample(self, index: int) -> HumanSample:
        """Return the newest sample, of the index that was found last."""
        return self._part.sample(index - self._first)
