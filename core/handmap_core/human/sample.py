"""A sample of a human hand: its landmarks, the palm that they show, and what is said about it.

Trackers, files and layouts make each `HumanSample`; the guard of its stream makes its `Verdict`,
which `MapStep` carries. `measure` measures a person's hand in a recording, and `fit` fits joint
angles to it.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np

from handmap_core.core import core
from handmap_core.errors import InvalidInputError, expect
from handmap_core.hands import FINGERS, Hand, Names, Point, Side
from handmap_core.se3 import (
    Array,
    as_floats,
    check_pose,
    frozen,
    is_real,
    transform_points,
)
from .findings import HAND_LENGTHS, Finding, FindingNumbers

LANDMARK_COUNT = 21
"""Landmarks of a hand: wrist; thumb CMC, MCP, IP, tip; of each finger MCP, PIP, DIP, tip."""
UNSEEN = np.full((LANDMARK_COUNT, 3), np.nan)
"""Landmarks of a hand that was not seen."""
LANDMARK_NAMES: Names = (
    "wrist",
    *(f"thumb_{joint}" for joint in ("cmc", "mcp", "ip", "tip")),
    *(
        f"{finger}_{joint}"
        for finger in FINGERS[1:]
        for joint in ("mcp", "pip", "dip", "tip")
    ),
)
"""Their names, in their order; the set `landmarks` of the human hand has the same ones."""
PALM = np.array([0, 5, 9, 13, 17])
"""Landmarks of the palm, taken as rigid: the wrist and the MCP joints of the four fingers."""
FIRST_JOINTS = np.arange(1, LANDMARK_COUNT, 4)
"""First joint of every finger: thumb CMC and the four MCPs."""
TIPS = FIRST_JOINTS + 3
"""The fingertips."""
_PALM_RATIOS: tuple[float, float] = core.PALM_RATIOS
"""Size of a sample's palm over the hand's own, which is constant; 0.87 to 1.12 in recordings."""


@dataclass(frozen=True, slots=True, eq=False)
class HumanSample:
    """A human hand at one instant; its arrays are read-only copies.

    Every tracker, file and layout is turned into samples of this form.

    Attributes:
        time: Instant [s]; only differences of it have a meaning.
        side: `right` or `left`.
        landmarks: Landmarks in the tracker's world [m], shape (21, 3), in the order of MediaPipe:
            wrist; thumb CMC, MCP, IP, tip; index, middle, ring and little MCP, PIP, DIP, tip.
            Arbitrary, also NaN, where the sample is not valid.
        wrist: The tracker's own pose of the wrist in its world, shape (4, 4); None if it gives
            none. Its axes are those of the human model's wrist frame.
        valid: True where the tracker saw the hand.
        confidence: The tracker's own confidence, from 0 to 1; 1 if it gives none.

    Raises:
        InvalidInputError: If a value has another shape or type than expected, the side is unknown,
            or a valid sample is not finite.
    """

    time: float
    side: Side
    landmarks: Array
    wrist: Array | None = None
    valid: bool = True
    confidence: float = 1.0

    @classmethod
    def of_checked(cls, **values: Any) -> HumanSample:
        """Make a sample of values that were checked before; arrays are not copied."""
        sample = object.__new__(cls)
        for name, value in values.items():
            object.__setattr__(sample, name, value)
        return sample

    def __post_init__(self) -> None:
        """Check the values, and replace arrays by read-only copies."""
        expect(is_real(self.time), "time", "a finite instant", value=self.time)
        check_side(self.side)
        landmarks = as_floats(
            self.landmarks, "landmarks", shape=(LANDMARK_COUNT, 3), is_finite=self.valid
        )
        object.__setattr__(self, "landmarks", frozen(landmarks.copy()))
        if self.wrist is not None:
            wrist = check_pose(self.wrist, "wrist").copy()
            object.__setattr__(self, "wrist", frozen(wrist))
        share = self.confidence
        expect(
            is_real(share) and 0.0 <= share <= 1.0,
            "confidence",
            "a number from 0 to 1",
            value=share,
        )


def check_side(side: Any) -> None:
    """Reject what is not a side of the body.

    Raises:
        InvalidInputError: If it is neither `right` nor `left`.
    """
    is_side = isinstance(side, str) and side in get_args(Side)
    expect(is_side, "side", "'right' or 'left'", value=side)


def palm_fit_weights(by_finger: Array) -> Array:
    """Return the weights of the landmarks `PALM` where the palm is fitted, shape (5,).

    Args:
        by_finger: `HumanLengths.palm_weights`, shape (5,). The wrist takes the thumb's place.
    """
    return np.append(1.0, by_finger[1:])


class PalmShape:
    """The palm of a human hand, to recognise landmarks of another size.

    Args:
        human: The hand, scaled to the person.

    Attributes:
        points: Its landmarks in the frame of the wrist [m], shape (5, 3).
        weights: Weights of them where the palm is fitted, shape (5,).

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        self.points = landmarks_at_rest(human)[PALM]
        self.weights = palm_fit_weights(human.palm_weights)
        self._size = float(palm_sizes(self.points))

    def ratios(self, landmarks: Array) -> Array:
        """Return the size of palms over this one's, shape (...).

        Args:
            landmarks: Of one sample or many [m], shape (..., 21, 3).
        """
        return palm_sizes(landmarks[..., PALM, :]) / self._size

    def fits(self, landmarks: Array) -> Array:
        """Tell whether landmarks belong to a hand about as large as this one.

        Landmarks in other units, or all in one place, do not.

        Args:
            landmarks: As of `ratios`.

        Returns:
            True or False for every sample, shape (...); False for NaN.
        """
        ratios = self.ratios(landmarks)
        return (ratios >= _PALM_RATIOS[0]) & (ratios <= _PALM_RATIOS[1])

    def check(self, landmarks: Array) -> None:
        """Reject landmarks of a hand that is much larger or smaller.

        Args:
            landmarks: Of one sample [m], shape (21, 3).

        Raises:
            InvalidInputError: If the palm is less than half or more than twice as large.
        """
        if not self.fits(landmarks):
            raise InvalidInputError(
                argument="landmarks",
                expected="metres and a palm as large as the hand's",
                value=landmarks,
                got=f"one {self.ratios(landmarks):.3g} times as large",
            )


