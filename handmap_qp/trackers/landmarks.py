"""From 21 hand landmarks to joint angles and a wrist pose of the human hand.

The hand is first measured: bone lengths and the shape of the palm are medians over the recording.
The model scaled to them is then fitted to every sample by inverse kinematics (the same QP that
moves robots), with joint limits, starting from the sample before.
"""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import PointSpec, Side
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.trackers.recording import LANDMARK_COUNT, HumanMotion, Recording
from handmap_qp.transform import rigid_fit

PALM = np.array([0, 5, 9, 13, 17])
"""Landmarks that move as one rigid body: the wrist and the MCP joints of the four fingers."""
FIRST_JOINTS = np.array([1, 5, 9, 13, 17])
"""First joint of every finger: thumb CMC and the four MCPs."""
TIPS = np.array([4, 8, 12, 16, 20])
"""The fingertips."""
HAND_LENGTHS = (0.08, 0.35)
"""Lengths that a hand may have [m]: from a baby's to somewhat more than the longest on record
(0.32). What is outside was measured in other units."""
_PALM_RATIOS = (0.5, 2.0)
"""Size of a sample's palm as a part of the hand's own, which is rigid.

Over all recordings 0.87 to 1.12.
"""

# Fingertips are what the mapping uses most, so they are fitted a little closer than the joints on
# the way to them.
_TIP_WEIGHT = 4.0
_FIT = IkOptions(
    rest_weight=0.02,
    damping=0.05,
    max_iterations=40,
    step_tolerance=1e-4,
    wrist_position_weight=0.0,
    wrist_orientation_weight=0.0,
)


