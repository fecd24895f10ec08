"""Pads of a thumb and a finger that close: `FingerPads`, and a term of the QP, `ClosingPads`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp.hands import Configuration, PadPair
from handmap_qp.ik import AttachedPoints, TaskRows
from handmap_qp.se3 import Array, unit

# Weights that leave other terms little: of pads that stay apart, and of their middle [1/m].
_APART = 6000.0
_CENTRED = 1000.0
# The gap of pads counts from this far before its least one [m], so that it ends there smoothly.
_EDGE = 0.005


class FingerPads(NamedTuple):
    """The pads of the thumb and a finger of a hand.

    Attributes:
        points: The middles of both.
        pads: Both pads.
        columns: Columns of q that move thumb and finger, shape (c,).
    """

    points: AttachedPoints
    pads: PadPair
    columns: Array

    def gap(self, hand: Configuration) -> float:
        """Return the distance between their surfaces, < 0 for pads in each other [m]."""
        return self.pads.gap(self.points.positions(hand))

    def middle(self, hand: Configuration) -> Array:
        """Return the point midway between their surfaces [m], shape (3,)."""
        return self.pads.middle(self.points.positions(hand))

    def line(self, hand: Configuration) -> Array:
        """Return the direction from the thumb's pad to the finger's, shape (3,)."""
        thumb, finger = self.points.positions(hand)
        return unit(finger - thumb)

    def slopes(self, hand: Configuration) -> tuple[Array, Array]:
        """Return the derivatives of the gap, shape (nv,), and of the middle, shape (3, nv)."""
        thumb, finger = self.points.jacobians(hand)
        gap = self.line(hand) @ (finger - thumb)
        return gap, (thumb + finger) / 2.0


class ClosingPads(NamedTuple):
    """Keeps two pads apart, and by their own joints the middle between them at a place.

    Attributes:
        pads: The pads.
        own: Whether each column of the velocity moves one of both fingers, shape (nv,).
        centre: The place [m], shape (3,).
        shares: Shares of the weights of errors from the place, as of `ObjectPlace`, shape (3, 3).
        least: The least gap [m]; -inf for none.
        share: Share of all weights.
    """

    pads: FingerPads
    own: Array
    centre: Array
    shares: Array
    least: float
    share: float

    def linearise(self, hand: Configuration) -> TaskRows:
        """Return three rows of the middle, and one of the gap; see `Task.linearise`."""
        gap, middle = self.pads.slopes(hand)
        placed = self.share * _CENTRED * self.shares
        off = placed @ (self.pads.middle(hand) - self.centre)
        rows = placed @ (middle * self.own)
        more = self.pads.gap(hand) - self.least
        apart = self.share * _APART * np.clip(1.0 - more / _EDGE, 0.0, 1.0)
        near = apart * min(more, 0.0) if apart else 0.0
        return TaskRows(np.append(off, near), np.vstack([rows, apart * gap]))
