"""The pads of a hand's fingertips: a ball inside each fingertip's surface.

A description names them, or they are found in the collision shapes.
"""

from collections import defaultdict
from functools import lru_cache

import coal
import msgspec
import numpy as np

from handmap_core.hands.pad import Pad
from handmap_core.se3 import Array, transform_points, unit
from .collision_shapes import read_collision_shapes
from .fingers import Finger, find_fingers, place_of
from .hand import Hand
from .spec import PointSpec

# A fingertip that lies deeper under its surface than this is the middle of a round tip [m].
_DEEP = 0.004
# The middle of a pad is looked for this far from the tip towards the last joint [m].
_LONGEST = 0.015
_STEP = 0.001
# The middle is the first point on the way that is nearly as deep as the deepest one.
_SHARE = 0.95
# Radius of a pad without any shape, and the smallest one with a shape [m].
_RADIUS = 0.006
_SMALLEST = 0.003


Surface = list[tuple[Array, float]]
"""Convex shapes: each is the hull of balls of one radius around points [m], shape (k, 3)."""


def find_pads(hand: Hand) -> dict[str, Pad]:
    """Find the pad of every finger: that of its description, or in the shapes of its last joint.

    The depth of a point under a convex surface is the smallest of `support(n) - n p` over
    directions n. The pad's middle lies on the line from the fingertip to the last joint.

    Returns:
        Pads by finger. A finger without shapes has a pad of 6 mm around its tip.

    Raises:
        HandError: If a shape cannot be read.
    """
    given = {point.finger: point for point in hand.spec.points if point.pad}
    chains = find_fingers(hand)
    return {name: _pad(hand, chains[name], given.get(name)) for name in chains}


@lru_cache(maxsize=32)
def _surfaces(hand: Hand) -> dict[int, Surface]:
    """Return the surface of each joint."""
    surfaces = defaultdict(list)
    for shape in read_collision_shapes(hand).geometryObjects:
        points, radius = _corners(shape.geometry)
        placed = transform_points(shape.placement.homogeneous, points)
        surfaces[shape.parentJoint].append((placed, radius))
    return surfaces


def _pad(hand: Hand, chain: Finger, point: PointSpec | None) -> Pad:
    """Return the pad of a finger, which its point gives or its shapes have."""
    joint, middle = chain.tip
    pad = point.pad if point else None
    if point and pad:
        joint, middle = place_of(hand, msgspec.structs.replace(point, xyz=pad.xyz))
    stretch = hand.stretches.get(hand.model.names[joint], np.ones(3))
    shapes = _surfaces(hand.unscaled or hand) if joint in chain.joints else {}
    surface = [
        (stretch * points, stretch[2] * radius)
        for points, radius in shapes.get(joint, ())
    ]
    if pad:
        depth = float(_depths(surface, middle)) if surface else pad.radius
        return Pad(joint, middle, pad.radius, max(0.0, pad.radius - max(0.0, depth)))
    return Pad(joint, *(ball_in(surface, middle) if surface else (middle, _RADIUS)))


def _depths(surface: Surface, points: Array) -> Array:
    """Return how deep points (..., 3) are under a surface [m], < 0 outside."""
    ahead = points @ _DIRECTIONS.T
    supports = [(of @ _DIRECTIONS.T).max(axis=0) + radius for of, radius in surface]
    return np.max([(support - ahead).min(axis=-1) for support in supports], axis=0)


def ball_in(surface: Surface, tip: Array) -> tuple[Array, float]:
    """Find the ball under a fingertip's surface.

    Args:
        surface: The surface in the frame of the last joint.
        tip: Fingertip there [m], shape (3,).

    Returns:
        Centre [m], shape (3,), and radius [m].
    """
    steps = np.arange(0.0, _LONGEST + _STEP, _STEP)
    points = tip - np.outer(steps, unit(tip))
    depths = _depths(surface, points)
    most = float(depths[0] if depths[0] > _DEEP else depths.max())
    return points[np.argmax(depths >= _SHARE * most)], max(most, _SMALLEST)


def _corners(geometry: coal.CollisionGeometry) -> tuple[Array, float]:
    """Return points and a radius so that the shape is the hull of balls around the points."""
    radius = 0.0
    match geometry:
        case coal.Box():
            points = np.where([*np.ndindex(2, 2, 2)], 1.0, -1.0) * geometry.halfSide
        case coal.Sphere(radius=radius):
            points = np.zeros((1, 3))
        case coal.Capsule(radius=radius, halfLength=half):
            points = np.outer((1.0, -1.0), (0.0, 0.0, half))
        case _:
            points = np.array([geometry.point(i) for i in range(geometry.num_points)])
    return points, radius


# Unit vectors spread evenly over the sphere (Fibonacci's lattice).
_COUNTS = np.arange(400) + 0.5
_HEIGHTS = 1.0 - 2.0 * _COUNTS / 400
_TURNS = np.pi * (1.0 + np.sqrt(5.0)) * _COUNTS
_FLAT = np.sqrt(1.0 - _HEIGHTS**2)
_DIRECTIONS = np.column_stack(
    [_FLAT * np.cos(_TURNS), _FLAT * np.sin(_TURNS), _HEIGHTS]
)
