"""`Recording`: the landmarks of a human hand over time, as a tracker or a video gave them.

A recording is an `.npz` file with at least `time (T,)` [s], `landmarks (T, 21, 3)` [m] and
`handedness`; `valid (T,)` marks the samples in which the hand was seen. Landmarks come in the order
of MediaPipe: wrist; thumb CMC, MCP, IP, tip; index, middle, ring and little MCP, PIP, DIP, tip.
`wrist_pose (T, 7)` may hold the tracker's own wrist poses (`read_wrist_poses`).
"""

from __future__ import annotations

import os
import zipfile
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError, RecordingError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.trackers.sample import LANDMARK_COUNT
from handmap_qp.transform import as_floats, pose_from_xyz_quat


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Landmarks of one human hand over time; its arrays are read-only copies.

    Attributes:
        name: Name of the file, without its suffix.
        time: Instants of the samples, strictly increasing [s], shape (T,), T >= 1.
        landmarks: Landmarks in the tracker's world [m], shape (T, 21, 3); arbitrary, also NaN,
            where a sample is not valid.
        valid: Samples in which the hand was seen, shape (T,); at least one of them.
        side: `right` or `left`.
        source: Where it came from, in words.

    Raises:
        InvalidInputError: If an array has another shape or type than expected, time does not
            increase, a valid sample is not finite, the side is unknown, or no sample is valid.
    """

    name: str
    time: np.ndarray
    landmarks: np.ndarray
    valid: np.ndarray
    side: Side
    source: str = ""

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        _check_times(time)
        landmarks = as_floats(self.landmarks, "landmarks", shape=(len(time), LANDMARK_COUNT, 3))
        valid = _as_flags(self.valid, "valid", len(time))
        check_side(self.side)
        if not valid.any():
            expected, got = "at least one valid sample", "none"
            raise InvalidInputError(argument="valid", expected=expected, got=got)
        is_spoilt = valid & ~np.isfinite(landmarks).all(axis=(1, 2))
        if is_spoilt.any():
            sample = int(np.flatnonzero(is_spoilt)[0])
            expected, got = "finite numbers in every valid sample", f"others in sample {sample}"
            raise InvalidInputError(argument="landmarks", expected=expected, got=got)
        _set_read_only(self, time=time, landmarks=landmarks, valid=valid)

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.time)

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt(self)

    @property
    def steps(self) -> np.ndarray:
        """Time from each sample's predecessor [s], shape (T,).

        The first is the median of the others.
        """
        steps = np.diff(self.time)
        return np.concatenate([[np.median(steps) if len(steps) else 1.0 / 60.0], steps])


@dataclass(frozen=True, slots=True, eq=False)
class HumanMotion:
    """A recording as joint angles; its arrays are read-only copies.

    Attributes:
        human: The human hand, scaled to the person, its reference points the 21 landmarks.
        time: Instants [s], shape (T,).
        dt: Time from each sample's predecessor [s], shape (T,).
        q: Joint angles in the order of `human.joint_names` [rad], shape (T, 20).
        wrist: Wrist poses in the tracker's world, shape (T, 4, 4).
        valid: Samples that were fitted, shape (T,). The others hold the last fitted posture; those
            before the first fitted one hold that one.
        fit_error: Distance between the model's landmarks and the measured ones [m], shape (T, 21);
            NaN where not valid.

    Raises:
        InvalidInputError: If the arrays are not as long as each other, or hold something else.
    """

    human: Hand
    time: np.ndarray
    dt: np.ndarray
    q: np.ndarray
    wrist: np.ndarray
    valid: np.ndarray
    fit_error: np.ndarray

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        if not isinstance(self.human, Hand):
            raise InvalidInputError(argument="human", expected="a Hand", value=self.human)
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        count, joints = len(time), len(self.human.joint_names)
        _set_read_only(
            self,
            time=time,
            dt=as_floats(self.dt, "dt", shape=(count,), is_finite=True),
            q=as_floats(self.q, "q", shape=(count, joints), is_finite=True),
            wrist=as_floats(self.wrist, "wrist", shape=(count, 4, 4), is_finite=True),
            valid=_as_flags(self.valid, "valid", count),
            fit_error=as_floats(self.fit_error, "fit_error", shape=(count, "m")),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt(self)


def read_recording(path: Path | str) -> Recording:
    """Read a recording.

    Args:
        path: An `.npz` file.

    Returns:
        The recording; samples with numbers that are not finite are marked as not valid.

    Raises:
        InvalidInputError: If `path` is something else than a path.
        RecordingError: If the file cannot be read, an array is missing or has another shape than
            expected, time does not increase, the hand's side is unknown, or no sample is valid.
    """
    if not isinstance(path, str | os.PathLike):
        raise InvalidInputError(argument="path", expected="the path of a file", value=path)
    file = Path(path)
    arrays = _load(file)
    for name in ("time", "landmarks", "handedness"):
        if name not in arrays:
            problem = f"has no array {name!r}; it has {', '.join(arrays) or 'none'}"
            raise RecordingError(problem, file=file)
    try:
        landmarks = as_floats(arrays["landmarks"], "landmarks", shape=("T", LANDMARK_COUNT, 3))
        is_finite = np.isfinite(landmarks).all(axis=(1, 2))
        valid = _as_flags(arrays.get("valid", is_finite), "valid", len(landmarks))
        return Recording(
            name=file.stem,
            time=arrays["time"],
            landmarks=landmarks,
            valid=valid & is_finite,
            side=_side(arrays["handedness"]),
            source=str(arrays.get("source", "")),
        )
    except InvalidInputError as error:
        array = "handedness" if error.argument == "side" else error.argument
        raise RecordingError(error.what, file=file, array=array) from error


def read_wrist_poses(path: Path | str, recording: Recording) -> np.ndarray | None:
    """Read the tracker's own wrist poses of a recording.

    They are the optional array `wrist_pose (T, 7)` of the file: position [m], then a quaternion in
    the order w, x, y, z. Their axes are the tracker's own.

    Args:
        path: The `.npz` file.
        recording: What `read_recording` read from it.

    Returns:
        Poses in the tracker's world, shape (T, 4, 4). Samples that are not valid have the identity.
        None if the file has no wrist poses, or a valid sample has none.

    Raises:
        RecordingError: If the file cannot be read, or the array is not one of poses.
    """
    file = Path(path)
    values = _load(file).get("wrist_pose")
    if values is None:
        return None
    try:
        rows = as_floats(values, "wrist_pose", shape=(len(recording), 7))
        if not np.isfinite(rows[recording.valid]).all():
            return None
        poses = np.tile(np.eye(4), (len(rows), 1, 1))
        for i in np.flatnonzero(recording.valid):
            poses[i] = pose_from_xyz_quat(rows[i], "wxyz")
    except InvalidInputError as error:
        raise RecordingError(error.what, file=file, array="wrist_pose") from error
    return poses


def mirrored(recording: Recording) -> Recording:
    """Return the recording of the other hand: x becomes -x."""
    return replace(
        recording,
        landmarks=recording.landmarks * (-1.0, 1.0, 1.0),
        side="left" if recording.side == "right" else "right",
    )


def _load(file: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here, because numpy leaves a damaged file open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            return dict(arrays)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror or error}", file=file) from error
    except (ValueError, EOFError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        problem = f"is not an .npz file of plain arrays: {' '.join(str(error).split())}"
        raise RecordingError(problem, file=file) from error


def _side(handedness: np.ndarray) -> Any:
    """Return the text in an array without dimensions; `Recording` checks it."""
    is_text = handedness.shape == () and handedness.dtype.kind == "U"
    return str(handedness).lower() if is_text else handedness


def _as_flags(values: Any, name: str, count: int) -> np.ndarray:
    """Return truth values, shape (count,), of booleans or of zeros and ones."""
    flags = as_floats(values, name, shape=(count,))
    if not np.isin(flags, (0.0, 1.0)).all():
        raise InvalidInputError(argument=name, expected="truth values, or 0 and 1", value=values)
    return flags.astype(bool)


def _check_times(time: np.ndarray) -> None:
    if len(time) == 0:
        raise InvalidInputError(argument="time", expected="at least one instant", got="none")
    if not (np.diff(time) > 0.0).all():
        sample = int(np.flatnonzero(np.diff(time) <= 0.0)[0]) + 1
        expected, got = "strictly increasing instants", f"{time[sample]} at sample {sample}"
        raise InvalidInputError(argument="time", expected=expected, value=time, got=got)


def _set_read_only(value: Recording | HumanMotion, **arrays: np.ndarray) -> None:
    """Set fields of a frozen dataclass to write-protected copies."""
    for name, array in arrays.items():
        copy = array.copy()
        copy.setflags(write=False)
        object.__setattr__(value, name, copy)


def _rebuilt(value: Recording | HumanMotion) -> tuple[Any, ...]:
    """Pickle through the constructor, because pickling drops the read-only flag of arrays."""
    return type(value), tuple(getattr(value, field.name) for field in fields(value))
