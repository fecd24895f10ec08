"""Overlaps of links on the ways of the service that no mapper leads: to rest, and to a posture.

A gate moves a robot between random postures that are clear of overlaps, and brakes now and
then. The same ways are taken straight too, as they would be without a check. `checker.py` judges
them, at the samples and between them. The exit code is 1 if a checked way has an overlap above
0.1 mm, or a limit is exceeded.

    nice python tests/judges slews --json slews.json
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

import common
import numpy as np
from checker import Checker
from overlap import OverlapMeter
from self_collision import HANDS, load

from handmap_qp import IkOptions
from handmap_qp.apps.service.safety import CommandedRobot
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik.qp import PointIk

_ACCELERATIONS = (None, 5.0, 20.0, 100.0)
_MOST_SAMPLES = 600
_STANDING = 1e-5
"""A robot that moves less in one sample has come to a stand [rad]."""


class Slews:
    """Random ways of one hand, and their worst figures.

    Args:
        hand: The hand.
        is_checked: Whether ways are checked for overlaps.
        seed: Seed of the postures.
    """

    def __init__(self, hand: Hand, is_checked: bool, seed: int) -> None:
        self._hand, self._is_checked = hand, is_checked
        self._pairs = all_pairs(hand)
        self._meter = OverlapMeter(hand, self._pairs)
        self._rng = np.random.default_rng(seed)
        self.checker = Checker(hand, self._pairs)
        self.overlapping = self.arrived = self.count = 0
        self.times: list[float] = []

    def run(self, most: float | None, share: float, *, to_rest: bool) -> None:
        """Take one way, from a random posture to rest or to another one.

        Args:
            most: Limit of acceleration; None for none.
            share: Share of the speed limits.
            to_rest: Whether the way ends in the rest posture.
        """
        hand, rng = self._hand, self._rng
        contacts = self._pairs if self._is_checked else None
        guard = CommandedRobot(hand, self._clear())
        guard.obey(PointIk(hand, IkOptions(max_acceleration=most), contacts=contacts))
        goal = hand.rest if to_rest else self._clear()
        is_there, checker, found = (
            False,
            self.checker,
            self.checker.violations["overlap"],
        )
        checker.start(guard.motion.q)
        for _ in range(_MOST_SAMPLES):
            before, dt, started = guard.q, rng.uniform(0.002, 0.033), time.thread_time()
            if is_braking := rng.random() < 0.1:
                guard.brake(dt)
            else:
                is_there = guard.move_to(goal, None, dt, share)
            self.times.append(time.thread_time() - started)
            checker.take(guard.motion.q, checker.time + dt, most)
            is_moving = np.abs(guard.q - before).max() > _STANDING
            if is_there or not (is_braking or is_moving or guard.motion.is_braking):
                break
        self.overlapping += checker.violations["overlap"] > found
        self.arrived += is_there
        self.count += 1

    def row(self) -> dict[str, Any]:
        """Return the figures."""
        times = 1e3 * np.array(self.times)
        return {
            "hand": self._hand.name,
            "ways": "checked" if self._is_checked else "straight",
            "slews": self.count,
            "overlap [mm]": 1e3 * self.checker.worst["overlap"],
            "overlapping [%]": 100.0 * self.overlapping / self.count,
            "arrived [%]": 100.0 * self.arrived / self.count,
            "speed / limit": self.checker.worst["speed"],
            "acceleration / limit": self.checker.worst["acceleration"],
            "p50 [ms]": float(np.median(times)),
            "p99 [ms]": float(np.quantile(times, 0.99)),
        }

    def _clear(self) -> np.ndarray:
        """Return a random posture without an overlap, shape (n,)."""
        hand = self._hand
        while True:
            q = self._rng.uniform(hand.lower_limits, hand.upper_limits)
            if self._depth(q) == 0.0:
                return q

    def _depth(self, q: np.ndarray) -> float:
        return self._meter.depth(self._hand.configuration_vector(q))


def main(words: Sequence[str] | None = None) -> None:
    """Take all ways, print the table."""
    parser = common.make_parser("Overlaps on ways that no mapper leads.", draws=False)
    parser.add_argument("--hands", nargs="+", choices=HANDS, default=list(HANDS))
    parser.add_argument(
        "--slews", type=int, default=100, help="ways of each hand and kind"
    )
    parser.add_argument("--seed", type=int, default=0)
    arguments = common.parse_arguments(parser, words)
    count = 8 if arguments.quick else arguments.slews
    rows: list[dict[str, Any]] = []
    broken = Counter[str]()
    with common.progress("hands", 2 * len(arguments.hands)) as advance:
        for hand in map(load, arguments.hands):
            for is_checked in (False, True):
                slews = Slews(hand, is_checked, arguments.seed)
                for i in range(count):
                    most, share = _ACCELERATIONS[i // 2 % 4], 1.0 if i % 3 else 0.5
                    slews.run(most, share, to_rest=bool(i % 2))
                rows.append(slews.row())
                broken += slews.checker.violations
                if not is_checked:
                    del broken["overlap"]
                advance()
    common.print_table("Slews", rows, to_stderr=arguments.json == "-")
    common.write_json(arguments.json, "slews", {"rows": rows})
    if broken:
        print("exceeded:", broken)
        raise SystemExit(1)


if __name__ == "__main__":
    main()
