"""Recordings as CSV: a header, then a row for each sample of each hand."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording
from handmap_qp.output_files import replaced_file
from handmap_qp.trackers.formats.archive import damages
from handmap_qp.trackers.formats.base import (
    COLUMNS,
    SIDES,
    Entry,
    RecordingFormat,
    build_recording,
    column,
    known_columns,
    side_of,
)

_ORDER = ("time", "landmarks", "valid", "confidence", "wrist")
_POSE = COLUMNS["wrist"]


class CsvFormat(RecordingFormat):
    """Columns by name, in any order; numbers are written so that they are read back exactly.

    Needed: `side` (right or left), `time` [s] and `wrist_x`, `wrist_y`, `wrist_z`, `thumb_cmc_x`
    and so on [m]. Optional: `valid` (1 or 0), `confidence`, and `wrist_pose_00` to `wrist_pose_23`,
    the upper three rows of the wrist's pose. An empty field is NaN.
    """

    name = "csv"
    suffixes = (".csv",)
    about = "a text table with a row for each sample; numbers are kept exactly"
    lacks = ("source",)

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the hands by their rows."""
        counts: dict[Side, int] = {}
        with _table(path) as (header, rows):
            column = header["side"]
            for line, row in rows:
                side = side_of(row[column], path, "side", line)
                counts[side] = counts.get(side, 0) + 1
        is_one = len(counts) == 1
        found = [side for side in SIDES if side in counts]
        return tuple(Entry("" if is_one else s, s, counts[s]) for s in found)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the rows of one hand."""
        with _table(path) as (header, rows):
            given = {f: names for f, names in COLUMNS.items() if names[0] in header}
            places = [(name, header[name]) for name in _joined(given)]
            table = np.array(
                [
                    [_number(path, line, name, row[i]) for name, i in places]
                    for line, row in rows
                    if side_of(row[header["side"]], path, "side", line) == entry.side
                ]
            )
        ends = np.cumsum([len(names) for names in given.values()])
        blocks = np.split(table, ends[:-1], axis=1)
        columns: dict[str, Any] = {
            field: block if block.shape[1] > 1 else block[:, 0]
            for field, block in zip(given, blocks, strict=True)
        }
        return build_recording(path, entry, **columns)

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the columns that a recording cannot hold."""
        with _table(path) as (header, _):
            known = {"side", *_joined(COLUMNS)}
            return tuple(name for name in header if name not in known)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand, or the rows of the left hand before those of the right one."""
        self.check_one_per_hand(recordings)
        known = known_columns(*recordings)
        fields = [field for field in _ORDER if field in known]
        with replaced_file(path, "path") as file:
            text = io.TextIOWrapper(file, "utf-8", newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(["side", *_joined({f: COLUMNS[f] for f in fields})])
            for recording in sorted(recordings, key=lambda r: r.side):
                writer.writerows(_rows(recording, fields))
            text.detach()


def _joined(fields: Mapping[str, Sequence[str]]) -> list[str]:
    return [name for names in fields.values() for name in names]


def _rows(recording: Recording, fields: Sequence[str]) -> Iterator[list[str]]:
    """Yield the texts of each sample; repr is the shortest text that is read back exactly."""
    blocks = [column(recording, field) for field in fields]
    # Flags are written as 1 and 0.
    lists = [(b.astype(int) if b.dtype == bool else b).tolist() for b in blocks]
    for rows in zip(*lists, strict=True):
        numbers = [number for row in rows for number in row]
        yield [recording.side, *("" if math.isnan(n) else repr(n) for n in numbers)]


Rows = Iterator[tuple[int, list[str]]]
"""Rows of a table with their lines, counted from 1."""


@contextmanager
def _table(path: Path) -> Iterator[tuple[dict[str, int], Rows]]:
    """Open a CSV file: its columns by name, and its rows below the header."""
    with (
        damages(path, "is not a CSV table"),
        path.open(
            encoding="utf-8",
            newline="",
        ) as file,
    ):
        rows = _rows_of(path, file)
        _, names = next(rows, (0, []))
        header = {name.strip(): i for i, name in enumerate(names)}
        poses = _POSE if any(name in header for name in _POSE) else ()
        for name in ("side", "time", *COLUMNS["landmarks"], *poses):
            if name not in header:
                about = "wrist poses, but " if name in _POSE else ""
                problem = f"has {about}no column {name!r}"
                raise RecordingError(
                    problem,
                    file=path,
                    line=1,
                )
        yield header, rows


def _rows_of(path: Path, file: TextIO) -> Rows:
    reader, count = csv.reader(file), 0
    try:
        for row in filter(None, reader):
            count = count or len(row)
            if len(row) != count:
                problem = f"expected {count} fields, got {len(row)}"
                raise RecordingError(
                    problem,
                    file=path,
                    line=reader.line_num,
                )
            yield reader.line_num, row
    except (csv.Error, UnicodeDecodeError) as error:
        problem = f"is not a CSV table in UTF-8: {error}"
        raise RecordingError(
            problem,
            file=path,
            line=reader.line_num + 1,
        ) from error


def _number(
    path: Path,
    line: int,
    name: str,
    text: str,
) -> float:
    if not text.strip():
        return math.nan
    try:
        return float(text)
    except ValueError as error:
        problem = f"expected a number, got {text[:20]!r}"
        raise RecordingError(
            problem,
            file=path,
            array=name,
            line=line,
        ) from error
