"""Measured landmarks as a human sample: the palm by a rigid fit, the points as they come."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import landmarks_at_rest
from handmap_qp.mapping.method import HumanPose
from handmap_qp.se3 import (
    FARTHEST,
    affine,
    affines,
    as_floats,
    kabsch_rotation,
    nearest_rotations,
)

_PALM = ("wrist", "index_mcp", "middle_mcp", "ring_mcp", "little_mcp")
"""Landmarks that move as one rigid body."""
_MEAN = np.full(len(_PALM), 1.0 / len(_PALM))
_CENTRING = np.eye(len(_PALM)) - _MEAN


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
        self._count = len(names)
        self._used = np.array([known[point.name] for point in human.reference_points])
        self._palm = np.array([known[name] for name in _PALM])
        model = landmarks_at_rest(human)[self._palm]
        self._model_centre = model.mean(axis=0)
        self._model = model - self._model_centre

    def read(self, landmarks: npt.ArrayLike, wrist: np.ndarray | None) -> HumanPose:
        """Return a sample.

        Args:
            landmarks: In MediaPipe's order, in the human's world [m], shape (21, 3).
            wrist: The tracker's own wrist pose, shape (4, 4); fitted to the landmarks of the palm
                (Kabsch 1976) if None.

        Raises:
            InvalidInputError: On a wrong shape, or coordinates that are not finite.
        """
        points = as_floats(landmarks, "landmarks")
        if points.shape != (self._count, 3):
            raise InvalidInputError(
                argument="landmarks", expected=f"shape ({self._count}, 3)", got=f"{points.shape}"
            )
        # `not ... <= FARTHEST` also rejects NaN.
        if not np.abs(points).max() <= FARTHEST:
            raise InvalidInputError(
                argument="landmarks", expected=f"finite coordinates within {FARTHEST:g} m"
            )
        if wrist is None:
            wrist = self._fit(points.take(self._palm, 0))
        return HumanPose(points.take(self._used, 0), wrist)

    def read_all(self, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return many samples without wrist poses of their own, as `read` up to rounding.

        Args:
            landmarks: In every sample, of a `Recording` [m], shape (T, 21, 3).

        Returns:
            Points [m], shape (T, n_h, 3), and wrist poses, shape (T, 4, 4).

        Raises:
            InvalidInputError: If a coordinate is too large.
        """
        # `not ... <= FARTHEST` also rejects NaN.
        if not np.abs(landmarks).max(initial=0.0) <= FARTHEST:
            raise InvalidInputError(
                argument="landmarks", expected=f"finite coordinates within {FARTHEST:g} m"
            )
        palms = landmarks.take(self._palm, 1)
        centres = _MEAN @ palms
        covariances = (_CENTRING @ palms).transpose(0, 2, 1) @ self._model
        rotations = nearest_rotations(covariances)
        wrists = affines(rotations, centres - rotations @ self._model_centre)
        return landmarks.take(self._used, 1), wrists

    def _fit(self, palm: np.ndarray) -> np.ndarray:
        """Lay the model's palm on measured points (5, 3) as `rigid_fit` does, centred once."""
        centre = _MEAN.dot(palm)
        rotation = kabsch_rotation(_CENTRING.dot(palm).T.dot(self._model))
        return affine(rotation, centre - rotation.dot(self._model_centre))
