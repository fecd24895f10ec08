"""Faults of trackers, put into samples on purpose.

What a camera or headset does when it fails: it loses the hand, repeats old data, jumps, confuses
palm and back, or its clock jumps. Each fault is a pure function of a sample, so that a replayed
recording, a test and the table of faults mean the same by the same name.

    faults = parse_faults("dropout@2+0.5,jump@4+1:0.3")
    for sample in inject(samples, faults): ...

`faulty_replay.py` plays a recording with faults into a service or a file, `bench_faults.py` makes
the table.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from handmap_core.human.sample import LANDMARK_COUNT, UNSEEN, HumanSample
from handmap_core.trackers.wrist_axes import palm_axes
from handmap_qp.errors import InvalidInputError, expect
from handmap_qp.se3 import affine, transform_points, unit


class Onset(NamedTuple):
    """What a fault knows besides the sample that it changes.

    Attributes:
        before: The last valid sample that was sent before the fault; the first of the fault if
            there is none.
        direction: A unit vector that stays the same during the fault, shape (3,).
        landmark: Index of a landmark that stays the same during the fault.
        random: Random numbers of this fault.
        size: Its size.
    """

    before: HumanSample
    direction: np.ndarray
    landmark: int
    random: np.random.Generator
    size: float


Change = Callable[[HumanSample, Onset], HumanSample]
"""Takes a sample, and returns it changed."""


def _moved(sample: HumanSample, motion: np.ndarray) -> HumanSample:
    """Move landmarks and wrist rigidly."""
    wrist = None if sample.wrist is None else motion @ sample.wrist
    landmarks = transform_points(motion, sample.landmarks)
    return replace(sample, landmarks=landmarks, wrist=wrist)


def _about(sample: HumanSample, linear: np.ndarray) -> np.ndarray:
    """Return the motion with a linear part that leaves the wrist's landmark where it is."""
    wrist = sample.landmarks[0]
    return affine(linear, wrist - linear @ wrist)


def _flip(sample: HumanSample, onset: Onset) -> HumanSample:
    axis = sample.landmarks[9] - sample.landmarks[0]
    turn = 2.0 * np.outer(axis, axis) / (axis @ axis) - np.eye(3)
    return _moved(sample, _about(sample, turn))


def _mirror(sample: HumanSample, onset: Onset) -> HumanSample:
    normal = palm_axes(sample.landmarks[None], 1.0)[0, :, 2]
    motion = _about(sample, np.eye(3) - 2.0 * np.outer(normal, normal))
    return replace(sample, landmarks=transform_points(motion, sample.landmarks))


def _zero(sample: HumanSample, onset: Onset) -> HumanSample:
    wrist = None if sample.wrist is None else np.eye(4)
    return replace(sample, landmarks=np.zeros((LANDMARK_COUNT, 3)), wrist=wrist)


def _outlier(sample: HumanSample, onset: Onset) -> HumanSample:
    landmarks = sample.landmarks.copy()
    landmarks[onset.landmark] += onset.size * onset.direction
    return replace(sample, landmarks=landmarks)


def _noise(sample: HumanSample, onset: Onset) -> HumanSample:
    noise = onset.random.normal(scale=abs(onset.size), size=(LANDMARK_COUNT, 3))
    return replace(sample, landmarks=sample.landmarks + noise)


_NOTHING = {
    "landmarks": UNSEEN,
    "wrist": None,
    "valid": False,
    "confidence": 0.0,
}


class FaultKind(NamedTuple):
    """A kind of fault.

    Attributes:
        about: What happens to the samples.
        duration: Usual duration [s].
        change: Changes a sample.
        size: Usual size; 0 where the kind has none.
        unit: Unit of the size; empty where the kind has none.
        copies: How often a sample is sent.
    """

    about: str
    duration: float
    change: Change = lambda sample, onset: sample
    size: float = 0.0
    unit: str = ""
    copies: int = 1