def finger_chains(landmarks: Array) -> Array:
    """Return the landmarks of each finger from its base to its tip [m], shape (..., 5, 4, 3).

    Args:
        landmarks: Landmarks [m], shape (..., 21, 3).
    """
    return landmarks[..., 1:, :].reshape(*landmarks.shape[:-2], len(FINGERS), 4, 3)


@lru_cache(maxsize=16)
def landmarks_at_rest(human: Hand) -> Array:
    """Return the landmarks of a hand at rest in the frame of its wrist [m], shape (21, 3).

    Raises:
        HandError: If the hand has no landmarks.
    """
    points = _landmark_points(human.unscaled or human)
    links = [point.link for point in points]
    offsets = np.array([point.xyz for point in points])
    in_palm = human.tree.points_on_links(human.rest, links, offsets)
    return frozen(transform_points(human.wrist_to_palm, in_palm))


@lru_cache(maxsize=16)
def _landmark_points(human: Hand) -> tuple[Point, ...]:
    """Return the points of a hand that are landmarks; people whose hand it is share them."""
    return tuple(human.with_points("landmarks").reference_points)


def human_name(side: Side) -> str:
    """Return the name of the human hand of a side.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """
    check_side(side)
    return "human" if side == "right" else "human_left"


def expect_hand_length(length: float, argument: str) -> None:
    """Reject a length from wrist to middle fingertip that no hand has in metres.

    Raises:
        InvalidInputError: If it is outside `HAND_LENGTHS`.
    """
    low, high = HAND_LENGTHS
    expect(
        low <= length <= high,
        argument,
        f"metres and a hand of {low} to {high} m from wrist to middle fingertip",
        value=length,
        got=f"{length:.3g}",
    )


def palm_sizes(palms: Array) -> Array:
    """Return RMS distances of palms' points (..., 5, 3) from their centroids [m], shape (...)."""
    offsets = palms - palms.mean(axis=-2, keepdims=True)
    return np.sqrt((offsets * offsets).sum(axis=-1).mean(axis=-1))


Rule = str
"""Name of what is wrong with a sample, one of `RULES`; empty if nothing is."""

RULES: dict[Rule, str] = json.loads(Path(__file__).with_name("rules.json").read_bytes())
"""The rules, in words (`rules.json`); `RULE_NAMES` of `stream.step_table` has the same order."""

UNPROVEN_SPEED: float = core.UNPROVEN_SPEED
"""Share of the speed limits at which the robot follows a wrist that is not proven yet."""


VerdictNumbers = tuple[
    Rule, bool, bool, float, float, FindingNumbers | None, float, float
]
"""What the core says about a sample, in the order of `Verdict`."""


class Verdict(msgspec.Struct, frozen=True):
    """What the guard says about one sample.

    Attributes:
        rule: What is wrong with it; empty if nothing is.
        is_held: The robot must hold: the sample is not to be followed.
        is_return: The first sample to follow after a hold, a gap, or samples that came too late.
        dt: Time that the sample accounts for [s].
        consistency: RMS difference of the distances that cannot change (bones, and neighbours in
            the palm) from the person's [m]; NaN if there are no landmarks.
        finding: What the input is instead of what it says; None if it is plausible.
        lost: At a return from a brief loss alone, its time [s]; else infinite.
        time: Instant of the sample in the time of its stream, which never goes back [s].
    """

    rule: Rule
    is_held: bool
    is_return: bool
    dt: float
    consistency: float
    finding: Finding | None = None
    lost: float = math.inf
    time: float = 0.0

    @property
    def speed(self) -> float:
        """Share of the robot's speed limits at which the sample may be followed."""
        return UNPROVEN_SPEED if self.rule == "unproven" else 1.0
