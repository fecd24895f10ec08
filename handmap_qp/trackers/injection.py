"""Faults of trackers, put into samples on purpose.

What a camera or headset does when it fails: it loses the hand, repeats old data, jumps, confuses
palm and back, or its clock jumps. Each fault is a pure function of a sample, so that a replayed
recording, a test and the table of faults mean the same by the same name.

    faults = parse_faults("dropout@2+0.5,jump@4+1:0.3")
    for sample in inject(samples, faults): ...
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.human.sample import LANDMARK_COUNT, HumanSample
from handmap_qp.se3 import affine, transform_points

FaultName = Literal[
    "dropout",
    "silence",
    "frozen",
    "jump",
    "flip",
    "mirror",
    "zero",
    "outlier",
    "noise",
    "clock",
    "jitter",
    "late",
    "duplicate",
]
FAULT_NAMES: tuple[FaultName, ...] = get_args(FaultName)
_MOST_SIZE = 1e6
_SPEC = re.compile(
    r"(?P<name>[a-z]+)@(?P<start>[0-9.]+)(\+(?P<duration>[0-9.]+))?(:(?P<size>[-0-9.]+))?"
)
_IDENTITY = np.eye(4)
_IDENTITY.setflags(write=False)


class Onset(NamedTuple):
    """What a fault knows besides the sample that it changes.

    Attributes:
        before: The last valid sample that was sent before the fault; the first of the fault if
            there is none.
        direction: A unit vector that stays the same during the fault, shape (3,).
        landmark: Index of a landmark that stays the same during the fault.
        random: Random numbers of this fault.
    """

    before: HumanSample
    direction: np.ndarray
    landmark: int
    random: np.random.Generator


Change = Callable[[HumanSample, float, Onset], tuple[HumanSample, ...]]
"""Takes a sample and the size of the fault, returns the samples to send in its place."""


def drop(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Mark the hand as not seen: landmarks NaN, no wrist, confidence 0."""
    nowhere = np.full((LANDMARK_COUNT, 3), np.nan)
    return (replace(sample, landmarks=nowhere, wrist=None, valid=False, confidence=0.0),)


