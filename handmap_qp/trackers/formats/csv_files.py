"""Recordings as CSV, a row for each sample of each hand; and reading any CSV table of numbers."""

import csv
import io
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import chain, islice
from pathlib import Path

import numpy as np

from handmap_core.errors import InvalidInputError, expect
from handmap_core.se3 import Array, Arrays
from handmap_qp.hands import Names, Side, Values
from handmap_qp.human import Recording
from handmap_qp.output_files import replaced_file
from .base import (
    COLUMNS,
    WORDS,
    Entry,
    WrittenByPieces,
    build_recording,
    column,
    known_columns,
    reading,
    side_of,
)
from .long import PIECE, LongRecording
from .pieces import OPTIONAL, open_pieces

Row = list[str]
_NO_ROWS = "has no rows below its header"


class CsvFormat(WrittenByPieces):
    """Columns by name, in any order; numbers are written so that they are read back exactly.

    Needed: `wrist_x`, `wrist_y`, `wrist_z`, `thumb_cmc_x` and so on [m]; `side` (right or left) and
    `time` [s], unless `with_hints` says them. Optional: `valid` (1 or 0), `confidence`, and
    `wrist_pose_00` to `wrist_pose_23`, the upper three rows of the wrist's pose; as
    `object_pose_00` those of an object's. An empty
    field is NaN.
    """

    name = "csv"
    suffixes = (".csv",)
    lacks = WORDS

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the hands by their rows."""
        with opened_table(path) as (header, rows):
            counts = Counter(side for side, _ in self._by_side(header, rows))
        is_one = len(counts) == 1
        return [Entry("" if is_one else s, s, counts[s]) for s in sorted(counts)]

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read the rows of one hand."""
        (columns,) = self._pieces(path, entry, entry.samples)
        return build_recording(path, entry, **columns)

    def open_long(self, path: Path, entry: Entry) -> LongRecording | None:
        """Open the rows of one hand."""
        with opened_table(path) as (header, _):
            optional = [name for name in OPTIONAL if COLUMNS[name][0] in header]
        fps = self.hints.fps
        rate = "" if fps is None else f"{fps:g} samples/s, as given"
        return open_pieces(
            path,
            entry,
            lambda: self._pieces(path, entry, PIECE),
            optional,
            time_source=rate,
        )

    def _pieces(self, path: Path, entry: Entry, size: int) -> Iterator[Values]:
        """Read the rows of one hand, so many at once, as columns of `build_recording`."""
        instants: Array | None = None
        start = 0
        for columns in self._table_pieces(path, entry, size):
            stop = start + len(columns["landmarks"])
            if self.hints.fps is not None or "time" not in columns:
                if instants is None:
                    instants = self.hints.time_of_file(entry.samples)
                columns["time"] = instants[start:stop]
            yield columns
            start = stop

    def _table_pieces(self, path: Path, entry: Entry, size: int) -> Iterator[Values]:
        """Read the columns of one hand that the table has, so many rows at once."""
        with opened_table(path) as (header, rows):
            sides = self._by_side(header, rows)
            own = (row for side, row in sides if side == entry.side)
            given = {f: names for f, names in COLUMNS.items() if names[0] in header}
            for _ in range(0, entry.samples, size):
                piece = islice(own, size)
                table = numbers(piece, header, [*chain(*given.values())])
                yield {
                    field: table[names[0]]
                    if len(names) == 1
                    else np.column_stack([table[name] for name in names])
                    for field, names in given.items()
                }

    def _by_side(
        self, header: Mapping[str, int], rows: Iterable[Row]
    ) -> Iterator[tuple[Side, Row]]:
        """Yield the rows with their hands, of a table that has all columns of a recording."""
        needed = [*COLUMNS["landmarks"]]
        for name in ("wrist", "object_pose"):
            if not set(COLUMNS[name]).isdisjoint(header):
                needed += COLUMNS[name]
        for name in needed:
            if name not in header:
                raise InvalidInputError(f"has no column {name!r}")
        own = None if "side" in header else self.hints.side_of_file()
        for row in rows:
            yield own or side_of(row[header["side"]], "side"), row

    def unread(self, path: Path) -> Names:
        """Name the columns that a recording cannot hold."""
        with opened_table(path) as (header, _):
            known = {"side", *chain(*COLUMNS.values())}
            return tuple(name for name in header if name not in known)

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write one hand, or the rows of the left hand before those of the right one."""
        self.check_one_per_hand(recordings)
        fields = known_columns(*(each.overview for each in recordings))
        with replaced_file(path, "path") as file:
            text = io.TextIOWrapper(file, "utf-8", newline="")
            writer = csv.writer(text, lineterminator="\n")
            writer.writerow(["side", *chain(*(COLUMNS[field] for field in fields))])
            for recording in sorted(recordings, key=lambda r: r.overview.side):
                for part in recording.parts():
                    columns = [column(part, field) for field in fields]
                    for row in np.column_stack(columns).tolist():
                        writer.writerow([part.side, *map(_text, row)])
            text.detach()


def _text(number: float) -> str:
    """Return the shortest text that is read back exactly."""
    return "" if math.isnan(number) else repr(number).removesuffix(".0")


@contextmanager
def opened_table(
    path: Path, *, is_padded: bool = False
) -> Iterator[tuple[dict[str, int], Iterator[Row]]]:
    """Open a CSV file of any columns.

    Args:
        path: The file.
        is_padded: Whether a row may end early, as those of trackers that lost the hand do; its last
            fields are then empty.

    Yields:
        Places of the columns by name, and the rows below the header that are not empty.

    Raises:
        RecordingError: If it is not a table in UTF-8, or for an error of the block, with its line.
    """
    problem = "is not a CSV table in UTF-8"
    with path.open(encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file)
        with reading(path, problem, table=reader):
            rows = _rows(reader, is_padded)
            names = next(rows, [])
            yield {name.strip(): place for place, name in enumerate(names)}, rows


def _rows(reader: Iterable[Row], is_padded: bool) -> Iterator[Row]:
    count = 0
    for row in reader:
        if any(map(str.strip, row)):
            count = count or len(row)
            if is_padded:
                row += [""] * (count - len(row))
            expect(len(row) == count, "", f"{count} fields", value=len(row))
            yield row


def numbers(
    rows: Iterable[Row], header: Mapping[str, int], names: Sequence[str]
) -> Arrays:
    """Read columns of a table; an empty field is NaN.

    Args:
        rows: Rows of `opened_table`.
        header: Places of the columns by name.
        names: Names of those to read.

    Returns:
        The columns by name, shape (T,) each.

    Raises:
        InvalidInputError: If a field is no number, or if there are no rows.
    """
    table = [[_number(name, row[header[name]]) for name in names] for row in rows]
    if not table:
        raise InvalidInputError(_NO_ROWS)
    return dict(zip(names, np.transpose(table), strict=True))


def numbers_of_column(
    rows: Iterable[Row], header: Mapping[str, int], name: str
) -> Array:
    """Read one column of a table of any length, shape (T,); arguments and errors as `numbers`."""
    place = header[name]
    column = np.fromiter((_number(name, row[place]) for row in rows), float)
    if not len(column):
        raise InvalidInputError(_NO_ROWS)
    return column


def _number(name: str, text: str) -> float:
    try:
        return float(text.strip() or "nan")
    except ValueError as error:
        got = f"{text[:20]!r}"
        raise InvalidInputError(argument=name, expected="a number", got=got) from error
