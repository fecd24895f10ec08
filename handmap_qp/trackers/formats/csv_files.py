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
from handmap_qp.trackers.formats.base import SIDES, Entry, check_one_per_hand, entry_stem, reading
from handmap_qp.trackers.formats.columns import (
    LANDMARK_COLUMNS,
    POSE_COLUMNS,
    landmark_rows,
    pose_rows,
    recording_of_rows,
)

_NEEDED = ("side", "time", *LANDMARK_COLUMNS)
_OPTIONAL = ("valid", "confidence", *POSE_COLUMNS)


class CsvFormat:
    """Columns by name, in any order; numbers are written so that they are read back exactly.

    Needed: `side` (right or left), `time` [s] and `wrist_x`, `wrist_y`, `wrist_z`, `thumb_cmc_x`
    and so on [m]. Optional: `valid` (1 or 0), `confidence`, and `wrist_pose_00` to `wrist_pose_23`,
    the upper three rows of the wrist's pose. An empty field is NaN.
    """

    name = "csv"
    suffixes = (".csv",)
    about = "a text table with a row for each sample; numbers are kept exactly"

    def recognises(self, path: Path) -> bool:
        """Return whether it is a file; the header is checked when it is read."""
        return path.is_file()

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the hands by their rows."""
        counts: dict[Side, int] = {}
        with _table(path) as (header, rows):
            column = header["side"]
            for line, row in rows:
                side = _side(path, line, row[column])
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
                    [_number(path, line, names[i], row[k]) for i, k in enumerate(places)]
                    for line, row in rows
                    if _side(path, line, row[side]) == entry.side
                ]
            )
        columns = dict(zip(names, table.T, strict=True))
        poses = [columns.get(name) for name in POSE_COLUMNS]
        given = [pose for pose in poses if pose is not None]
        if given and len(given) < len(poses):
            name = POSE_COLUMNS[next(i for i, pose in enumerate(poses) if pose is None)]
            raise RecordingError(f"has wrist poses, but no column {name!r}", file=path, line=1)
        valid = columns.get("valid")
        if valid is not None and not np.isin(valid, (0.0, 1.0)).all():
            raise RecordingError("expected 1 or 0", file=path, array="valid")
        with reading(path):
            return recording_of_rows(
                entry_stem(path, entry),
                entry.side,
                columns["time"],
                np.stack([columns[name] for name in LANDMARK_COLUMNS], axis=1),
                valid=None if valid is None else valid.astype(bool),
                confidence=columns.get("confidence"),
                wrist=np.stack(given, axis=1) if given else None,
            )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the columns that a recording cannot hold."""
        with _table(path) as (header, _):
            return tuple(name for name in header if name not in (*_NEEDED, *_OPTIONAL))

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name the description of the source."""
        return ("the words about the source",) if any(r.source for r in recordings) else ()

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand, or the rows of the left hand before those of the right one."""
        check_one_per_hand(recordings, self.name)
        has_confidence = any(r.confidence is not None for r in recordings)
        has_wrist = any(r.wrist is not None for r in recordings)
        header = [*_NEEDED, "valid"]
        header += ["confidence"] if has_confidence else []
        header += POSE_COLUMNS if has_wrist else ()
        with replaced_file(path, "path") as file:
            text = io.TextIOWrapper(file, "utf-8", newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(header)
            for recording in sorted(recordings, key=lambda r: r.side):
                writer.writerows(_rows(recording, has_confidence, has_wrist))
            text.detach()


def _rows(recording: Recording, has_confidence: bool, has_wrist: bool) -> Iterator[list[str]]:
    count = len(recording)
    columns = [recording.time[:, None], landmark_rows(recording), recording.valid[:, None]]
    if has_confidence:
        given = recording.confidence
        columns.append(np.full((count, 1), np.nan) if given is None else given[:, None])
    if has_wrist:
        wrist = recording.wrist
        columns.append(np.full((count, 12), np.nan) if wrist is None else pose_rows(wrist))
    valid = 1 + landmark_rows(recording).shape[1]
    for numbers in np.hstack(columns).tolist():
        # repr is the shortest text that is read back as the same number.
        row = ["" if math.isnan(number) else repr(number) for number in numbers]
        row[valid] = "1" if numbers[valid] else "0"
        yield [recording.side, *row]


Rows = Iterator[tuple[int, list[str]]]
"""Rows of a table with their lines, counted from 1."""


@contextmanager
def _table(path: Path) -> Iterator[tuple[dict[str, int], Rows]]:
    """Open a CSV file: its columns by name, and its rows below the header."""
    try:
        file = path.open(encoding="utf-8", newline="")
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise RecordingError(problem, file=path) from error
    with file:
        rows = _rows_of(path, file)
        _, names = next(rows, (0, []))
        header = {name.strip(): i for i, name in enumerate(names)}
        for name in _NEEDED:
            if name not in header:
                raise RecordingError(f"has no column {name!r}", file=path, line=1)
        yield header, _checked(path, rows, len(names))


def _rows_of(path: Path, file: TextIO) -> Rows:
    reader = csv.reader(file)
    try:
        for row in reader:
            if row:
                yield reader.line_num, row
    except (csv.Error, UnicodeDecodeError, OSError) as error:
        problem = f"is not a CSV table in UTF-8: {error}"
        raise RecordingError(problem, file=path, line=reader.line_num + 1) from error


def _checked(path: Path, rows: Rows, count: int) -> Rows:
    for line, row in rows:
        if len(row) != count:
            problem = f"expected {count} fields, got {len(row)}"
            raise RecordingError(problem, file=path, line=line)
        yield line, row


def _side(path: Path, line: int, text: str) -> Side:
    for side in SIDES:
        if text.strip().lower() == side:
            return side
    problem = f"expected right or left, got {text[:20]!r}"
    raise RecordingError(problem, file=path, array="side", line=line)


def _number(path: Path, line: int, name: str, text: str) -> float:
    if not text.strip():
        return math.nan
    try:
        return float(text)
    except ValueError as error:
        problem = f"expected a number, got {text[:20]!r}"
        raise RecordingError(problem, file=path, array=name, line=line) from error
