"""`handmap compare`: from the words of the command line to tables, JSON and files."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import handmap_qp
from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.experiments import comparison_pictures
from handmap_qp.apps.offline.comparison import (
    LOOK_AHEAD,
    SMOOTH,
    ComparedMethod,
    Comparison,
    Take,
    check_names,
    compare_methods,
    outside_methods,
    own_method,
    own_methods,
    prepare_take,
)
from handmap_qp.apps.offline.metrics import GROUPS, METRICS, SUMMARY, Metric
from handmap_qp.apps.tables import progress
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS
from handmap_qp.hands.library import load_hand
from handmap_qp.human.person import Person, read_person
from handmap_qp.output_files import make_folder, writing

if TYPE_CHECKING:
    from handmap_qp.apps.experiments.cli import Compare

FILES = ("table.md", "results.json", "metrics.png", "poses.png")
"""Files that are written."""
_PACKAGES = ("handmap-qp", "pin", "daqp", "numpy")
_LEGEND = (
    "Mean over the recordings in which a question arises; `-` where it arises in none or the "
    "method has no answer. The best values are bold."
)


def run_comparison(request: Compare) -> None:
    """Compare, print the result and write the files.

    Raises:
        HandmapError: If a recording, hand, method or folder cannot be used; before any mapping.
    """
    if not request.recordings:
        raise InvalidInputError(
            argument="RECORDING", expected="at least one file", got="none"
        )
    robot = load_hand(request.robot)
    person = None if request.person is None else read_person(request.person)
    methods = _methods(request)
    if request.out is not None:
        require_matplotlib()
        make_folder(request.out, "--out")
    with progress("comparing") as advance:

        def say(what: str, done: int, total: int) -> None:
            advance(done, f"{what} ({done} of {total})")

        takes = _takes(request, robot, person, say)
        comparison = compare_methods(takes, robot, methods, say)
        written = [] if request.out is None else _write(request.out, comparison, say)
    if request.json:
        print(json.dumps(as_json(comparison), allow_nan=False))
        return
    for group in GROUPS:
        _print_overall(f"{group}, {robot.name}", overall_rows(comparison, group))
    for note in notes_of(comparison):
        print(f"- {note}")
    for file in written:
        print(f"wrote {file}")


def overall_rows(comparison: Comparison, group: str) -> list[dict[str, str]]:
    """Return the rows of one table: a method each, with the metrics of a key of `GROUPS`."""
    return [
        {
            "method": method,
            **{
                _heading(m): m.text(comparison.overall(method)[m.key])
                for m in GROUPS[group]
            },
        }
        for method in comparison.methods
    ]


def markdown(comparison: Comparison) -> str:
    """Return all tables as Markdown: overall, then every recording."""
    overall = {method: comparison.overall(method) for method in comparison.methods}
    short = [next(m for m in METRICS if m.key == key) for key in SUMMARY]
    parts = [f"# Methods on {comparison.robot.name}", "", _LEGEND, ""]
    parts += ["## In short", "", *_table("method", short, overall)]
    parts += [
        "## Overall",
        "",
        f"{len(comparison.takes)} recordings.",
        "",
        *_tables(overall),
    ]
    parts += ["## What the columns say", ""]
    parts += [f"- **{m.label}**: {m.about}; {_better(m)}." for m in METRICS]
    if notes := notes_of(comparison):
        parts += ["", "## Notes", "", *(f"- {note}." for note in notes)]
    for take in comparison.takes:
        values = {run.method: run.values for run in comparison.runs if run.take is take}
        about = f"{len(take.recording)} samples, {_palm(take)}"
        about += f", contact gap {1e3 * take.human.contact_gap:.0f} mm"
        about += ", mirrored" if take.is_mirrored else ""
        parts += ["", f"## {take.name}", "", f"{about}.", "", *_tables(values)]
    return "\n".join(parts).rstrip() + "\n"


def notes_of(comparison: Comparison) -> list[str]:
    """Return footnotes: what methods did not do, and what was done to recordings."""
    notes, robot = comparison.notes(), comparison.robot
    if turned := [take.name for take in comparison.takes if take.is_mirrored]:
        side = robot.spec.side
        notes.append(
            f"mirrored, because {robot.name} is a {side} hand: {', '.join(turned)}"
        )
    if fitted := [take.name for take in comparison.takes if not take.has_wrist]:
        text = "palm fitted to its landmarks, without a tracker's wrist"
        notes.append(f"{text}: {', '.join(fitted)}")
    if pinches := _pinch_samples(comparison):
        shown = [f"{count} in {name}" for name, count in pinches.items() if count]
        notes.append(
            "samples of pinches (tips nearer than 15 mm) of fingers that "
            f"{robot.name} has: {', '.join(shown) or 'none'}"
        )
    return notes


def as_json(comparison: Comparison) -> dict[str, Any]:
    """Return everything that was measured as plain values; NaN is None.

    Returns:
        `robot`, `versions`, `metrics`, `recordings`, `methods` (each with `about`), `overall`
        (by method and metric), `runs` (by recording and method: `values`, `fingers`, `problem`) and
        `notes`.
    """
    pinches = _pinch_samples(comparison)
    abouts = {
        method: next(
            (one.motion.about for one in comparison.of_method(method) if one.motion), ""
        )
        for method in comparison.methods
    }
    runs: dict[str, dict[str, Any]] = {take.name: {} for take in comparison.takes}
    for run in comparison.runs:
        fingers = run.fidelity.fingers
        runs[run.take.name][run.method] = {
            "values": _plain(run.values),
            "fingers": {
                name: _plain(fingers[name]) for name in FINGERS if name in fingers
            }
            if run.motion
            else None,
            "problem": run.problem,
        }
    return {
        "robot": comparison.robot.name,
        "versions": {package: version(package) for package in _PACKAGES},
        "metrics": [
            {
                key: getattr(m, key)
                for key in ("key", "title", "unit", "better", "about")
            }
            for m in METRICS
        ],
        "recordings": [
            {
                "name": take.name,
                "samples": len(take.recording),
                "valid": int(take.recording.valid.sum()),
                "is_mirrored": take.is_mirrored,
                "palm": _palm(take),
                "contact_gap_mm": 1e3 * take.human.contact_gap,
                "pinch_samples": pinches.get(take.name, 0),
            }
            for take in comparison.takes
        ],
        "methods": {method: {"about": about} for method, about in abouts.items()},
        "overall": {
            method: _plain(comparison.overall(method)) for method in comparison.methods
        },
        "runs": runs,
        "notes": notes_of(comparison),
    }


def _methods(request: Compare) -> list[ComparedMethod]:
    """Return the methods by their names, peers last unless they are named."""
    outside = {}
    if request.peers:
        folder = (
            request.peers_from
            or Path(handmap_qp.__file__).parents[1] / "benchmarks" / "peers"
        )
        outside = {
            method.name: method for method in outside_methods(folder, request.robot)
        }
    own = [
        name + ending for name in own_methods() for ending in ("", SMOOTH, LOOK_AHEAD)
    ]
    first, *others = own_methods()
    names = request.methods or (first, first + SMOOTH, *others)
    unknown = [name for name in names if name not in outside and name not in own]
    if unknown:
        known = ", ".join([*own_methods(), *outside])
        raise InvalidInputError(
            argument="--methods",
            expected=f"some of {known}, or one of ours with {SMOOTH} or {LOOK_AHEAD}",
            got=unknown[0],
            advice="" if request.peers else "peers need --peers",
        )
    chosen = [outside[n] if n in outside else own_method(n) for n in names]
    return chosen if outside.keys() & set(names) else [*chosen, *outside.values()]


def _takes(
    request: Compare,
    robot: Hand,
    person: Person | None,
    say: Callable[[str, int, int], None],
) -> list[Take]:
    """Read all recordings before any is prepared."""
    side = robot.spec.side
    recordings = [request.inputs.read(file, side) for file in request.recordings]
    check_names(
        "RECORDING", [one.name for one in recordings], "files of different names"
    )
    turned = [recording.name for recording in recordings if recording.side != side]
    if turned:
        text = f"handmap: mirrored, because {robot.name} is a {side} hand: {', '.join(turned)}"
        print(text, file=sys.stderr)
    takes = []
    for i, recording in enumerate(recordings):
        say(f"measuring the hand of {recording.name}", i, len(recordings))
        takes.append(prepare_take(recording, side, person=person))
    return takes


def _print_overall(title: str, rows: list[dict[str, str]]) -> None:
    """Print a table of methods, whose names are not broken."""
    from rich.console import Console
    from rich.table import Table

    table = Table(box=None, header_style="bold")
    for name in rows[0]:
        is_method = name == "method"
        table.add_column(
            name, justify="left" if is_method else "right", no_wrap=is_method
        )
    for row in rows:
        table.add_row(*row.values())
    console = Console()
    console.print(title, style="bold")
    console.print(table)
    console.print()


def _write(
    out: Path, comparison: Comparison, say: Callable[[str, int, int], None]
) -> list[Path]:
    """Write all files, and return those that were written."""
    table, results, metrics, poses = (out / name for name in FILES)
    with writing(out, "--out"):
        table.write_text(markdown(comparison), encoding="utf-8")
        text = json.dumps(as_json(comparison), indent=1, allow_nan=False)
        results.write_text(text + "\n", encoding="utf-8")
        say("drawing metrics", 0, 2)
        comparison_pictures.draw_metrics(metrics, comparison)
        say("drawing poses", 1, 2)
        sheet, missing = comparison_pictures.draw_poses(poses, comparison)
    if sheet is None:
        poses.unlink(missing_ok=True)
        print(
            f"handmap: no contact sheet; not shown: {', '.join(missing)}",
            file=sys.stderr,
        )
        return [table, results, metrics]
    return [table, results, metrics, sheet]


def _pinch_samples(comparison: Comparison) -> dict[str, int]:
    """Return how many samples the pinch metrics rest on, by recording; empty if nothing ran."""
    return {
        run.take.name: run.fidelity.pinch_samples
        for run in comparison.runs
        if run.motion
    }


def _tables(values: dict[str, dict[str, float]]) -> list[str]:
    """Return the lines of a table for every group, with a row for every method."""
    return [
        line for group in GROUPS for line in _table(group, list(GROUPS[group]), values)
    ]


def _table(
    title: str, metrics: list[Metric], values: dict[str, dict[str, float]]
) -> list[str]:
    """Return the lines of a table with a row for every method, and an empty line."""
    best = {m.key: m.best([row[m.key] for row in values.values()]) for m in metrics}
    lines = [f"| {title} | {' | '.join(m.label for m in metrics)} |"]
    lines += ["|---|" + "---:|" * len(metrics)]
    for i, (method, row) in enumerate(values.items()):
        cells = [
            f"**{m.text(row[m.key])}**" if i in best[m.key] else m.text(row[m.key])
            for m in metrics
        ]
        lines.append(f"| {method} | {' | '.join(cells)} |")
    return [*lines, ""]


def _heading(metric: Metric) -> str:
    """Return the title and the unit, a word a line."""
    return "\n".join([*metric.title.split(), *([metric.unit] if metric.unit else [])])


def _better(metric: Metric) -> str:
    return {
        "high": "higher is better",
        "low": f"up to {metric.enough:g} is good"
        if metric.enough
        else "lower is better",
        "zero": "nearer to 0 is better",
        "one": "nearer to 1 is better",
    }[metric.better]


def _palm(take: Take) -> str:
    return "palm of the tracker" if take.has_wrist else "palm fitted to its landmarks"


def _plain(values: dict[str, float]) -> dict[str, float | None]:
    return {key: float(v) if np.isfinite(v) else None for key, v in values.items()}
