"""`Recording`: the landmarks of a human hand over time, as a tracker or a video gave them.

A recording is an `.npz` file with at least `time (T,)` [s], `landmarks (T, 21, 3)` [m] and
`handedness`; `valid (T,)` tells the samples in which the hand was seen. Landmarks come in the order
of MediaPipe: wrist; thumb CMC, MCP, IP, tip; index, middle, ring and little MCP, PIP, DIP, tip.
"""

from __future__ import annotations

import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from handmap_qp.errors import RecordingError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side

LANDMARK_COUNT = 21


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """Landmarks of one human hand over time.

    Attributes:
        name: Name of the file, without its ending.
        time: Instants of the samples, increasing [s], shape (T,).
        landmarks: Landmarks in the tracker's world [m], shape (T, 21, 3); anything where a sample
            is not valid.
        valid: Samples in which the hand was seen, shape (T,).
        side: `right` or `left`.
        source: Where it came from, in words.
    """

    name: str
    time: np.ndarray
    landmarks: np.ndarray
    valid: np.ndarray
    side: Side
    source: str = ""

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.time)

    @property
    def steps(self) -> np.ndarray:
        """Time from each sample's predecessor [s], shape (T,).

        The first is the median of the others.
        """
        steps = np.diff(self.time)
        return np.concatenate([[np.median(steps) if len(steps) else 1.0 / 60.0], steps])


def read_recording(path: Path | str) -> Recording:
    """Read a recording.

    Args:
        path: An `.npz` file.

    Returns:
        The recording; samples with numbers that are not finite are marked as not valid.

    Raises:
        RecordingError: If the file cannot be read, an array is missing or has another shape than
            expected, time does not increase, the hand's side is unknown, or no sample is valid.
    """
    file = Path(path)
    arrays = _load(file)
    time = _array(file, arrays, "time", float)
    landmarks = _array(file, arrays, "landmarks", float)
    if time.ndim != 1 or len(time) == 0:
        raise RecordingError(f"time: expected shape (T,) with T >= 1, got {time.shape}", file=file)
    if landmarks.shape != (len(time), LANDMARK_COUNT, 3):
        raise RecordingError(
            f"landmarks: expected shape ({len(time)}, {LANDMARK_COUNT}, 3), got {landmarks.shape}",
            file=file,
        )
    if not (np.isfinite(time).all() and (np.diff(time) > 0.0).all()):
        raise RecordingError("time: expected finite, strictly increasing instants", file=file)
    valid = (
        _array(file, arrays, "valid", bool) if "valid" in arrays else np.ones(len(time), dtype=bool)
    )
    if valid.shape != time.shape:
        raise RecordingError(f"valid: expected shape {time.shape}, got {valid.shape}", file=file)
    valid = valid & np.isfinite(landmarks).all(axis=(1, 2))
    if not valid.any():
        raise RecordingError("no sample is valid", file=file)
    side = str(_array(file, arrays, "handedness", str)).lower()
    if side != "right" and side != "left":
        raise RecordingError(f"handedness: expected right or left, got {side!r}", file=file)
    source = str(arrays["source"]) if "source" in arrays else ""
    return Recording(file.stem, time, landmarks, valid, side, source)


def _load(file: Path) -> dict[str, np.ndarray]:
    try:
        # Opened here, because numpy leaves a torn file open.
        with file.open("rb") as stream, np.load(stream, allow_pickle=False) as arrays:
            return dict(arrays)
    except OSError as error:
        raise RecordingError(f"cannot be read: {error.strerror or error}", file=file) from error
    except (ValueError, EOFError, KeyError, TypeError, AttributeError, zipfile.BadZipFile) as error:
        raise RecordingError(f"is no .npz file of plain arrays: {error}", file=file) from error


def _array(file: Path, arrays: dict[str, np.ndarray], name: str, kind: type) -> np.ndarray:
    if name not in arrays:
        raise RecordingError(
            f"has no array {name!r}; it has {', '.join(arrays) or 'none'}", file=file
        )
    try:
        return arrays[name].astype(kind)
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"{name}: expected {kind.__name__} values, got {arrays[name].dtype}", file=file
        ) from error


@dataclass(frozen=True, slots=True, eq=False)
class HumanMotion:
    """A recording as joint angles.

    Attributes:
        human: The human hand, scaled to the person, its reference points the 21 landmarks.
        time: Instants [s], shape (T,).
        dt: Time from each sample's predecessor [s], shape (T,).
        q: Joint angles in the order of `human.joint_names` [rad], shape (T, 20).
        wrist: Wrist poses in the tracker's world, shape (T, 4, 4).
        valid: Samples that were fitted, shape (T,); the others hold the last fitted posture (the
            first one, before it).
        fit_error: Distance between the model's landmarks and the measured ones [m], shape (T, 21);
            NaN where not valid.
    """

    human: Hand
    time: np.ndarray
    dt: np.ndarray
    q: np.ndarray
    wrist: np.ndarray
    valid: np.ndarray
    fit_error: np.ndarray
