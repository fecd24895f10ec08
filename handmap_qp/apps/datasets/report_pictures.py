"""Pictures of `handmap report`: distributions of all measures, and the worst episodes."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from handmap_qp.apps.datasets.manifest import Line
from handmap_qp.apps.datasets.report import Quality
from handmap_qp.apps.drawing.contact_sheet import SheetRow, contact_sheet, sheet_rows
from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.offline.fidelity import SETTLING
from handmap_qp.apps.offline.metrics import Metric
from handmap_qp.errors import HandmapError
from handmap_qp.hands.library import load_hand
from handmap_qp.human.recording import Recording
from handmap_qp.trackers.formats import read_recording
from handmap_qp.trackers.formats.archive import Arrays, read_archive

_COLUMNS, _BINS = 4, 40
_LONGEST_NAME = 21  # characters beside a picture
_KEPT, _LEFT_OUT = "#3d6fb4", "#d8472f"
_STYLE = Path(__file__).with_suffix(".mplstyle")


def draw_report(folder: Path, quality: Quality, count: int, out: Path) -> list[Path]:
    """Draw `distributions.png`, and the worst episodes of each robot, `worst_ROBOT.png`.

    Of each robot's episodes in the folder of the batch, the `count` worst ones are drawn. Those
    whose recording has gone are left out.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    file = out / "distributions.png"
    with require_matplotlib().rc_context(fname=_STYLE):
        _draw_distributions(file, quality)
    return [file, *_draw_worst(folder, quality, count, out)]


def _draw_distributions(file: Path, quality: Quality) -> None:
    """Draw a histogram of every measure, with the episodes that the filter leaves out in red."""
    from matplotlib.figure import Figure

    shown = {
        m: found for m, found in quality.values.items() if np.isfinite(found).any()
    }
    is_kept = np.array([episode.is_kept for episode in quality.episodes])
    rows = -(-len(shown) // _COLUMNS)
    figure = Figure(figsize=(3.0 * _COLUMNS, 2.2 * rows), layout="constrained")
    grid = figure.subplots(rows, _COLUMNS, squeeze=False)
    for axes in grid.flat[len(shown) :]:
        axes.set_axis_off()
    for axes, (measure, values) in zip(grid.flat, shown.items(), strict=False):
        low = np.nanmin(values)
        high = np.nanmax(values)
        # NaN is in no bin.
        axes.hist(
            [values[is_kept], values[~is_kept]],
            bins=_BINS,
            range=(low, high) if high > low else (min(0.0, low), max(1.0, low)),
            stacked=True,
            color=[_KEPT, _LEFT_OUT],
        )
        axes.set_title(measure.label)
        axes.yaxis.get_major_locator().set_params(integer=True)
        # Numbers that are nearly the same have long labels.
        axes.xaxis.get_major_locator().set_params(nbins=4)
    for axes in grid[:, 0]:
        axes.set_ylabel("episodes")
    left_out = len(is_kept) - quality.kept
    figure.suptitle(f"{quality.kept} episodes kept, {left_out} left out (red)")
    figure.savefig(file)


def _draw_worst(folder: Path, quality: Quality, count: int, out: Path) -> list[Path]:
    """Draw human and robot in the worst sample of the worst episodes, a picture for each robot.

    The sample is the worst one in what the episode is worst in, and else the one with the largest
    distance of a point from its target. The first half second counts only where there is no more:
    the robot is still on its way to the hand.
    """
    rows: dict[str, list[SheetRow]] = {}
    for rank, (line, _, worst, _) in enumerate(quality.episodes, start=1):
        own = rows.setdefault(line.robot, [])
        if len(own) < count:
            with suppress(HandmapError):
                own.append(_worst_row(folder, line, rank, worst))
    files = []
    for name, own in rows.items():
        if own:
            robot = load_hand(name)
            figure = contact_sheet(
                [(robot.name, robot)],
                own,
                side=robot.spec.side,
                title="worst episodes",
            )
            files.append(out / f"worst_{robot.name}.png")
            figure.savefig(files[-1], dpi=100)
    return files


def _worst_row(folder: Path, line: Line, rank: int, measure: Metric) -> SheetRow:
    """Return the worst sample of an episode, with its rank, name and measure."""
    recording = read_recording(line.source)
    names = {"q", "point_error", "valid", "at_limit", "at_speed_limit"}
    columns = read_archive(folder / line.out, names)
    sample = _worst_sample(recording, columns, measure)
    (row,) = sheet_rows(recording, {f"#{rank}": sample}, [columns["q"]])
    name = line.name
    if len(name) > _LONGEST_NAME:
        name = f"...{name[3 - _LONGEST_NAME :]}"
    return replace(row, note=f"{name}\n{measure.label}\n{row.note}")


def _worst_sample(recording: Recording, columns: Arrays, measure: Metric) -> int:
    """Return the index of the sample that is worst in a measure, or in reach."""
    usable = columns["valid"] & recording.valid
    settled = usable & (recording.time >= recording.time[0] + SETTLING)
    usable = settled if settled.any() else usable
    error = columns["point_error"].max(axis=1)
    joints = {"saturation": "at_limit", "speed_limited": "at_speed_limit"}
    if measure.key in joints:
        # Less than one joint, so that it decides between samples of as many joints.
        share = error / (1.0 + error)
        error = columns[joints[measure.key]].sum(axis=1) + share
    return int(np.argmax(np.where(usable, error, -1.0)))
