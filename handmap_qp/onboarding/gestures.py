"""What a described hand does: make a fist, and pinch.

Both use the description and the kinematics only, and none of the reasoning of `detect`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandmapError
from handmap_qp.hands.fingers import (
    THUMB,
    Finger,
    PalmKinematics,
    columns_of,
    find_fingers,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.hands.spec import PointSpec

# The fingers' planes have a common normal if the mean of these unit vectors is this long.
_COMMON = 0.8
# Search for a pinch: iterations, damping [m/rad], and random starts.
_ITERATIONS, _DAMPING, _STARTS = 40, 0.01, 6
# Surfaces that come this near touch [m].
_TOUCHING = 0.002
# Radius of a pad without shapes [m].
_RADIUS = 0.006


@dataclass(frozen=True, slots=True)
class Fist:
    """Where the fingertips go as the hand closes, in palm axes.

    Attributes:
        across_deg: Angle between the fingers' common axis of flexion and the palm's x axis, 0 in a
            hand whose axes are right, 180 if the fingers close to the back [deg].
        distal_deg: Angle between the mean direction of the stretched fingers and distal [deg].
        fingers: Fingers that close.
    """

    across_deg: float
    distal_deg: float
    fingers: tuple[str, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Pinch:
    """How near the thumb's pad comes to a finger's.

    Attributes:
        finger: The finger.
        gap: Smallest distance between the surfaces of both pads [m]; 0 or less if they touch.
        q: Joint angles there, shape (n,).
    """

    finger: str
    gap: float
    q: np.ndarray

    @property
    def touches(self) -> bool:
        """Whether the pads touch."""
        return self.gap < _TOUCHING


def make_fist(hand: Hand) -> Fist | None:
    """Compare the way in which the fingers, but the thumb, close with the palm's axes.

    Args:
        hand: The hand.

    Returns:
        The directions; None if fewer than two fingers close, or they close about different axes.
    """
    view, axes, directions = PalmKinematics(hand), {}, []
    for name, finger in find_fingers(hand).items():
        flexion = finger.flexion
        if name == THUMB or flexion is None or not flexion.curls or flexion.sense == 0.0:
            continue
        straight = zero_posture(hand)
        straight[flexion.columns] = flexion.straight
        line = view.points(straight, [finger.tip])[0] - flexion.knuckle
        directions.append(line / np.linalg.norm(line))
        axes[name] = flexion.sense * flexion.axis
    if len(axes) < 2:
        return None
    axis, direction = np.mean([*axes.values()], axis=0), np.mean(directions, axis=0)
    if np.linalg.norm(axis) < _COMMON or np.linalg.norm(direction) < _COMMON:
        return None
    # Flexion turns distal (y) towards palmar (-z), about -x.
    return Fist(
        angle_between(axis, np.array([-1.0, 0.0, 0.0])),
        angle_between(direction, np.array([0.0, 1.0, 0.0])),
        tuple(axes),
    )


def measure_pinches(hand: Hand) -> tuple[Pinch, ...]:
    """Find how near the thumb's pad can come to every other finger's.

    Damped least squares from several postures, within the joint limits.

    Args:
        hand: The hand; an arm stays at rest.

    Returns:
        One entry per finger; none if the hand has no thumb or no second finger.
    """
    chains = find_fingers(hand)
    if THUMB not in chains or len(chains) < 2:
        return ()
    pads = fingertip_pads(hand, chains)
    padded = hand.with_points([_pad_point(hand, name, pad) for name, pad in pads.items()])
    names = list(pads)
    thumb = names.index(THUMB)
    pinches = []
    for i, name in enumerate(names):
        if name != THUMB:
            joints = [*chains[THUMB].joints, *chains[name].joints]
            columns = np.sort(columns_of(hand, joints))
            radii = pads[THUMB].radius + pads[name].radius
            distance, q = _nearest(padded, thumb, i, columns, radii)
            gap = distance - radii
            pinches.append(Pinch(name, gap, q))
    return tuple(pinches)


def fingertip_pads(hand: Hand, chains: dict[str, Finger]) -> dict[str, Pad]:
    """Return the pad of each fingertip; a ball of 6 mm around it if the shapes cannot be read."""
    try:
        return find_pads(hand, chains)
    except HandmapError:
        return {name: Pad(*chain.tip, _RADIUS) for name, chain in chains.items()}


def _pad_point(hand: Hand, finger: str, pad: Pad) -> PointSpec:
    """Return the centre of a pad as a point on a link of the pad's joint."""
    frames = (
        (point, hand.model.frames[hand.model.getFrameId(point.link, pin.FrameType.BODY)])
        for point in hand.spec.points
    )
    tip, frame = next(pair for pair in frames if pair[1].parentJoint == pad.joint)
    x, y, z = (float(value) for value in frame.placement.actInv(pad.offset))
    return PointSpec(f"{finger}_pad", tip.link, (x, y, z), finger)


def _nearest(
    hand: Hand, one: int, other: int, columns: np.ndarray, near: float
) -> tuple[float, np.ndarray]:
    """Return the smallest distance of two points, or one below `near`, and the posture there."""
    low, high = hand.lower_limits[columns], hand.upper_limits[columns]
    generator = np.random.default_rng(0)
    starts = [hand.rest[columns], 0.5 * (low + high), np.clip(0.0, low, high)]
    starts += [low + generator.random(len(columns)) * (high - low) for _ in range(_STARTS)]
    best, best_q = np.inf, hand.rest.copy()
    for start in starts:
        if best < near:
            break
        q = hand.rest.copy()
        q[columns] = start
        for _ in range(_ITERATIONS):
            points = hand.points(q)
            gap = points[one] - points[other]
            distance = float(np.linalg.norm(gap))
            if distance < best:
                best, best_q = distance, q.copy()
            jacobian = hand.point_jacobian(q)[:, columns]
            J = jacobian[3 * other : 3 * other + 3] - jacobian[3 * one : 3 * one + 3]
            step = J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(3), gap)
            moved = np.clip(q[columns] + step, low, high)
            if distance < near or np.abs(moved - q[columns]).max() < 1e-4:
                break
            q[columns] = moved
    return best, best_q


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two vectors [deg]; 180 if one is zero."""
    length = float(np.linalg.norm(one) * np.linalg.norm(other))
    return float(np.degrees(np.arccos(np.clip(one @ other / length, -1.0, 1.0)))) if length else 180
