"""Pictures of `handmap report`: distributions of all measures, and the worst episodes."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np

from handmap_qp.datasets.manifest import Line
from handmap_qp.datasets.measures import MEASURES
from handmap_qp.datasets.report import Quality
from handmap_qp.drawing.contact_sheet import SheetRow, contact_sheet, sheet_rows
from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.errors import HandmapError
from handmap_qp.hands.library import load_hand
from handmap_qp.trackers.formats import SEPARATOR
from handmap_qp.trackers.formats.archive import read_archive
from handmap_qp.trackers.recording import read_recording

_COLUMNS, _BINS = 4, 40
_KEPT, _LEFT_OUT = "#3d6fb4", "#d8472f"


def draw_distributions(file: Path, quality: Quality) -> None:
    """Draw a histogram of every measure, with the episodes that the filter leaves out in red.

    Args:
        file: PNG file to write.
        quality: The ranking.

    Raises:
        MissingExtraError: If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    shown = [k for k in range(len(MEASURES)) if np.isfinite(quality.values[:, k]).any()]
    rows = -(-len(shown) // _COLUMNS)
    figure = Figure(figsize=(3.0 * _COLUMNS, 2.2 * rows), layout="constrained", dpi=100)
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    for axes, k in zip(grid.flat, shown, strict=False):
        values = quality.values[:, k]
        known = np.isfinite(values)
        parts = [values[known & quality.is_kept], values[known & ~quality.is_kept]]
        low, high = float(values[known].min()), float(values[known].max())
        room = (low, high) if high > low else (low - 0.5, low + 0.5)
        axes.hist(parts, bins=_BINS, range=room, stacked=True, color=[_KEPT, _LEFT_OUT])
        axes.set_title(MEASURES[k].title, fontsize=9)
        axes.tick_params(labelsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    for row in grid:
        row[0].set_ylabel("episodes", fontsize=8)
    kept = int(quality.is_kept.sum())
    left_out = len(quality.lines) - kept
    title = f"{kept} episodes kept, {left_out} left out (red)"
    figure.suptitle(title, fontsize=10)
    figure.savefig(file)


def draw_worst(folder: Path, quality: Quality, count: int, out: Path) -> list[Path]:
    """Draw human and robot in the worst sample of the worst episodes, a picture for each robot.

    The sample is the one with the largest distance of a point from its target.

    Args:
        folder: Folder of the batch.
        quality: The ranking.
        count: How many episodes of each robot. Those whose recording has gone are left out.
        out: Folder to write to.

    Returns:
        The files, `worst_ROBOT.png`.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    require_matplotlib()
    rows: dict[str, list[SheetRow]] = {}
    for place, line in enumerate(quality.lines):
        own = rows.setdefault(line.robot, [])
        if len(own) < count:
            with suppress(HandmapError):
                own.append(_worst_row(folder, line, MEASURES[quality.worst_measure[place]].title))
    files = []
    for name, own in rows.items():
        if own:
            robot = load_hand(name)
            columns, side = [(robot.name, robot)], robot.spec.side
            figure = contact_sheet(columns, own, side=side, title="worst episodes")
            files.append(out / f"worst_{robot.name}.png")
            figure.savefig(files[-1], dpi=100)
    return files


def _worst_row(folder: Path, line: Line, measure: str) -> SheetRow:
    """Return the worst sample of an episode, with its file and measure as label."""
    name, _, entry = line.key.rpartition(SEPARATOR)
    recording = read_recording(f"{line.path}{SEPARATOR}{entry}" if entry else line.path)
    arrays = read_archive(folder / line.out, {"q", "point_error", "valid"})
    usable = arrays["valid"] & recording.valid
    error = np.where(usable, arrays["point_error"].max(axis=1), -1.0)
    label = f"{Path(name).stem[:12]}"
    (row,) = sheet_rows(recording, {label: int(np.argmax(error))}, [arrays["q"]])
    return SheetRow(row.label, f"{measure[:18]}, {row.note}", row.landmarks, row.q)
