"""Where the left hand has the bar of `handmap score --tasks hand-over`, and whether it keeps it.

    python benchmarks taken_bars --methods picking teleoperation --seeds 12500 12600 --attempts 6

The instant is the last one at which both hands touch the bar: the right hand lets go then. Heights
are those of the left pads' surfaces in the bar's frame, whose faces end 12 mm below and above its
middle. A pad that is lower than that presses on an edge.
"""

from __future__ import annotations

# isort: split
import argparse
from typing import NamedTuple

import numpy as np
from handmap_score.tasks.handing import HandOverTask
from handmap_score.tasks.mapping import Mapping, make_mapping
from handmap_score.tasks.operator import OTHER
from handmap_score.tasks.touch import Contacts
from handmap_score.tasks.two_hands import TwoHands

from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.apps.tables import Row, print_result
from handmap_qp.hands import load_hand
from handmap_qp.se3 import inverse_pose, transform_points

_AFTERWARDS = 2.0  # time for which the bar is watched when the person has finished [s]
_EDGE = -12.0  # height of the bar's lower edge [mm]


class Take(NamedTuple):
    """How the left hand has the bar when the right one lets go.

    Attributes:
        thumb: Height of the thumb's pad on the bar [mm].
        finger: Height of the index finger's [mm].
        is_kept: Whether the attempt succeeded.
    """

    thumb: float
    finger: float
    is_kept: bool


def take_of(
    task: HandOverTask, person: TwoHands, mapping: Mapping, seed: int
) -> Take | None:
    """Return how the bar is taken in one attempt; None if both hands never have it."""
    scene = task.reset(seed)
    person.reset(seed)
    mapping.reset()
    assert task.other is not None
    right = Contacts(task.model, task.robot, [OBJECT])
    left = Contacts(task.model, task.other, [OBJECT], OTHER)
    heights: list[float] = []
    held = idle = 0
    for _ in range(round(task.time_limit / task.time_step)):
        hand = person.see(scene)
        scene = task.step(hand, mapping.map(hand, task.time_step))
        if right.by_link(task.data) and left.by_link(task.data):
            bar = inverse_pose(scene.poses["object"])
            pads = transform_points(bar, scene.points[f"{OTHER}pads"])
            heights = (1e3 * pads[:, 2]).tolist()
        held = held + 1 if scene.signals.is_reached else 0
        idle = idle + 1 if person.has_finished else 0
        if held == task.hold or idle * task.time_step > _AFTERWARDS:
            break
    return Take(*heights, is_kept=held == task.hold) if heights else None


def row_of(method: str, hand: str, seeds: list[int], attempts: int) -> Row:
    """Return the row of a mapping.

    Args:
        method: Its name, as of `handmap score --tasks`.
        hand: The robot hand.
        seeds: Of each block the seed of the calibration and of the first attempt.
        attempts: Number of attempts of each block.
    """
    robot = load_hand(hand)
    task = HandOverTask(robot)
    person = TwoHands(robot)
    found = []
    for first in seeds:
        mapping = make_mapping(method, person, robot, first, task.other)
        found += [
            take_of(task, person, mapping, seed)
            for seed in range(first, first + attempts)
        ]
    takes = [take for take in found if take]
    on_edge = [take for take in takes if min(take.thumb, take.finger) < _EDGE]
    inside = [take for take in takes if take not in on_edge]
    thumb, finger = np.mean([take[:2] for take in takes], axis=0).tolist()
    return {
        "mapping": method,
        "taken": f"{len(takes)} of {len(found)}",
        "thumb's height [mm]": round(thumb, 1),
        "finger's height [mm]": round(finger, 1),
        "kept, with a pad on the lower edge": _kept(on_edge),
        "kept, others": _kept(inside),
    }


def _kept(takes: list[Take]) -> str:
    return f"{sum(take.is_kept for take in takes)} of {len(takes)}"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--hand", default="leap_right")
    parser.add_argument("--methods", nargs="+", default=["teleoperation", "picking"])
    parser.add_argument("--seeds", type=int, nargs="+", default=[12500, 12600])
    parser.add_argument("--attempts", type=int, default=6)
    given = parser.parse_args()
    rows = [
        row_of(method, given.hand, given.seeds, given.attempts)
        for method in given.methods
    ]
    print_result({}, {"Taking a bar": rows}, [], as_json=False)


if __name__ == "__main__":
    main()
