"""Open long files whose samples are in a tracker's own layout, to read them by pieces."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array, Arrays, as_floats
from handmap_qp.hands import HumanLengths, Side
from handmap_qp.human import Recording, RecordingPart
from handmap_qp.trackers.formats.archive import (
    ArrayHeader,
    read_archive,
    read_headers,
    read_rows,
)
from handmap_qp.trackers.formats.base import reading
from handmap_qp.trackers.formats.long import LongRecording, open_or_read
from .base import Layout
from .files import Content, as_wrists, content_of, expect_plausible, read_with_layout


def read_long_with_layout(
    path: Path | str,
    layout: Layout,
    side: Side | None = None,
    lengths: HumanLengths | None = None,
    fps: float | None = None,
) -> Recording | LongRecording:
    """Read a recording as `read_with_layout`, or open it to be read by pieces if it is long.

    A `.csv` is read as a whole, and so are layouts whose samples depend on each other
    (`Layout.is_by_sample`).

    Args:
        path: As of `read_with_layout`.
        layout: As of `read_with_layout`.
        side: As of `read_with_layout`.
        lengths: As of `read_with_layout`.
        fps: As of `read_with_layout`.

    Raises:
        RecordingError: As `read_with_layout`.
    """
    file = Path(path)

    def read() -> Recording:
        return read_with_layout(file, layout, side, lengths, fps)

    if file.suffix.lower() != ".npz" or not layout.is_by_sample:
        return read()
    with reading(file):
        headers = read_headers(file)
        small = {name for name, header in headers.items() if len(header.shape) < 2}
        arrays = read_archive(file, small)
        shapes = {
            name: _without_numbers(header)
            for name, header in headers.items()
            if name not in small
        }
        content = content_of(shapes | arrays, layout, side, fps)

    def opened() -> LongRecording | None:
        names = [name for name in (content.values, content.wrists) if name]
        is_plain = all(
            headers[name].is_by_rows
            and len(headers[name].shape) > 1
            and not headers[name].dtype.hasobject
            for name in names
        )
        lengths_of = {headers[name].shape[0] for name in names if is_plain}
        if "valid" in headers:
            lengths_of |= {*headers["valid"].shape}
        if not is_plain or lengths_of != {len(content.time)}:
            return None
        with reading(file):
            return _LongLayout(file, layout, content, arrays, lengths).opened()

    return open_or_read(len(content.time), opened, read)


def _without_numbers(header: ArrayHeader) -> Array:
    """Return an array of a shape and type, which takes no memory."""
    return np.broadcast_to(np.zeros((), header.dtype), header.shape)


class _LongLayout:
    """A long file whose samples are in a layout.

    Args:
        file: The file.
        layout: The layout.
        content: What its arrays are.
        arrays: Those with one axis or none, of all samples.
        lengths: The person's lengths.
    """

    def __init__(
        self,
        file: Path,
        layout: Layout,
        content: Content,
        arrays: Arrays,
        lengths: HumanLengths | None,
    ) -> None:
        self._file = file
        self._layout = layout
        self._content = content
        self._valid = arrays.get("valid")
        self._lengths = lengths
        steps = np.diff(as_floats(content.time, "time", is_finite=True))
        expect((steps > 0.0).all(), "time", "strictly increasing instants")
        self._has_wrists = any(poses is not None for _, _, poses, _ in self._seen())

    def opened(self) -> LongRecording:
        """Read it for the first time, and reject it if it cannot be a hand.

        Raises:
            HandmapError: If the file is damaged, or something in it is wrong.
        """
        long = LongRecording.opened(self._parts, len(self._content.time))
        none = np.empty((0, *self._layout.shapes[0]))
        expect_plausible(long.overview, self._layout, none)
        return long

    def _seen(self) -> Iterator[tuple[slice, Array, Array | None, Array]]:
        """Yield the first piece in which the hand is seen, if there is one."""
        for piece in self._pieces():
            if piece[-1].any():
                yield piece
                return

    def _pieces(self) -> Iterator[tuple[slice, Array, Array | None, Array]]:
        """Yield which samples a piece has, and what `Layout.convert` returns of them."""
        content = self._content
        names = [name for name in (content.values, content.wrists) if name]
        start = 0
        for values, *wrists in read_rows(self._file, names, len(content.time)):
            samples = slice(start, start + len(values))
            start = samples.stop
            landmarks, poses, seen = self._layout.convert(
                values,
                content.side,
                as_wrists(wrists[0]) if wrists else None,
                None if self._valid is None else self._valid[samples],
                self._lengths,
            )
            yield samples, landmarks, poses, seen

    def _parts(self) -> Iterator[Recording]:
        """Read it from the first sample on."""
        content = self._content
        for samples, landmarks, poses, seen in self._pieces():
            if poses is None and self._has_wrists:
                poses = np.tile(np.eye(4), (len(seen), 1, 1))
            yield RecordingPart(
                self._file.stem,
                content.time[samples],
                landmarks,
                seen,
                content.side,
                f"layout {self._layout.name}",
                poses,
                upright=self._layout.upright,
            )