class LandmarkFitter:
    """Fits a human hand to landmarks, sample by sample.

    Args:
        side: Which hand.
        lengths: The person's segment lengths; the model's own if omitted.

    Attributes:
        human: The human hand, its reference points the 21 landmarks.
    """

    def __init__(self, side: Side = "right", lengths: HumanLengths | None = None) -> None:
        self.human = load_hand(human_name(side), points=_landmark_points(side), lengths=lengths)
        self._ik = PointIk(self.human, _FIT)
        self._palm = self.human.points(
            np.clip(0.0, self.human.lower_limits, self.human.upper_limits)
        )[PALM]
        self._palm_size = float(_palm_sizes(self._palm))
        self._is_warm = False

    def fits_size(self, landmarks: np.ndarray) -> np.ndarray:
        """Whether landmarks are of a hand as large as this one.

        Neither in other units, nor all in one place.

        Args:
            landmarks: Of one sample or many [m], shape (..., 21, 3).

        Returns:
            An answer for every sample, shape (...).
        """
        sizes = _palm_sizes(landmarks[..., PALM, :])
        return (sizes >= _PALM_RATIOS[0] * self._palm_size) & (
            sizes <= _PALM_RATIOS[1] * self._palm_size
        )

    def fit(self, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit one sample, starting from the one before.

        Args:
            landmarks: Measured landmarks [m], shape (21, 3), finite.

        Returns:
            Joint angles [rad], shape (20,); wrist pose, shape (4, 4); distance of every landmark
            [m], shape (21,).

        Raises:
            InvalidInputError: On a wrong shape, numbers that are not finite, or a palm of quite
                another size than the hand's.
        """
        if landmarks.shape != (LANDMARK_COUNT, 3) or not np.isfinite(landmarks).all():
            raise InvalidInputError(
                f"landmarks: expected finite numbers of shape ({LANDMARK_COUNT}, 3), got {landmarks.shape}"
            )
        if not self.fits_size(landmarks):
            ratio = float(_palm_sizes(landmarks[PALM])) / self._palm_size
            raise InvalidInputError(
                f"landmarks: expected metres and a palm as large as the hand's, got one {ratio:.3g} times as large"
            )
        if not self._is_warm:
            wrist = rigid_fit(self._palm, landmarks[PALM])
            self._ik.place(self.human.configuration_vector(self.human.rest, wrist))
            self._is_warm = True
        result = self._ik.solve(landmarks, None, 1.0)
        hand = self._ik.configuration
        return (
            hand.q[self.human.q_indices],
            hand.wrist.homogeneous,
            np.linalg.norm(result.errors, axis=1),
        )


def human_name(side: Side) -> str:
    """Name of the human hand of a side."""
    return "human" if side == "right" else "human_left"


def check_length(landmarks: np.ndarray) -> np.ndarray:
    """Refuse landmarks of something that is no hand, or of a hand in other units than metres.

    Args:
        landmarks: Of one sample or more [m], shape (T, 21, 3).

    Returns:
        Bone lengths, the median over the samples [m], shape (5, 3).

    Raises:
        InvalidInputError: If no hand is as long as that.
    """
    bones = np.linalg.norm(np.diff(landmarks[:, 1:].reshape(-1, 5, 4, 3), axis=2), axis=3)
    segments = np.median(bones, axis=0)
    low, high = HAND_LENGTHS
    length = float(
        np.median(np.linalg.norm(landmarks[:, 9] - landmarks[:, 0], axis=1)) + segments[2].sum()
    )
    if not low <= length <= high:
        message = f"landmarks: expected metres and a hand of {low} to {high} m from wrist to middle fingertip, got {length:.3g}"
        raise InvalidInputError(message, value=length)
    return segments


def measure_hand(recording: Recording) -> HumanLengths:
    """Measure a person's hand.

    Medians of bone lengths and of the palm's shape over the valid samples.

    Args:
        recording: The recording.

    Returns:
        Lengths in the coordinates of a right hand, whichever hand was recorded.

    Raises:
        InvalidInputError: If no hand is as long as that.
    """
    landmarks = recording.landmarks[recording.valid]
    segments = check_length(landmarks)
    if recording.side == "left":
        landmarks = landmarks * (-1.0, 1.0, 1.0)
    right = load_hand("human", points="landmarks")
    palm = right.points(np.clip(0.0, right.lower_limits, right.upper_limits))[PALM]
    in_palm = landmarks
    # Generalised Procrustes: lay every sample on the mean shape, take the mean shape anew; three
    # rounds settle it.
    for _ in range(3):
        in_palm = _lay_on(landmarks, palm)
        palm = np.median(in_palm[:, PALM], axis=0)
        palm = palm - palm[0]
    return HumanLengths(
        bases=np.median(_lay_on(landmarks, palm)[:, FIRST_JOINTS], axis=0), segments=segments
    )


def fit_recording(
    recording: Recording, progress: Callable[[int], None] | None = None
) -> HumanMotion:
    """Turn a recording into joint angles and wrist poses of a hand scaled to the person.

    Args:
        recording: The recording.
        progress: Called with the number of samples done after each one.

    Returns:
        The motion; samples that are not valid, or of quite another size than the hand, hold the
        posture before them.

    Raises:
        InvalidInputError: If no hand is as long as the one recorded, or none of the samples as
            large as all together.
    """
    fitter = LandmarkFitter(recording.side, measure_hand(recording))
    valid = recording.valid.copy()
    valid[valid] = fitter.fits_size(recording.landmarks[valid])
    if not valid.any():
        raise InvalidInputError(
            "landmarks: expected a hand that keeps its size, got none as large as the median of all samples"
        )
    count = len(recording)
    q, wrist = np.empty((count, len(fitter.human.joint_names))), np.empty((count, 4, 4))
    error = np.full((count, LANDMARK_COUNT), np.nan)
    first = int(np.argmax(valid))
    for i in range(first, count):
        if valid[i]:
            q[i], wrist[i], error[i] = fitter.fit(recording.landmarks[i])
        else:
            q[i], wrist[i] = q[i - 1], wrist[i - 1]
        if progress is not None:
            progress(i + 1)
    q[:first], wrist[:first] = q[first], wrist[first]
    return HumanMotion(fitter.human, recording.time, recording.steps, q, wrist, valid, error)


def _landmark_points(side: Side) -> tuple[PointSpec, ...]:
    """The 21 landmarks as reference points, the tips with more weight."""
    points = load_hand(human_name(side), points="landmarks").reference_points
    tips = {points[i].name for i in TIPS}
    return tuple(
        msgspec.structs.replace(point, weight=_TIP_WEIGHT) if point.name in tips else point
        for point in points
    )


def _palm_sizes(palms: np.ndarray) -> np.ndarray:
    """Root mean square distances of palms' points (..., 5, 3) from their middles [m], shape (...)."""
    offsets = palms - palms.mean(axis=-2, keepdims=True)
    return np.sqrt(np.square(offsets).sum(axis=(-2, -1)) / len(PALM))


def _lay_on(landmarks: np.ndarray, palm: np.ndarray) -> np.ndarray:
    """All samples, shape (T, 21, 3), each moved rigidly so that its palm lies on `palm` (5, 3)."""
    poses = np.array([rigid_fit(sample[PALM], palm) for sample in landmarks])
    return landmarks @ poses[:, :3, :3].transpose(0, 2, 1) + poses[:, None, :3, 3]
