"""Trials and outcomes of pinches as rows of tables."""

import math
from collections.abc import Sequence

import numpy as np

from handmap_qp.apps.success_rate import success_rate
from handmap_qp.apps.tables import Row
from handmap_qp.mapping import surface
from .pinch import PinchOutcome, PinchTrial


def trial_row(name: str, outcomes: Sequence[PinchOutcome]) -> Row:
    """Summarise the trials of one mapping in a row of a table."""
    rows = [outcome_row(name, outcome) for outcome in outcomes]
    held = [row for row in rows if row["held"] == "yes"]
    shares = [o.held_time / max(o.pinch_time, 1e-9) for o in outcomes]
    medians = {
        key: round(np.median([row[key] for row in held]), 2) if held else "-"
        for key in ("slip mm", "slide mm", "force N", "torque N m")
    }
    return {
        "mapping": name,
        "trials": len(rows),
        "held %": "-",
        "95 % interval": "-",
        "time held %": "-",
        **medians,
    } | _shares(len(held), shares)


def _shares(held: int, shares: Sequence[float]) -> Row:
    """Return columns of what was held of the objects that could be tried; none of no objects."""
    if not shares:
        return {}
    rate, low, high = success_rate(held, len(shares))
    return {
        "held %": round(100.0 * rate, 1),
        "95 % interval": f"{100.0 * low:.0f}-{100.0 * high:.0f}",
        "time held %": round(100.0 * np.mean(shares), 1),
    }


def describe_trial(trial: PinchTrial) -> Row:
    """Describe an object and its place by plain values, in metres, kilograms and radians.

    `place_error` is in standard deviations.
    """
    return trial._asdict() | {
        "shape": type(trial.shape).__name__.lower(),
        "width": float(surface(trial.shape).extents[0]),
        "offset": list(trial.offset),
        "place_error": list(trial.place_error),
    }


OUTCOME_COLUMNS = (
    "held",
    "held s",
    "of s",
    "slip mm",
    "slide mm",
    "rotation deg",
    "force N",
    "torque N m",
    "why not",
)
"""Columns of `outcome_row`, without the mapping's name."""


def outcome_row(name: str, outcome: PinchOutcome) -> Row:
    """Describe one trial in a row of a table."""
    values = (
        "yes" if outcome.is_held else "no",
        round(outcome.held_time, 2),
        round(outcome.pinch_time, 2),
        round(1e3 * outcome.slip, 1),
        round(1e3 * outcome.slide, 1),
        round(math.degrees(outcome.rotation)),
        round(outcome.force, 1),
        round(outcome.torque, 2),
        outcome.loss or "",
    )
    return {"mapping": name} | dict(zip(OUTCOME_COLUMNS, values, strict=True))
