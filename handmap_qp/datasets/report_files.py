"""The files of `handmap report`."""

from __future__ import annotations

import csv
import io
from pathlib import Path

from handmap_qp.datasets.measures import MEASURES
from handmap_qp.datasets.report import Quality, filter_text, markdown
from handmap_qp.output_files import make_folder, replaced_file

FOLDER = "report"
"""Folder of the report, below that of the batch."""
_MOST_DRAWN = 8


def write_report(folder: Path, quality: Quality, worst: int, *, draws: bool) -> tuple[Path, ...]:
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
    pictures = _draw(out, folder, quality, min(worst, _MOST_DRAWN)) if draws else []
    texts = {
        "report.md": markdown(quality, worst, [file.name for file in pictures]),
        "episodes.csv": _table(quality),
        "keep.txt": filter_text(quality),
    }
    for name, text in texts.items():
        with replaced_file(out / name, "DIR") as file:
            file.write(text.encode())
    return (*(out / name for name in texts), *pictures)


def _draw(out: Path, folder: Path, quality: Quality, count: int) -> list[Path]:
    from handmap_qp.datasets.report_pictures import draw_distributions, draw_worst

    files = [out / "distributions.png"]
    draw_distributions(files[0], quality)
    return [*files, *draw_worst(folder, quality, count, out)]


def _table(quality: Quality) -> str:
    """Return all numbers as CSV, the worst episode first."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["episode", "file", "kept", "badness", "frames", *(m.key for m in MEASURES)])
    rows = zip(quality.lines, quality.is_kept, quality.badness, strict=True)
    for line, kept, badness in rows:
        values = [line.metrics.get(measure.key) for measure in MEASURES]
        texts = ["" if value is None else repr(value) for value in values]
        writer.writerow([line.key, line.out, int(kept), f"{badness:.4f}", line.frames, *texts])
    return text.getvalue()
