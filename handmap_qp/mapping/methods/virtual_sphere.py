"""Virtual sphere: the ball that encloses the fingertips moves, turns and grows with them.

Gioioso, Salvietti, Malvezzi and Prattichizzo, "Mapping synergies from human to robotic hands with
dissimilar kinematics: an approach in the object domain", IEEE Trans. Robotics 29 (2013) 825-837.
They map velocities: `dq_r = J_r^+ A_r S_c A_h^+ J_h dq_h`, where each point contributes `A_i = [I,
-[p_i - c]x, (p_i - c)]` and `S_c = diag(k, k, k, 1, 1, 1, 1)`.

Here displacements since the reference take the place of velocities. `A_h^+` becomes the similarity
that best fits the human's points (Umeyama, IEEE PAMI 13, 1991), and the QP takes the place of
`J_r^+`. For a small displacement both agree (test). k is measured at the reference.

Partners are not needed. Opening and closing, and the motion of a held object, come across. A sphere
cannot tell fingers apart: a pointing finger turns it, and one bent finger bends all of the robot's.
"""

from __future__ import annotations

from itertools import combinations
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

# A point this far outside a ball is outside it, as a share of its radius.
_OUTSIDE = 1e-12


class VirtualSphere(MethodOptions, frozen=True):
    """Map the motion of the fingertips' enclosing ball."""

    scale: (
        Annotated[
            float,
            number(
                "k, the factor on the ball's displacement; the ratio of the radii at the reference "
                "if omitted.",
                above=True,
            ),
        ]
        | None
    ) = None

    def bind(self, human: Hand, robot: Hand) -> BoundVirtualObject:
        """Choose the points of both hands; see `Method.bind`."""
        return BoundVirtualObject(Sphere, self.scale, human, robot)


PRESETS = {"virtual-sphere": to_compare(VirtualSphere(), "ball")}


class Sphere:
    """The smallest ball that encloses points; see `VirtualObject`.

    Args:
        points: The points at the reference [m], shape (n, 3).

    Attributes:
        centre: Centre [m], shape (3,).
        size: Radius [m].
    """

    def __init__(self, points: np.ndarray) -> None:
        self.centre, self.size = enclosing_ball(points)
        self._mean = points.mean(axis=0)
        self._offsets = points - self._mean
        self._spread = float(np.vdot(self._offsets, self._offsets))

    def motion_to(self, points: np.ndarray) -> ObjectMotion:
        """Return the best similarity; see `VirtualObject.motion_to`."""
        mean = points.mean(axis=0)
        covariance = (points - mean).T.dot(self._offsets)
        rotation = nearest_rotation(covariance)
        ratio = float(np.vdot(rotation, covariance)) / self._spread
        linear = ratio * rotation
        shift = mean + linear.dot(self.centre - self._mean) - self.centre
        return ObjectMotion(shift, linear, np.array([ratio]))


def enclosing_ball(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Find the smallest ball that encloses points, exactly.

    Points outside are taken in one at a time, the farthest first, until none is left. Each time the
    ball of the few points on its surface and the new one is found among their circumscribed balls.

    Args:
        points: Points [m], shape (n, 3), n > 0.

    Returns:
        Centre [m], shape (3,), and radius [m].
    """
    support = [0]
    centre, radius = points[0].copy(), 0.0
    while True:
        distances = np.linalg.norm(points - centre, axis=1)
        farthest = int(np.argmax(distances))
        if distances[farthest] <= radius * (1.0 + _OUTSIDE) or farthest in support:
            return centre, float(distances[farthest])
        found = _smallest_ball(points, [*support, farthest])
        if not found[2] > radius:
            # The ball grows with every point taken in; rounding alone can say otherwise.
            return centre, float(distances[farthest])
        support, centre, radius = found


def _smallest_ball(
    points: np.ndarray, chosen: list[int]
) -> tuple[list[int], np.ndarray, float]:
    """Return the smallest ball of at most five points: those on its surface, centre and radius."""
    best: tuple[list[int], np.ndarray, float] = (chosen, points[chosen[0]], np.inf)
    for count in range(1, min(len(chosen), 4) + 1):
        for subset in combinations(chosen, count):
            first = points[subset[0]]
            edges = points[list(subset[1:])] - first
            # Centre of the circumscribed ball in the span of the edges.
            squares = np.einsum("ij,ij->i", edges, edges)
            centre = first + 0.5 * np.linalg.pinv(edges).dot(squares)
            # With its farthest point as radius, every candidate encloses all of them.
            radius = float(np.linalg.norm(points[chosen] - centre, axis=1).max())
            if radius < best[2] * (1.0 - _OUTSIDE):
                best = (list(subset), centre, radius)
    return best
