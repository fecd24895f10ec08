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
from typing import Any, Literal, NamedTuple, get_args

import numpy as np

from handmap_qp.errors import InvalidInputError, expect
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
_SPEC = re.compile(r"([a-z]+)@([0-9.]+)(?:\+([0-9.]+))?(?::([-0-9.]+))?")


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


Change = Callable[[HumanSample, float, Onset], dict[str, Any]]
"""Takes a sample and the size of the fault, returns the fields that change."""


def _flip(
    sample: HumanSample,
    size: float,
    onset: Onset,
) -> dict[str, Any]:
    wrist, axis, _ = _palm_axes(sample.landmarks)
    rotation = 2.0 * np.outer(axis, axis) - np.eye(3)
    return _moved(sample, affine(rotation, wrist - rotation @ wrist))


def _mirror(
    sample: HumanSample,
    size: float,
    onset: Onset,
) -> dict[str, Any]:
    wrist, _, normal = _palm_axes(sample.landmarks)
    reflection = np.eye(3) - 2.0 * np.outer(normal, normal)
    return {"landmarks": (sample.landmarks - wrist) @ reflection.T + wrist}


def _outlier(
    sample: HumanSample,
    size: float,
    onset: Onset,
) -> dict[str, Any]:
    landmarks = sample.landmarks.copy()
    landmarks[onset.landmark] += size * onset.direction
    return {"landmarks": landmarks}


def _noise(
    sample: HumanSample,
    size: float,
    onset: Onset,
) -> dict[str, Any]:
    noise = onset.random.normal(scale=abs(size), size=(LANDMARK_COUNT, 3))
    return {"landmarks": sample.landmarks + noise}


_NOWHERE = np.full((LANDMARK_COUNT, 3), np.nan)
_FIELDS = ("landmarks", "wrist", "valid", "confidence")


class FaultKind(NamedTuple):
    """A kind of fault.

    Attributes:
        about: What it does to a sample.
        duration: Usual duration [s].
        change: Changes a sample; None where the sample stays as it is.
        size: Usual size; 0 where the kind has none.
        unit: Unit of the size; empty where the kind has none.
        needs_hand: Whether a sample that is not valid passes unchanged.
        copies: How often a sample is sent.
    """

    about: str
    duration: float
    change: Change | None = None
    size: float = 0.0
    unit: str = ""
    needs_hand: bool = False
    copies: int = 1


