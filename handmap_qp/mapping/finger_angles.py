"""A human hand's joint angles from its landmarks, by geometry and without iterations.

A finger has four joints and three bones. The first joint turns the whole finger (abduction), the
other three bend it, one a bone. The abduction is the direction in which the bones extend most
across its axis. Each flexion is then the angle of its bone in the frame that the joints before it
leave. Landmarks of this package's human hand give its joint angles back; measured ones, whose bones
leave the plane of their finger, give the nearest in that sense.
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.fingers import Finger, PalmKinematics, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, HUMAN_JOINTS
from handmap_qp.mapping.landmarks import chain_landmarks, require_points

# Bones that point along the axis of abduction say nothing of it: length that pulls it to zero [m].
_STRAIGHTENING = 0.0005
# Cosine from which on two axes are parallel.
_PARALLEL = 1.0 - 1e-9


class FingerAngles:
    """Joint angles of some fingers of the human hand.

    Args:
        human: The human hand; its reference points must hold the fingers' four landmarks.
        fingers: Names of the fingers, f of them.

    Attributes:
        columns: Indices of the joints in `human.joint_names`, shape (f, 4).

    Raises:
        InvalidOptionsError: If the hand has other joints than this package's human hand, or its
            reference points lack a landmark.
    """

    def __init__(self, human: Hand, fingers: tuple[str, ...]) -> None:
        if human.joint_names != HUMAN_JOINTS:
            raise InvalidOptionsError(
                option="human",
                problem=f"{human.name} has other joints than the human hand",
                advice="load_hand('human')",
            )
        needed = [name for finger in fingers for name in chain_landmarks(finger)]
        points = require_points(human, needed, "a mapping of joint angles")
        self._points = points.reshape(-1, 4)
        self.columns = np.array(
            [4 * FINGERS.index(finger) + np.arange(4) for finger in fingers]
        )
        found = find_fingers(human)
        self._fingers = [
            _FingerFrames(human, found[finger], columns)
            for finger, columns in zip(fingers, self.columns, strict=True)
        ]

    def measure(self, in_palm: np.ndarray) -> np.ndarray:
        """Return the joint angles [rad], shape (f, 4).

        Args:
            in_palm: The human's reference points in palm axes [m], shape (n_h, 3).
        """
        bones = np.diff(in_palm[self._points], axis=1)
        return np.array(
            [
                frames.angles(each)
                for frames, each in zip(self._fingers, bones, strict=True)
            ]
        )


class _FingerFrames:
    """One finger's joint frames at zero, in palm axes: x along the bones, z along the axis."""

    def __init__(self, human: Hand, finger: Finger, columns: np.ndarray) -> None:
        view = PalmKinematics(human)
        zero = np.zeros(len(human.joint_names))
        axes, origins = view.axes(zero, finger.joints)
        bone = view.points(zero, [finger.tip])[0] - origins[-1]
        bone = bone / np.linalg.norm(bone)
        self._frames = [
            np.column_stack([bone, np.cross(axis, bone), axis]) for axis in axes
        ]
        self._lower = human.lower_limits[columns]
        self._upper = human.upper_limits[columns]
        # Bones that stay in one plane however the finger bends.
        parallel = np.abs(axes[1:] @ axes[1]) > _PARALLEL
        self._in_plane = int(np.argmin(parallel)) if not parallel.all() else 3

    def angles(self, bones: np.ndarray) -> np.ndarray:
        """Return the four angles from three bones in palm axes, shape (3, 3)."""
        x, y, _ = bones[: self._in_plane].dot(self._frames[0]).T
        doubled = np.arctan2(2.0 * x.dot(y), x.dot(x) - y.dot(y) + _STRAIGHTENING**2)
        along = 0.5 * float(doubled)
        # The direction has two senses: that within the joint limits is meant.
        angles = self._bend(along, bones)
        if (excess := self._excess(angles)) > 0.0:
            other = self._bend(along - float(np.copysign(np.pi, along)), bones)
            if self._excess(other) < excess:
                return other
        return angles

    def _excess(self, angles: np.ndarray) -> float:
        """Return how far the first two angles are outside their limits [rad]."""
        outside = np.maximum(self._lower - angles, angles - self._upper)[:2]
        return float(np.maximum(outside, 0.0).sum())

    def _bend(self, abduction: float, bones: np.ndarray) -> np.ndarray:
        """Return all angles, given the first."""
        angles = [abduction]
        turned = pin.exp3(abduction * self._frames[0][:, 2])
        for frame, bone in zip(self._frames[1:], bones, strict=True):
            x, y, _ = frame.T.dot(turned.T.dot(bone))
            angles.append(float(np.arctan2(y, x)))
            turned = turned.dot(pin.exp3(angles[-1] * frame[:, 2]))
        return np.array(angles)
