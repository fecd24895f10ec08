"""Limits of a robot's displacements; `handmap/limits.hpp` has the formulas."""

from __future__ import annotations

from .encoding import Flags, Indices, Model, Vector


class BoxLimits(Model, frozen=True, kw_only=True):
    """Limits of position, speed and acceleration, from which the core makes the bounds of a sample.

    Attributes:
        lowest: Lower position limits of a configuration, shape (nq,).
        highest: Upper ones.
        lower: Lower position limits of the coordinates, shape (k,).
        upper: Upper ones.
        speeds: Speed limits, shape (k,); infinite for none.
        coordinates: Where each coordinate's joint is in a configuration, shape (k,).
        together: Which coordinates must be able to stop together, shape (k,).
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
        """Number of active coordinates, k."""
        return len(self.lower)
