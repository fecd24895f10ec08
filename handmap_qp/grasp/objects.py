"""Objects to hold: box, sphere and cylinder, each centred at the origin of its own frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.spec import Vector


@dataclass(frozen=True, slots=True)
class Box:
    """A box.

    Attributes:
        size: Its sides along x, y and z [m].
    """

    size: Vector

    def __post_init__(self) -> None:
        _check_lengths(size=self.size)

    @property
    def circumradius(self) -> float:
        """Radius of the smallest sphere round the centre that holds it [m]."""
        return float(np.linalg.norm(self.size)) / 2.0


@dataclass(frozen=True, slots=True)
class Sphere:
    """A sphere.

    Attributes:
        radius: Radius [m].
    """

    radius: float

    def __post_init__(self) -> None:
        _check_lengths(radius=(self.radius,))

    @property
    def circumradius(self) -> float:
        """Its radius [m]."""
        return self.radius


@dataclass(frozen=True, slots=True)
class Cylinder:
    """A cylinder along z.

    Attributes:
        radius: Radius [m].
        length: Length [m].
    """

    radius: float
    length: float

    def __post_init__(self) -> None:
        _check_lengths(radius=(self.radius,), length=(self.length,))

    @property
    def circumradius(self) -> float:
        """Radius of the smallest sphere round the centre that holds it [m]."""
        return float(np.hypot(self.radius, self.length / 2.0))


Shape = Box | Sphere | Cylinder


def _check_lengths(**lengths: tuple[float, ...]) -> None:
    for name, values in lengths.items():
        if not all(np.isfinite(value) and value > 0.0 for value in values):
            raise InvalidInputError(
                f"{name}: expected lengths > 0 in metres, got {values}", value=values
            )
