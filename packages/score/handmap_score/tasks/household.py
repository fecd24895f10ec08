"""Objects of a household, made of simple shapes: `Household`, `HOUSEHOLD`."""

from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from handmap_qp.mapping import Box, Cylinder, MeshShape, Shape, Sphere


class Household(NamedTuple):
    """An object of a household.

    Attributes:
        shape: Its shape; z is up, x is across, and the origin is where it is to be held.
        mass: Its mass [kg].
        friction: Coulomb coefficient.
        is_round: Whether it can be held from all sides.
        putty: Lever of what keeps it from tilting where it stands [m]: a little putty, or a rack.
            It resists with friction times weight times this.
    """

    shape: Shape
    mass: float
    friction: float
    is_round: bool = False
    putty: float = 0.01


def bar(width: float, back: float, front: float, height: float) -> MeshShape:
    """Return a bar along y that is held beside its middle.

    Args:
        width: Its width along x [m].
        back: How far it reaches toward -y [m].
        front: How far it reaches toward +y [m].
        height: Its height along z [m].
    """
    x, z = width / 2.0, height / 2.0
    ends = [(a, b, c) for a in (-x, x) for b in (-back, front) for c in (-z, z)]
    return MeshShape(np.array(ends))


def rings(*heights_and_radii: tuple[float, float]) -> MeshShape:
    """Return the hull of circles about z, each given by height and radius [m]."""
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
    return MeshShape(
        np.concatenate([r * circle + (0.0, 0.0, z) for z, r in heights_and_radii])
    )


def disc(thickness: float, radius: float, inside: float) -> MeshShape:
    """Return a disc that stands on its edge and is held inside its upper edge.

    Args:
        thickness: Its thickness along x [m].
        radius: Its radius [m].
        inside: Distance of the origin from the upper edge [m].
    """
    turns = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    y, z = radius * np.cos(turns), radius * np.sin(turns) - radius + inside
    x = np.full(len(turns), thickness / 2.0)
    sides = [np.column_stack([side * x, y, z]) for side in (-1.0, 1.0)]
    return MeshShape(np.concatenate(sides))


def egg(length: float, diameter: float) -> MeshShape:
    """Return an ellipsoid about z [m], which stands in for an egg."""
    angles = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 13)
    circles = [
        (0.5 * length * np.sin(angle), 0.5 * diameter * np.cos(angle))
        for angle in angles.tolist()
    ]
    return rings(*circles)


HOUSEHOLD: Mapping[str, Household] = MappingProxyType(
    {
        "tea box": Household(Box((0.036, 0.06, 0.09)), 0.06, 0.5),
        "foam brick": Household(Box((0.05, 0.075, 0.05)), 0.028, 0.8),
        "die": Household(Box((0.02, 0.02, 0.02)), 0.01, 0.6),
        "can": Household(Cylinder(0.033, 0.1), 0.2, 0.6, is_round=True),
        "tube": Household(Cylinder(0.016, 0.08), 0.04, 0.6, is_round=True),
        "golf ball": Household(Sphere(0.0214), 0.046, 0.6, is_round=True),
        "tennis ball": Household(Sphere(0.033), 0.058, 0.9, is_round=True),
        "strawberry": Household(Sphere(0.015), 0.018, 0.7, is_round=True),
        "mug's handle": Household(bar(0.012, 0.01, 0.1, 0.03), 0.04, 0.7),
        "bottle": Household(
            rings((-0.09, 0.025), (0.01, 0.025), (0.05, 0.012)),
            0.1,
            0.6,
            is_round=True,
        ),
        "pen": Household(Cylinder(0.005, 0.14), 0.012, 0.6, is_round=True),
        "plate's rim": Household(disc(0.012, 0.09, 0.015), 0.05, 0.5, putty=0.05),
    }
)
"""Objects of about the sizes of YCB's, made of simple shapes.

Their weights are such that the person's own hand, with the motors that all hands have, can carry
them between two fingertips: the thinner an object, the less the fingers press on it. So mug and
plate weigh what plastic ones do. Bottles end 50 mm above the grip, because the palm is above it.
The mug's handle is a bar whose weight hangs 45 mm beside the grip, as the mug's does; the mug
itself is not there to be touched. The plate stands in a rack.
"""
