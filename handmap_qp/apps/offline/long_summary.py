"""Summary of a motion of hours: `summarise_long`."""

from collections import Counter

from handmap_qp.hands import Values
from handmap_qp.trackers import PIECE
from .long_motion import LongMotion
from .summary import (
    by_instants,
    count_broken,
    holds_in,
    plain_values,
    steps_in,
    summarise,
)
from .trajectory import Trajectory

_BEFORE = 2
"""Samples before a piece that its accelerations need."""


def summarise_long(motion: LongMotion, overview: Trajectory) -> Values:
    """Summarise a motion as `summarise`.

    Of more samples than the overview has, counts, holds, largest values and the times between
    samples are of all. Means, medians, percentiles and shares are of the overview.

    Args:
        motion: The motion.
        overview: Its samples that the overview of the recording has.
    """
    found = summarise(overview)
    if len(overview.time) == len(motion):
        return found
    return plain_values(found | _of_all(motion))


def _of_all(motion: LongMotion) -> Values:
    """Return what a summary says of all samples."""
    count = len(motion)
    instants = motion.column("time")
    valid = motion.column("valid")
    rules = Counter[str]()
    largest: dict[str, list[float]] = {}
    at_limit = 0
    for start in range(0, count, PIECE):
        before = min(_BEFORE, start)
        part = motion.trajectory(slice(start - before, min(start + PIECE, count)))
        rules.update(part.rule[before:].tolist())
        at_limit += int(part.at_limit[before:].any(axis=1).sum())
        errors = part.point_error[part.valid]
        values = by_instants(part) | {
            "limit_violation_max": part.limit_violation,
            "point_error_mm_max": 1e3 * errors.max() if errors.size else None,
        }
        for name, value in values.items():
            if name.endswith("_max") and value is not None:
                largest.setdefault(name, []).append(value)
    return {
        "samples": count,
        "held": int((~valid).sum()),
        "rules": count_broken(rules),
        "events": holds_in(instants, valid, motion.rule_at),
        "samples_at_limit": at_limit,
        "steps_ms": steps_in(instants),
        **{name: max(values) for name, values in largest.items()},
    }
