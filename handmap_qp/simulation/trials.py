"""Many pinches with random objects: `random_trials`, `run_trials`, `success_rate`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from handmap_qp.grasp.checks import whole_number
from handmap_qp.simulation.pinch import PinchOutcome, PinchScene, PinchTrial, Regulator
from handmap_qp.simulation.shapes import KINDS, named_shape

Objects = Literal["nominal", "varied"]
"""One object at random places, or random objects at random places."""

# Standard deviation of the place along each axis [m], and largest turn about the vertical [rad].
_PLACE, _YAW = 0.004, math.radians(20.0)
_SIZES, _MASSES, _FRICTIONS = (0.02, 0.045), (0.02, 0.2), (0.5, 1.0)


def random_trials(
    count: int, seed: int, objects: Objects = "varied", nominal: PinchTrial | None = None
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
    random = np.random.default_rng(whole_number(seed, "seed", least=0))
    trials = []
    for _ in range(whole_number(count, "trials", least=1)):
        x, y, z = random.normal(0.0, _PLACE, 3)
        yaw = random.uniform(-_YAW, _YAW)
        place: dict[str, Any] = {"offset": (float(x), float(y), float(z)), "yaw": float(yaw)}
        if objects == "varied":
            kind = str(random.choice(KINDS))
            place |= {
                "shape": named_shape(kind, float(random.uniform(*_SIZES))),
                "mass": float(np.exp(random.uniform(*np.log(_MASSES)))),
                "friction": float(random.uniform(*_FRICTIONS)),
            }
        trials.append(replace(fixed, **place))
    return trials


def run_trials(
    scene: PinchScene,
    trials: Sequence[PinchTrial],
    progress: Callable[[int], None] | None = None,
    regulator: Regulator | None = None,
) -> list[PinchOutcome]:
    """Simulate trials one after the other.

    Args:
        scene: The robot with the commands of one mapping.
        trials: Objects and places.
        progress: Called after each trial with the number of trials done.
        regulator: Squeeze term; position control alone if omitted.
    """
    outcomes = []
    for trial in trials:
        outcomes.append(scene.run(trial, regulator))
        if progress is not None:
            progress(len(outcomes))
    return outcomes


def success_rate(held: int, count: int) -> tuple[float, float, float]:
    """Return a success rate with its 95 % interval (Wilson).

    Args:
        held: Number of successes.
        count: Number of trials.

    Returns:
        Rate, lower and upper end.
    """
    z, rate = 1.959964, held / count
    centre = (rate + z * z / (2 * count)) / (1 + z * z / count)
    half = z * math.sqrt(rate * (1 - rate) / count + z * z / (4 * count**2)) / (1 + z * z / count)
    return rate, max(0.0, centre - half), min(1.0, centre + half)


def trial_row(name: str, outcomes: Sequence[PinchOutcome]) -> dict[str, Any]:
    """Summarise the trials of one mapping in a row of a table."""
    held = [outcome for outcome in outcomes if outcome.is_held]
    rate, low, high = success_rate(len(held), len(outcomes))
    shares = [min(1.0, o.held_time / max(o.pinch_time, 1e-9)) for o in outcomes]
    kept = [1e3 * outcome.slip for outcome in held]
    return {
        "mapping": name,
        "trials": len(outcomes),
        "held %": round(100.0 * rate, 1),
        "95 % interval": f"{100.0 * low:.0f}-{100.0 * high:.0f}",
        "time held %": round(100.0 * float(np.mean(shares)), 1),
        "slip mm": round(float(np.median(kept)), 1) if kept else "-",
        "force N": round(float(np.median([o.force for o in held])), 1) if held else "-",
    }


def describe_trial(trial: PinchTrial) -> dict[str, Any]:
    """Describe an object and its place by plain values, in metres, kilograms and radians."""
    return {
        "shape": trial.kind,
        "width": trial.size,
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
