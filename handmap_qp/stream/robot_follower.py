"""`RobotFollower`: a robot follows the samples of both hands of a person that make sense.

`handmap_core.stream.robot_follower` follows; here its guards know the orders of all layouts.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from handmap_core.stream import robot_follower
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.smoothing import Smoothing
from handmap_qp.hands import Side
from handmap_qp.human import HumanSample, Recording, sample_columns
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
    leading = max(recordings.values(), key=len)
    columns = {side: sample_columns(each) for side, each in recordings.items()}
    stale = leading.time[0] - BEHIND
    before = {
        side: np.searchsorted(each.time, stale, "left") - 1
        for side, each in columns.items()
    }
    for time in leading.time:
        newest = {
            side: np.searchsorted(each.time, time, "right") - 1
            for side, each in columns.items()
        }
        yield {s: columns[s].sample(k) for s, k in newest.items() if k > before[s]}
        before = newest
