"""Open long files whose samples are in a tracker's own layout, to read them by pieces."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack
from itertools import islice
from pathlib import Path
from tempfile import gettempdir
from typing import NamedTuple

import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array, Arrays, as_floats
from handmap_qp.hands import HumanLengths, Side
from handmap_qp.human import Recording, RecordingPart
from handmap_qp.output_files import writing
from handmap_qp.trackers.formats.archive import (
    ArrayHeader,
    read_archive,
    read_headers,
    read_rows,
)
from handmap_qp.trackers.formats.base import reading
from handmap_qp.trackers.formats.csv_files import (
    numbers,
    numbers_of_column,
    opened_table,
)
from handmap_qp.trackers.formats.disk_columns import DiskColumn
from handmap_qp.trackers.formats.long import LongRecording, open_or_read, pieces_of
from .base import Converted, Layout, Samples
from .files import (
    Content,
    as_wrists,
    columns_of_table,
    content_of,
    expect_plausible,
    read_with_layout,
)

_VALUES = "values"
"""Name of the samples of a table."""


def read_long_with_layout(
    path: Path | str,
    layout: Layout,
    side: Side | None = None,
    lengths: HumanLengths | None = None,
    fps: float | None = None,
) -> Recording | LongRecording:
    """Read a recording as `read_with_layout`, or open it to be read by pieces if it is long.

    Landmarks that take long to find (`Layout.is_costly`) are kept in a temporary file while the
    recording is in use.

    Args:
        path: As of `read_with_layout`.
        layout: As of `read_with_layout`.
        side: As of `read_with_layout`.
        lengths: As of `read_with_layout`.
        fps: As of `read_with_layout`.

    Raises:
        DiskFullError: If the disk of the temporary file is full.
        RecordingError: As `read_with_layout`.
    """
    file = Path(path)

    def read() -> Recording:
        return read_with_layout(file, layout, side, lengths, fps)

    if not _has_pieces(file):
        return read()
    with reading(file):
        found = _listed(file, layout, side, fps)

    def opened() -> LongRecording | None:
        if not found.is_plain:
            return None
        with reading(file):
            return _LongLayout(file, layout, found, lengths).opened()

    return open_or_read(len(found.content.time), opened, read)


def side_with_layout(
    path: Path, layout: Layout, side: Side | None = None, fps: float | None = None
) -> Side:
    """Return which hand a recording is of that `read_with_layout` reads.

    Raises:
        RecordingError: As `read_with_layout`, but for damages of the samples.
    """
    if not _has_pieces(path):
        return read_with_layout(path, layout, side, None, fps).side
    with reading(path):
        return _listed(path, layout, side, fps).content.side


class _Listed(NamedTuple):
    """What a file is, known without reading its samples.

    Attributes:
        content: What its arrays are.
        valid: Samples in which the hand was seen, shape (T,), if the file says it.
        pieces: Reads values, and wrist poses beside them if there are any, from the start.
        is_plain: Whether they can be read by pieces.
    """

    content: Content
    valid: Array | None
    pieces: Callable[[], Iterator[tuple[Array, ...]]]
    is_plain: bool


def _has_pieces(file: Path) -> bool:
    """Tell whether files of this suffix can be read by pieces."""
    return file.suffix.lower() in (".npz", ".csv")


def _listed(
    file: Path, layout: Layout, side: Side | None, fps: float | None
) -> _Listed:
    """List a file."""
    is_table = file.suffix.lower() == ".csv"
    return (_table if is_table else _archive)(file, layout, side, fps)


def _archive(
    file: Path, layout: Layout, side: Side | None, fps: float | None
) -> _Listed:
    """List an `.npz` file."""
    headers = read_headers(file)
    small = {name for name, header in headers.items() if len(header.shape) < 2}
    arrays = read_archive(file, small)
    shapes = {
        name: _without_numbers(header)
        for name, header in headers.items()
        if name not in small
    }
    content = content_of(shapes | arrays, layout, side, fps)
    names = [name for name in (content.values, content.wrists) if name]
    is_plain = all(
        headers[name].is_by_rows
        and len(headers[name].shape) > 1
        and not headers[name].dtype.hasobject
        for name in names
    )
    counts = {headers[name].shape[0] for name in names if is_plain}
    if "valid" in headers:
        counts |= {*headers["valid"].shape}
    return _Listed(
        content,
        arrays.get("valid"),
        lambda: read_rows(file, names, len(content.time)),
        is_plain and counts == {len(content.time)},
    )


def _without_numbers(header: ArrayHeader) -> Array:
    """Return an array of a shape and type, which takes no memory."""
    return np.broadcast_to(np.zeros((), header.dtype), header.shape)


def _table(file: Path, layout: Layout, side: Side | None, fps: float | None) -> _Listed:
    """List a `.csv` file: its instants are read, or any column to count the samples."""
    with opened_table(file, is_padded=True) as (header, rows):
        found = columns_of_table(header, layout, side)
        (first,) = [*filter(None, (found.time, *found.values))][:1]
        column = numbers_of_column(rows, header, first)
    shape = len(column), len(layout.columns)
    arrays: Arrays = {_VALUES: np.broadcast_to(0.0, shape)} | found.small
    if found.time:
        arrays[found.time] = column
    content = content_of(arrays, layout, side, fps)

    def pieces() -> Iterator[tuple[Array, ...]]:
        with opened_table(file, is_padded=True) as (header, rows):
            for samples in pieces_of(len(column)):
                piece = islice(rows, samples.stop - samples.start)
                yield (found.values_of(numbers(piece, header, found.values), layout),)

    return _Listed(content, None, pieces, is_plain=bool(found.values))


class _LongLayout:
    """A long file whose samples are in a layout.

    Args:
        file: The file.
        layout: The layout.
        listed: What the file is.
        lengths: The person's lengths.
    """

    def __init__(
        self,
        file: Path,
        layout: Layout,
        listed: _Listed,
        lengths: HumanLengths | None,
    ) -> None:
        self._file = file
        self._layout = layout
        self._listed = listed
        self._content = listed.content
        self._lengths = lengths
        steps = np.diff(as_floats(self._content.time, "time", is_finite=True))
        expect((steps > 0.0).all(), "time", "strictly increasing instants")
        layout.check_parts(self._samples())
        self._has_wrists = self._gives_wrists()
        self._kept: _KeptHands | None = None

    def opened(self) -> LongRecording:
        """Read it for the first time, and reject it if it cannot be a hand.

        Raises:
            HandmapError: If the file is damaged, or something in it is wrong.
        """
        if self._layout.is_costly:
            self._kept = _KeptHands(self._converted(), has_wrists=self._has_wrists)
        long = LongRecording.opened(self._parts, len(self._content.time))
        none = np.empty((0, *self._layout.shapes[0]))
        expect_plausible(long.overview, self._layout, none)
        return long

    def _samples(self) -> Iterator[Samples]:
        """Yield what `Layout.convert` takes of each piece."""
        start = 0
        for values, *wrists in self._listed.pieces():
            stop = start + len(values)
            valid = self._listed.valid
            yield (
                values,
                as_wrists(wrists[0]) if wrists else None,
                None if valid is None else valid[start:stop],
            )
            start = stop

    def _gives_wrists(self) -> bool:
        """Tell whether the layout finds wrist poses, by the first sample that is seen."""
        content = self._content
        for values, wrists, valid in self._samples():
            for i in np.flatnonzero(self._layout.seen(values, valid))[:1].tolist():
                one = (
                    values[i : i + 1],
                    None if wrists is None else wrists[i : i + 1],
                    None,
                )
                found = self._layout.convert_parts([one], content.side, self._lengths)
                return next(found)[1] is not None
        return False

    def _converted(self) -> Iterator[Converted]:
        """Find the hands of each piece; wrist poses where the recording has any."""
        found = self._layout.convert_parts(
            self._samples(), self._content.side, self._lengths
        )
        for landmarks, poses, seen in found:
            if poses is None and self._has_wrists:
                poses = np.tile(np.eye(4), (len(seen), 1, 1))
            yield landmarks, poses, seen

    def _parts(self) -> Iterator[Recording]:
        """Read it from the first sample on."""
        content = self._content
        hands = self._kept.pieces() if self._kept else self._converted()
        start = 0
        for landmarks, poses, seen in hands:
            stop = start + len(seen)
            yield RecordingPart(
                self._file.stem,
                content.time[start:stop],
                landmarks,
                seen,
                content.side,
                f"layout {self._layout.name}",
                poses,
                upright=self._layout.upright,
            )
            start = stop


class _KeptHands:
    """Hands that were found once, in temporary files without names.

    Args:
        pieces: The hands.
        has_wrists: Whether they have wrist poses.

    Raises:
        DiskFullError: If the disk is full.
    """

    def __init__(self, pieces: Iterator[Converted], *, has_wrists: bool) -> None:
        folder = Path(gettempdir())
        self._has_wrists = has_wrists
        self._opened = ExitStack()
        with writing(folder, "TMPDIR"):
            self._landmarks = self._column(folder, (21, 3), float)
            self._poses = self._column(folder, (4, 4), float)
            self._seen = self._column(folder, (), bool)
        for landmarks, poses, seen in pieces:
            with writing(folder, "TMPDIR"):
                self._landmarks.append(landmarks)
                self._seen.append(seen)
                if poses is not None:
                    self._poses.append(poses)

    def _column(self, folder: Path, row: tuple[int, ...], kind: type) -> DiskColumn:
        """Make an empty column, which `__del__` removes."""
        column = DiskColumn(folder, np.dtype(kind), row)
        self._opened.callback(column.close)
        return column

    def pieces(self) -> Iterator[Converted]:
        """Read them from the start."""
        for samples in pieces_of(len(self._seen)):
            yield (
                self._landmarks.rows(samples),
                self._poses.rows(samples) if self._has_wrists else None,
                self._seen.rows(samples),
            )

    def __del__(self) -> None:
        """Remove the files."""
        self._opened.close()