FAULT_KINDS: dict[FaultName, FaultKind] = {
    "dropout": FaultKind(
        "The hand is not seen: landmarks NaN, no wrist, confidence 0.",
        0.5,
        lambda *_: dict(zip(_FIELDS, (_NOWHERE, None, False, 0.0), strict=True)),
    ),
    "silence": FaultKind("Nothing is sent.", 0.5, copies=0),
    "frozen": FaultKind(
        "The last valid sample that was sent before the fault, with new time stamps.",
        0.5,
        lambda sample, size, onset: {
            name: getattr(onset.before, name) for name in ("side", *_FIELDS)
        },
    ),
    "jump": FaultKind(
        "The whole hand is displaced.",
        0.5,
        lambda sample, size, onset: _moved(
            sample, affine(np.eye(3), size * onset.direction)
        ),
        0.2,
        "m",
        needs_hand=True,
    ),
    "flip": FaultKind(
        "The hand is turned by 180 degrees about its long axis: palm and back confused.",
        0.2,
        _flip,
        needs_hand=True,
    ),
    "mirror": FaultKind(
        "Landmarks are reflected in the plane of the palm: the other hand at the same place.",
        0.2,
        _mirror,
        needs_hand=True,
    ),
    "zero": FaultKind(
        "All landmarks and the wrist are at the origin, and still called valid.",
        0.2,
        lambda sample, size, onset: {
            "landmarks": np.zeros((LANDMARK_COUNT, 3)),
            "wrist": None if sample.wrist is None else np.eye(4),
        },
    ),
    "outlier": FaultKind(
        "One landmark is displaced.", 0.1, _outlier, 0.1, "m", needs_hand=True
    ),
    "noise": FaultKind(
        "Gaussian noise is added to every coordinate, its standard deviation the size.",
        math.inf,
        _noise,
        0.005,
        "m",
        needs_hand=True,
    ),
    "clock": FaultKind(
        "The size is added to the time stamp: the tracker's clock was set.",
        math.inf,
        lambda sample, size, onset: {"time": sample.time + size},
        5.0,
        "s",
    ),
    "jitter": FaultKind(
        "Gaussian noise is added to the time stamp, its standard deviation the size.",
        math.inf,
        lambda sample, size, onset: {
            "time": sample.time + onset.random.normal(scale=abs(size))
        },
        0.002,
        "s",
    ),
    "late": FaultKind(
        "One of two time stamps is set back by the size: samples arrive in disorder.",
        0.5,
        lambda sample, size, onset: {
            "time": sample.time - size * (onset.random.random() < 0.5)
        },
        0.05,
        "s",
    ),
    "duplicate": FaultKind("Every sample is sent twice.", 0.5, copies=2),
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
        names = f"one of {', '.join(FAULT_NAMES)}"
        expect(self.name in FAULT_KINDS, "fault", names, value=self.name)
        kind = FAULT_KINDS[self.name]
        duration = kind.duration if self.duration is None else self.duration
        size = kind.size if self.size is None else self.size
        for name, value, is_right, expected in (
            ("start", self.start, 0.0 <= self.start < math.inf, "a finite time >= 0 s"),
            ("duration", duration, duration > 0.0, "more than 0 s"),
            (
                "size",
                size,
                kind.unit or self.size is None,
                "none: this fault has no size",
            ),
            ("size", size, abs(size) <= _MOST_SIZE, f"a finite number of {kind.unit}"),
        ):
            expect(is_right, f"{self.name} {name}", expected, value=value)
        object.__setattr__(self, "duration", duration)
        object.__setattr__(self, "size", size)

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

    Raises:
        InvalidInputError: If the text does not have this form, or a fault makes no sense.
    """
    return tuple(_parse_fault(part.strip()) for part in text.split(","))


def inject(
    samples: Iterable[HumanSample],
    faults: Sequence[Fault],
    seed: int = 0,
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
        sent = [sample]
        for number, fault in enumerate(faults):
            if fault.start <= sample.time - start < fault.end:
                if number not in onsets:
                    onsets[number] = _onset(before or sample, seed, number)
                sent = _altered(sent, fault, onsets[number])
        before = next((each for each in reversed(sent) if each.valid), before)
        yield from sent


def _altered(
    samples: Sequence[HumanSample], fault: Fault, onset: Onset
) -> list[HumanSample]:
    """Return what is sent instead of samples while a fault is active."""
    kind, sent = FAULT_KINDS[fault.name], []
    for sample in samples:
        if kind.change is not None and (sample.valid or not kind.needs_hand):
            sample = replace(sample, **kind.change(sample, fault.size or 0.0, onset))
        sent += [sample] * kind.copies
    return sent


def _digits(number: float) -> str:
    """Return the shortest decimal digits that give this number, without an exponent."""
    return np.format_float_positional(number, trim="-")


def _onset(
    before: HumanSample,
    seed: int,
    number: int,
) -> Onset:
    random = np.random.default_rng((seed, number))
    direction = random.normal(size=3)
    direction /= np.linalg.norm(direction)
    return Onset(before, direction, int(random.integers(LANDMARK_COUNT)), random)


def _parse_fault(text: str) -> Fault:
    match = _SPEC.fullmatch(text)
    try:
        name, *numbers = match.groups() if match else ()
        values = [None if part is None else float(part) for part in numbers]
    except ValueError as error:
        expected = "NAME@START[+DURATION][:SIZE], such as dropout@2+0.5 or jump@4+1:0.3"
        raise InvalidInputError(
            argument="faults", expected=expected, value=text
        ) from error
    return Fault(name, *values)  # ty: ignore[invalid-argument-type]


def _moved(sample: HumanSample, motion: np.ndarray) -> dict[str, Any]:
    """Return landmarks and wrist, moved rigidly."""
    wrist = None if sample.wrist is None else motion @ sample.wrist
    return {"landmarks": transform_points(motion, sample.landmarks), "wrist": wrist}


def _palm_axes(landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the wrist [m], the unit vector to the middle MCP, and the unit normal of the palm."""
    wrist, index, middle, little = landmarks[[0, 5, 9, 17]]
    normal = np.cross(index - wrist, little - wrist)
    axis = middle - wrist
    normal -= (normal @ axis) / (axis @ axis) * axis
    return wrist, axis / np.linalg.norm(axis), normal / np.linalg.norm(normal)
