"""`Recording`: a human hand over time, as a tracker or a video gave it.

Landmarks come in the order of MediaPipe: wrist; thumb CMC, MCP, IP, tip; index, middle, ring and
little MCP, PIP, DIP, tip. `handmap_qp.trackers.formats` has the files that recordings come from.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.human.sample import LANDMARK_COUNT, HumanSample, unchecked_sample
from handmap_qp.se3 import as_floats, check_poses

_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


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
        wrist: The tracker's own poses of the wrist in its world, shape (T, 4, 4); None if it gave
            none. Their axes are the tracker's own. Arbitrary where a sample is not valid.
        confidence: The tracker's own confidence, from 0 to 1, shape (T,); None if it gave none.
            Arbitrary where a sample is not valid.

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
    wrist: np.ndarray | None = None
    confidence: np.ndarray | None = None

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        _check_times(time)
        landmarks = as_floats(
            self.landmarks, "landmarks", shape=(len(time), LANDMARK_COUNT, 3)
        )
        valid = as_flags(self.valid, "valid", len(time))
        check_side(self.side)
        if not valid.any():
            expected, got = "at least one valid sample", "none"
            raise InvalidInputError(argument="valid", expected=expected, got=got)
        is_spoilt = valid & ~np.isfinite(landmarks).all(axis=(1, 2))
        if is_spoilt.any():
            sample = int(np.flatnonzero(is_spoilt)[0])
            expected, got = (
                "finite numbers in every valid sample",
                f"others in sample {sample}",
            )
            raise InvalidInputError(argument="landmarks", expected=expected, got=got)
        _set_read_only(self, time=time, landmarks=landmarks, valid=valid)
        if self.wrist is not None:
            _set_read_only(self, wrist=check_poses(self.wrist, "wrist", valid))
        if self.confidence is not None:
            _set_read_only(self, confidence=_as_confidence(self.confidence, valid))

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.time)

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt(self)

    def part(self, samples: slice | np.ndarray) -> Recording:
        """Return some of the samples.

        Args:
            samples: A slice, or indices or flags of samples in the order of time.

        Raises:
            InvalidInputError: If no valid sample is left, or time does not increase.
        """
        columns = ("time", "landmarks", "valid", "wrist", "confidence")
        values = {name: getattr(self, name) for name in columns}
        return replace(
            self,
            **{name: None if v is None else v[samples] for name, v in values.items()},
        )

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
            raise InvalidInputError(
                argument="human", expected="a Hand", value=self.human
            )
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        count, joints = len(time), len(self.human.joint_names)
        _set_read_only(
            self,
            time=time,
            dt=as_floats(self.dt, "dt", shape=(count,), is_finite=True),
            q=as_floats(self.q, "q", shape=(count, joints), is_finite=True),
            wrist=as_floats(self.wrist, "wrist", shape=(count, 4, 4), is_finite=True),
            valid=as_flags(self.valid, "valid", count),
            fit_error=as_floats(self.fit_error, "fit_error", shape=(count, "m")),
        )

    def __reduce__(self) -> tuple[Any, ...]:
        return _rebuilt(self)


def mirrored(recording: Recording) -> Recording:
    """Return the recording of the other hand: x becomes -x."""
    wrist = recording.wrist
    return replace(
        recording,
        landmarks=recording.landmarks * (-1.0, 1.0, 1.0),
        wrist=None if wrist is None else _MIRROR @ wrist @ _MIRROR,
        side="left" if recording.side == "right" else "right",
    )


def recording_samples(
    recording: Recording, wrist_poses: np.ndarray | None = None
) -> list[HumanSample]:
    """Return the samples of a recording, as a tracker would send them.

    Args:
        recording: The recording.
        wrist_poses: Wrist poses with our axes, shape (T, 4, 4). Those of the recording are left
            out, because their axes are the tracker's own; the palm gives the wrist then.
    """
    times, valid, confidence = recording.time.tolist(), recording.valid.tolist(), [1.0]
    confidence *= len(times)
    if recording.confidence is not None:
        confidence = np.where(recording.valid, recording.confidence, 0.0).tolist()
    columns = zip(times, recording.landmarks, valid, confidence, strict=True)
    if wrist_poses is None:
        return [
            unchecked_sample(time, recording.side, landmarks, is_seen, share)
            for time, landmarks, is_seen, share in columns
        ]
    return [
        HumanSample(
            time, recording.side, landmarks, pose if is_seen else None, is_seen, share
        )
        for (time, landmarks, is_seen, share), pose in zip(
            columns, wrist_poses, strict=True
        )
    ]


def as_flags(values: Any, name: str, count: int) -> np.ndarray:
    """Return truth values, shape (count,), of booleans or of zeros and ones.

    Raises:
        InvalidInputError: If they are something else.
    """
    flags = as_floats(values, name, shape=(count,))
    if not np.isin(flags, (0.0, 1.0)).all():
        raise InvalidInputError(
            argument=name, expected="truth values, or 0 and 1", value=values
        )
    return flags.astype(bool)


def _as_confidence(values: Any, valid: np.ndarray) -> np.ndarray:
    confidence = as_floats(values, "confidence", shape=(len(valid),))
    is_share = (confidence >= 0.0) & (confidence <= 1.0)
    if (valid & ~is_share).any():
        sample = int(np.flatnonzero(valid & ~is_share)[0])
        expected, got = (
            "numbers from 0 to 1",
            f"{confidence[sample]} in sample {sample}",
        )
        raise InvalidInputError(
            argument="confidence", expected=expected, value=values, got=got
        )
    return confidence


def _check_times(time: np.ndarray) -> None:
    if len(time) == 0:
        raise InvalidInputError(
            argument="time", expected="at least one instant", got="none"
        )
    if not (np.diff(time) > 0.0).all():
        sample = int(np.flatnonzero(np.diff(time) <= 0.0)[0]) + 1
        expected, got = (
            "strictly increasing instants",
            f"{time[sample]} at sample {sample}",
        )
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
