"""The landmarks of a hand: which they are, its bones, and the palm's shape.

`measure` measures a person's hand in a recording, and `fit` fits joint angles to it.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.se3 import as_floats, frozen, lengths

PALM = np.array([0, 5, 9, 13, 17])
"""Landmarks of the palm, taken as rigid: the wrist and the MCP joints of the four fingers."""
FIRST_JOINTS = np.array([1, 5, 9, 13, 17])
"""First joint of every finger: thumb CMC and the four MCPs."""
TIPS = np.array([4, 8, 12, 16, 20])
"""The fingertips."""
HAND_LENGTHS = (0.12, 0.25)
"""Lengths that a hand may have [m], from wrist to middle fingertip: from a child's of five years to
more than those of nearly all men. Adults that were tracked have 0.175 to 0.195."""
_PALM_RATIOS = (0.5, 2.0)
"""Size of a sample's palm over the hand's own, which is constant; 0.87 to 1.12 in recordings."""


class PalmShape:
    """The palm of a human hand, to recognise landmarks of another size.

    Args:
        human: The hand, scaled to the person.

    Attributes:
        points: Its landmarks in the frame of the wrist [m], shape (5, 3).

    Raises:
        HandError: If the hand has no landmarks.
    """

    def __init__(self, human: Hand) -> None:
        self.points = landmarks_at_rest(human)[PALM]
        self._size = float(palm_sizes(self.points))

    def ratios(self, landmarks: np.ndarray) -> np.ndarray:
        """Return the size of palms over this one's, shape (...).

        Args:
            landmarks: Of one sample or many [m], shape (..., 21, 3).
        """
        return palm_sizes(landmarks[..., PALM, :]) / self._size

    def fits(self, landmarks: np.ndarray) -> np.ndarray:
        """Tell whether landmarks belong to a hand about as large as this one.

        Landmarks in other units, or all in one place, do not.

        Args:
            landmarks: As of `ratios`.

        Returns:
            True or False for every sample, shape (...); False for NaN.
        """
        ratios = self.ratios(landmarks)
        return np.asarray((ratios >= _PALM_RATIOS[0]) & (ratios <= _PALM_RATIOS[1]))

    def check(self, landmarks: np.ndarray) -> None:
        """Reject landmarks of a hand that is much larger or smaller.

        Args:
            landmarks: Of one sample [m], shape (21, 3).

        Raises:
            InvalidInputError: If the palm is less than half or more than twice as large.
        """
        expect(
            self.fits(landmarks),
            "landmarks",
            "metres and a palm as large as the hand's",
            value=landmarks,
            got=f"one {self.ratios(landmarks):.3g} times as large",
        )


@lru_cache(maxsize=8)
def landmarks_at_rest(human: Hand) -> np.ndarray:
    """Return the landmarks of a hand at rest in the frame of its wrist [m], shape (21, 3).

    Raises:
        HandError: If the hand has no landmarks.
    """
    hand = human.with_points("landmarks")
    # A workspace for once: the hand's own would stay, a megabyte a person.
    placed = hand.configuration()
    placed.place_frames(hand.configuration_vector(hand.rest))
    return frozen(placed.points.copy())


def human_name(side: Side) -> str:
    """Return the name of the human hand of a side.

    Raises:
        InvalidInputError: If the side is neither `right` nor `left`.
    """
    check_side(side)
    return "human" if side == "right" else "human_left"


def check_length(landmarks: np.ndarray) -> np.ndarray:
    """Reject landmarks that are not a plausible hand in metres.

    Args:
        landmarks: Of one sample or more [m], shape (T, 21, 3).

    Returns:
        Bone lengths, the median over the samples [m], shape (5, 3).

    Raises:
        InvalidInputError: On a wrong shape, anything but finite numbers, or a length outside
            `HAND_LENGTHS`.
    """
    shape = ("T", LANDMARK_COUNT, 3)
    landmarks = as_floats(landmarks, "landmarks", shape=shape, is_finite=True)
    bones = lengths(np.diff(landmarks[:, 1:].reshape(-1, 5, 4, 3), axis=2))
    segments = np.median(bones, axis=0)
    palm = np.median(lengths(landmarks[:, 9] - landmarks[:, 0]))
    expect_hand_length(float(palm + segments[2].sum()), "landmarks")
    return segments


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


def palm_sizes(palms: np.ndarray) -> np.ndarray:
    """Return RMS distances of palms' points (..., 5, 3) from their centroids [m], shape (...)."""
    offsets = palms - palms.mean(axis=-2, keepdims=True)
    return np.sqrt(np.square(offsets).sum(axis=(-2, -1)) / len(PALM))
