"""Read files whose samples are in a tracker's own layout: `.npz` arrays, or columns of a `.csv`.

Files in the package's own forms need no layout; `handmap_qp.trackers.formats` reads them.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_core.errors import InvalidInputError, RecordingError, expect
from handmap_core.se3 import Array, Arrays
from handmap_qp.hands import OTHER_SIDE, HumanLengths, Names, Side
from handmap_qp.human import LANDMARK_COUNT, Recording
from handmap_qp.trackers.formats.archive import read_archive, read_headers
from handmap_qp.trackers.formats.base import (
    SIDES,
    TIME_UNITS,
    FileHints,
    reading,
    seconds,
    side_of,
    time_in,
)
from handmap_qp.trackers.formats.csv_files import numbers, opened_table
from handmap_qp.trackers.plausibility import examine_recording
from . import LAYOUTS
from .base import Layout, layouts_of_shape

_VALUES = ("values", "landmarks")
_WRISTS = ("wrist", "wrist_pose", "right_wrist", "left_wrist")


def read_with_layout(
    path: Path | str,
    layout: Layout,
    side: Side | None = None,
    lengths: HumanLengths | None = None,
    fps: float | None = None,
) -> Recording:
    """Read a recording in a tracker's own layout.

    An `.npz` has an array of time, one of values whose rows have a shape of the layout, and where
    they are known `valid (T,)`, `handedness`, and `wrist (T, 4, 4)` or `wrist_pose (T, 7)` in the
    tracker's own axes, where the layout takes a wrist beside its values. A `.csv` has a column of
    time and the columns of the layout; cells may be empty where the hand was not seen.

    Args:
        path: The file.
        layout: The layout.
        side: Which hand; what the file says if omitted.
        lengths: The person's lengths, for angles and markers.
        fps: Samples a second, in place of the file's time; needed where it has none.

    Raises:
        RecordingError: If the file cannot be read, or something in it is missing or of another
            shape than expected. The message names layouts that fit better.
    """
    file = Path(path)
    suffix = file.suffix.lower()
    with reading(file):
        expect(
            suffix in (".npz", ".csv"),
            "",
            "a .npz or .csv where a layout is named",
            got=suffix,
        )
        is_table = suffix == ".csv"
        arrays = _read_columns(file, layout, side) if is_table else read_archive(file)
        content = content_of(arrays, layout, side, fps)
        values = arrays[content.values]
        wrists = arrays[content.wrists] if content.wrists else None
        recording = layout.record(
            file.stem,
            content.time,
            values,
            content.side,
            valid=arrays.get("valid"),
            wrists=None if wrists is None else as_wrists(wrists),
            lengths=lengths,
        )
        expect_plausible(recording, layout, values)
        return recording


class Content(NamedTuple):
    """What the arrays of a file are.

    Attributes:
        side: Which hand they are of.
        time: Instants of the samples [s], shape (T,).
        values: Name of the array whose rows are samples of the layout.
        wrists: Name of that of wrist poses beside the values; empty if there is none, or the layout
            does not take them.
    """

    side: Side
    time: Array
    values: str
    wrists: str


def content_of(
    arrays: Arrays, layout: Layout, side: Side | None, fps: float | None
) -> Content:
    """Find out what the arrays of a file are.

    Args:
        arrays: The arrays by name. Of those with two axes or more, only shape and type count.
        layout: As of `read_with_layout`.
        side: As of `read_with_layout`.
        fps: As of `read_with_layout`.

    Raises:
        InvalidInputError: If something is missing or of another shape.
    """
    hints = FileHints(side, fps)
    handedness = arrays.get("handedness")
    hand = (
        hints.side_of_file()
        if handedness is None
        else side_of(handedness, "handedness")
    )
    if side not in (None, hand):
        raise InvalidInputError(f"is of a {hand} hand, not of a {side} one")
    time = _time(arrays, layout) if fps is None else None
    count = None if time is None else len(time)
    values = _values_name(arrays, layout, side, count)
    if time is None:
        time = hints.time_of_file(len(arrays[values]))
    return Content(hand, time, values, _wrists_name(arrays, layout, side))


def expect_plausible(recording: Recording, layout: Layout, values: Array) -> None:
    """Reject a recording that cannot be a hand.

    Args:
        recording: The recording.
        layout: The layout that it was read with.
        values: Its values, of which other layouts are tried; none are if there are no rows.

    Raises:
        InvalidInputError: With the layouts that fit better.
    """
    finding = examine_recording(recording)
    if finding is None:
        return
    names = [] if finding.kind in ("time", "wrist") else _better(recording, values)
    other = f"read them with --layout {' or '.join(names)}"
    problem = f"as the layout {layout.name}, {finding.problem}"
    raise InvalidInputError(problem, advice=other if names else finding.advice)


def layout_hint(path: Path) -> str:
    """Name the layouts that have the shape of an array of an `.npz` file.

    Args:
        path: A file that could not be read as it is.

    Returns:
        Advice in words; empty if no array has such a shape, or the file cannot be read.
    """
    if path.suffix.lower() == ".npz":
        with suppress(RecordingError):
            headers = read_headers(path)
            return _shaped_like({name: each.shape for name, each in headers.items()})
    return ""


def _shaped_like(shapes: Mapping[str, tuple[int, ...]]) -> str:
    """Say which layouts have the shape of an array that is not plain landmarks."""
    for name, shape in shapes.items():
        sample = shape[1:]
        is_plain = sample in ((), (LANDMARK_COUNT, 3))
        names = " or ".join([] if is_plain else layouts_of_shape(sample))
        if names:
            return f"{name} {shape} has the shape of --layout {names}"
    return ""


def _better(recording: Recording, values: Array) -> list[str]:
    """Return the layouts of the same shape that explain the values without a mistake."""
    names = []
    for name in layouts_of_shape(values.shape[1:]):
        with suppress(InvalidInputError):
            read = LAYOUTS[name].record(name, recording.time, values, recording.side)
            if examine_recording(read) is None:
                names.append(name)
    return names


def _values_name(
    arrays: Arrays,
    layout: Layout,
    side: Side | None,
    count: int | None,
) -> str:
    """Return the name of the array whose rows are samples of the layout.

    Args:
        arrays: The arrays of the file.
        layout: The layout.
        side: Which hand, if it is known.
        count: Number of samples; any number if the file has no time that counts.
    """

    def takes(name: str) -> bool:
        array = arrays[name]
        is_array = array.ndim > 1 and array.dtype.kind in "fiu"
        is_long = is_array and count in (None, len(array))
        return is_long and layout.sample_shape(array.shape[1:]) is not None

    def is_of_side(name: str) -> bool:
        return name.startswith(side or "")

    usual = (*layout.arrays, layout.name, *_VALUES)
    chosen = list(filter(takes, arrays))
    for is_better in (usual.__contains__, is_of_side):
        chosen = list(filter(is_better, chosen)) or chosen
    if len(chosen) == 1:
        return chosen[0]
    samples = "T" if count is None else count
    shapes = " or ".join(
        f"({', '.join(map(str, (samples, *shape)))})" for shape in layout.shapes
    )
    how = "more than one" if chosen else "no"
    problem = f"has {how} array of shape {shapes}"
    have = {name: array.shape for name, array in arrays.items()}
    listing = ", ".join(f"{name} {shape}" for name, shape in have.items() if shape)
    hint = "" if chosen else _shaped_like(have)
    raise InvalidInputError(f"{problem}; {hint or f'it has {listing}'}")


def _wrists_name(
    arrays: Arrays,
    layout: Layout,
    side: Side | None,
) -> str:
    """Return the name of wrist poses beside the values, where the layout takes them."""
    if layout.wrist is None or layout.has_wrist:
        return ""
    other = OTHER_SIDE[side] if side else "neither"
    names = [name for name in _WRISTS if name in arrays and not name.startswith(other)]
    return names[0] if names else ""


def as_wrists(given: Array) -> Array:
    """Return wrist poses of a file as `Layout.record` takes them: without axes of one."""
    return given.reshape(-1, *given.shape[-2:]) if given.ndim > 2 else given


class TableColumns(NamedTuple):
    """What the columns of a CSV file are.

    Attributes:
        side: Which hand they are of; None if they do not say it.
        time: Name of the column of time; empty if there is none.
        values: Names of the columns of the layout.
    """

    side: Side | None
    time: str
    values: Names

    @property
    def small(self) -> Arrays:
        """What an `.npz` file would have besides time and values."""
        return {} if self.side is None else {"handedness": np.array(self.side)}

    def values_of(self, columns: Arrays, layout: Layout) -> Array:
        """Return the samples of a table's columns, shape (T, n)."""
        return layout.from_columns(columns, self.side or "right")


