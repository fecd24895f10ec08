"""Pictures of a comparison: every metric as dots, and the contact sheet of poses."""

from __future__ import annotations

from dataclasses import replace
from math import ceil
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.apps.drawing.contact_sheet import contact_sheet, sheet_rows
from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.offline.comparison import (
    Comparison,
    Take,
    base_name,
    own_methods,
)
from handmap_qp.apps.offline.metrics import METRICS, Metric
from handmap_qp.apps.offline.poses import POSES, rank_poses

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_COLUMNS = 8
_OWN = "#c8452f"
_OUTSIDE = "#3f6fb5"
_SAMPLE = "#b8bec6"
_STYLE = Path(__file__).with_suffix(".mplstyle")
_BAND = 6  # Methods side by side on the contact sheet; more are drawn below.
_WIDEST = 6.0  # Values beyond this multiple of the median value are drawn at the edge.


def draw_metrics(file: Path, comparison: Comparison) -> Path:
    """Draw a PNG file: a panel for every metric, with large dots for methods, small for recordings.

    Raises:
        MissingExtraError: If matplotlib is not installed.
    """
    with require_matplotlib().rc_context(fname=_STYLE):
        from matplotlib.figure import Figure

        rows = ceil(len(METRICS) / _COLUMNS)
        height = 0.75 + 0.165 * len(comparison.methods)
        figure = Figure(figsize=(18.5, rows * height + 0.8))
        for i, metric in enumerate(METRICS):
            panel = figure.add_subplot(rows, _COLUMNS, i + 1)
            _draw_panel(panel, metric, comparison, has_names=i % _COLUMNS == 0)
        figure.suptitle(
            f"{comparison.robot.name}: mean over {len(comparison.takes)} recordings (large dots) "
            "and each recording (small dots); filled: best. Arrows: beyond the panel.",
        )
        figure.tight_layout(rect=(0.0, 0.0, 1.0, 0.985))
        figure.savefig(file)
    return file


def draw_poses(file: Path, comparison: Comparison) -> tuple[Path | None, list[str]]:
    """Draw the contact sheet: each pose as the recording that shows it most clearly has it.

    Six methods are side by side; further ones are below, beside the human again.

    Methods that failed on one of those recordings are left out.

    Returns:
        The PNG file, or None if no recording shows a pose or no method could be drawn; names of the
        poses and methods that are not on it.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    shown = _clearest(comparison)
    q = {(run.method, run.take): run.motion.q for run in comparison.runs if run.motion}
    drawn = [
        method
        for method in comparison.methods
        if all((method, take) in q for take, _ in shown.values())
    ]
    names = (*POSES, *comparison.methods)
    missing = [name for name in names if name not in {*shown, *drawn}]
    if not shown or not drawn:
        return None, missing
    matplotlib = require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    footnote = f"Not shown: {', '.join(missing)}." if missing else ""
    rows = []
    for pose, (take, index) in shown.items():
        recording = take.recording
        (row,) = sheet_rows(recording, {pose: index}, [q[m, take] for m in drawn])
        name = recording.name.replace("_", " ").removesuffix(f" {recording.side}")
        rows.append(replace(row, note=f"{name}\n{row.note}"))
    bands = []
    for first in range(0, len(drawn), _BAND):
        side_by_side = slice(first, first + _BAND)
        figure = contact_sheet(
            [(method, comparison.robot) for method in drawn[side_by_side]],
            [replace(row, q=row.q[side_by_side]) for row in rows],
            side=comparison.robot.spec.side,
            title=comparison.robot.name,
            footnote=footnote,
        )
        canvas = FigureCanvasAgg(figure)
        canvas.draw()
        bands.append(np.asarray(canvas.buffer_rgba())[..., :3])
    # One below the other, on white.
    width = max(band.shape[1] for band in bands)
    padded = [
        np.pad(band, ((0, 0), (0, width - band.shape[1]), (0, 0)), constant_values=255)
        for band in bands
    ]
    matplotlib.image.imsave(file, np.concatenate(padded))
    return file, missing


def _clearest(comparison: Comparison) -> dict[str, tuple[Take, int]]:
    """Return the take and the sample that show each pose most clearly, of the poses shown."""
    ranked = [(take, rank_poses(take.recording)) for take in comparison.takes]
    places = {}
    for pose in POSES:
        shown = [(*found, take) for take, poses in ranked if (found := poses[pose])]
        if shown:
            index, _, take = max(shown, key=itemgetter(1))
            places[pose] = take, index
    return places


def _draw_panel(
    panel: Axes,
    metric: Metric,
    comparison: Comparison,
    *,
    has_names: bool,
) -> None:
    """Draw one metric: methods from top to bottom."""
    methods = comparison.methods
    means = [comparison.overall(method)[metric.key] for method in methods]
    best = metric.best(means)
    low, high = _range(metric, means)
    for y, method in enumerate(methods):
        colour = _OWN if base_name(method) in own_methods() else _OUTSIDE
        values = [run.values[metric.key] for run in comparison.of_method(method)]
        panel.plot(
            np.clip(values, low, high),
            [y] * len(values),
            ".",
            ms=3,
            color=_SAMPLE,
            zorder=1,
        )
        if np.isnan(means[y]):
            panel.text(low, y, " -", va="center", color=colour)
            continue
        is_beyond = not low <= means[y] <= high
        panel.plot(
            np.clip(means[y], low, high),
            y,
            ">" if is_beyond else "o",
            ms=5.5,
            color=colour,
            mfc=colour if y in best or is_beyond else "white",
            mew=1.3,
            zorder=3,
            clip_on=False,
        )
    panel.set_xlim(low, high + 0.02 * (high - low))
    panel.set_ylim(len(methods) - 0.4, -0.6)
    panel.set_yticks(range(len(methods)), methods if has_names else [""] * len(methods))
    panel.set_title(metric.label)
    panel.text(
        0.0,
        1.005,
        metric.hint,
        transform=panel.transAxes,
        fontsize=6.3,
        color="#6b7280",
    )


def _range(metric: Metric, means: list[float]) -> tuple[float, float]:
    """Return the limits of a panel that shows most methods, without being stretched by one."""
    finite = np.array([v for v in means if np.isfinite(v)])
    if not len(finite):
        return 0.0, 1.0
    low = min(0.0, finite.min())
    high = finite.max()
    middle = np.median(np.abs(finite))
    if metric.better == "high":
        high = max(high, 1.0) if high > 0.5 else high
    elif middle > 0.0:
        high = min(high, _WIDEST * middle)
    return low, high * 1.03 if high > low else low + 1.0