def silence(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Send nothing."""
    return ()


def freeze(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Repeat the last valid sample that was sent before the fault, with new time stamps."""
    return (replace(onset.before, time=sample.time),)


def jump(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Displace the whole hand by `size` [m]."""
    return (_moved(sample, affine(np.eye(3), size * onset.direction)),)


def flip(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Turn the hand by 180 degrees about its long axis: palm and back confused."""
    wrist, axis, _ = _palm_axes(sample.landmarks)
    rotation = 2.0 * np.outer(axis, axis) - np.eye(3)
    return (_moved(sample, affine(rotation, wrist - rotation @ wrist)),)


def mirror(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Reflect the landmarks in the plane of the palm: the other hand at the same place."""
    wrist, _, normal = _palm_axes(sample.landmarks)
    reflection = np.eye(3) - 2.0 * np.outer(normal, normal)
    return (replace(sample, landmarks=(sample.landmarks - wrist) @ reflection.T + wrist),)


def zero(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Put all landmarks and the wrist at the origin, and still call the sample valid."""
    wrist = None if sample.wrist is None else _IDENTITY
    return (replace(sample, landmarks=np.zeros((LANDMARK_COUNT, 3)), wrist=wrist),)


def displace_one(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Displace one landmark by `size` [m]."""
    landmarks = sample.landmarks.copy()
    landmarks[onset.landmark] += size * onset.direction
    return (replace(sample, landmarks=landmarks),)


def add_noise(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Add Gaussian noise of standard deviation `size` [m] to every coordinate."""
    noise = onset.random.normal(scale=abs(size), size=(LANDMARK_COUNT, 3))
    return (replace(sample, landmarks=sample.landmarks + noise),)


def shift_time(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Add `size` [s] to the time stamp: the tracker's clock was set."""
    return (replace(sample, time=sample.time + size),)


def jitter_time(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Add Gaussian noise of standard deviation `size` [s] to the time stamp."""
    return (replace(sample, time=sample.time + onset.random.normal(scale=abs(size))),)


def set_back(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Set one of two time stamps back by `size` [s]: samples arrive in disorder."""
    is_late = onset.random.random() < 0.5
    return (replace(sample, time=sample.time - size if is_late else sample.time),)


def duplicate(sample: HumanSample, size: float, onset: Onset) -> tuple[HumanSample, ...]:
    """Send every sample twice."""
    return (sample, sample)


class FaultKind(NamedTuple):
    """A kind of fault.

    Attributes:
        change: Changes a sample.
        duration: Usual duration [s].
        size: Usual size; 0 where the kind has none.
        unit: Unit of the size; empty where the kind has none.
    """

    change: Change
    duration: float
    size: float = 0.0
    unit: str = ""


FAULT_KINDS: dict[FaultName, FaultKind] = {
    "dropout": FaultKind(drop, 0.5),
    "silence": FaultKind(silence, 0.5),
    "frozen": FaultKind(freeze, 0.5),
    "jump": FaultKind(jump, 0.5, 0.2, "m"),
    "flip": FaultKind(flip, 0.2),
    "mirror": FaultKind(mirror, 0.2),
    "zero": FaultKind(zero, 0.2),
    "outlier": FaultKind(displace_one, 0.1, 0.1, "m"),
    "noise": FaultKind(add_noise, math.inf, 0.005, "m"),
    "clock": FaultKind(shift_time, math.inf, 5.0, "s"),
    "jitter": FaultKind(jitter_time, math.inf, 0.002, "s"),
    "late": FaultKind(set_back, 0.5, 0.05, "s"),
    "duplicate": FaultKind(duplicate, 0.5),
}
"""All kinds by name."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault at a certain time.

    Attributes:
        name: The kind.
        start: Time of its begin, from the first sample on [s].
        duration: Its duration [s]; the usual one of the kind if omitted.
        size: Its size in the unit of the kind; the usual one if omitted.

    Raises:
        InvalidInputError: If the kind is unknown, has no size, or a number makes no sense.
    """

    name: FaultName
    start: float
    duration: float | None = None
    size: float | None = None

    def __post_init__(self) -> None:
        """Check the numbers, and fill in the usual ones."""
        kind = FAULT_KINDS.get(self.name)
        if kind is None:
            raise InvalidInputError(
                argument="fault", expected=f"one of {', '.join(FAULT_NAMES)}", value=self.name
            )
        if not 0.0 <= self.start < math.inf:
            raise InvalidInputError(
                argument=f"{self.name} start", expected="0 s or later", value=self.start
            )
        if self.duration is None:
            object.__setattr__(self, "duration", kind.duration)
        elif not self.duration > 0.0:
            raise InvalidInputError(
                argument=f"{self.name} duration", expected="more than 0 s", value=self.duration
            )
        if self.size is None:
            object.__setattr__(self, "size", kind.size)
        elif not kind.unit:
            raise InvalidInputError(
                argument=f"{self.name} size",
                expected="none: this fault has no size",
                value=self.size,
            )
        elif not abs(self.size) <= _MOST_SIZE:
            raise InvalidInputError(
                argument=f"{self.name} size",
                expected=f"a finite number of {kind.unit}",
                value=self.size,
            )

    @property
    def end(self) -> float:
        """Time of its end, from the first sample on [s]."""
        return self.start + (self.duration or 0.0)

    def __str__(self) -> str:
        """Compose the text that `parse_faults` reads."""
        text = f"{self.name}@{_digits(self.start)}"
        if self.duration is not None and self.duration < math.inf:
            text += f"+{_digits(self.duration)}"
        if self.size is not None and FAULT_KINDS[self.name].unit:
            text += f":{_digits(self.size)}"
        return text


def parse_faults(text: str) -> tuple[Fault, ...]:
    """Read faults from text such as `dropout@2+0.5,jump@4+1:0.3`.

    Args:
        text: Faults with commas between them, each `NAME@START[+DURATION][:SIZE]`, in seconds and
            in the unit of the kind.

    Returns:
        The faults, in the order of the text.

    Raises:
        InvalidInputError: If the text does not have this form, or a fault makes no sense.
    """
    return tuple(_parse_fault(part.strip()) for part in text.split(","))


def inject(
    samples: Iterable[HumanSample], faults: Sequence[Fault], seed: int = 0
) -> Iterator[HumanSample]:
    """Change samples while faults are active; other samples pass unchanged.

    Faults that are active together act one after the other, in the order given. A sample that is
    not valid passes unchanged through faults of its landmarks.

    Args:
        samples: The samples of a tracker, with its own increasing time stamps.
        faults: The faults; their times count from the first sample.
        seed: Seed of the random numbers: the same seed gives the same samples.

    Yields:
        The changed samples.
    """
    onsets: dict[int, Onset] = {}
    start: float | None = None
    before: HumanSample | None = None
    for sample in samples:
        start = sample.time if start is None else start
        elapsed = sample.time - start
        changed: tuple[HumanSample, ...] = (sample,)
        for number, fault in enumerate(faults):
            if not fault.start <= elapsed < fault.end:
                continue
            if number not in onsets:
                onsets[number] = _onset(before or sample, seed, number)
            changed = tuple(
                result for each in changed for result in _apply(fault, each, onsets[number])
            )
        before = next((each for each in reversed(changed) if each.valid), before)
        yield from changed


_NEED_LANDMARKS = (jump, flip, mirror, displace_one, add_noise)


def _apply(fault: Fault, sample: HumanSample, onset: Onset) -> tuple[HumanSample, ...]:
    change = FAULT_KINDS[fault.name].change
    if not sample.valid and change in _NEED_LANDMARKS:
        return (sample,)
    return change(sample, fault.size or 0.0, onset)


def _digits(number: float) -> str:
    """Return the shortest decimal digits that give this number, without an exponent."""
    return np.format_float_positional(number, trim="-")


def _onset(before: HumanSample, seed: int, number: int) -> Onset:
    random = np.random.default_rng((seed, number))
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction)
    return Onset(before, direction, int(random.integers(LANDMARK_COUNT)), random)


def _parse_fault(text: str) -> Fault:
    match = _SPEC.fullmatch(text)
    expected = "NAME@START[+DURATION][:SIZE], such as dropout@2+0.5 or jump@4+1:0.3"
    if match is None:
        raise InvalidInputError(argument="faults", expected=expected, value=text)
    name, start, duration, size = match.group("name", "start", "duration", "size")
    if name not in FAULT_KINDS:
        raise InvalidInputError(
            argument="faults", expected=f"one of {', '.join(FAULT_NAMES)}", value=name
        )
    try:
        return Fault(
            name,
            float(start),
            None if duration is None else float(duration),
            None if size is None else float(size),
        )
    except ValueError as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(argument="faults", expected=expected, value=text) from error


def _moved(sample: HumanSample, motion: np.ndarray) -> HumanSample:
    """Move landmarks and wrist rigidly."""
    wrist = None if sample.wrist is None else motion @ sample.wrist
    return replace(sample, landmarks=transform_points(motion, sample.landmarks), wrist=wrist)


def _palm_axes(landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the wrist [m], the unit vector to the middle MCP, and the unit normal of the palm."""
    wrist, index, middle, little = landmarks[[0, 5, 9, 17]]
    normal = np.cross(index - wrist, little - wrist)
    axis = middle - wrist
    normal -= (normal @ axis) / (axis @ axis) * axis
    return wrist, axis / np.linalg.norm(axis), normal / np.linalg.norm(normal)
