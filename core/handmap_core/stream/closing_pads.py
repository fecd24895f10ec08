"""Pads of a thumb and a finger that close: `FingerPads`, and a term of the QP, `ClosingPads`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.hands import Configuration, PadPair
from handmap_core.ik import AttachedPoints, TaskRows
from handmap_core.se3 import Array, lengths, unit

# Weights that leave other terms little: of pads that stay apart, and of their middle [1/m].
_APART = 6000.0
_CENTRED = 1000.0
# A pad turns about its joints on arcs of about this radius [m]. A place that is so far that fingers
# do not reach it pulls them along tangents, past the nearest point of the arc and back in the next
# sample, for ever. So steps cost what the arc takes away (Levenberg-Marquardt): nothing at the
# place.
_BEND = 0.05
# The gap of pads counts from this far before its least one [m], so that it ends there smoothly.
_EDGE = 0.005


class PadsState(NamedTuple):
    """Where two pads of a hand are.

    Attributes:
        gap: Distance between their surfaces, < 0 for pads in each other [m].
        middle: Point midway between their surfaces [m], shape (3,).
        line: Direction from the thumb's pad to the finger's, shape (3,).
    """

    gap: float
    middle: Array
    line: Array


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

    def state(self, hand: Configuration) -> PadsState:
        """Return where they are."""
        places = self.points.positions(hand)
        thumb, finger = places
        line = unit(finger - thumb)
        return PadsState(self.pads.gap(places), self.pads.middle(places), line)

    def gap(self, hand: Configuration) -> float:
        """Return the distance between their surfaces, < 0 for pads in each other [m]."""
        return self.pads.gap(self.points.positions(hand))

    def slopes(self, hand: Configuration, line: Array) -> tuple[Array, Array]:
        """Return the derivatives of the gap, shape (nv,), and of the middle, shape (3, nv).

        Args:
            hand: The hand, placed with Jacobians.
            line: As of `PadsState`.
        """
        thumb, finger = self.points.jacobians(hand)
        return line @ (finger - thumb), (thumb + finger) / 2.0


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
        state = self.pads.state(hand)
        gap, middle = self.pads.slopes(hand, state.line)
        placed = self.share * _CENTRED * self.shares
        off = placed @ (state.middle - self.centre)
        rows = placed @ (middle * self.own)
        more = state.gap - self.least
        apart = self.share * _APART * np.clip(1.0 - more / _EDGE, 0.0, 1.0)
        near = apart * min(more, 0.0) if apart else 0.0
        pull = float(lengths(placed @ off))
        return TaskRows(
            np.append(off, near),
            np.vstack([rows, apart * gap]),
            _BEND * pull * self.own,
        )
