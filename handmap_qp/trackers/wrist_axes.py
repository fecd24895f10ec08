"""The tracker's own wrist poses, checked against the palm that the landmarks show."""

import numpy as np

from handmap_qp.human import Finding
from handmap_qp.se3 import Array, cross, lengths, nearest_rotation, unit
from .hand_geometry import median

_X, _Y, _Z = np.eye(3)


def axes_convention(distal: Array, dorsal: Array) -> Array:
    """Return a wrist's axes in the frame of our wrist: +y distal, +z dorsal.

    Args:
        distal: The direction of the fingers in the wrist's own axes, shape (3,).
        dorsal: The direction out of the back of the hand in them, shape (3,).

    Returns:
        Rotation from the wrist's axes to ours, shape (3, 3).
    """
    return np.stack([np.cross(distal, dorsal), distal, dorsal])


CONVENTIONS = np.array(
    [
        axes_convention(_Y, _Z),  # ours
        axes_convention(_X, _Z),  # from Leap's direction and palm normal
        axes_convention(-_Z, _Y),  # OpenXR, WebXR
        axes_convention(_X, _Y),  # MANO and SMPL-X, left
        axes_convention(-_X, _Y),  # MANO and SMPL-X, right
        axes_convention(_X, -_Y),
    ]
)
"""The wrist's axes that known trackers have, shape (6, 3, 3)."""

# Angle between a wrist's axes and those of the palm's landmarks: up to 10 degrees in recordings
# of four trackers.
_FARTHEST = np.cos(np.radians(22.0))
# A wrist that follows the palm keeps its rotation to it: up to 5 degrees in recordings.
_STEADY = np.cos(np.radians(12.0))
# A palm that has turned by more proves a wrist whose rotation to it changed by less than this share
# of the turn: that of a wrist that stands still changes by all of it, an inverse one's by twice it.
_TURNED = np.radians(12.0)
_KEPT = 0.4
_FARTHEST_APART = 0.10  # m, of the wrist's landmark from the pose


def palm_axes(landmarks: Array, sign: float) -> Array:
    """Return the palm's rotations: +y to the middle knuckle, 8 to 11 degrees from ours, +z dorsal.

    Args:
        landmarks: Some samples, shape (T, 21, 3).
        sign: 1 for a right hand, -1 for a left one.

    Returns:
        Rotations, shape (T, 3, 3).
    """
    offsets = landmarks - landmarks[:, :1]
    dorsal = unit(-sign * cross(offsets[:, 5], offsets[:, 17]))
    lateral = unit(cross(offsets[:, 9], dorsal))
    return np.stack([lateral, cross(dorsal, lateral), dorsal], axis=2)


class WristCheck:
    """Tells whether wrist poses belong to the landmarks, batch by batch.

    Args:
        sign: 1 for a right hand, -1 for a left one.

    Attributes:
        is_proven: Whether the wrist, in the axes of the human model, has followed a palm that
            turned by 12 degrees, and has not lost it since.
    """

    def __init__(self, sign: float) -> None:
        self._sign = sign
        # Mean palm, and mean rotation from wrist to palm, of the batch to compare with.
        self._start: tuple[Array, Array] | None = None
        self.is_proven = False

    def examine(self, landmarks: Array, wrists: Array) -> Finding | None:
        """Compare wrist poses with the palm that the landmarks show.

        The rotation from one to the other must be that of a known tracker, or at least be the same
        in all samples since the start.

        Args:
            landmarks: Some samples [m], shape (T, 21, 3).
            wrists: The tracker's wrist poses, shape (T, 3, 4).

        Returns:
            What is wrong; None if they belong together.
        """
        was_proven = self.is_proven
        self.is_proven = False
        apart = median(lengths(wrists[:, :, 3] - landmarks[:, 0]))
        if apart > _FARTHEST_APART:
            return Finding(
                "wrist",
                f"the wrist pose is {apart:.3g} m from the wrist's landmark",
                "give both in metres and in the same world",
            )
        palms = palm_axes(landmarks, self._sign)
        rotations = wrists[:, :, :3]
        mean, steadiness = _mean_relative(palms, rotations)
        palm = nearest_rotation(palms.sum(axis=0))
        start = self._start or (palm, mean)
        kept = _cosine(mean, start[1])
        is_steady = min(steadiness, kept) > _STEADY
        does_not_follow = "the wrist's orientation does not follow the palm"
        is_known = _cosine(CONVENTIONS, mean) > _FARTHEST
        if not (is_steady and is_known.any()):
            name = _usual_mistake(palms, rotations)
            if name:
                return Finding(
                    "wrist",
                    f"{does_not_follow}, but {name} would",
                    "check the order of the quaternion and the direction of the pose",
                )
        if not is_steady:
            return Finding(
                "wrist",
                f"{does_not_follow} that the landmarks show",
                "check its quaternion's order, and that its world is that of the landmarks",
            )
        self._start = start
        turn, change = np.arccos([_cosine(palm, start[0]), kept])
        has_turned = is_known[0] and turn > _TURNED and change < _KEPT * turn
        self.is_proven = was_proven or bool(has_turned)
        return None


def _mean_relative(palms: Array, rotations: Array) -> tuple[Array, Array]:
    """Return the mean rotation from wrist to palm, and the cosine between those of both halves."""
    relative = palms.mT @ rotations
    # Noise of the landmarks cancels in the means.
    half = len(palms) // 2
    # Both halves of a single sample are that sample.
    parts = relative, relative[: half or 1], relative[half:]
    mean, first, second = (nearest_rotation(part.sum(axis=0)) for part in parts)
    return mean, _cosine(first, second)


def _cosine(a: Array, b: Array) -> Array:
    """Return cosines of the angles between rotations, shape (...)."""
    traces = np.einsum("...ij,...ij", a, b)
    return np.clip((traces - 1.0) / 2.0, -1.0, 1.0)


_ROLLS = {
    "a quaternion w, x, y, z that was read as x, y, z, w": -1,
    "a quaternion x, y, z, w that was read as w, x, y, z": 1,
}


def _usual_mistake(palms: Array, rotations: Array) -> str:
    """Return the usual mistake of a reader that explains the rotations; empty if none does."""
    from scipy.spatial.transform import Rotation

    tried = []
    # A layout may have turned the wrist's axes to ours afterwards.
    for convention in CONVENTIONS:
        xyzw = Rotation.from_matrix(rotations @ convention).as_quat()
        for name, roll in _ROLLS.items():
            rolled = Rotation.from_quat(np.roll(xyzw, roll, axis=1))
            tried.append((name, rolled.as_matrix()))
    for name, others in (*tried, ("its inverse", rotations.mT)):
        mean, steadiness = _mean_relative(palms, others)
        is_known = _cosine(CONVENTIONS, mean) > _FARTHEST
        if steadiness > _STEADY and is_known.any():
            return name
    return ""
