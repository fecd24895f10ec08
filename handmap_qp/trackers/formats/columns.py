"""A recording as flat columns, for formats that have rows and names."""

from __future__ import annotations

import numpy as np

from handmap_qp.hands.human import FINGERS
from handmap_qp.hands.spec import Side
from handmap_qp.human.recording import Recording
from handmap_qp.human.sample import LANDMARK_COUNT

_JOINTS = {
    finger: ("cmc", "mcp", "ip", "tip") if finger == "thumb" else ("mcp", "pip", "dip", "tip")
    for finger in FINGERS
}
LANDMARK_NAMES: tuple[str, ...] = (
    "wrist",
    *(f"{finger}_{joint}" for finger in FINGERS for joint in _JOINTS[finger]),
)
"""Names of the 21 landmarks, those of the points of the human hand."""
LANDMARK_COLUMNS: tuple[str, ...] = tuple(
    f"{name}_{axis}" for name in LANDMARK_NAMES for axis in "xyz"
)
"""Names of the 63 coordinates."""
POSE_COLUMNS: tuple[str, ...] = tuple(f"wrist_pose_{i}{j}" for i in range(3) for j in range(4))
"""Names of the upper three rows of the wrist's pose, row by row."""


def finite_samples(points: np.ndarray) -> np.ndarray:
    """Tell of samples (T, m, n) whether all their numbers are finite, shape (T,)."""
    return np.asarray(np.isfinite(points).all(axis=(1, 2)))


def landmark_rows(recording: Recording) -> np.ndarray:
    """Return the landmarks as rows [m], shape (T, 63)."""
    return recording.landmarks.reshape(len(recording), 3 * LANDMARK_COUNT)


def pose_rows(poses: np.ndarray) -> np.ndarray:
    """Return the upper three rows of poses (T, 4, 4) as rows, shape (T, 12)."""
    return poses[:, :3].reshape(len(poses), 12)


def poses_of_rows(rows: np.ndarray) -> np.ndarray:
    """Return poses, shape (T, 4, 4), of rows of twelve numbers, shape (T, 12)."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows.reshape(-1, 3, 4)
    return poses


def recording_of_rows(
    name: str,
    side: Side,
    time: np.ndarray,
    landmarks: np.ndarray,
    *,
    valid: np.ndarray | None = None,
    confidence: np.ndarray | None = None,
    wrist: np.ndarray | None = None,
    source: str = "",
) -> Recording:
    """Build a recording from columns; samples that are not finite are not valid.

    Args:
        name: Its name.
        side: Which hand.
        time: Instants [s], shape (T,).
        landmarks: Coordinates [m], shape (T, 63).
        valid: Whether the hand was seen, shape (T,); where the landmarks are finite if omitted.
        confidence: Confidence, shape (T,); a column without numbers counts as none.
        wrist: Poses as rows of twelve numbers, shape (T, 12); likewise.
        source: Where it came from, in words.

    Raises:
        InvalidInputError: As of `Recording`.
    """
    points = landmarks.reshape(len(landmarks), LANDMARK_COUNT, 3)
    seen = finite_samples(points)
    if valid is not None:
        seen &= valid
    if confidence is not None and np.isnan(confidence).all():
        confidence = None
    if wrist is not None and np.isnan(wrist).all():
        wrist = None
    return Recording(
        name=name,
        time=time,
        landmarks=points,
        valid=seen,
        side=side,
        source=source,
        wrist=None if wrist is None else poses_of_rows(wrist),
        confidence=confidence,
    )
