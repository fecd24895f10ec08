"""`Recording`: a human hand over time, as a tracker or a video gave it.

Landmarks come in the order of MediaPipe: wrist; thumb CMC, MCP, IP, tip; index, middle, ring and
little MCP, PIP, DIP, tip. `handmap_qp.trackers.formats` has the files that recordings come from.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from typing import Any, Literal

import numpy as np

from handmap_core.errors import expect
from handmap_core.hands import OTHER_SIDE, UPRIGHT, Side
from handmap_core.se3 import Array, affine, as_floats, check_poses, frozen, is_real
from .sample import LANDMARK_COUNT, HumanSample, check_side

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
        upright: Axes of the tracker's world that are up and forward, such as `+y up, -z forward`;
            empty if not known.
        object_pose: Poses of an object that the hand holds, in the tracker's world, shape
            (T, 4, 4); None if there is none. NaN where it is not seen; arbitrary where a sample is
            not valid.
        object_shape: The object's shape, as of `parse_object`; empty if it is not known.
        task: What is done, in words; empty if it is not known.
        time_source: Where the instants are from if they are not the tracker's own stamps, in
            words, such as a rate that was declared; empty otherwise.

    Raises:
        InvalidInputError: If an array has another shape or type than expected, time does not
            increase, a valid sample is not finite, the side is unknown, or no sample is valid.
    """

    name: str
    time: Array
    landmarks: Array
    valid: Array
    side: Side
    source: str = ""
    wrist: Array | None = None
    confidence: Array | None = None
    upright: str = ""
    object_pose: Array | None = None
    object_shape: str = ""
    task: str = ""
    time_source: str = ""

    def __post_init__(self) -> None:
        """Check the arrays, and replace them by read-only copies."""
        time = as_floats(self.time, "time", shape=("T",), is_finite=True)
        count = len(time)
        expect(count > 0, "time", "at least one instant", got="none")
        increases = np.diff(time, prepend=-np.inf) > 0.0
        increasing = "strictly increasing instants"
        _expect_each(increases, "time", increasing, time, "{} at sample {}")
        shape = (count, LANDMARK_COUNT, 3)
        landmarks = as_floats(self.landmarks, "landmarks", shape=shape)
        valid = as_flags(self.valid, count)
        columns = {"time": time, "landmarks": landmarks, "valid": valid}
        check_side(self.side)
        if self.upright != "":
            upright_axes(self.upright)
        shape = self.object_shape
        is_known = isinstance(shape, str) and self.object_pose is not None
        wanted = "a text, of an object that has poses"
        expect(shape == "" or is_known, "object_shape", wanted, value=shape)
        self._check_seen(valid)
        is_right = ~valid | finite_samples(landmarks)
        finite = "finite numbers in every valid sample"
        _expect_each(is_right, "landmarks", finite, landmarks, "others in sample {1}")
        for name in ("wrist", "object_pose"):
            if (poses := getattr(self, name)) is not None:
                poses = as_floats(poses, name, shape=(count, 4, 4))
                is_lost = (name == "object_pose") & np.isnan(poses).any(axis=(1, 2))
                columns[name] = check_poses(poses, name, valid & ~is_lost)
        if self.confidence is not None:
            shares = as_floats(self.confidence, "confidence", shape=(count,))
            columns["confidence"] = shares
            is_right = ~valid | ((shares >= 0.0) & (shares <= 1.0))
            _expect_each(is_right, "confidence", "numbers from 0 to 1", shares)
        for name, array in columns.items():
            object.__setattr__(self, name, frozen(array.copy()))

    def _check_seen(self, valid: Array) -> None:
        """Reject a recording in which the hand is never seen."""
        expect(valid.any(), "valid", "at least one valid sample", got="none")

    def __len__(self) -> int:
        """Number of samples."""
        return len(self.time)

    def __reduce__(self) -> tuple[Any, ...]:
        # Through the constructor, because pickling drops the read-only flag of arrays.
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

    def part(self, samples: slice | Array) -> Recording:
        """Return some of the samples.

        Args:
            samples: A slice, or indices or flags of samples in the order of time.

        Raises:
            InvalidInputError: If no valid sample is left, or time does not increase.
        """
        columns = {
            field.name: column[samples]
            for field in fields(self)
            if isinstance(column := getattr(self, field.name), Array)
        }
        return replace(self, **columns)

    def at_rate(self, fps: float | None) -> Recording:
        """Return it with so many samples a second in place of its instants, unless None.

        `time_source` then names the rate, and that of the former instants unless they number the
        samples.

        Raises:
            InvalidInputError: If there is no such rate.
        """
        if fps is None:
            return self
        former = self.steps[0]
        is_rate = len(self) == 1 or former == 1.0 or abs(former * fps - 1.0) < 1e-6
        stamps = "" if is_rate else f"; those of the file say {1.0 / former:.3g}"
        return replace(
            self,
            time=regular_time(len(self), fps),
            time_source=f"{fps:g} samples/s, as given{stamps}",
        )

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield the samples, as of `sample`."""
        return map(self.sample, range(len(self)))

    def sample(self, i: int) -> HumanSample:
        """Return a sample; the axes of its wrist are ours in what `sample_columns` returns."""
        seen = bool(self.valid[i])
        wrist = self.wrist[i] if self.wrist is not None and seen else None
        share = 1.0 if self.confidence is None else float(self.confidence[i])
        time = float(self.time[i])
        return HumanSample(time, self.side, self.landmarks[i], wrist, seen, share)

    @property
    def steps(self) -> Array:
        """Time from each sample's predecessor [s], shape (T,).

        The first is the median of the others.
        """
        steps = np.diff(self.time)
        return np.insert(steps, 0, np.median(steps) if len(steps) else 1.0 / 60.0)


class RecordingPart(Recording):
    """Consecutive samples of a longer recording; the hand may be unseen in all of them."""

    __slots__ = ()

    def _check_seen(self, valid: Array) -> None:
        """Take samples without a hand: another part has one."""


def regular_time(count: int, fps: float) -> Array:
    """Return instants at a constant rate, from 0 on [s], shape (count,).

    Raises:
        InvalidInputError: If there is no such rate.
    """
    expect(is_real(fps) and fps > 0.0, "fps", "a rate > 0", value=fps)
    return np.arange(count) / fps


def axis_direction(axis: str) -> Array:
    """Return the unit vector of an axis such as `-z`, shape (3,)."""
    sign, name = axis
    return float(f"{sign}1") * np.eye(3)["xyz".index(name)]


def upright_axes(upright: str) -> Array:
    """Return the rotation that takes a world's forward to x and up to z (REP 103), shape (3, 3).

    Raises:
        InvalidInputError: If it is not as of `Upright`.
    """
    expected = "axes at right angles, such as '+y up, -z forward'"
    is_frame = isinstance(upright, str) and re.match(UPRIGHT, upright)
    expect(is_frame, "upright", expected, value=upright)
    z, x = map(axis_direction, upright.split()[::2])
    return np.array([x, np.cross(z, x), z])


def turned(recording: Recording, turn: Array, own: Array, **changes: Any) -> Recording:
    """Return a recording in other axes.

    Args:
        recording: The recording.
        turn: Takes the tracker's world to the other one, shape (3, 3).
        own: Takes other axes of wrist and object to their own, shape (4, 4).
        changes: Further fields that change.
    """
    poses = {
        name: affine(turn) @ pose @ own
        for name in ("wrist", "object_pose")
        if (pose := getattr(recording, name)) is not None
    }
    # Samples that are not valid may hold anything.
    with np.errstate(invalid="ignore"):
        landmarks = recording.landmarks @ turn.T
    return replace(recording, landmarks=landmarks, **poses, **changes)


def mirrored(recording: Recording) -> Recording:
    """Return the recording of the other hand, mirrored from side to side.

    The axis that is neither up nor forward is negated, and x where they are not known.

    Raises:
        InvalidInputError: If it has an object that is no box, ball or cylinder.
    """
    shape = recording.object_shape
    is_plain = re.match("box:|sphere:|cylinder:|$", shape)
    expect(is_plain, "object_shape", "a shape that its mirror image is", value=shape)
    kept = recording.upright or "yz"
    mirror = np.diag([1.0 if axis in kept else -1.0 for axis in "xyz"])
    return turned(recording, mirror, _MIRROR, side=OTHER_SIDE[recording.side])


def sample_columns(recording: Recording, wrist_poses: Array | None = None) -> Recording:
    """Return a recording with the wrist and the confidence that its samples have.

    Args:
        recording: The recording.
        wrist_poses: Wrist poses with our axes, shape (T, 4, 4). Those of the recording are left
            out, because their axes are the tracker's own; the palm gives the wrist then.
    """
    valid = recording.valid
    shares = recording.confidence
    shares = 1.0 if shares is None else shares
    confidence = np.where(valid | (shares == 1.0), shares, 0.0)
    return replace(recording, wrist=wrist_poses, confidence=confidence)


def as_flags(valid: Any, count: int) -> Array:
    """Return which samples are valid, shape (count,), of booleans or of zeros and ones.

    Raises:
        InvalidInputError: If they are something else.
    """
    flags = as_floats(valid, "valid", shape=(count,))
    is_flag = np.isin(flags, (0.0, 1.0)).all()
    expect(is_flag, "valid", "truth values, or 0 and 1", value=valid)
    return flags.astype(bool)


def newest_at(
    time: Array, instants: Array | float, side: Literal["left", "right"] = "right"
) -> Array:
    """Return the index of the newest sample at each instant; -1 where there is none yet.

    Args:
        time: Instants of the samples, strictly increasing [s], shape (T,).
        instants: Instants in any order [s], shape (N,), or one of them.
        side: Whether a sample at an instant counts there: `right` if it does.
    """
    return np.searchsorted(time, instants, side) - 1


def finite_samples(values: Array) -> Array:
    """Tell of samples (T, ...) whether all their numbers are finite, shape (T,)."""
    return np.all(np.isfinite(values), axis=tuple(range(1, values.ndim)))


def _expect_each(
    is_right: Array,
    argument: str,
    expected: str,
    values: Array,
    got: str = "{} in sample {}",
) -> None:
    """Reject an array if one of its samples is wrong; `got` tells its value and its index."""
    sample = np.argmin(is_right)
    text = got.format(values[sample], sample)
    expect(is_right[sample], argument, expected, value=values, got=text)