def columns_of_table(
    header: Collection[str], layout: Layout, side: Side | None
) -> TableColumns:
    """Find the columns of a layout by the header of a CSV file.

    Raises:
        InvalidInputError: If one is missing.
    """
    hand = side or _named_side(" ".join(header).lower())
    own = layout.find_columns(header, hand or "right").values()
    times = [name for name in _time_units(layout) if name in header]
    return TableColumns(hand, times[0] if times else "", tuple(own))


def _read_columns(
    file: Path,
    layout: Layout,
    side: Side | None,
) -> Arrays:
    """Return the columns of a CSV file by the names that an `.npz` file has for them."""
    with opened_table(file, is_padded=True) as (header, rows):
        found = columns_of_table(header, layout, side)
        times = [found.time] if found.time else []
        columns = numbers(rows, header, [*times, *found.values])
    arrays = {name: columns[name] for name in times}
    return arrays | {"values": found.values_of(columns, layout)} | found.small


def _named_side(header: str) -> Side | None:
    named = [side for side in SIDES if side in header]
    return named[0] if len(named) == 1 else None


def _time_units(layout: Layout) -> dict[str, float]:
    """Return the names that a time may have, the likeliest first, with their units [s]."""
    own = layout.time
    return own | TIME_UNITS | own


def _time(arrays: Arrays, layout: Layout) -> Array | None:
    """Return the file's instants since its first one [s]; None if it has none."""
    found = time_in(arrays, _time_units(layout))
    return found and seconds(*found)
