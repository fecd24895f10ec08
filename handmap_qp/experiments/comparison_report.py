"""Tables and JSON of a comparison of methods."""

from __future__ import annotations

from importlib.metadata import version
from typing import Any

import numpy as np

from handmap_qp.hands.human import FINGERS
from handmap_qp.offline.comparison import Comparison, Run
from handmap_qp.offline.metrics import GROUPS, METRICS, SUMMARY, Metric

_LEGEND = (
    "Mean over the recordings in which a question arises; `-` where it arises in none or the "
    "method has no answer. The best values are bold."
)


def overall_rows(comparison: Comparison, group: str) -> list[dict[str, str]]:
    """Return the rows of one table: a method each, with the metrics of one group.

    Args:
        comparison: What was measured.
        group: A key of `GROUPS`.
    """
    return [
        {
            "method": method,
            **{_heading(m): m.text(comparison.overall(method)[m.key]) for m in GROUPS[group]},
        }
        for method in comparison.methods
    ]


def markdown(comparison: Comparison) -> str:
    """Return all tables as Markdown: overall, then every recording."""
    robot, takes = comparison.robot.name, comparison.takes
    overall = {method: comparison.overall(method) for method in comparison.methods}
    parts = [f"# Methods on {robot}", "", _LEGEND, ""]
    short = [next(m for m in METRICS if m.key == key) for key in SUMMARY]
    parts += ["## In short", "", *_table("method", short, overall)]
    parts += ["## Overall", "", f"{len(takes)} recordings.", "", *_tables(overall)]
    parts += ["## What the columns say", ""]
    parts += [f"- **{m.label}**: {m.about}; {_better(m)}." for m in METRICS]
    if notes := notes_of(comparison):
        parts += ["", "## Notes", "", *(f"- {note}." for note in notes)]
    for take in takes:
        values = {run.method: run.values for run in comparison.runs if run.take is take}
        about = f"{len(take.recording)} samples, {_palm(take.has_wrist)}"
        about += f", contact gap {1e3 * take.contact_gap:.0f} mm"
        about += ", mirrored" if take.is_mirrored else ""
        parts += ["", f"## {take.name}", "", f"{about}.", "", *_tables(values)]
    return "\n".join(parts).rstrip() + "\n"


def notes_of(comparison: Comparison) -> list[str]:
    """Return footnotes: what methods did not do, and what was done to recordings."""
    notes = comparison.notes()
    turned = [take.name for take in comparison.takes if take.is_mirrored]
    if turned:
        side = comparison.robot.spec.side
        notes.append(f"mirrored, because {comparison.robot.name} is a {side} hand: {_list(turned)}")
    fitted = [take.name for take in comparison.takes if not take.has_wrist]
    if fitted:
        notes.append(f"palm fitted to its landmarks, without a tracker's wrist: {_list(fitted)}")
    pinches = _pinch_samples(comparison)
    if pinches:
        shown = [f"{count} in {name}" for name, count in pinches.items() if count]
        notes.append(
            "samples of pinches (tips nearer than 15 mm) of fingers that "
            f"{comparison.robot.name} has: {_list(shown) or 'none'}"
        )
    return notes


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Return everything that was measured as plain values; NaN is None.

    Returns:
        `robot`, `versions`, `metrics`, `recordings`, `methods` (each with `about`), `overall`
        (by method and metric), `runs` (by recording and method: `values`, `fingers`, `problem`) and
        `notes`.
    """
    methods = {}
    for method in comparison.methods:
        texts = [run.motion.about for run in comparison.of_method(method) if run.motion]
        methods[method] = {"about": next(iter(texts), "")}
    pinches = _pinch_samples(comparison)
    packages = ("handmap-qp", "pin", "daqp", "numpy")
    return {
        "robot": comparison.robot.name,
        "versions": {package: version(package) for package in packages},
        "metrics": [
            {"key": m.key, "title": m.title, "unit": m.unit, "better": m.better, "about": m.about}
            for m in METRICS
        ],
        "recordings": [
            {
                "name": take.name,
                "samples": len(take.recording),
                "valid": int(take.recording.valid.sum()),
                "is_mirrored": take.is_mirrored,
                "palm": _palm(take.has_wrist),
                "contact_gap_mm": 1e3 * take.contact_gap,
                "pinch_samples": pinches.get(take.name, 0),
            }
            for take in comparison.takes
        ],
        "methods": methods,
        "overall": {m: _plain(comparison.overall(m)) for m in comparison.methods},
        "runs": {
            take.name: {
                run.method: {
                    "values": _plain(run.values),
                    "fingers": _fingers(run),
                    "problem": run.problem,
                }
                for run in comparison.runs
                if run.take is take
            }
            for take in comparison.takes
        },
        "notes": notes_of(comparison),
    }


def _pinch_samples(comparison: Comparison) -> dict[str, int]:
    """Return how many samples the pinch metrics rest on, by recording; empty if nothing ran."""
    return {
        run.take.name: run.fidelity.pinch_samples
        for run in comparison.runs
        if run.fidelity is not None
    }


def _tables(values: dict[str, dict[str, float]]) -> list[str]:
    """Return the lines of a table for every group, with a row for every method."""
    return [
        line for group, metrics in GROUPS.items() for line in _table(group, list(metrics), values)
    ]


def _table(title: str, metrics: list[Metric], values: dict[str, dict[str, float]]) -> list[str]:
    """Return the lines of a table with a row for every method, and an empty line."""
    best = {m.key: m.best([row[m.key] for row in values.values()]) for m in metrics}
    lines = [f"| {title} | {' | '.join(m.label for m in metrics)} |"]
    lines += ["|---|" + "---:|" * len(metrics)]
    for i, (method, row) in enumerate(values.items()):
        cells = [
            f"**{m.text(row[m.key])}**" if i in best[m.key] else m.text(row[m.key]) for m in metrics
        ]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return [*lines, ""]


def _heading(metric: Metric) -> str:
    """Return the title and the unit, a word a line."""
    return "\n".join([*metric.title.split(), *([metric.unit] if metric.unit else [])])


def _better(metric: Metric) -> str:
    return {
        "high": "higher is better",
        "low": f"up to {metric.enough:g} is good" if metric.enough else "lower is better",
        "zero": "nearer to 0 is better",
        "one": "nearer to 1 is better",
    }[metric.better]


def _palm(has_wrist: bool) -> str:
    return "palm of the tracker" if has_wrist else "palm fitted to its landmarks"


def _fingers(run: Run) -> dict[str, dict[str, float | None]] | None:
    if run.fidelity is None:
        return None
    found = run.fidelity.fingers
    return {
        name: _plain({key: getattr(found[name], key) for key in found[name].__slots__})
        for name in FINGERS
        if name in found
    }


def _plain(values: dict[str, float]) -> dict[str, float | None]:
    return {key: float(v) if np.isfinite(v) else None for key, v in values.items()}


def _list(names: list[str]) -> str:
    return ", ".join(names)
