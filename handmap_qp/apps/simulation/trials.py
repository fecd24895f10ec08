"""Many pinches with random objects, and rows about them: `random_trials`, `success_rate`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from scipy.stats import binomtest

from handmap_qp.apps.simulation.objects import KINDS, named_shape
from handmap_qp.apps.simulation.pinch import PinchOutcome, PinchTrial
from handmap_qp.errors import expect

Objects = Literal["nominal", "varied"]
"""One object at random places, or random objects at random places."""

# Standard deviation of the place along each axis [m], and largest turn about the vertical [rad].
_PLACE, _YAW = 0.004, math.radians(20.0)
_SIZES = (0.02, 0.045)
_MASSES = (0.02, 0.2)
_FRICTIONS = (0.5, 1.0)


def random_trials(
    count: int,
    seed: int,
    objects: Objects = "varied",
    nominal: PinchTrial | None = None,
) -> list[PinchTrial]:
    """Draw objects and places.

    Every place is off by 4 mm (standard deviation) along each axis, and turned by up to 20 degrees.
    `varied` objects are cubes, spheres and cylinders, 20 to 45 mm wide, 20 to 200 g (uniform in the
    logarithm), with friction 0.5 to 1.0.

    Args:
        count: Number of trials.
        seed: Seed of the random numbers; the same seed gives the same trials.
        objects: Which objects.
        nominal: The object of `nominal` trials; the cube of `PinchTrial` if omitted.
    """
    fixed = nominal or PinchTrial()
    expect(count >= 1, "trials", "an integer >= 1", value=count)
    expect(seed >= 0, "seed", "an integer >= 0", value=seed)
    random = np.random.default_rng(seed)
    trials = []
    for _ in range(count):
        x, y, z = random.normal(0.0, _PLACE, 3).tolist()
        trial = replace(fixed, offset=(x, y, z), yaw=float(random.uniform(-_YAW, _YAW)))
        if objects == "varied":
            kind = str(random.choice(KINDS))
            trial = replace(
                trial,
                shape=named_shape(kind, float(random.uniform(*_SIZES))),
                mass=float(np.exp(random.uniform(*np.log(_MASSES)))),
                friction=float(random.uniform(*_FRICTIONS)),
            )
        trials.append(trial)
    return trials


def success_rate(held: int, count: int) -> tuple[float, float, float]:
    """Return a success rate with its 95 % interval (Wilson).

    Args:
        held: Number of successes.
        count: Number of trials.

    Returns:
        Rate, lower and upper end.
    """
    found = binomtest(held, count)
    interval = found.proportion_ci(method="wilson")
    return found.statistic, interval.low, interval.high


def trial_row(name: str, outcomes: Sequence[PinchOutcome]) -> dict[str, Any]:
    """Summarise the trials of one mapping in a row of a table."""
    held = [outcome for outcome in outcomes if outcome.is_held]
    rate, low, high = success_rate(len(held), len(outcomes))
    shares = [min(1.0, o.held_time / max(o.pinch_time, 1e-9)) for o in outcomes]
    return {
        "mapping": name,
        "trials": len(outcomes),
        "held %": round(100.0 * rate, 1),
        "95 % interval": f"{100.0 * low:.0f}-{100.0 * high:.0f}",
        "time held %": round(100.0 * float(np.mean(shares)), 1),
        "slip mm": _median([1e3 * outcome.slip for outcome in held]),
        "force N": _median([outcome.force for outcome in held]),
    }


def _median(values: list[float]) -> float | str:
    return round(float(np.median(values)), 1) if values else "-"


def describe_trial(trial: PinchTrial) -> dict[str, Any]:
    """Describe an object and its place by plain values, in metres, kilograms and radians."""
    return {
        "shape": type(trial.shape).__name__.lower(),
        "width": trial.shape.width,
        "mass": trial.mass,
        "friction": trial.friction,
        "offset": list(trial.offset),
        "yaw": trial.yaw,
    }


def outcome_row(name: str, outcome: PinchOutcome) -> dict[str, Any]:
    """Describe one trial in a row of a table."""
    return {
        "mapping": name,
        "held": "yes" if outcome.is_held else "no",
        "held s": round(outcome.held_time, 2),
        "of s": round(outcome.pinch_time, 2),
        "slip mm": round(1e3 * outcome.slip, 1),
        "rotation deg": round(math.degrees(outcome.rotation)),
        "force N": round(outcome.force, 1),
    }
