"""Recordings as CSV: a header, then a row for each sample of each hand."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording
from handmap_qp.output_files import replaced_file
from handmap_qp.trackers.formats.archive import damages
from handmap_qp.trackers.formats.base import (
    LANDMARK_COLUMNS,
    POSE_COLUMNS,
    SIDES,
    Entry,
    RecordingFormat,
    build_recording,
    landmark_rows,
    pose_rows,
    side_of,
)

_NEEDED = ("side", "time", *LANDMARK_COLUMNS)
_OPTIONAL = ("valid", "confidence", *POSE_COLUMNS)


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
        names: list[Side] = [side for side in SIDES if side in counts]
        return tuple(Entry(s if len(names) > 1 else "", s, counts[s]) for s in names)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the rows of one hand."""
        with _table(path) as (header, rows):
            names = [name for name in (*_NEEDED[1:], *_OPTIONAL) if name in header]
            places, side = [header[name] for name in names], header["side"]
            table = np.array(
                [
                    [
                        _number(path, line, names[i], row[k])
                        for i, k in enumerate(places)
                    ]
                    for line, row in rows
                    if side_of(row[side], path, "side", line) == entry.side
                ]
            )
        columns = dict(zip(names, table.T, strict=True))
        poses = [name for name in POSE_COLUMNS if name in columns]
        if poses and len(poses) < len(POSE_COLUMNS):
            name = next(name for name in POSE_COLUMNS if name not in columns)
            raise RecordingError(
                f"has wrist poses, but no column {name!r}", file=path, line=1
            )
        return build_recording(
            path,
            entry,
            columns["time"],
            np.stack([columns[name] for name in LANDMARK_COLUMNS], axis=1),
            valid=columns.get("valid"),
            confidence=columns.get("confidence"),
            wrist=np.stack([columns[name] for name in poses], axis=1)
            if poses
            else None,
        )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the columns that a recording cannot hold."""
        with _table(path) as (header, _):
            return tuple(name for name in header if name not in (*_NEEDED, *_OPTIONAL))

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand, or the rows of the left hand before those of the right one."""
        self.check_one_per_hand(recordings)
        columns = [*_NEEDED, "valid"]
        if any(recording.confidence is not None for recording in recordings):
            columns.append("confidence")
        if any(recording.wrist is not None for recording in recordings):
            columns += POSE_COLUMNS
        with replaced_file(path, "path") as file:
            text = io.TextIOWrapper(file, "utf-8", newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(columns)
            for recording in sorted(recordings, key=lambda r: r.side):
                writer.writerows(_rows(recording, columns))
            text.detach()


def _rows(recording: Recording, columns: Sequence[str]) -> Iterator[list[str]]:
    """Yield the fields of each sample; repr is the shortest text that is read back exactly."""
    given = recording.confidence
    blocks = {
        "time": recording.time[:, None],
        LANDMARK_COLUMNS[0]: landmark_rows(recording),
        "confidence": np.full((len(recording), 1), np.nan)
        if given is None
        else given[:, None],
        POSE_COLUMNS[0]: pose_rows(recording),
    }
    numbers = np.hstack([block for name, block in blocks.items() if name in columns])
    at = columns.index("valid") - 1
    for row, is_valid in zip(numbers.tolist(), recording.valid, strict=True):
        fields = ["" if math.isnan(number) else repr(number) for number in row]
        yield [recording.side, *fields[:at], "1" if is_valid else "0", *fields[at:]]


Rows = Iterator[tuple[int, list[str]]]
"""Rows of a table with their lines, counted from 1."""


@contextmanager
def _table(path: Path) -> Iterator[tuple[dict[str, int], Rows]]:
    """Open a CSV file: its columns by name, and its rows below the header."""
    with (
        damages(path, "is not a CSV table"),
        path.open(encoding="utf-8", newline="") as file,
    ):
        rows = _rows_of(path, file)
        _, names = next(rows, (0, []))
        header = {name.strip(): i for i, name in enumerate(names)}
        for name in _NEEDED:
            if name not in header:
                raise RecordingError(f"has no column {name!r}", file=path, line=1)
        yield header, rows


def _rows_of(path: Path, file: TextIO) -> Rows:
    reader, count = csv.reader(file), 0
    try:
        for row in filter(None, reader):
            count = count or len(row)
            if len(row) != count:
                problem = f"expected {count} fields, got {len(row)}"
                raise RecordingError(problem, file=path, line=reader.line_num)
            yield reader.line_num, row
    except (csv.Error, UnicodeDecodeError) as error:
        problem = f"is not a CSV table in UTF-8: {error}"
        raise RecordingError(problem, file=path, line=reader.line_num + 1) from error


def _number(path: Path, line: int, name: str, text: str) -> float:
    if not text.strip():
        return math.nan
    try:
        return float(text)
    except ValueError as error:
        problem = f"expected a number, got {text[:20]!r}"
        raise RecordingError(problem, file=path, array=name, line=line) from error
