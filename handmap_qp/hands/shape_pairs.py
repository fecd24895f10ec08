"""Pairs of a hand's collision shapes: those that its description names, or all that may collide."""

from __future__ import annotations

from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import FINGERS

if TYPE_CHECKING:
    from handmap_qp.hands.fingers import Finger

_THUMB = FINGERS[0]


class ShapePairs(NamedTuple):
    """Collision shapes, and the pairs of them that distances are measured between.

    Attributes:
        geometry: The shapes, with one collision pair for each of the pairs.
        links: Links of both shapes of each pair.
        fingers: Finger whose distal link the pair brings together with the thumb's; empty for
            pairs that do not pinch.
    """

    geometry: pin.GeometryModel
    links: tuple[tuple[str, str], ...]
    fingers: tuple[str, ...]


def named_pairs(hand: Hand) -> ShapePairs:
    """Pair the shapes of the links that the hand's description names.

    Args:
        hand: The hand; its `spec.collision` must not be None.

    Raises:
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """
    geometry, spec = read_collision_shapes(hand), hand.spec.collision
    shapes: dict[str, list[int]] = {}
    for i, shape in enumerate(geometry.geometryObjects):
        shapes.setdefault(hand.model.frames[shape.parentFrame].name, []).append(i)
    links: list[tuple[str, str]] = []
    for i, pair in enumerate(spec.pairs if spec else ()):
        for link in pair:
            if link not in shapes:
                what = (
                    "has no collision shape"
                    if hand.model.existFrame(link, pin.FrameType.BODY)
                    else "is not a link of the URDF"
                )
                raise hand.spec.error(
                    f"{link!r} {what}", key=f"collision.pairs[{i}]", value=link
                )
        for first in shapes[pair[0]]:
            for second in shapes[pair[1]]:
                geometry.addCollisionPair(pin.CollisionPair(first, second))
                links.append(pair)
    return ShapePairs(geometry, tuple(links), ("",) * len(links))


def all_pairs(hand: Hand, chains: dict[str, Finger]) -> ShapePairs:
    """Pair all shapes that may collide.

    Pairs on one joint, on neighbouring joints, on one finger, or that overlap at rest or with the
    hand stretched are left out. Shapes of one finger overlap at its joints as it bends, and its
    joint limits keep it from touching itself.

    Args:
        hand: The hand.
        chains: Its fingers.

    Raises:
        HandError: If a shape cannot be read.
    """
    geometry, parents = read_collision_shapes(hand), hand.model.parents
    shapes = geometry.geometryObjects
    owner = {
        joint: finger for finger, chain in chains.items() for joint in chain.joints
    }

    def may_touch(a: int, b: int) -> bool:
        is_one_finger = a in owner and owner[a] == owner.get(b)
        return a != b and parents[a] != b and parents[b] != a and not is_one_finger

    for i, j in combinations(range(len(shapes)), 2):
        if may_touch(shapes[i].parentJoint, shapes[j].parentJoint):
            geometry.addCollisionPair(pin.CollisionPair(i, j))
    pairs, overlaps = list(geometry.collisionPairs), _overlaps(hand, geometry)
    geometry.removeAllCollisionPairs()
    kept = [pair for pair, overlap in zip(pairs, overlaps, strict=True) if not overlap]
    for pair in kept:
        geometry.addCollisionPair(pair)
    distal = {
        finger: set(distal_shapes(chain, geometry)) for finger, chain in chains.items()
    }
    names = [hand.model.frames[shape.parentFrame].name for shape in shapes]
    return ShapePairs(
        geometry,
        tuple((names[pair.first], names[pair.second]) for pair in kept),
        tuple(_pinching_finger(pair, distal) for pair in kept),
    )


def distal_shapes(chain: Finger, geometry: pin.GeometryModel) -> list[int]:
    """Find the shapes on a finger's last joint, or on the nearest one before it that has any.

    Args:
        chain: The finger.
        geometry: The hand's collision shapes.

    Returns:
        Indices into `geometry.geometryObjects`; empty if the finger has no shapes.
    """
    shapes = list(enumerate(geometry.geometryObjects))
    found = (
        [i for i, s in shapes if s.parentJoint == joint]
        for joint in reversed(chain.joints)
    )
    return next(filter(None, found), [])


def _pinching_finger(pair: pin.CollisionPair, distal: dict[str, set[int]]) -> str:
    ends, thumb = {pair.first, pair.second}, distal.get(_THUMB, set())
    pinches = (
        finger
        for finger, shapes in distal.items()
        if finger != _THUMB and ends & thumb and ends & shapes
    )
    return next(pinches, "")


def _overlaps(hand: Hand, geometry: pin.GeometryModel) -> np.ndarray:
    """Return whether each pair overlaps at rest or with the hand stretched, shape (k,)."""
    data, geometry_data = hand.model.createData(), geometry.createData()
    overlaps = np.zeros(len(geometry.collisionPairs), dtype=bool)
    for posture in (hand.rest, np.clip(0.0, hand.lower_limits, hand.upper_limits)):
        vector = hand.configuration_vector(posture)
        pin.updateGeometryPlacements(hand.model, data, geometry, geometry_data, vector)
        pin.computeDistances(geometry, geometry_data)
        distances = [result.min_distance for result in geometry_data.distanceResults]
        overlaps |= np.array(distances, dtype=float) <= 0.0
    return overlaps
