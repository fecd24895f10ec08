"""Shapes of held objects: box, sphere and cylinder, centred at the origin of their own frame."""

from __future__ import annotations

from dataclasses import dataclass

from handmap_qp.errors import expect
from handmap_qp.hands.spec import Vector
from handmap_qp.se3 import as_floats


def positive(value: float, name: str) -> float:
    """Return a finite number > 0.

    Raises:
        InvalidInputError: If it is not one.
    """
    number = float(as_floats(value, name, shape=(), is_finite=True))
    expect(number > 0.0, name, "a number > 0", value=value)
    return number


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
            positive(side, "size") for side in as_floats(self.size, "size", shape=(3,))
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
        object.__setattr__(self, "radius", positive(self.radius, "radius"))


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
            object.__setattr__(self, name, positive(getattr(self, name), name))


Shape = Box | Sphere | Cylinder
