"""What every episode of a batch is measured by, without a reference to compare with.

`measures.yaml` has names, units and meaning of the measures.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from handmap_qp.apps.offline.metrics import Metric
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.offline.trajectory import Trajectory, rms_derivative
from handmap_qp.hands.human import FINGERS
from handmap_qp.human.contact_gap import tip_gaps
from handmap_qp.human.recording import Recording
from handmap_qp.ik.core import core
from handmap_qp.se3 import lengths

MOST_SURFACES = 60
"""Surfaces are measured in at most this many samples, evenly spread."""
_CLOSED, _DEEP = 0.003, 0.001  # m
_PINCHING = 0.004  # m above the contact gap


MEASURES: tuple[Metric, ...] = msgspec.yaml.decode(
    Path(__file__).with_suffix(".yaml").read_bytes(),
    type=tuple[Metric, ...],
)
"""All measures, in the order of the report."""


def measure_episode(
    recording: Recording,
    trajectory: Trajectory,
    contact_gap: float,
    meter: GapMeter | None,
) -> dict[str, float | None]:
    """Measure an episode.

    Args:
        recording: What the human did.
        trajectory: What the robot does.
        contact_gap: Gap of tip landmarks where the skin touches [m].
        meter: The robot's surfaces; None where it has none.

    Returns:
        Values by the keys of `MEASURES`, rounded to six digits; None where a question does not
        arise.
    """
    measure = _measured if core is None else core.measure_episode
    values = measure(recording, trajectory)
    if meter is not None:
        values |= _surfaces(recording, trajectory, contact_gap, meter)
    found = ((each.key, values.get(each.key, np.nan)) for each in MEASURES)
    return {
        key: float(f"{value:.6g}") if np.isfinite(value) else None
        for key, value in found
    }


def _measured(recording: Recording, trajectory: Trajectory) -> dict[str, Any]:
    """Measure all but surfaces; see `MEASURES`."""
    seen = trajectory.valid
    errors = 1e3 * trajectory.point_error[seen]
    fingers = recording.landmarks[recording.valid, 1:].reshape(-1, 5, 4, 3)
    bones = lengths(np.diff(fingers, axis=2))
    # The longest time between valid samples, beyond the usual step.
    whole = recording.time
    times = whole[recording.valid]
    inside = np.diff(times).max(initial=0.0) - np.median(recording.steps)
    gap = max(0.0, inside, times[0] - whole[0], whole[-1] - times[-1])
    return {
        "valid": recording.valid.mean(),
        "longest_gap_s": gap,
        "bone_variation": (bones.std(axis=0) / bones.mean(axis=0)).mean(),
        "reach_mm": errors.mean(),
        "reach_p95_mm": np.percentile(errors, 95),
        "saturation": trajectory.at_limit[seen].mean(),
        "speed_limited": trajectory.at_speed_limit[seen].any(axis=1).mean(),
        "jerk": rms_derivative(trajectory.q, trajectory.time, seen, order=3),
    }


def _surfaces(
    recording: Recording,
    trajectory: Trajectory,
    contact_gap: float,
    meter: GapMeter,
) -> dict[str, float]:
    """Measure pinches and self-penetration in some of the samples."""
    count = len(recording)
    pinching = tip_gaps(recording.landmarks) < contact_gap + _PINCHING
    pinching &= trajectory.valid[:, None]
    pinches = np.flatnonzero(pinching.any(axis=1))
    chosen = pinches[:: max(1, -(-len(pinches) // MOST_SURFACES))]
    gaps = meter.pinches(trajectory.q[chosen]) if len(chosen) else {}
    closed = [
        gaps[finger][pinching[chosen, i]] < _CLOSED
        for i, finger in enumerate(FINGERS[1:])
        if finger in gaps
    ]
    spread = np.linspace(0, count - 1, min(MOST_SURFACES, count)).astype(int)
    # Deeper overlaps than this are counted, and how deep they are is not asked.
    nearest = meter.nearest(trajectory.q[spread], most=-_DEEP)
    found = {"self_penetration": (nearest < -_DEEP).mean()}
    if any(map(len, closed)):
        found["pinch_closed"] = np.concatenate(closed).mean()
    return found
