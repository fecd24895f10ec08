"""What `handmap compare` measures: names, units and meaning of every metric."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

Better = Literal["high", "low", "zero", "one"]


class Metric(NamedTuple):
    """One number about how a robot follows a hand.

    Attributes:
        key: Its name in JSON.
        title: Short name for columns.
        unit: Unit; empty for a share, a ratio or a correlation.
        better: Whether `high` or `low` values are better, or those near `zero` or `one`.
        about: What it says, in a few words.
        digits: Decimals to print.
        enough: Where `low` is better, values up to this are equally good.
    """

    key: str
    title: str
    unit: str
    better: Better
    about: str
    digits: int = 2
    enough: float = 0.0

    @property
    def label(self) -> str:
        """The short name with the unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title

    @property
    def hint(self) -> str:
        """Which values are better, in words."""
        low = f"up to {self.enough:g} is good" if self.enough else "lower is better"
        return {
            "high": "higher is better",
            "low": low,
            "zero": "nearer to 0 is better",
            "one": "nearer to 1 is better",
        }[self.better]

    def text(self, value: float) -> str:
        """Format a value; `-` for NaN."""
        return "-" if np.isnan(value) else f"{value + 0.0:.{self.digits}f}"

    def best(self, values: list[float]) -> set[int]:
        """Return the indices of the best values as printed; none if fewer than two are finite."""
        worth = {i: self._cost(v) for i, v in enumerate(values) if np.isfinite(v)}
        if len(worth) < 2:
            return set()
        least = min(worth.values())
        return {i for i, cost in worth.items() if cost == least}

    def _cost(self, value: float) -> float:
        """Smaller is better; values that print alike are alike."""
        x = round(value, self.digits)
        costs = {
            "high": -x,
            "low": max(x, self.enough),
            "zero": abs(x),
            "one": abs(x - 1.0),
        }
        return costs[self.better]


GROUPS: dict[str, tuple[Metric, ...]] = {
    "Gestures": (
        Metric(
            "extension_correlation",
            "ext. corr.",
            "",
            "high",
            "correlation of finger extensions, weighted by the human's range",
        ),
        Metric(
            "thumb_extension_correlation",
            "thumb corr.",
            "",
            "high",
            "the same of the thumb",
        ),
        Metric(
            "extension_rms",
            "ext. RMS",
            "",
            "low",
            "RMS difference of extensions [reach]",
            3,
        ),
        Metric(
            "finger_direction_deg",
            "finger dir.",
            "deg",
            "low",
            "knuckle-to-tip directions",
            1,
        ),
        Metric(
            "wrist_direction_deg",
            "wrist dir.",
            "deg",
            "low",
            "wrist-to-tip directions",
            1,
        ),
        Metric(
            "tip_error_knuckles_mm",
            "tips",
            "mm",
            "low",
            "fingertips from the knuckles' centre",
            1,
        ),
        Metric(
            "tip_error_mm", "tips, palm", "mm", "low", "fingertips in the palm frame", 1
        ),
    ),
    "Object and palm": (
        Metric("object_rotation_deg", "obj. turn", "deg", "low", "rotation of T", 1),
        Metric("object_stretch", "obj. stretch", "", "low", "log-stretch of T"),
        Metric(
            "object_translation_mm",
            "obj. shift",
            "mm",
            "low",
            "centroid displacement",
            1,
        ),
        Metric("palm_deg", "palm", "deg", "low", "rotation of the palm", 1),
        Metric("palm_mm", "palm", "mm", "low", "displacement of the palm", 1),
    ),
    "Pinches": (
        Metric(
            "pinch_closed",
            "closed",
            "",
            "high",
            "share of pinches with a gap below 3 mm",
        ),
        Metric(
            "pinch_gap_mm",
            "gap",
            "mm",
            "zero",
            "median gap of surfaces in a pinch, negative where they overlap",
            1,
        ),
        Metric("pinch_gap_p95_mm", "gap p95", "mm", "zero", "95th percentile of it", 1),
        Metric(
            "pinch_depth_mm",
            "depth",
            "mm",
            "low",
            "95th percentile of the penetration",
            1,
        ),
        Metric(
            "pinch_false",
            "false",
            "",
            "low",
            "share of open samples with surfaces touching",
            4,
        ),
        Metric("pinch_order", "order", "", "high", "rank correlation of tip gaps"),
    ),
    "Motion": (
        Metric("jerk_ratio", "jerk", "", "low", "RMS joint jerk over the human's"),
        Metric(
            "speed_ratio",
            "speed",
            "",
            "low",
            "largest joint speed over its limit",
            enough=1.0,
        ),
        Metric(
            "outside_limits",
            "limits",
            "",
            "low",
            "share of samples outside joint limits",
        ),
        Metric("latency_ms", "lag", "ms", "zero", "lag behind the human", 0),
        Metric(
            "self_penetration",
            "penetr.",
            "",
            "low",
            "share of samples deeper than 1 mm",
            3,
        ),
    ),
    "Key vectors (mimic)": (
        Metric("key_cosine", "cosine", "", "high", "cosine of key vectors", 3),
        Metric("key_angle_deg", "angle", "deg", "low", "angle of key vectors", 1),
        Metric(
            "key_scale", "scale", "", "one", "length of key vectors, robot over human"
        ),
        Metric(
            "motion_preservation",
            "motion",
            "",
            "high",
            "cosine of tip displacements",
            3,
        ),
        Metric(
            "flatness_mm2",
            "flat",
            "mm2",
            "low",
            "second difference of tips, squared",
            2,
        ),
        Metric(
            "colliding", "coll.", "", "low", "share of samples in self-collision", 3
        ),
        Metric(
            "workspace", "space", "", "high", "share of the reachable points used", 3
        ),
        Metric("step_time_ms", "time", "ms", "low", "CPU time of one sample", 2),
    ),
}
"""All metrics by subject: those of `fidelity`, then the eight of mimic_retargeter_lab."""
METRICS: tuple[Metric, ...] = tuple(
    metric for group in GROUPS.values() for metric in group
)
"""The same in one row."""
SUMMARY: tuple[str, ...] = (
    "extension_correlation",
    "thumb_extension_correlation",
    "finger_direction_deg",
    "tip_error_knuckles_mm",
    "object_rotation_deg",
    "object_translation_mm",
    "pinch_closed",
    "pinch_gap_p95_mm",
    "pinch_depth_mm",
    "pinch_false",
    "pinch_order",
    "jerk_ratio",
    "speed_ratio",
    "outside_limits",
    "latency_ms",
    "self_penetration",
    "step_time_ms",
)
"""Keys of the metrics that say most, for one table."""


def mean_values(rows: Sequence[dict[str, float]]) -> dict[str, float]:
    """Return the mean of each metric over what is not NaN; NaN where nothing is left."""
    means = {}
    for metric in METRICS:
        finite = [row[metric.key] for row in rows if np.isfinite(row[metric.key])]
        means[metric.key] = float(np.mean(finite)) if finite else float("nan")
    return means
