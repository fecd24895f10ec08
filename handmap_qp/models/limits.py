"""Limits of a robot's displacements; `core/limits.hpp` has the formulas."""

from __future__ import annotations

from .encoding import Flags, Indices, Model, Vector


class BoxLimits(Model, frozen=True, kw_only=True):
    """Limits of position, speed and acceleration, from which the core makes the bounds of a sample.

    Attributes:
        lowest: Lower position limits of a configuration, shape (nq,).
        highest: Upper ones.
        lower: Lower position limits of the coordinates, shape (nv,).
        upper: Upper ones.
        speeds: Speed limits, shape (nv,); infinite for none.
        coordinates: Where each coordinate's joint is in a configuration, shape (nv,).
        together: Which coordinates must be able to stop together, shape (nv,).
        acceleration: Limit of every coordinate's acceleration; infinite for none.
    """

    lowest: Vector
    highest: Vector
    lower: Vector
    upper: Vector
    speeds: Vector
    coordinates: Indices
    together: Flags
    acceleration: float

    @property
    def size(self) -> int:
        """Number of coordinates, nv."""
        return len(self.lower)
