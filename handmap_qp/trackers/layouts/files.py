"""Read files whose samples are in a tracker's own layout: `.npz` arrays, or columns of a `.csv`.

Files in the package's own forms need no layout; `handmap_qp.trackers.formats` reads them.
"""

from __future__ import annotations

import csv
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.trackers.formats.archive import damages, read_archive
from handmap_qp.trackers.formats.base import SIDES, side_of
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import Layout, layouts_of_shape
from handmap_qp.trackers.plausibility import Finding, examine_recording

_TIMES = {
    "time": 1.0,
    "time_s": 1.0,
    "t": 1.0,
    "timestamp": 1.0,
    "time_ms": 1e-3,
    "time_ns": 1e-9,
}
"""Names of arrays and columns of time, with their unit [s]."""
_VALUES = ("values", "landmarks")
_WRISTS = ("wrist", "wrist_pose", "right_wrist", "left_wrist")


def read_with_layout(
    path: Path | str,
    layout: Layout,
    side: Side | None = None,
    lengths: HumanLengths | None = None,
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

    Raises:
        RecordingError: If the file cannot be read, or something in it is missing or of another
            shape than expected. The message names layouts that fit better.
    """
    file = Path(path)
    readers = {".npz": _read_npz, ".csv": _read_csv}
    if file.suffix.lower() not in readers:
        problem = (
            f"has the suffix {file.suffix!r}; with a layout, .npz and .csv are read"
        )
        raise RecordingError(problem, file=file)
    found = readers[file.suffix.lower()](file, layout, side)
    if side is not None and found.side is not None and side != found.side:
        raise RecordingError(
            f"is of a {found.side} hand, not of a {side} one", file=file
        )
    hand = side or found.side
    if hand is None:
        raise RecordingError("does not say which hand it is of: give --side", file=file)
    try:
        recording = layout.record(
            file.stem,
            found.time,
            found.values,
            hand,
            valid=found.valid,
            wrists=found.wrists,
            lengths=lengths,
        )
    except InvalidInputError as error:
        text = f"{error.what}: {error.advice}" if error.advice else error.what
        raise RecordingError(text, file=file, array=error.argument) from error
    finding = examine_recording(recording)
    if finding is not None:
        raise _better(file, layout, recording, found.values, finding)
    return recording


def layout_hint(path: Path) -> str:
    """Name the layouts that have the shape of an array of an `.npz` file.

    Args:
        path: A file that could not be read as it is.

    Returns:
        Advice in words; empty if no array has such a shape, or the file cannot be read.
    """
    if path.suffix.lower() != ".npz":
        return ""
    try:
        arrays = read_archive(path)
    except RecordingError:
        return ""
    return _shaped_like(arrays, "--layout ", " or ")


def _shaped_like(
    arrays: Mapping[str, np.ndarray], option: str = "", between: str = ", "
) -> str:
    """Say which layouts have the shape of an array that is not plain landmarks."""
    for name, array in arrays.items():
        shape = array.shape[1:]
        names = (
            layouts_of_shape(shape) if shape and shape != (LANDMARK_COUNT, 3) else []
        )
        if names:
            return (
                f"{name} {array.shape} has the shape of {option}{between.join(names)}"
            )
    return ""


def _better(
    file: Path,
    layout: Layout,
    recording: Recording,
    values: np.ndarray,
    finding: Finding,
) -> RecordingError:
    """Name the layouts of the same shape that explain the values without a mistake."""
    names = []
    if finding.kind not in ("time", "wrist"):
        for name in layouts_of_shape(values.shape[1:]):
            if name == layout.name:
                continue
            try:
                read = LAYOUTS[name].record(
                    recording.name, recording.time, values, recording.side
                )
            except InvalidInputError:
                continue
            if examine_recording(read) is None:
                names.append(name)
    advice = (
        f"read them with --layout {' or '.join(names)}" if names else finding.advice
    )
    problem = f"as the layout {layout.name}, {finding.problem}: {advice}"
    return RecordingError(problem, file=file)


class _Columns(NamedTuple):
    """What a file holds: time [s], values, and where it says so valid, wrist poses and side."""

    time: np.ndarray
    values: np.ndarray
    valid: np.ndarray | None
    wrists: np.ndarray | None
    side: Side | None


def _read_npz(file: Path, layout: Layout, side: Side | None) -> _Columns:
    arrays = read_archive(file)
    time = _time(file, arrays, layout)
    valid = arrays.get("valid")
    return _Columns(
        time,
        arrays[_values_name(file, arrays, layout, side, len(time))].astype(float),
        None if valid is None else as_flags(valid, "valid", len(time)),
        _wrists_beside(arrays, layout, side, len(time)),
        side_of(arrays["handedness"], file, "handedness")
        if "handedness" in arrays
        else None,
    )


def _values_name(
    file: Path,
    arrays: Mapping[str, np.ndarray],
    layout: Layout,
    side: Side | None,
    count: int,
) -> str:
    """Return the name of the array whose rows are samples of the layout."""
    accepted = {*layout.shapes, *((int(np.prod(shape)),) for shape in layout.shapes)}
    long = {
        name: array for name, array in arrays.items() if array.shape[:1] == (count,)
    }
    fitting = [
        n for n, a in long.items() if a.dtype.kind in "fiu" and a.shape[1:] in accepted
    ]
    known = (*layout.table.arrays, layout.name, *_VALUES)
    chosen = [name for name in fitting if name in known] or fitting
    chosen = [
        name for name in chosen if side is None or name.startswith(side)
    ] or chosen
    if len(chosen) == 1:
        return chosen[0]
    shapes = " or ".join(f"({count}, {', '.join(map(str, s))})" for s in layout.shapes)
    problem = f"has {'no' if not chosen else 'more than one'} array of shape {shapes}"
    hint = "" if chosen else _shaped_like(long)
    have = ", ".join(
        f"{name} {array.shape}" for name, array in arrays.items() if array.ndim
    )
    raise RecordingError(f"{problem}; {hint or f'it has {have}'}", file=file)


def _wrists_beside(
    arrays: Mapping[str, np.ndarray], layout: Layout, side: Side | None, count: int
) -> np.ndarray | None:
    """Return wrist poses beside the values, where the layout takes them."""
    if layout.wrist_table is None or layout.has_wrist:
        return None
    other = {"left": "right", "right": "left", None: "neither"}[side]
    names = [name for name in _WRISTS if name in arrays and not name.startswith(other)]
    if not names:
        return None
    given = arrays[names[0]].astype(float)
    return given.reshape(count, *given.shape[-2:]) if given.ndim > 2 else given


def _read_csv(file: Path, layout: Layout, side: Side | None) -> _Columns:
    with (
        damages(file, "cannot be read"),
        file.open(newline="", encoding="utf-8-sig") as stream,
    ):
        rows = [row for row in csv.reader(stream) if any(cell.strip() for cell in row)]
    if len(rows) < 2:
        raise RecordingError("has no rows below its header", file=file)
    header = tuple(cell.strip() for cell in rows[0])
    named = {side for side in SIDES for name in header if side in name.lower()}
    hand = side or (named.pop() if len(named) == 1 else None)
    try:
        columns = layout.find_columns(header, hand or "right")
    except InvalidInputError as error:
        raise RecordingError(
            f"{error.what}; it has {', '.join(header)}", file=file
        ) from error

    def numbers(name: str) -> np.ndarray:
        place, found = header.index(name), np.full(len(rows) - 1, np.nan)
        for i, row in enumerate(rows[1:]):
            cell = row[place].strip() if place < len(row) else ""
            try:
                found[i] = float(cell or "nan")
            except ValueError as error:
                problem = f"expected a number in row {i + 2}, got {cell[:40]!r}"
                raise RecordingError(problem, file=file, array=name) from error
        return found

    values = np.empty((len(rows) - 1, len(columns)))
    for i, name in columns:
        values[:, i] = layout.default(i) if name is None else numbers(name)
    times = {name: numbers(name) for name in _times_of(header, layout)}
    return _Columns(_time(file, times, layout), values, None, None, hand)


def _times_of(names: Iterable[str], layout: Layout) -> dict[str, float]:
    """Return the first name of a time among names, with its unit [s]; nothing if there is none."""
    units, known = _TIMES | layout.table.time, set(names)
    found = [name for name in (*layout.table.time, *_TIMES) if name in known]
    return {name: units[name] for name in found[:1]}


def _time(file: Path, arrays: Mapping[str, np.ndarray], layout: Layout) -> np.ndarray:
    for name, unit in _times_of(arrays, layout).items():
        values = np.asarray(arrays[name])
        if values.ndim == 1 and values.dtype.kind in "fiu":
            # Nanoseconds since 1970 need more digits than a float has.
            return (values - values[:1]).astype(float) * unit
    expected = ", ".join(dict.fromkeys((*layout.table.time, *_TIMES)))
    raise RecordingError(
        f"has no time; expected one of {expected}", file=file, array="time"
    )
