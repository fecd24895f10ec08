"""Hands that are read or written by pieces: what all formats share that can do so."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from handmap_core.errors import RecordingError, expect
from handmap_core.se3 import Arrays
from handmap_qp.hands import Values
from handmap_qp.human import Recording, RecordingPart
from handmap_qp.output_files import writing
from .base import Entry, build_recording, reading, whole_poses
from .disk_columns import DiskColumn
from .long import LongRecording, columns_of

OPTIONAL = ("wrist", "object_pose", "confidence")
"""Fields that a recording does not have if all their numbers are NaN."""


def open_pieces(
    path: Path,
    entry: Entry,
    pieces: Callable[[], Iterator[Values]],
    optional: Collection[str],
    *,
    prefix: str = "",
    **words: str,
) -> LongRecording:
    """Open one hand of a file to read it by pieces.

    Args:
        path: The file.
        entry: The hand.
        pieces: Reads the hand from the start: the columns that `build_recording` takes, of some
            consecutive samples at once.
        optional: Those of `OPTIONAL` that the pieces have. One whose numbers are all NaN is left
            out.
        prefix: As of `build_recording`.
        words: Words about the recording, and its name if it has one of its own.

    Raises:
        HandmapError: If the file is damaged, or a sample is wrong.
    """
    unknown = set(optional)
    if unknown:
        for columns in pieces():
            unknown = {name for name in unknown if np.isnan(columns[name]).all()}
            if not unknown:
                break

    def known() -> Iterator[Values]:
        for columns in pieces():
            yield {name: each for name, each in columns.items() if name not in unknown}

    def parts() -> Iterator[Recording]:
        return recording_parts(path, entry, known(), prefix=prefix, **words)

    return LongRecording.opened(parts, entry.samples)


def recording_parts(
    path: Path,
    entry: Entry,
    pieces: Iterable[Values],
    *,
    prefix: str = "",
    **words: str,
) -> Iterator[Recording]:
    """Build the parts of a recording; arguments as of `open_pieces`.

    Yields:
        All samples in the order of time, a piece at once.

    Raises:
        RecordingError: If the file is damaged, or a sample is wrong.
    """
    start = 0
    last = -np.inf
    for columns in pieces:
        try:
            part = build_recording(
                path, entry, **columns, prefix=prefix, kind=RecordingPart, **words
            )
            with reading(path, array=prefix):
                expect(part.time[0] > last, "time", "strictly increasing instants")
                part = _with_unknown(part, columns)
        except RecordingError as error:
            error.problem += f", counted from sample {start}"
            raise
        yield part
        start += len(part)
        last = part.time[-1]


def _with_unknown(part: Recording, columns: Values) -> Recording:
    """Return a part with all columns of its recording: NaN where it has none of their numbers.

    Raises:
        InvalidInputError: If a sample in which the hand was seen has none.
    """
    lost: Arrays = {}
    for name in OPTIONAL:
        if name in columns and getattr(part, name) is None:
            known = "numbers wherever the hand was seen"
            expect(not part.valid.any(), name, known, got="none")
            lost[name] = whole_poses(np.full(np.shape(columns[name]), np.nan))
    return replace(part, **lost)


@contextmanager
def columns_on_disk(
    recording: LongRecording, path: Path
) -> Iterator[dict[str, DiskColumn]]:
    """Copy the samples of a recording to the disk, for a file that has its columns one by one.

    Args:
        recording: The recording.
        path: The file that is written; the copies are in its folder until the block ends.

    Yields:
        The columns by the names of `Recording`.

    Raises:
        DiskFullError: If the disk is full.
        HandmapError: If the recording cannot be read.
    """
    columns: dict[str, DiskColumn] = {}
    try:
        for part in recording.parts():
            with writing(path, "path"):
                for name, rows in columns_of(part):
                    if name not in columns:
                        columns[name] = DiskColumn(
                            path.parent, rows.dtype, rows.shape[1:]
                        )
                    columns[name].append(rows)
        yield columns
    finally:
        for column in columns.values():
            column.close()
