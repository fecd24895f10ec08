"""Read files whose samples are in a tracker's own layout: `.npz` arrays, or columns of a `.csv`.

Files in the package's own forms need no layout; `handmap_qp.trackers.formats` reads them.
"""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.human.verdict import Finding
from handmap_qp.trackers.formats.archive import read_archive
from handmap_qp.trackers.layout import Layout, all_layouts
from handmap_qp.trackers.plausibility import examine_recording

_TIMES = {"time": 1.0, "time_s": 1.0, "t": 1.0, "timestamp": 1.0, "time_ms": 1e-3, "time_ns": 1e-9}
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

    Returns:
        The recording.

    Raises:
        RecordingError: If the file cannot be read, or something in it is missing or of another
            shape than expected. The message names layouts that fit better.
    """
    file = Path(path)
    if file.suffix.lower() == ".npz":
        columns = _read_npz(file, layout, side)
    elif file.suffix.lower() == ".csv":
        columns = _read_csv(file, layout, side)
    else:
        problem = f"has the suffix {file.suffix!r}; with a layout, .npz and .csv are read"
        raise RecordingError(problem, file=file)
    time, values, valid, wrists, found_side = columns
    if side is not None and found_side is not None and side != found_side:
        raise RecordingError(f"is of a {found_side} hand, not of a {side} one", file=file)
    hand = side or found_side
    if hand is None:
        raise RecordingError("does not say which hand it is of: give --side", file=file)
    try:
        recording = layout.record(
            file.stem, time, values, hand, valid=valid, wrists=wrists, lengths=lengths
        )
    except InvalidInputError as error:
        text = f"{error.what}: {error.advice}" if error.advice else error.what
        raise RecordingError(text, file=file, array=error.argument) from error
    finding = examine_recording(recording)
    if finding is not None:
        raise _better(file, layout, recording, values, finding)
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
    for name, array in arrays.items():
        shape = array.shape[1:]
        names = [layout.name for layout in all_layouts() if shape in layout.shapes]
        if array.ndim >= 2 and names and shape != (LANDMARK_COUNT, 3):
            return f"{name} {array.shape} has the shape of --layout {' or '.join(names)}"
    return ""


def _better(
    file: Path, layout: Layout, recording: Recording, values: np.ndarray, finding: Finding
) -> RecordingError:
    """Name the layouts of the same shape that explain the values without a mistake."""
    names = []
    if finding.kind not in ("time", "wrist"):
        for other in all_layouts():
            if other.name == layout.name or values.shape[1:] not in other.shapes:
                continue
            try:
                read = other.record(recording.name, recording.time, values, recording.side)
            except InvalidInputError:
                continue
            if examine_recording(read) is None:
                names.append(other.name)
    advice = f"read them with --layout {' or '.join(names)}" if names else finding.advice
    problem = f"as the layout {layout.name}, {finding.problem}: {advice}"
    return RecordingError(problem, file=file)


_Columns = tuple[np.ndarray, np.ndarray, np.ndarray | None, np.ndarray | None, Side | None]


def _read_npz(file: Path, layout: Layout, side: Side | None) -> _Columns:
    arrays = read_archive(file)
    time = _time(file, arrays, layout)
    count = len(time)
    accepted = {*layout.shapes, *((int(np.prod(shape)),) for shape in layout.shapes)}
    fitting = [
        name
        for name, array in arrays.items()
        if array.dtype.kind in "fiu" and array.shape[:1] == (count,) and array.shape[1:] in accepted
    ]
    known = (*layout.table.arrays, layout.name, *_VALUES)
    chosen = [name for name in fitting if name in known] or fitting
    chosen = [name for name in chosen if side is None or name.startswith(side)] or chosen
    if len(chosen) != 1:
        shapes = " or ".join(f"({count}, {', '.join(map(str, s))})" for s in layout.shapes)
        have = ", ".join(f"{name} {array.shape}" for name, array in arrays.items() if array.ndim)
        others = _shaped_like(arrays, count)
        problem = f"has {'no' if not chosen else 'more than one'} array of shape {shapes}"
        hint = f"; {others}" if others and not chosen else f"; it has {have}"
        raise RecordingError(problem + hint, file=file)
    values = arrays[chosen[0]].astype(float)
    valid = arrays.get("valid")
    flags = None if valid is None else as_flags(valid, "valid", count)
    wrists = None
    if layout.wrist_table is not None and not layout.has_wrist:
        names = [n for n in _WRISTS if n in arrays and (side is None or _is_of(n, side))]
        found = [arrays[n].astype(float) for n in names]
        wrists = next((w.reshape(count, *w.shape[-2:]) if w.ndim > 2 else w for w in found), None)
    return time, values, flags, wrists, _side_of(file, arrays)


def _read_csv(file: Path, layout: Layout, side: Side | None) -> _Columns:
    try:
        with file.open(newline="", encoding="utf-8-sig") as stream:
            rows = [row for row in csv.reader(stream) if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        text = getattr(error, "strerror", None) or " ".join(str(error).split())
        raise RecordingError(f"cannot be read: {text}", file=file) from error
    if len(rows) < 2:
        raise RecordingError("has no rows below its header", file=file)
    header = tuple(cell.strip() for cell in rows[0])
    body = [row + [""] * (len(header) - len(row)) for row in rows[1:]]
    hand = side or _side_in(header)
    try:
        columns = layout.find_columns(header, hand or "right")
    except InvalidInputError as error:
        raise RecordingError(f"{error.what}; it has {', '.join(header)}", file=file) from error
    values = np.empty((len(body), len(columns)))
    for i, name in columns:
        values[:, i] = layout.default(i) if name is None else _numbers(file, header, body, name)
    times = {name: _numbers(file, header, body, name) for name in _time_names(header, layout)}
    return _time(file, times, layout), values, None, None, hand


def _numbers(
    file: Path, header: Sequence[str], body: Sequence[Sequence[str]], name: str
) -> np.ndarray:
    place = header.index(name)
    numbers = np.empty(len(body))
    for i, row in enumerate(body):
        cell = row[place].strip()
        try:
            numbers[i] = float(cell) if cell else np.nan
        except ValueError as error:
            problem = f"expected a number in row {i + 2}, got {cell[:40]!r}"
            raise RecordingError(problem, file=file, array=name) from error
    return numbers


def _time_names(names: Sequence[str], layout: Layout) -> list[str]:
    units = {**_TIMES, **layout.table.time}
    return [name for name in (*layout.table.time, *_TIMES) if name in names and name in units][:1]


def _time(file: Path, arrays: dict[str, np.ndarray], layout: Layout) -> np.ndarray:
    units = {**_TIMES, **layout.table.time}
    for name in _time_names(tuple(arrays), layout):
        values = np.asarray(arrays[name])
        if values.ndim == 1 and values.dtype.kind in "fiu":
            # Nanoseconds since 1970 need more digits than a float has.
            return (values - values[:1]).astype(float) * units[name]
    expected = ", ".join(dict.fromkeys((*layout.table.time, *_TIMES)))
    raise RecordingError(f"has no time; expected one of {expected}", file=file, array="time")


def _shaped_like(arrays: dict[str, np.ndarray], count: int) -> str:
    """Say which layouts have the shape of an array."""
    for name, array in arrays.items():
        if array.ndim >= 2 and array.shape[0] == count:
            names = [layout.name for layout in all_layouts() if array.shape[1:] in layout.shapes]
            if names:
                return f"{name} {array.shape} has the shape of {', '.join(names)}"
    return ""


def _side_of(file: Path, arrays: dict[str, np.ndarray]) -> Side | None:
    if "handedness" not in arrays:
        return None
    text = str(arrays["handedness"]).lower()
    try:
        check_side(text)
    except InvalidInputError as error:
        raise RecordingError(error.what, file=file, array="handedness") from error
    return "left" if text == "left" else "right"


def _side_in(header: Sequence[str]) -> Side | None:
    """Tell the hand that the columns are named after, if it is one only."""
    sides = {side for side in ("left", "right") for name in header if side in name.lower()}
    if len(sides) != 1:
        return None
    return "left" if sides == {"left"} else "right"


def _is_of(name: str, side: Side) -> bool:
    return not name.startswith("left" if side == "right" else "right")
