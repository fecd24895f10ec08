"""The quality of the episodes of a batch: distributions, the worst, a filter, and their files."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.stats import rankdata

from handmap_qp.apps import datasets
from handmap_qp.apps.datasets.manifest import Line, read_manifests
from handmap_qp.apps.datasets.measures import MEASURES
from handmap_qp.apps.tables import csv_text, markdown_table
from handmap_qp.errors import InvalidInputError, expect
from handmap_qp.output_files import make_folder, replaced_file

FOLDER = "report"
"""Folder of the report, below that of the batch."""
_SUMMARY = "measure", "median", "worst 5 %", "worst", "episodes"
_MOST_DRAWN, _MOST_FAILED = 8, 50


class Quality(NamedTuple):
    """How the episodes of a batch are.

    Attributes:
        lines: Lines of the episodes, the worst first.
        failed: Lines of the recordings that failed.
        values: Values of every measure (`MEASURES`), NaN where a question does not arise, (E, m).
        badness: Of every episode, the worst of its ranks among the measures, from 0 (best in
            everything) to 1 (worst in something), shape (E,).
        worst_measure: Index of the measure in which an episode is worst, shape (E,).
        is_kept: Episodes that the filter keeps, shape (E,).
    """

    lines: tuple[Line, ...]
    failed: tuple[Line, ...]
    values: np.ndarray
    badness: np.ndarray
    worst_measure: np.ndarray
    is_kept: np.ndarray


def assess(folder: Path, keep: float = 0.95) -> Quality:
    """Read the manifest of a batch, and rank its episodes.

    Every measure gives an episode a rank, from 0 for the best to 1 for the worst; equal values have
    equal ranks. The filter leaves out the episodes that are worst in something, until the share is
    reached; of episodes that are equally bad in their worst measure, the one with the worse mean
    rank goes first.

    Args:
        folder: Folder of the batch.
        keep: Share of the episodes to keep, from 0 to 1.

    Returns:
        The ranking.

    Raises:
        InvalidInputError: If the folder has no manifest or no episode, or the share is impossible.
    """
    expect(0.0 < keep <= 1.0, "--keep", "a share in (0, 1]", value=keep)
    state = sorted(read_manifests(folder).items())
    lines = [line for _, line in state if line.status == "done"]
    if not lines:
        raise InvalidInputError(
            f"{folder}: has no manifest with episodes",
            argument="DIR",
            advice="run handmap batch first",
        )
    rows = [[line.metrics.get(measure.key) for measure in MEASURES] for line in lines]
    values = np.array(rows, dtype=float)
    ranks = _ranks(values)
    badness = ranks.max(axis=1)
    order = np.lexsort((-ranks.mean(axis=1), -badness))
    return Quality(
        lines=tuple(lines[i] for i in order),
        failed=tuple(line for _, line in state if line.status != "done"),
        values=values[order],
        badness=badness[order],
        worst_measure=ranks.argmax(axis=1)[order],
        is_kept=np.arange(len(lines)) >= round((1.0 - keep) * len(lines)),
    )


def _ranks(values: np.ndarray) -> np.ndarray:
    """Return the shares of episodes that are better, 0 where there is no value, shape (E, m)."""
    signs = np.array([1.0 if measure.worse == "high" else -1.0 for measure in MEASURES])
    # Values that are all good enough do not tell episodes apart.
    costs = np.maximum(signs * values, signs * [measure.enough for measure in MEASURES])
    better = rankdata(costs, method="min", axis=0, nan_policy="omit") - 1.0
    others = np.maximum(np.isfinite(values).sum(axis=0) - 1, 1)
    return np.nan_to_num(better / others)


def summary_rows(quality: Quality) -> list[dict[str, str]]:
    """Return a table: of every measure the median, the worst 5 %, and the worst."""
    rows = []
    for measure, column in zip(MEASURES, quality.values.T, strict=True):
        known = column[np.isfinite(column)]
        if len(known):
            shares = (50, 95, 100) if measure.worse == "high" else (50, 5, 0)
            numbers = map(_text, np.percentile(known, shares))
            cells = (measure.title, *numbers, str(len(known)))
            rows.append(dict(zip(_SUMMARY, cells, strict=True)))
    return rows


def worst_rows(quality: Quality, count: int) -> list[dict[str, str]]:
    """Return a table of the worst episodes, with the measure in which they are worst."""
    worst = zip(
        quality.lines[:count], quality.worst_measure, quality.values, strict=False
    )
    return [
        {
            "#": str(rank),
            "episode": line.name,
            "worst in": MEASURES[k].title,
            "value": _text(values[k]),
            "samples": str(line.frames),
        }
        for rank, (line, k, values) in enumerate(worst, start=1)
    ]


def write_report(
    folder: Path,
    quality: Quality,
    worst: int,
    *,
    draws: bool,
) -> tuple[Path, ...]:
    """Write report, table, filter and pictures.

    Args:
        folder: Folder of the batch.
        quality: The ranking.
        worst: How many of the worst episodes to list.
        draws: Whether to draw pictures.

    Returns:
        The files.

    Raises:
        InvalidInputError: If the folder cannot be written.
        MissingExtraError: If pictures are wanted, and matplotlib or trimesh is not installed.
    """
    out = folder / FOLDER
    make_folder(out, "DIR")
    pictures: list[Path] = []
    if draws:
        drawing = datasets.report_pictures
        pictures = drawing.draw_report(folder, quality, min(worst, _MOST_DRAWN), out)
    # The worst episode first.
    rows = [
        {
            "episode": line.key,
            "file": line.out,
            "kept": int(kept),
            "badness": f"{badness:.4f}",
            "frames": line.frames,
            **{measure.key: line.metrics.get(measure.key) for measure in MEASURES},
        }
        for line, kept, badness in zip(
            quality.lines, quality.is_kept, quality.badness, strict=True
        )
    ]
    texts = {
        "report.md": _markdown(quality, worst, [file.name for file in pictures]),
        "episodes.csv": csv_text(rows),
        "keep.txt": "".join(sorted(f"{row['file']}\n" for row in rows if row["kept"])),
    }
    for name, text in texts.items():
        with replaced_file(out / name, "DIR") as file:
            file.write(text.encode())
    return (*(out / name for name in texts), *pictures)


def _markdown(quality: Quality, count: int, pictures: Sequence[str]) -> str:
    samples = sum(line.frames for line in quality.lines)
    about = [f"- {m.title}: {m.about}; {m.worse} values are worse" for m in MEASURES]
    parts = [
        "# Quality of the episodes",
        f"{_counted(len(quality.lines), 'episode')}, {samples} samples; "
        f"{_counted(len(quality.failed), 'recording')} failed. "
        f"The filter keeps {_counted(int(quality.is_kept.sum()), 'episode')}: `keep.txt`.",
        "## Measures",
        markdown_table(summary_rows(quality)),
        "\n".join(about),
        "## Worst episodes",
        markdown_table(worst_rows(quality, count)),
    ]
    if quality.failed:
        failed = quality.failed[:_MOST_FAILED]
        rows = [{"recording": line.name, "error": line.error} for line in failed]
        parts += ["## Failed recordings", markdown_table(rows)]
    parts += [f"![{name}]({name})" for name in pictures]
    return "\n\n".join(parts) + "\n"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _text(value: float) -> str:
    """Write a number with three digits, and one from 1000 on without a power of ten."""
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"
