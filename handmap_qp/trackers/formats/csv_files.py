"""Recordings as CSV, a row for each sample of each hand; and reading any CSV table of numbers."""

from __future__ import annotations

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain
from pathlib import Path
from typing import Any

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

Rows = Iterator[tuple[int, list[str]]]
"""Rows of a table with their lines, counted from 1."""


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
        with opened_table(path) as (header, rows):
            counts = Counter(side for side, _ in _by_side(path, header, rows))
        is_one = len(counts) == 1
        found = [side for side in SIDES if side in counts]
        return tuple(Entry("" if is_one else s, s, counts[s]) for s in found)

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the rows of one hand."""
        with opened_table(path) as (header, rows):
            sides = _by_side(path, header, rows)
            own = (row for side, row in sides if side == entry.side)
            given = {f: names for f, names in COLUMNS.items() if names[0] in header}
            places = {name: header[name] for name in chain(*given.values())}
            table = numbers(path, own, places)
        columns: dict[str, Any] = {}
        for field, names in given.items():
            block, table = np.split(table, [len(names)], axis=1)
            columns[field] = block if len(names) > 1 else block[:, 0]
        return build_recording(path, entry, **columns)

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the columns that a recording cannot hold."""
        with opened_table(path) as (header, _):
            known = {"side", *chain(*COLUMNS.values())}
            return tuple(name for name in header if name not in known)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand, or the rows of the left hand before those of the right one."""
        self.check_one_per_hand(recordings)
        fields = known_columns(*recordings)
        with replaced_file(path, "path") as file:
            text = io.TextIOWrapper(file, "utf-8", newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(["side", *chain(*(COLUMNS[field] for field in fields))])
            for recording in sorted(recordings, key=lambda r: r.side):
                columns = [column(recording, field) for field in fields]
                for row in np.column_stack(columns).tolist():
                    writer.writerow([recording.side, *map(_text, row)])
            text.detach()


def _text(number: float) -> str:
    """Return the shortest text that is read back exactly."""
    return "" if math.isnan(number) else repr(number).removesuffix(".0")


def _by_side(
    path: Path,
    header: Mapping[str, int],
    rows: Rows,
) -> Iterator[tuple[Side, tuple[int, list[str]]]]:
    """Yield the rows with their hands, of a table that has all columns of a recording."""
    poses = COLUMNS["wrist"]
    has_poses = any(name in header for name in poses)
    needed = ("side", "time", *COLUMNS["landmarks"], *(poses if has_poses else ()))
    for name in needed:
        if name not in header:
            about = "wrist poses, but " if name in poses else ""
            raise RecordingError(
                f"has {about}no column {name!r}",
                file=path,
                line=1,
            )
    for line, row in rows:
        yield side_of(row[header["side"]], path, "side", line), (line, row)


@contextmanager
def opened_table(path: Path) -> Iterator[tuple[dict[str, int], Rows]]:
    """Open a CSV file of any columns.

    Yields:
        Places of the columns by name, and the rows below the header that are not empty.

    Raises:
        RecordingError: If it is not a table in UTF-8.
    """
    problem = "is not a CSV table in UTF-8"
    with damages(path, problem), path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        try:
            rows = _rows(path, reader)
            _, names = next(rows, (0, []))
            yield {name.strip(): place for place, name in enumerate(names)}, rows
        except (csv.Error, UnicodeDecodeError) as error:
            line = reader.line_num + 1
            raise RecordingError(
                f"{problem}: {error}",
                file=path,
                line=line,
            ) from error


def _rows(path: Path, reader: Any) -> Rows:
    count = 0
    for row in reader:
        if any(map(str.strip, row)):
            count = count or len(row)
            if len(row) != count:
                problem = f"expected {count} fields, got {len(row)}"
                raise RecordingError(
                    problem,
                    file=path,
                    line=reader.line_num,
                )
            yield reader.line_num, row


def numbers(
    path: Path,
    rows: Iterable[tuple[int, list[str]]],
    places: Mapping[str, int],
) -> np.ndarray:
    """Read columns of a table; an empty field is NaN.

    Args:
        path: The file, for errors.
        rows: Rows of `opened_table`.
        places: Places of the columns by name.

    Returns:
        The numbers, columns in the order of `places`, shape (T, n).

    Raises:
        RecordingError: If a field is no number, with its line; or if there are no rows.
    """
    table = [
        [_number(path, line, name, row[place]) for name, place in places.items()]
        for line, row in rows
    ]
    if not table:
        raise RecordingError("has no rows below its header", file=path)
    return np.array(table)


def _number(
    path: Path,
    line: int,
    name: str,
    text: str,
) -> float:
    try:
        return float(text.strip() or "nan")
    except ValueError as error:
        problem = f"expected a number, got {text[:20]!r}"
        raise RecordingError(
            problem,
            file=path,
            array=name,
            line=line,
        ) from error
