"""The command `handmap report`: distributions, the worst episodes, a filter, and their files."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
from tyro.conf import Positional, arg

from handmap_core.errors import HandmapError, InvalidInputError, expect
from handmap_core.se3 import Array, Arrays
from handmap_qp.apps.drawing import require_matplotlib
from handmap_qp.apps.drawing.contact_sheet import SheetRow, contact_sheet, sheet_rows
from handmap_qp.apps.offline.fidelity import SETTLING
from handmap_qp.apps.offline.metrics import Metric
from handmap_qp.apps.tables import Row, csv_text, markdown_table, print_result
from handmap_qp.hands import load_whole
from handmap_qp.human import Recording
from handmap_qp.output_files import make_folder, replaced_file
from handmap_qp.trackers import read_archive, read_recording
from .episodes import MEASURES
from .manifest import Line, read_manifests

FOLDER = "report"
"""Folder of the report, below that of the batch."""
_MOST_DRAWN, _MOST_FAILED = 8, 50
_COLUMNS, _BINS = 4, 40
_LONGEST_NAME = 21  # characters beside a picture
_KEPT, _LEFT_OUT = "#3d6fb4", "#d8472f"
_STYLE = Path(__file__).with_suffix(".mplstyle")


@dataclass(frozen=True)
class Report:
    """Report the quality of the episodes of a batch, and write a filter.

    Writes DIR/report: report.md with the distribution of every measure and the worst episodes,
    distributions.png, worst_ROBOT.png (human and robot in the worst samples), episodes.csv with all
    numbers, and keep.txt with the files of the episodes to keep, one a line.

    No measure needs a reference: reach, saturation, pinches, jerk, valid samples, self-penetration
    and the like. An episode is as bad as its worst rank among them.

    Examples:
        handmap report mapped
        handmap report mapped --keep 0.9 --worst 20

    Attributes:
        folder: Folder of a batch.
        keep: Share of the episodes that the filter keeps.
        worst: How many of the worst episodes to list; the picture shows up to 8.
        pictures: Draw pictures (extra `plot`).
        json: Print one JSON object.
    """

    folder: Positional[Annotated[Path, arg(metavar="DIR")]]
    keep: float = 0.95
    worst: int = 10
    pictures: bool = True
    json: bool = False

    def run(self) -> None:
        """Read the manifest, rank, write, and print."""
        expect(self.worst > 0, "--worst", "a number > 0", value=self.worst)
        quality = assess(self.folder, self.keep)
        files = self._write(quality)
        document = {
            "episodes": len(quality.episodes),
            "kept": quality.kept,
            "failed": len(quality.failed),
            "measures": summary_rows(quality),
            "worst": worst_rows(quality, self.worst),
            "files": list(map(str, files)),
        }
        tables = {
            f"{document['episodes']} episodes, {quality.kept} kept": document[
                "measures"
            ],
            "Worst episodes": document["worst"],
        }
        print_result(document, tables, files, as_json=self.json)

    def _write(self, quality: "Quality") -> list[Path]:
        """Write report, table, filter and pictures, and return the files."""
        out = self.folder / FOLDER
        make_folder(out, "DIR")
        pictures = (
            draw_report(self.folder, quality, min(self.worst, _MOST_DRAWN), out)
            if self.pictures
            else []
        )
        rows = [
            {
                "episode": line.key,
                "file": line.out,
                "kept": int(place >= quality.left_out),
                "badness": f"{badness:.4f}",
                "frames": line.frames,
                **{measure.key: line.metrics.get(measure.key) for measure in MEASURES},
            }
            for place, (line, badness, _) in enumerate(quality.episodes)
        ]
        kept = sorted(f"{row['file']}\n" for row in rows if row["kept"])
        texts = {
            "report.md": _markdown(quality, self.worst, pictures),
            "episodes.csv": csv_text(rows),
            "keep.txt": "".join(kept),
        }
        for name, text in texts.items():
            with replaced_file(out / name, "DIR") as file:
                file.write(text.encode())
        return [*(out / name for name in texts), *pictures]


class Ranked(NamedTuple):
    """An episode among the others of its batch.

    Attributes:
        line: Its line in the manifest.
        badness: The worst of its ranks among the measures, from 0 (best in everything) to 1 (worst
            in something).
        worst: The measure in which it is worst.
    """

    line: Line
    badness: float
    worst: Metric


class Quality(NamedTuple):
    """How the episodes of a batch are.

    Attributes:
        episodes: The episodes, the worst first.
        left_out: How many of the first ones the filter leaves out.
        failed: Lines of the recordings that failed.
        values: Values of every measure, NaN where a question does not arise, shape (E,).
    """

    episodes: Sequence[Ranked]
    left_out: int
    failed: Sequence[Line]
    values: dict[Metric, Array]

    @property
    def kept(self) -> int:
        """Number of episodes that the filter keeps."""
        return len(self.episodes) - self.left_out


def assess(folder: Path, keep: float = 0.95) -> Quality:
    """Read the manifest of a batch, and rank its episodes, of which a share is to be kept.

    Every measure gives an episode a rank, from 0 for the best to 1 for the worst; equal values have
    equal ranks. The filter leaves out the episodes that are worst in something, until the share is
    reached; of episodes that are equally bad in their worst measure, the one with the worse mean
    rank goes first.

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
    worst = ranks.argmax(axis=1)
    return Quality(
        episodes=[Ranked(lines[i], badness[i], MEASURES[worst[i]]) for i in order],
        left_out=round((1.0 - keep) * len(lines)),
        failed=[line for _, line in state if line.status != "done"],
        values=dict(zip(MEASURES, values[order].T, strict=True)),
    )


