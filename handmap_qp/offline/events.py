"""Events of a mapped motion: the holds, by name and time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp.offline.trajectory import Trajectory


class HoldEvent(NamedTuple):
    """One hold of the robot.

    Attributes:
        rule: The rule that began it (`stream.guard.RULES`).
        start: Time of its first sample, from the first sample of all on [s].
        duration: Time from there to the first sample that is followed again, or to the end [s].
        samples: Number of samples that were not followed.
    """

    rule: str
    start: float
    duration: float
    samples: int


def find_holds(trajectory: Trajectory) -> list[HoldEvent]:
    """Find the holds of a mapped motion.

    Args:
        trajectory: The robot's trajectory.

    Returns:
        The holds, in the order of time.
    """
    time, is_held = trajectory.time - trajectory.time[0], ~trajectory.valid
    edges = np.diff(is_held.astype(int), prepend=0, append=0)
    begins, ends = np.flatnonzero(edges == 1), np.flatnonzero(edges == -1)
    return [
        HoldEvent(
            str(trajectory.rule[begin]),
            float(time[begin]),
            float(time[min(end, len(time) - 1)] - time[begin]),
            int(end - begin),
        )
        for begin, end in zip(begins, ends, strict=True)
    ]


def count_rules(trajectory: Trajectory) -> dict[str, int]:
    """Count the samples that break each rule, most frequent first."""
    rules, counts = np.unique(trajectory.rule[trajectory.rule != ""], return_counts=True)
    order = np.argsort(-counts, kind="stable")
    return {str(rules[i]): int(counts[i]) for i in order}
