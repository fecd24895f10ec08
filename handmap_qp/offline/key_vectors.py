"""The eight metrics of mimic_retargeter_lab, computed on this package's traces.

Definitions after https://github.com/mimicrobotics/mimic_retargeter_lab (`dexworld/metrics`): the
human's landmarks are laid on the robot's by a similarity (Umeyama 1991) in every sample; key
vectors and displacements are then compared.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from handmap_qp.hands.fingers import THUMB, Finger
from handmap_qp.hands.hand import Hand
from handmap_qp.offline.finger_traces import HandTrace, trace_robot

WORKSPACE_RADIUS = 0.005
"""A reachable point was used if the fingertip came this near [m]."""
_LEAST = 1e-8


@dataclass(frozen=True, slots=True)
class KeyVectors:
    """Means over samples, and over key vectors or fingers. NaN where not measured.

    Attributes:
        cosine: Cosine between the key vectors of both hands: palm origin to each tip, thumb tip to
            each other tip.
        angle_deg: Angle between them [deg].
        scale: Length of the robot's key vector over the aligned human's.
        motion_preservation: Cosine between the displacements of both hands' tips from one sample to
            the next.
        flatness_mm2: Squared second difference of the robot's tips in the palm frame [mm^2].
        colliding: Share of samples with any self-collision.
        workspace: Share of the reachable points that the tips came within 5 mm of.
        step_time_ms: Time of one call of the mapping [ms].
    """

    cosine: float
    angle_deg: float
    scale: float
    motion_preservation: float
    flatness_mm2: float
    colliding: float = float("nan")
    workspace: float = float("nan")
    step_time_ms: float = float("nan")


def compare_key_vectors(
    human: HandTrace,
    robot: HandTrace,
    nearest: np.ndarray | None = None,
    workspace: dict[str, np.ndarray] | None = None,
    step_time: np.ndarray | None = None,
) -> KeyVectors:
    """Compute the eight metrics.

    Args:
        human: The human's motion.
        robot: The robot's, of the same samples.
        nearest: Smallest distance between links that can collide [m], shape (T,).
        workspace: Points that each fingertip can reach, in the palm frame [m], shape (N, 3) each.
        step_time: Time of each call of the mapping [s], shape (T,).

    Returns:
        The metrics.
    """
    shared = [name for name in human.fingers if name in robot.fingers]
    one, other = _landmarks(human, shared), _landmarks(robot, shared)
    aligned = _laid_on(one, other)
    tips = slice(1, 1 + len(shared))
    vectors = [points[:, tips] - points[:, :1] for points in (aligned, other)]
    if THUMB in shared and len(shared) > 1:
        thumb = 1 + shared.index(THUMB)
        rest = [1 + i for i, name in enumerate(shared) if name != THUMB]
        vectors = [
            np.concatenate([v, points[:, rest] - points[:, [thumb]]], axis=1)
            for v, points in zip(vectors, (aligned, other), strict=True)
        ]
    a, b = vectors
    cosine = _cosines(a, b)
    scale = np.linalg.norm(b, axis=2) / (np.linalg.norm(a, axis=2) + _LEAST)
    moves = _cosines(np.diff(aligned[:, tips], axis=0), np.diff(other[:, tips], axis=0))
    bends = other[2:, tips] + other[:-2, tips] - 2.0 * other[1:-1, tips]
    return KeyVectors(
        cosine=float(cosine.mean()),
        angle_deg=float(np.degrees(np.arccos(cosine)).mean()),
        scale=float(scale.mean()),
        motion_preservation=_mean(moves),
        flatness_mm2=1e6 * _mean((bends**2).sum(axis=2)),
        colliding=float("nan") if nearest is None else float((nearest < 0.0).mean()),
        workspace=float("nan") if workspace is None else workspace_share(robot, workspace),
        step_time_ms=float("nan") if step_time is None else 1e3 * _mean(np.asarray(step_time)),
    )


def workspace_share(robot: HandTrace, workspace: dict[str, np.ndarray]) -> float:
    """Share of the reachable points that the fingertips came near, mean over the fingers."""
    shares = []
    for name, points in workspace.items():
        if name in robot.fingers:
            path = KDTree(robot.in_palm(robot.fingers[name].tip))
            distances, _ = path.query(points)
            shares.append(float((distances <= WORKSPACE_RADIUS).mean()))
    return float(np.mean(shares)) if shares else float("nan")


def sample_workspace(
    hand: Hand, chains: dict[str, Finger] | None = None, *, count: int = 20_000, seed: int = 42
) -> dict[str, np.ndarray]:
    """Draw points that each fingertip can reach, joints uniform within their limits.

    Args:
        hand: The robot hand.
        chains: Its fingers, if they have been found before.
        count: Number of postures.
        seed: Of the random numbers.

    Returns:
        Points in the palm frame by finger [m], shape (count, 3) each.
    """
    random = np.random.default_rng(seed)
    q = random.uniform(hand.lower_limits, hand.upper_limits, (count, len(hand.joint_names)))
    trace = trace_robot(hand, q, None, chains)
    return {name: trace.in_palm(finger.tip) for name, finger in trace.fingers.items()}


def _landmarks(hand: HandTrace, fingers: list[str]) -> np.ndarray:
    """Palm origin, tips and knuckles in the palm frame [m], shape (T, 1 + 2 k, 3)."""
    tips = [hand.fingers[name].tip for name in fingers]
    knuckles = [hand.fingers[name].knuckle for name in fingers]
    return hand.in_palm(np.stack([hand.palm[:, :3, 3], *tips, *knuckles], axis=1))


def _laid_on(points: np.ndarray, onto: np.ndarray) -> np.ndarray:
    """Points of every sample moved by the similarity that lays them best on others (Umeyama)."""
    centre, centre_onto = points.mean(axis=1, keepdims=True), onto.mean(axis=1, keepdims=True)
    a, b = points - centre, onto - centre_onto
    left, values, right = np.linalg.svd(np.einsum("tki,tkj->tij", b, a))
    signs = np.ones_like(values)
    signs[:, 2] = np.sign(np.linalg.det(left @ right))
    rotation = (left * signs[:, None]) @ right
    scale = (values * signs).sum(axis=1) / np.maximum((a**2).sum(axis=(1, 2)), _LEAST**2)
    return scale[:, None, None] * (a @ rotation.transpose(0, 2, 1)) + centre_onto


def _cosines(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Cosines between vectors along the last axis; 0 where either is zero."""
    norms = np.linalg.norm(a, axis=-1) * np.linalg.norm(b, axis=-1)
    dots = (a * b).sum(axis=-1)
    return np.clip(np.divide(dots, norms, out=np.zeros_like(dots), where=norms > 0.0), -1.0, 1.0)


def _mean(values: np.ndarray) -> float:
    return float(values.mean()) if values.size else float("nan")
