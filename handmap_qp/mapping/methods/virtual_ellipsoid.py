"""Virtual ellipsoid: as the virtual sphere, with a ratio of growth along each principal axis.

The idea is that of Gioioso, Salvietti, Malvezzi and Prattichizzo, "An object-based approach to map
human hand synergies onto robotic hands with dissimilar kinematics" (2012), of which the abstract
was at hand. The formulas extend those of their sphere and are not checked against that article.
Taken: the object is the smallest ellipsoid around the fingertips, and it deforms along its own
axes. Its column of A for axis e_j is `e_j e_j^T (p_i - c)`; the three add up to the sphere's `(p_i
- c)`. The displacement of the centre is scaled by one ratio k. The axes are the human's, laid on
the robot's palm, so no axis of one hand has to be paired with one of the other.

Displacements since the reference are finite: `p -> c + v + R E diag(s) E^T (p - c)`, by least
squares. Five fingertips lie near one plane and say little about the axis across it. A ridge pulls
the three ratios s towards their common one, that of the sphere.

Partners are not needed. Where fingers close but do not spread, the ellipsoid says so and the sphere
does not. Neither can tell fingers apart.
"""

from __future__ import annotations

from functools import partial
from typing import Annotated

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.method import MethodOptions
from handmap_qp.mapping.virtual_object import (
    BoundVirtualObject,
    ObjectMotion,
    to_compare,
)
from handmap_qp.options import number
from handmap_qp.se3 import nearest_rotation

# Points whose extent across a plane or a line is less than this share of their largest lie in it.
_FLAT = 1e-6
# The smallest ellipsoid is found to this relative accuracy of its volume's derivative.
_ACCURACY = 1e-9
_MOST_STEPS = 10_000
# Rotation and ratios are fitted in turns until no ratio changes by more than this.
_SETTLED = 1e-10
_MOST_TURNS = 100


class VirtualEllipsoid(MethodOptions, frozen=True):
    """Map the motion of the fingertips' enclosing ellipsoid."""

    scale: (
        Annotated[
            float,
            number(
                "k, the factor on the ellipsoid's displacement; the ratio of the sizes at the "
                "reference if omitted.",
                above=True,
            ),
        ]
        | None
    ) = None
    ridge: Annotated[
        float,
        number(
            "Pull of the three ratios towards their common one, as a share of the points' mean "
            "square extent. 0 is the plain least squares; at infinity it is the sphere."
        ),
    ] = 0.1

    def bind(self, human: Hand, robot: Hand) -> BoundVirtualObject:
        """Choose the points of both hands; see `Method.bind`."""
        return BoundVirtualObject(
            partial(Ellipsoid, ridge=self.ridge), self.scale, human, robot
        )


PRESETS = {"virtual-ellipsoid": to_compare(VirtualEllipsoid(), "ellipsoid")}


class Ellipsoid:
    """The smallest ellipsoid that encloses points; see `VirtualObject`.

    Args:
        points: The points at the reference [m], shape (n, 3).
        ridge: As of `VirtualEllipsoid`.

    Attributes:
        centre: Centre [m], shape (3,).
        axes: Principal axes, a column each, shape (3, 3).
        semi_axes: Lengths along them, the largest first; 0 across a plane or a line in which the
            points lie [m], shape (3,).
        size: Root of the sum of their squares [m].
    """

    def __init__(self, points: np.ndarray, ridge: float = 0.0) -> None:
        self.centre, self.axes, self.semi_axes = enclosing_ellipsoid(points)
        self.size = float(np.linalg.norm(self.semi_axes))
        self._mean = points.mean(axis=0)
        self._offsets = (points - self._mean) @ self.axes
        squares = np.einsum("ij,ij->j", self._offsets, self._offsets)
        # An axis without extent has no ratio of its own.
        floor = _FLAT**2 * squares.max()
        self._squares, self._pull = squares, max(ridge * float(squares.mean()), floor)

    def motion_to(self, points: np.ndarray) -> ObjectMotion:
        """Return the best rotation and ratios; see `VirtualObject.motion_to`."""
        mean = points.mean(axis=0)
        covariance = (points - mean).T.dot(self._offsets)
        ratios, rotation = np.ones(3), np.eye(3)
        for _ in range(_MOST_TURNS):
            rotation = nearest_rotation(covariance * ratios)
            along = np.einsum("ij,ij->j", rotation, covariance)
            common = max(float(along.sum()) / float(self._squares.sum()), 0.0)
            fitted = np.maximum(
                (along + self._pull * common) / (self._squares + self._pull), 0.0
            )
            change, ratios = float(np.abs(fitted - ratios).max()), fitted
            if change <= _SETTLED:
                break
        linear = (rotation * ratios).dot(self.axes.T)
        shift = mean + linear.dot(self.centre - self._mean) - self.centre
        return ObjectMotion(shift, linear, ratios)


def enclosing_ellipsoid(
    points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Find the ellipsoid of the smallest volume that encloses points.

    Points that lie in a plane or on a line get the smallest ellipse or segment. By Khachiyan's
    method with steps in both directions (Todd and Yildirim, Discrete Appl. Math. 155, 2007).

    Args:
        points: Points [m], shape (n, 3), n > 0.

    Returns:
        Centre [m], shape (3,); principal axes, a column each, right-handed, shape (3, 3); lengths
        of the semi-axes, the largest first [m], shape (3,).
    """
    mean = points.mean(axis=0)
    _, extents, right = np.linalg.svd(np.vstack([points - mean, np.zeros((3, 3))]))
    rank = int((extents > _FLAT * max(extents[0], 1e-12)).sum())
    if rank == 0:
        return mean, np.eye(3), np.zeros(3)
    basis = right[:rank].T
    # In units of the extents, so that thin sets are no worse conditioned than round ones.
    units = extents[:rank]
    shares = _ellipsoid_shares((points - mean) @ basis / units)
    centre = shares @ points
    offsets = (points - centre) @ basis
    values, turn = np.linalg.eigh(rank * (offsets.T * shares) @ offsets)
    order = np.argsort(values)[::-1]
    axes = np.column_stack([basis @ turn[:, order], right[rank:].T])
    if np.linalg.det(axes) < 0.0:
        axes[:, 2] *= -1.0
    semi_axes = np.zeros(3)
    semi_axes[:rank] = np.sqrt(np.maximum(values[order], 0.0))
    return centre, axes, semi_axes


def _ellipsoid_shares(points: np.ndarray) -> np.ndarray:
    """Return each point's share in the smallest ellipsoid, adding up to 1, shape (n,)."""
    count, rank = points.shape
    lifted = np.column_stack([points, np.ones(count)])
    shares, full = np.full(count, 1.0 / count), rank + 1
    for _ in range(_MOST_STEPS):
        inverse = np.linalg.inv((lifted.T * shares) @ lifted)
        distances = np.einsum("ij,jk,ik->i", lifted, inverse, lifted)
        most = int(np.argmax(distances))
        least = int(np.argmin(np.where(shares > 0.0, distances, np.inf)))
        above, below = distances[most] - full, full - distances[least]
        if max(above, below) <= _ACCURACY * full:
            break
        chosen = most if above >= below else least
        excess = distances[chosen] - 1.0
        step = (excess + 1.0 - full) / (full * excess) if excess > 0.0 else -np.inf
        # A share that would become negative is dropped.
        step = max(step, -shares[chosen] / (1.0 - shares[chosen]))
        shares = (1.0 - step) * shares
        shares[chosen] = max(shares[chosen] + step, 0.0)
    return shares / shares.sum()