def _ranks(values: Array) -> Array:
    """Return the shares of episodes that are better, 0 where there is no value, shape (E, m)."""
    costs = np.array([[*map(Metric.cost, MEASURES, row)] for row in values])
    # NaN is sorted to the end, behind all that there is.
    better = [np.searchsorted(np.sort(column), column) for column in costs.T]
    better = np.where(np.isnan(costs), np.nan, np.transpose(better))
    others = np.maximum(np.isfinite(values).sum(axis=0) - 1, 1)
    return np.nan_to_num(better / others)


def summary_rows(quality: Quality) -> list[Row]:
    """Return a table: of every measure the median, the worst 5 %, and the worst."""
    rows = []
    for measure, column in quality.values.items():
        known = column[np.isfinite(column)]
        if len(known):
            shares = (50, 95, 100) if measure.better == "low" else (50, 5, 0)
            typical, poor, worst = map(_text, np.percentile(known, shares))
            rows.append(
                {
                    "measure": measure.label,
                    "median": typical,
                    "worst 5 %": poor,
                    "worst": worst,
                    "episodes": str(len(known)),
                }
            )
    return rows


def worst_rows(quality: Quality, count: int) -> list[Row]:
    """Return a table of the worst episodes, with the measure in which they are worst."""
    return [
        {
            "#": str(rank),
            "episode": line.name,
            "worst in": worst.label,
            "value": _text(quality.values[worst][rank - 1]),
            "samples": str(line.frames),
        }
        for rank, (line, _, worst) in enumerate(quality.episodes[:count], start=1)
    ]


def _markdown(quality: Quality, count: int, pictures: Sequence[Path]) -> str:
    samples = sum(episode.line.frames for episode in quality.episodes)
    about = [
        f"- {measure.label}: {measure.about}; {measure.hint}" for measure in MEASURES
    ]
    parts = [
        "# Quality of the episodes",
        f"{_counted(len(quality.episodes), 'episode')}, {samples} samples; "
        f"{_counted(len(quality.failed), 'recording')} failed. "
        f"The filter keeps {_counted(quality.kept, 'episode')}: `keep.txt`.",
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
    parts += [f"![{file.name}]({file.name})" for file in pictures]
    return "\n\n".join(parts) + "\n"


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}" if count == 1 else f"{count} {noun}s"


