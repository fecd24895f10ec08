"""Measured landmarks as a human sample: the palm by a rigid fit, the points as they come."""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import landmarks_at_rest
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import FARTHEST, rigid_fit

_PALM = ("wrist", "index_mcp", "middle_mcp", "ring_mcp", "little_mcp")
"""Landmarks that move as one rigid body."""


class LandmarkReader:
    """Turns the 21 landmarks of a tracker into samples of a human hand.

    Args:
        human: The human hand, scaled to the person.

    Raises:
        InvalidOptionsError: If a reference point of the hand is not a landmark.
    """

    def __init__(self, human: Hand) -> None:
        names = human.spec.sets.get("landmarks", ())
        known = {name: i for i, name in enumerate(names)}
        missing = [point.name for point in human.reference_points if point.name not in known]
        if missing or not set(_PALM) <= set(known):
            raise InvalidOptionsError(
                option="human_points",
                problem=f"{', '.join(missing) or human.name} cannot be read from landmarks",
                advice="choose reference points among the landmarks, or call map_points",
            )
        self._used = np.array([known[point.name] for point in human.reference_points])
        self._palm = np.array([known[name] for name in _PALM])
        self._model = landmarks_at_rest(human)[self._palm]

    def read(self, landmarks: np.ndarray, wrist: np.ndarray | None = None) -> HumanPose:
        """Return a sample, or many along leading axes.

        Args:
            landmarks: In MediaPipe's order, in the human's world [m], shape (..., 21, 3).
            wrist: The tracker's own wrist pose, shape (..., 4, 4); fitted to the landmarks of the
                palm (Kabsch 1976) if None.

        Raises:
            InvalidInputError: If a coordinate is not finite.
        """
        check_near(landmarks, "landmarks")
        if wrist is None:
            wrist = rigid_fit(self._model, landmarks[..., self._palm, :])
        return HumanPose(landmarks[..., self._used, :], wrist)


def check_near(points: np.ndarray, name: str) -> None:
    """Reject points with a coordinate that is not finite, or farther away than any hand."""
    # `not ... <= FARTHEST` also rejects NaN.
    if not np.abs(points).max(initial=0.0) <= FARTHEST:
        expected = f"finite coordinates within {FARTHEST:g} m"
        raise InvalidInputError(argument=name, expected=expected, value=points.tolist())
