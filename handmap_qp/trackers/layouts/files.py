"""Read files whose samples are in a tracker's own layout: `.npz` arrays, or columns of a `.csv`.

Files in the package's own forms need no layout; `handmap_qp.trackers.formats` reads them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from contextlib import suppress
from pathlib import Path

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording, as_flags
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.trackers.formats.archive import read_archive
from handmap_qp.trackers.formats.base import SIDES, reading, side_of
from handmap_qp.trackers.formats.csv_files import numbers, opened_table
from handmap_qp.trackers.layouts.base import LAYOUTS, Layout, layouts_of_shape
from handmap_qp.trackers.plausibility import examine_recording

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
    suffix = file.suffix.lower()
    if suffix not in (".npz", ".csv"):
        problem = (
            f"has the suffix {file.suffix!r}; with a layout, .npz and .csv are read"
        )
        raise RecordingError(problem, file=file)
    arrays = (
        read_archive(file) if suffix == ".npz" else _read_columns(file, layout, side)
    )
    said = arrays.get("handedness")
    found = None if said is None else side_of(said, file, "handedness")
    hand = side or found
    if hand is None:
        raise RecordingError("does not say which hand it is of: give --side", file=file)
    if found not in (None, hand):
        raise RecordingError(f"is of a {found} hand, not of a {hand} one", file=file)
    time = _time(file, arrays, layout)
    name = _values_name(file, arrays, layout, side, len(time))
    values = arrays[name].astype(float)
    valid = arrays.get("valid")
    with reading(file):
        recording = layout.record(
            file.stem,
            time,
            values,
            hand,
            valid=None if valid is None else as_flags(valid, "valid", len(time)),
            wrists=_wrists_beside(arrays, layout, side, len(time)),
            lengths=lengths,
        )
    finding = examine_recording(recording)
    if finding is None:
        return recording
    names = [] if finding.kind in ("time", "wrist") else _better(recording, values)
    advice = (
        f"read them with --layout {' or '.join(names)}" if names else finding.advice
    )
    problem = f"as the layout {layout.name}, {finding.problem}: {advice}"
    raise RecordingError(problem, file=file)


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
    arrays: Mapping[str, np.ndarray],
    option: str = "",
    between: str = ", ",
) -> str:
    """Say which layouts have the shape of an array that is not plain landmarks."""
    for name, array in arrays.items():
        shape = array.shape[1:]
        is_plain = shape in ((), (LANDMARK_COUNT, 3))
        names = between.join([] if is_plain else layouts_of_shape(shape))
        if names:
            return f"{name} {array.shape} has the shape of {option}{names}"
    return ""


def _better(recording: Recording, values: np.ndarray) -> list[str]:
    """Return the layouts of the same shape that explain the values without a mistake."""
    names = []
    for name in layouts_of_shape(values.shape[1:]):
        with suppress(InvalidInputError):
            read = LAYOUTS[name].record(name, recording.time, values, recording.side)
            if examine_recording(read) is None:
                names.append(name)
    return names


def _values_name(
    file: Path,
    arrays: Mapping[str, np.ndarray],
    layout: Layout,
    side: Side | None,
    count: int,
) -> str:
    """Return the name of the array whose rows are samples of the layout."""
    long = {name: a for name, a in arrays.items() if a.shape[:1] == (count,)}
    known = (*layout.table.arrays, layout.name, *_VALUES)

    def takes(name: str) -> bool:
        array = long[name]
        return array.dtype.kind in "fiu" and bool(layout.own_shape(array.shape[1:]))

    def is_of_side(name: str) -> bool:
        return name.startswith(side or "")

    chosen = list(filter(takes, long))
    for is_better in (known.__contains__, is_of_side):
        chosen = list(filter(is_better, chosen)) or chosen
    if len(chosen) == 1:
        return chosen[0]
    shapes = [", ".join(map(str, (count, *shape))) for shape in layout.shapes]
    how, hint = "more than one", ""
    if not chosen:
        how, hint = "no", _shaped_like(long)
    problem = f"has {how} array of shape ({') or ('.join(shapes)})"
    raise RecordingError(f"{problem}; {hint or _listing(arrays)}", file=file)


def _listing(arrays: Mapping[str, np.ndarray]) -> str:
    have = [f"{name} {array.shape}" for name, array in arrays.items() if array.ndim]
    return f"it has {', '.join(have)}"


def _wrists_beside(
    arrays: Mapping[str, np.ndarray],
    layout: Layout,
    side: Side | None,
    count: int,
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


def _read_columns(
    file: Path,
    layout: Layout,
    side: Side | None,
) -> dict[str, np.ndarray]:
    """Return the columns of a CSV file by the names that an `.npz` file has for them."""
    with opened_table(file) as (header, rows):
        named = [hand for hand in SIDES if hand in " ".join(header).lower()]
        hand = side or (named[0] if len(named) == 1 else None)
        try:
            wanted = layout.find_columns(tuple(header), hand or "right").values()
        except InvalidInputError as error:
            problem = f"{error.what}; it has {', '.join(header)}"
            raise RecordingError(problem, file=file) from error
        times = _times_of(header, layout)
        names = [*times, *wanted]
        places = {name: header[name] for name in names}
        columns = dict(zip(places, numbers(file, rows, places).T, strict=True))
    arrays = {name: columns[name] for name in times}
    arrays["values"] = layout.from_columns(columns, hand or "right")
    if hand is not None:
        arrays["handedness"] = np.array(hand)
    return arrays


def _times_of(names: Iterable[str], layout: Layout) -> dict[str, float]:
    """Return the first name of a time among names, with its unit [s]; nothing if there is none."""
    units = _TIMES | layout.table.time
    known = set(names)
    found = [name for name in (*layout.table.time, *_TIMES) if name in known]
    return {name: units[name] for name in found[:1]}


def _time(
    file: Path,
    arrays: Mapping[str, np.ndarray],
    layout: Layout,
) -> np.ndarray:
    for name, unit in _times_of(arrays, layout).items():
        values = np.asarray(arrays[name])
        if values.ndim == 1 and values.dtype.kind in "fiu":
            # Nanoseconds since 1970 need more digits than a float has.
            return (values - values[:1]).astype(float) * unit
    expected = ", ".join(dict.fromkeys((*layout.table.time, *_TIMES)))
    raise RecordingError(
        f"has no time; expected one of {expected}", file=file, array="time"
    )
