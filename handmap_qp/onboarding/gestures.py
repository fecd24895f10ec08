"""What a described hand does: make a fist, and pinch.

Both use the description and the kinematics only, and none of the reasoning of `detect`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.hands.fingers import (
    THUMB,
    Finger,
    PalmKinematics,
    Place,
    find_fingers,
    zero_posture,
)
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.onboarding.anatomy import angle_between

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
    fingers = find_fingers(hand)
    if THUMB not in fingers:
        return ()
    pads, pinches = fingertip_pads(hand, fingers), []
    for name, finger in fingers.items():
        if name != THUMB:
            used = [pads[THUMB], pads[name]]
            radii = sum(pad.radius for pad in used)
            columns = np.union1d(fingers[THUMB].columns, finger.columns)
            places = [(pad.joint, pad.offset) for pad in used]
            distance, q = _nearest(hand, places, columns, radii)
            pinches.append(Pinch(name, distance - radii, q))
    return tuple(pinches)


def fingertip_pads(hand: Hand, chains: dict[str, Finger]) -> dict[str, Pad]:
    """Return the pad of each fingertip; a ball of 6 mm around it if the shapes cannot be read."""
    try:
        return find_pads(hand, chains)
    except HandmapError:
        return {name: Pad(*chain.tip, _RADIUS) for name, chain in chains.items()}


def _nearest(
    hand: Hand, places: list[Place], columns: np.ndarray, near: float
) -> tuple[float, np.ndarray]:
    """Return the smallest distance of two points, or one below `near`, and the posture there."""
    view, low, high = PalmKinematics(hand), hand.lower_limits[columns], hand.upper_limits[columns]
    random = low + np.random.default_rng(0).random((_STARTS, len(columns))) * (high - low)
    starts = [hand.rest[columns], 0.5 * (low + high), np.clip(0.0, low, high), *random]
    best, best_q = np.inf, hand.rest.copy()
    for start in starts:
        if best < near:
            break
        q = hand.rest.copy()
        q[columns] = start
        for _ in range(_ITERATIONS):
            gap = np.subtract(*view.points(q, places))
            distance = float(np.linalg.norm(gap))
            if distance < best:
                best, best_q = distance, q.copy()
            J = np.subtract(*(view.motion(q, place)[:3, columns] for place in reversed(places)))
            step = J.T @ np.linalg.solve(J @ J.T + _DAMPING**2 * np.eye(3), gap)
            moved = np.clip(q[columns] + step, low, high)
            if distance < near or np.abs(moved - q[columns]).max() < 1e-4:
                break
            q[columns] = moved
    return best, best_q