def _text(value: float) -> str:
    """Write a number with three digits, and one from 1000 on without a power of ten."""
    return f"{value:.3g}" if abs(value) < 1000.0 else f"{value:.0f}"


def draw_report(folder: Path, quality: Quality, count: int, out: Path) -> list[Path]:
    """Draw `distributions.png`, and the worst episodes of each robot, `worst_ROBOT.png`.

    Of each robot's episodes in the folder of the batch, the `count` worst ones are drawn, human and
    robot in their worst sample. Those whose recording has gone are left out.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    files = [out / "distributions.png"]
    with require_matplotlib().rc_context(fname=_STYLE):
        _draw_distributions(files[0], quality)
    rows: dict[str, list[SheetRow]] = {}
    for rank, (line, _, worst) in enumerate(quality.episodes, start=1):
        own = rows.setdefault(line.robot, [])
        if len(own) < count:
            # ValueError: of another length, or with hands at other instants.
            with suppress(HandmapError, ValueError):
                own.append(_worst_row(folder, line, rank, worst))
    for name, own in rows.items():
        if own:
            robot = load_whole(name)
            figure = contact_sheet(
                [(robot.name, robot)], own, side=robot.side, title="worst episodes"
            )
            files.append(out / f"worst_{robot.name}.png")
            figure.savefig(files[-1])
    return files


def _draw_distributions(file: Path, quality: Quality) -> None:
    """Draw a histogram of every measure, with the episodes that the filter leaves out in red."""
    from matplotlib.figure import Figure

    shown = {
        m: found for m, found in quality.values.items() if np.isfinite(found).any()
    }
    left_out = quality.left_out
    rows = -(-len(shown) // _COLUMNS)
    figure = Figure(figsize=(3.0 * _COLUMNS, 2.2 * rows), layout="constrained")
    for i, (measure, values) in enumerate(shown.items()):
        axes = figure.add_subplot(rows, _COLUMNS, i + 1)
        low = np.nanmin(values)
        high = np.nanmax(values)
        # NaN is in no bin.
        axes.hist(
            [values[left_out:], values[:left_out]],
            bins=_BINS,
            range=(low, high) if high > low else (min(0.0, low), max(1.0, low)),
            stacked=True,
            color=[_KEPT, _LEFT_OUT],
        )
        axes.set_title(measure.label)
        axes.locator_params("y", integer=True)
        # Numbers that are nearly the same have long labels.
        axes.locator_params("x", nbins=4)
    figure.supylabel("episodes")
    figure.suptitle(f"{quality.kept} episodes kept, {left_out} left out (red)")
    figure.savefig(file)


def _worst_row(folder: Path, line: Line, rank: int, measure: Metric) -> SheetRow:
    """Return the worst sample of an episode, with its rank, name and measure."""
    recording = read_recording(line.source, "left")
    names = {"q", "point_error", "valid", "at_limit", "at_speed_limit"}
    columns = read_archive(folder / line.out, names)
    sample = _worst_sample(recording, columns, measure)
    (row,) = sheet_rows(recording, {f"#{rank}": sample}, [columns["q"]])
    name = line.name
    if len(name) > _LONGEST_NAME:
        name = f"...{name[3 - _LONGEST_NAME :]}"
    return row._replace(note=f"{name}\n{measure.label}\n{row.note}")


def _worst_sample(recording: Recording, columns: Arrays, measure: Metric) -> int:
    """Return the index of the sample that is worst in a measure of joints, or else in reach.

    The first half second counts only where there is no more: the robot is still on its way.
    """
    usable = columns["valid"].reshape(len(recording), -1).all(axis=1) & recording.valid
    settled = usable & (recording.time >= recording.time[0] + SETTLING)
    usable = settled if settled.any() else usable
    error = columns["point_error"].max(axis=1)
    joints = {"saturation": "at_limit", "speed_limited": "at_speed_limit"}
    if measure.key in joints:
        # Less than one joint, so that it decides between samples of as many joints.
        share = error / (1.0 + error)
        error = columns[joints[measure.key]].sum(axis=1) + share
    return int(np.argmax(np.where(usable, error, -1.0)))
