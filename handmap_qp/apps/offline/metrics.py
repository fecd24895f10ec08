"""What `handmap compare` measures: names, units and meaning of its metrics (`metrics.yaml`)."""

from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from handmap_qp.hands import Values

Better = Literal["high", "low", "zero", "one"]


class Metric(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One number about how a robot follows a hand.

    Attributes:
        key: Its name in JSON.
        title: Short name for columns.
        unit: Unit; empty for a share, a ratio or a correlation.
        better: Whether `high` or `low` values are better, or those near `zero` or `one`.
        about: What it says, in a few words.
        digits: Decimals to print.
        enough: Values as good as this are equally good; 0 for none where `high` is better.
        in_short: Whether it is one of those that say most, for one table.
    """

    key: str
    title: str
    unit: str
    better: Better
    about: str
    digits: int = 2
    enough: float = 0.0
    in_short: bool = False

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
        costs = np.array([self.cost(round(x, self.digits)) for x in values])
        if np.isfinite(costs).sum() < 2:
            return set()
        return {*np.flatnonzero(costs == np.nanmin(costs))}

    def cost(self, value: float) -> float:
        """Return a number that is smaller for better values, and NaN for NaN."""
        costs = {
            "high": -min(value, self.enough or np.inf),
            "low": max(value, self.enough),
            "zero": abs(value),
            "one": abs(value - 1.0),
        }
        return costs[self.better]


GROUPS: dict[str, tuple[Metric, ...]] = msgspec.yaml.decode(
    Path(__file__).with_suffix(".yaml").read_bytes(), type=dict[str, tuple[Metric, ...]]
)
"""All metrics by subject: those of `fidelity`, then the eight of mimic_retargeter_lab."""
METRICS = sum(GROUPS.values(), ())
"""The same in one row."""


def arising(rows: Collection[Values]) -> Iterator[tuple[str, tuple[Metric, ...]]]:
    """Yield the groups of metrics of which a row has one that is not NaN."""
    for group, metrics in GROUPS.items():
        if any(np.isfinite(row[metric.key]) for row in rows for metric in metrics):
            yield group, metrics


def mean_values(rows: Sequence[Values]) -> Values:
    """Return the mean of each metric over what is not NaN; NaN where nothing is left."""
    means = {}
    for metric in METRICS:
        finite = [row[metric.key] for row in rows if np.isfinite(row[metric.key])]
        means[metric.key] = np.mean(finite) if finite else np.nan
    return means
