"""`RobotFollower`: a robot follows the samples of both hands of a person that make sense.

Each hand has the guard, the return and the smoothing of a `Follower`; the robot moves once for all.
"""

import math
from collections.abc import Iterator, Mapping
from copy import deepcopy
from typing import Any

import numpy as np

from handmap_qp.errors import HandmapError, expect
from handmap_qp.hands import Side
from handmap_qp.human import HumanSample, Recording, Verdict, sample_columns
from handmap_qp.mapping import MapStep, RobotMapper, RobotStep
from handmap_qp.mapping.exclusive import exclusively
from .follower import Follower

_SILENCE = 0.25
"""Time without a sample after which a hand is held [s]."""


class RobotFollower:
    """Lets a robot follow the samples of a tracker of both hands.

    A hand whose sample makes no sense, or that has been without one for a quarter
    of a second, holds its side of the robot; the other one is followed.

    Args:
        mapper: Maps the samples; its human hands must be scaled to the person.
        **options: As of `Follower`.

    Attributes:
        mapper: As given.
        hands: The follower of each hand, by side.
    """

    def __init__(self, mapper: RobotMapper, **options: Any) -> None:
        self.mapper = mapper
        self.work = mapper.work
        self.hands = {
            side: Follower(leader, **options) for side, leader in mapper.leaders.items()
        }
        self._seen = dict.fromkeys(self.hands, -math.inf)

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @exclusively
    def map_samples(
        self,
        samples: Mapping[Side, HumanSample],
        *,
        dt: float | None = None,
        arrival: float | None = None,
    ) -> RobotStep:
        """Map one sample of each hand that has one; arguments and errors as of `Follower`.

        A hand without a sample goes on to what it asked for last.
        """
        expect(
            isinstance(samples, Mapping),
            "samples",
            "a HumanSample of each hand by side",
            value=samples,
        )
        followed: dict[Side, MapStep] = {}

        def follow(side: Side) -> MapStep:
            followed[side] = self.hands[side].map_sample(
                samples[side], dt=dt, arrival=arrival
            )
            return followed[side]

        try:
            step = self.mapper.step(samples, follow)
        except HandmapError:
            # The hand whose sample was refused is as it was before by itself.
            for side, step in followed.items():
                self.hands[side].forget(step)
            raise
        newest = max(sample.time for sample in samples.values())
        self._seen |= dict.fromkeys(samples, newest)
        for side, time in self._seen.items():
            # The tracker's clock may also have been set back.
            if abs(newest - time) > _SILENCE:
                self.mapper.stay(side, Verdict("missing", True, False, 0.0, math.nan))
        return step


def paired(recordings: Mapping[Side, Recording]) -> Iterator[dict[Side, HumanSample]]:
    """Yield the samples of both hands at the instants of the one that has most.

    The other one's are the newest at each instant, and used once.
    """
    leading = max(recordings.values(), key=len)
    columns = {side: sample_columns(each) for side, each in recordings.items()}
    before = dict.fromkeys(columns, -1)
    for time in leading.time:
        newest = {
            side: np.searchsorted(each.time, time, "right") - 1
            for side, each in columns.items()
        }
        yield {s: columns[s].sample(k) for s, k in newest.items() if k > before[s]}
        before = newest
