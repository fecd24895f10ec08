"""The quality of the episodes of a batch: distributions, the worst, and a filter."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from handmap_qp.datasets.manifest import Line, read_manifests
from handmap_qp.datasets.measures import MEASURES, Measure
from handmap_qp.errors import InvalidInputError


@dataclass(frozen=True, slots=True, eq=False)
class Quality:
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
    if not 0.0 < keep <= 1.0:
        raise InvalidInputError(argument="--keep", expected="a share in (0, 1]", value=keep)
    state = read_manifests(folder)
    lines = [state[key] for key in sorted(state) if state[key].status == "done"]
    if not lines:
        raise InvalidInputError(
            argument="DIR",
            problem=f"{folder}: has no manifest with episodes",
            advice="run handmap batch first",
        )
    values = np.array([[_number(line, measure) for measure in MEASURES] for line in lines])
    ranks = np.stack([_ranks(values[:, k], MEASURES[k]) for k in range(len(MEASURES))], axis=1)
    badness, mean = ranks.max(axis=1), ranks.mean(axis=1)
    order = np.lexsort((np.arange(len(lines)), -mean, -badness))
    is_kept = np.ones(len(lines), dtype=bool)
    is_kept[: round((1.0 - keep) * len(lines))] = False
    return Quality(
        lines=tuple(lines[i] for i in order),
        failed=tuple(line for line in state.values() if line.status != "done"),
        values=values[order],
        badness=badness[order],
        worst_measure=ranks.argmax(axis=1)[order],
        is_kept=is_kept,
    )


def summary_rows(quality: Quality) -> list[dict[str, str]]:
    """Return a table: of every measure the median, the worst 5 %, and the worst.

    Args:
        quality: The ranking.
    """
    rows = []
    for k, measure in enumerate(MEASURES):
        known = quality.values[np.isfinite(quality.values[:, k]), k]
        if not len(known):
            continue
        bad, worst = (95, known.max()) if measure.worse == "high" else (5, known.min())
        rows.append(
            {
                "measure": measure.title,
                "median": _text(float(np.median(known))),
                "worst 5 %": _text(float(np.percentile(known, bad))),
                "worst": _text(float(worst)),
                "episodes": str(len(known)),
            }
        )
    return rows


def worst_rows(quality: Quality, count: int) -> list[dict[str, str]]:
    """Return a table of the worst episodes, with the measure in which they are worst.

    Args:
        quality: The ranking.
        count: How many.
    """
    rows = []
    worst = zip(quality.lines[:count], quality.worst_measure, quality.values, strict=False)
    for rank, (line, k, values) in enumerate(worst, start=1):
        rows.append(
            {
                "#": str(rank),
                "episode": line.name,
                "worst in": MEASURES[k].title,
                "value": _text(float(values[k])),
                "samples": str(line.frames),
            }
        )
    return rows


def filter_text(quality: Quality) -> str:
    """Return the filter: the file of every episode that is kept, one a line, by name."""
    kept = sorted(
        line.out for line, kept in zip(quality.lines, quality.is_kept, strict=True) if kept
    )
    return "".join(f"{out}\n" for out in kept)


def markdown(quality: Quality, count: int, pictures: Sequence[str]) -> str:
    """Return the report as Markdown.

    Args:
        quality: The ranking.
        count: How many of the worst to list.
        pictures: Files of pictures, beside the report.
    """
    kept = int(quality.is_kept.sum())
    parts = [
        "# Quality of the episodes\n",
        f"{_counted(len(quality.lines), 'episode')}, "
        f"{sum(line.frames for line in quality.lines)} samples; "
        f"{_counted(len(quality.failed), 'recording')} failed. "
        f"The filter keeps {_counted(kept, 'episode')}: `keep.txt`.\n",
        "## Measures\n",
        _table(summary_rows(quality)),
        "\n".join(f"- {m.title}: {m.about}; {m.worse} values are worse" for m in MEASURES) + "\n",
        "## Worst episodes\n",
        _table(worst_rows(quality, count)),
    ]
    if quality.failed:
        failed = [{"recording": line.name, "error": line.error} for line in quality.failed[:50]]
        parts += ["## Failed recordings\n", _table(failed)]
    parts += [f"![{name}]({name})\n" for name in pictures]
    return "\n".join(parts)


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _table(rows: Sequence[dict[str, str]]) -> str:
    heads = list(rows[0])
    lines = ["| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    lines += [
        "| " + " | ".join(row[head].replace("|", "\\|") for head in heads) + " |" for row in rows
    ]
    return "\n".join(lines) + "\n"


def _number(line: Line, measure: Measure) -> float:
    value = line.metrics.get(measure.key)
    return np.nan if value is None else float(value)


def _ranks(values: np.ndarray, measure: Measure) -> np.ndarray:
    """Return the share of episodes that are better, from 0 to 1; 0 where there is no value."""
    known = np.isfinite(values)
    ranks = np.zeros(len(values))
    if known.sum() > 1:
        sign = 1.0 if measure.worse == "high" else -1.0
        # Values that are all good enough do not tell episodes apart.
        costs = np.maximum(sign * values[known], sign * measure.enough)
        better = np.searchsorted(np.sort(costs), costs, side="left")
        ranks[known] = better / (known.sum() - 1)
    return ranks


def _text(value: float) -> str:
    """Write a number with three digits, and one from 1000 on without a power of ten."""
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"