FAULT_KINDS: dict[str, FaultKind] = {
    "dropout": FaultKind(
        "the hand is not seen: landmarks NaN, no wrist, confidence 0",
        0.5,
        lambda sample, onset: replace(sample, **_NOTHING),
    ),
    "silence": FaultKind("no samples come", 0.5, copies=0),
    "frozen": FaultKind(
        "the last valid sample sent is repeated with new time stamps",
        0.5,
        lambda sample, onset: replace(onset.before, time=sample.time),
    ),
    "jump": FaultKind(
        "the whole hand is displaced",
        0.5,
        lambda sample, onset: _moved(
            sample, affine(np.eye(3), onset.size * onset.direction)
        ),
        0.2,
        "m",
    ),
    "flip": FaultKind(
        "the hand is turned by 180 degrees about its length: palm and back", 0.2, _flip
    ),
    "mirror": FaultKind(
        "the landmarks are mirrored in the palm: the other hand", 0.2, _mirror
    ),
    "zero": FaultKind(
        "landmarks and wrist are at the origin, and the sample counts as valid",
        0.2,
        _zero,
    ),
    "outlier": FaultKind("one landmark is displaced", 0.1, _outlier, 0.1, "m"),
    "noise": FaultKind(
        "Gaussian noise on every coordinate; the size is its standard deviation",
        math.inf,
        _noise,
        0.005,
        "m",
    ),
    "clock": FaultKind(
        "the time stamps are shifted: the tracker's clock was set",
        math.inf,
        lambda sample, onset: replace(sample, time=sample.time + onset.size),
        5.0,
        "s",
    ),
    "jitter": FaultKind(
        "Gaussian noise on time stamps; the size is its standard deviation",
        math.inf,
        lambda sample, onset: replace(
            sample, time=sample.time + onset.random.normal(scale=abs(onset.size))
        ),
        0.002,
        "s",
    ),
    "late": FaultKind(
        "half of the time stamps are set back: samples arrive in disorder",
        0.5,
        lambda sample, onset: replace(
            sample, time=sample.time - onset.size * (onset.random.random() < 0.5)
        ),
        0.05,
        "s",
    ),
    "duplicate": FaultKind("every sample comes twice", 0.5, copies=2),
}
"""All kinds by name."""
FORM = "NAME@START[+DURATION][:SIZE]"
"""How a fault is written."""
_MOST_SIZE = 1e6


class Fault(NamedTuple):
    """A fault at a certain time.

    Attributes:
        kind: What happens.
        start: Time of its begin, from the first sample on [s].
        duration: Its duration [s].
        size: Its size in the unit of the kind.
    """

    kind: FaultKind
    start: float
    duration: float
    size: float


def parse_faults(text: str) -> tuple[Fault, ...]:
    """Read faults from text such as `dropout@2+0.5,jump@4+1:0.3`.

    Args:
        text: Faults with commas between them, each `NAME@START[+DURATION][:SIZE]`, in seconds and
            in the unit of the kind; the usual duration and size of the kind if omitted.

    Raises:
        InvalidInputError: If the text does not have this form, a kind is unknown or has no size, or
            a number makes no sense.
    """
    return tuple(_parse_fault(part.strip()) for part in text.split(","))


def _parse_fault(text: str) -> Fault:
    name, _, numbers = text.partition("@")
    times, _, size = numbers.partition(":")
    start, _, duration = times.partition("+")
    expect(name in FAULT_KINDS, "fault", f"one of {', '.join(FAULT_KINDS)}", value=name)
    kind = FAULT_KINDS[name]
    pairs = ((start, math.nan), (duration, kind.duration), (size, kind.size))
    try:
        fault = Fault(kind, *(float(part or usual) for part, usual in pairs))
    except ValueError as error:
        form = f"{FORM}, such as dropout@2+0.5 or jump@4+1:0.3"
        raise InvalidInputError(argument="faults", expected=form, value=text) from error
    for key, is_right, expected in (
        ("start", 0.0 <= fault.start < math.inf, f"a finite time >= 0 s in {FORM}"),
        ("duration", fault.duration > 0.0, "more than 0 s"),
        ("size", kind.unit or not size, "none: this fault has no size"),
        ("size", abs(fault.size) <= _MOST_SIZE, f"a finite number of {kind.unit}"),
    ):
        expect(is_right, f"{name} {key}", expected, value=getattr(fault, key))
    return fault


def inject(
    samples: Iterable[HumanSample],
    faults: Sequence[Fault],
    seed: int = 0,
) -> Iterator[HumanSample]:
    """Change samples while faults are active; other samples pass unchanged.

    Faults that are active together act one after the other, in the order given.

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
            since = sample.time - start - fault.start
            if 0.0 <= since < fault.duration:
                if number not in onsets:
                    onsets[number] = _onset(before or sample, seed, number, fault.size)
                onset = onsets[number]
                # A hand that is not seen may lie in one place, without axes.
                with np.errstate(divide="ignore", invalid="ignore"):
                    sent = [fault.kind.change(one, onset) for one in sent]
                sent *= fault.kind.copies
        before = next((each for each in reversed(sent) if each.valid), before)
        yield from sent


def _onset(before: HumanSample, seed: int, number: int, size: float) -> Onset:
    random = np.random.default_rng((seed, number))
    direction = unit(random.normal(size=3))
    landmark = int(random.integers(LANDMARK_COUNT))
    return Onset(before, direction, landmark, random, size)
