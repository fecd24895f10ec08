"""`HumanSample`: one human hand at one instant, as a tracker saw it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands.spec import Side, check_side
from handmap_qp.se3 import as_floats, check_pose, frozen

LANDMARK_COUNT = 21
"""Landmarks of a hand: wrist; thumb CMC, MCP, IP, tip; of each finger MCP, PIP, DIP, tip."""
LANDMARK_NAMES: tuple[str, ...] = (
    "wrist",
    *(f"thumb_{joint}" for joint in ("cmc", "mcp", "ip", "tip")),
    *(
        f"{finger}_{joint}"
        for finger in ("index", "middle", "ring", "little")
        for joint in ("mcp", "pip", "dip", "tip")
    ),
)
"""Their names, in their order; the set `landmarks` of the human hand has the same ones."""


@dataclass(frozen=True, slots=True, eq=False)
class HumanSample:
    """A human hand at one instant; its arrays are read-only copies.

    Every tracker, file and layout is turned into samples of this form, and nothing behind it needs
    to know where they came from.

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
    landmarks: np.ndarray
    wrist: np.ndarray | None = None
    valid: bool = True
    confidence: float = 1.0

    def __post_init__(self) -> None:
        """Check the values, and replace arrays by read-only copies."""
        is_number = isinstance(self.time, int | float | np.number)
        is_finite = is_number and math.isfinite(self.time)
        expect(
            is_finite,
            "time",
            "a finite instant",
            value=self.time,
        )
        check_side(self.side)
        landmarks = as_floats(
            self.landmarks,
            "landmarks",
            shape=(LANDMARK_COUNT, 3),
            is_finite=bool(self.valid),
        )
        object.__setattr__(self, "landmarks", frozen(landmarks.copy()))
        if self.wrist is not None:
            wrist = check_pose(self.wrist, "wrist").copy()
            object.__setattr__(self, "wrist", frozen(wrist))
        share = self.confidence
        expect(
            0.0 <= share <= 1.0,
            "confidence",
            "a number from 0 to 1",
            value=share,
        )
