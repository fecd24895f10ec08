"""What fidelity is measured on: palm, knuckles, middle joints and fingertips over time.

A human's come from raw landmarks, a robot's from its model, its joint angles and its wrist poses,
whatever mapping found those. So every mapping is measured in the same way.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import THUMB, Finger, PalmKinematics, find_fingers, zero_posture
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS, HumanLengths
from handmap_qp.hands.spec import Side
from handmap_qp.human.landmarks import FIRST_JOINTS, PALM, TIPS
from handmap_qp.se3 import affine, nearest_rotation

MIDDLES = np.array([3, 6, 10, 14, 18])
"""Landmarks of the middle joints: the thumb's IP and the other fingers' PIP."""


@dataclass(frozen=True, slots=True, eq=False)
class FingerTrace:
    """One finger over time.

    Attributes:
        name: Anatomical name, as in `FINGERS`.
        knuckle: Its base: the thumb's CMC, another finger's MCP; in the world [m], shape (T, 3).
        middle: The thumb's IP, another finger's PIP [m], shape (T, 3).
        tip: Fingertip [m], shape (T, 3).
        reach: Largest distance from knuckle to tip that the finger can have [m].
    """

    name: str
    knuckle: np.ndarray
    middle: np.ndarray
    tip: np.ndarray
    reach: float

    @property
    def extension(self) -> np.ndarray:
        """Distance from knuckle to tip as a share of the reach, shape (T,)."""
        return np.linalg.norm(self.tip - self.knuckle, axis=1) / self.reach


@dataclass(frozen=True, slots=True, eq=False)
class HandTrace:
    """A hand over time.

    Attributes:
        fingers: Its fingers, by name.
        palm: Palm poses in the world: origin at the wrist, +y distal, +z dorsal, shape (T, 4, 4).
        size: From the palm's origin over the middle of the knuckles to the stretched fingertips,
            mean over the fingers without the thumb [m].
    """

    fingers: dict[str, FingerTrace]
    palm: np.ndarray
    size: float

    def in_palm(self, points: np.ndarray) -> np.ndarray:
        """Points of every sample in the palm frame.

        Args:
            points: In the world [m], shape (T, 3) or (T, k, 3).

        Returns:
            The same shape [m].
        """
        rotation, origin = self.palm[:, :3, :3], self.palm[:, :3, 3]
        if points.ndim == 3:
            return (points - origin[:, None]) @ rotation
        return np.einsum("tji,tj->ti", rotation, points - origin)

    def at(self, samples: np.ndarray) -> HandTrace:
        """Some of the samples, by index or mask."""
        fingers = {
            name: FingerTrace(name, f.knuckle[samples], f.middle[samples], f.tip[samples], f.reach)
            for name, f in self.fingers.items()
        }
        return HandTrace(fingers, self.palm[samples], self.size)


def trace_human(
    landmarks: np.ndarray,
    lengths: HumanLengths,
    side: Side = "right",
    wrist_poses: np.ndarray | None = None,
) -> HandTrace:
    """Describe a human's motion by its raw landmarks.

    Args:
        landmarks: Measured landmarks [m], shape (T, 21, 3), finite.
        lengths: The person's lengths, as a right hand (`measure_hand`).
        side: Which hand.
        wrist_poses: Wrist poses of the tracker, shape (T, 4, 4). The palm then moves with them; its
            mean pose on the wrist comes from the landmarks. If omitted, the palm is the rigid fit
            (Kabsch 1976) of landmarks 0, 5, 9, 13 and 17 in every sample.

    Returns:
        The trace.

    Raises:
        InvalidInputError: On a wrong shape or numbers that are not finite.
    """
    points = np.asarray(landmarks, dtype=float)
    if points.ndim != 3 or points.shape[1:] != (21, 3) or not np.isfinite(points).all():
        raise InvalidInputError(
            argument="landmarks", expected="finite numbers of shape (T, 21, 3)", value=landmarks
        )
    template = np.vstack([np.zeros(3), lengths.bases[1:]])
    if side == "left":
        template = template * (-1.0, 1.0, 1.0)
    palm = np.array([_rigid_fit(template, sample[PALM]) for sample in points])
    if wrist_poses is not None:
        palm = np.asarray(wrist_poses, dtype=float) @ _mean_pose(np.linalg.inv(wrist_poses) @ palm)
    reach = lengths.segments.sum(axis=1)
    fingers = {
        name: FingerTrace(
            name,
            points[:, FIRST_JOINTS[i]],
            points[:, MIDDLES[i]],
            points[:, TIPS[i]],
            float(reach[i]),
        )
        for i, name in enumerate(FINGERS)
    }
    size = float(np.linalg.norm(lengths.bases[1:].mean(axis=0)) + reach[1:].mean())
    return HandTrace(fingers, palm, size)


def trace_robot(
    hand: Hand,
    q: np.ndarray,
    wrist: np.ndarray | None = None,
    chains: dict[str, Finger] | None = None,
) -> HandTrace:
    """Describe a robot's motion by its joint angles and wrist poses.

    Args:
        hand: The robot hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        wrist: Wrist poses in the world, shape (T, 4, 4); omitted for a fixed hand.
        chains: Its fingers, if they have been found before.

    Returns:
        The trace.
    """
    chains = chains or find_fingers(hand)
    count = len(q)
    data, palm = hand.model.createData(), np.empty((count, 4, 4))
    vector = np.zeros(hand.model.nq)
    points = np.empty((count, len(chains), 3, 3))
    places = [(chain.knuckle, chain.middle, chain.tip) for chain in chains.values()]
    for t in range(count):
        hand.write_configuration(vector, q[t], np.eye(4) if wrist is None else wrist[t])
        pin.framesForwardKinematics(hand.model, data, vector)
        palm[t] = data.oMf[hand.palm_frame_id].homogeneous
        for i, three in enumerate(places):
            for k, (joint, offset) in enumerate(three):
                points[t, i, k] = data.oMi[joint].act(offset)
    fingers = {
        name: FingerTrace(name, points[:, i, 0], points[:, i, 1], points[:, i, 2], chain.reach)
        for i, (name, chain) in enumerate(chains.items())
    }
    return HandTrace(fingers, palm, _robot_size(hand, chains))


def _robot_size(hand: Hand, chains: dict[str, Finger]) -> float:
    """Distance from the palm's origin over the knuckles to the stretched tips [m]."""
    others = [chain for name, chain in chains.items() if name != THUMB] or list(chains.values())
    knuckles = PalmKinematics(hand).points(zero_posture(hand), [c.knuckle for c in others])
    reach = np.mean([chain.reach for chain in others])
    return float(np.linalg.norm(knuckles.mean(axis=0)) + reach)


def _rigid_fit(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Pose that best lays points (n, 3) onto others (n, 3), shape (4, 4)."""
    centre, centre_onto = points.mean(axis=0), onto.mean(axis=0)
    rotation = nearest_rotation((onto - centre_onto).T @ (points - centre))
    return affine(rotation, centre_onto - rotation @ centre)


def _mean_pose(poses: np.ndarray) -> np.ndarray:
    """Rotation nearest to the mean one, and the median origin, shape (4, 4)."""
    rotation = nearest_rotation(poses[:, :3, :3].mean(axis=0))
    return affine(rotation, np.median(poses[:, :3, 3], axis=0))
