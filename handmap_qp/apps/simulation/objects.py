"""Shapes of held objects: box, sphere and cylinder, centred at the origin of their own frame."""

from __future__ import annotations

from dataclasses import dataclass

from handmap_qp.apps.simulation.checks import finite_array, positive_number
from handmap_qp.hands.spec import Vector


@dataclass(frozen=True, slots=True)
class Box:
    """A box.

    Attributes:
        size: Lengths of its sides along x, y and z [m].

    Raises:
        InvalidInputError: If a side is not > 0.
    """

    size: Vector

    def __post_init__(self) -> None:
        x, y, z = (
            positive_number(side, "size")
            for side in finite_array(self.size, (3,), "size")
        )
        object.__setattr__(self, "size", (x, y, z))


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere.

    Attributes:
        radius: Radius [m].

    Raises:
        InvalidInputError: If the radius is not > 0.
    """

    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive_number(self.radius, "radius"))


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder along z.

    Attributes:
        radius: Radius [m].
        length: Length [m].

    Raises:
        InvalidInputError: If radius or length is not > 0.
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        for name in ("radius", "length"):
            object.__setattr__(self, name, positive_number(getattr(self, name), name))


Shape = Box | Sphere | Cylinder
