"""Virtual object between the fingertips: its motion on the human hand moves the robot's points.

The object encloses the human's fingertips at the reference, and another one encloses the robot's
(all reference points, where too few are fingertips). The human's object moves, turns and grows as
its points do, by least squares. All of the robot's points move with the robot's object. Everything
is in palm axes, and the robot's palm follows the human's. Points of the two hands are never paired,
so the hands may have any number of fingers, and no object can tell fingers apart: a pointing finger
turns it, and one bent finger bends all of the robot's.

`VirtualSphere`: Gioioso, Salvietti, Malvezzi and Prattichizzo, "Mapping synergies from human to
robotic hands with dissimilar kinematics: an approach in the object domain", IEEE Trans. Robotics 29
(2013) 825-837. They map velocities: `dq_r = J_r^+ A_r S_c A_h^+ J_h dq_h`, where each point
contributes `A_i = [I, -[p_i - c]x, (p_i - c)]` and `S_c = diag(k, k, k, 1, 1, 1, 1)`. Here
displacements since the reference take the place of velocities. `A_h^+` becomes the similarity that
best fits the human's points (Umeyama, IEEE PAMI 13, 1991), and the QP takes the place of `J_r^+`.
For a small displacement both agree (test). k is measured at the reference.

`VirtualEllipsoid`: the idea is that of the same authors, "An object-based approach to map human
hand synergies onto robotic hands with dissimilar kinematics" (2012), of which the abstract was at
hand. The formulas extend those of their sphere and are not checked against that article. Taken: the
object is the smallest ellipsoid around the fingertips, and it deforms along its own axes. Its
column of A for axis e_j is `e_j e_j^T (p_i - c)`; the three add up to the sphere's `(p_i - c)`. The
axes are the human's, laid on the robot's palm, so no axis of one hand has to be paired with one of
the other.

Displacements are finite: `p -> c + v + R E diag(s) E^T (p - c)`, by least squares. Five fingertips
lie near one plane and say little about the axis across it, so a ridge pulls the three ratios s
towards their common one. The sphere is the limit of an infinite ridge.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_core.errors import DegeneratePointsError, InvalidOptionsError
from handmap_core.options import NotNegative, Positive
from handmap_core.se3 import Array, lengths, mirror_sign, nearest_rotation
from handmap_qp.hands import FINGERS, Hand
from handmap_qp.mapping import (
    FOLLOWING,
    AlignedOptions,
    HumanPose,
    PalmMap,
    PalmMethod,
    Preset,
    RobotPosture,
    Targets,
)

# Points on a line leave the turn about it free: least ratio of their second singular value to the
# first.
_FLATTEST = 1e-3
# Fewest points of each hand; three determine a rotation.
_FEWEST_HUMAN = 3
_FEWEST_ROBOT = 2
# A point this far outside a ball is outside it, as a share of its radius.
_OUTSIDE = 1e-12
# Points whose extent across a plane or a line is less than this share of their largest lie in it.
_FLAT = 1e-6
# The smallest ellipsoid is found to this relative accuracy of its volume's derivative.
_ACCURACY = 1e-9
_MOST_STEPS = 10_000
# Rotation and ratios are fitted in turns until no ratio changes by more than this.
_SETTLED = 1e-10
_MOST_TURNS = 100


class ObjectMotion(NamedTuple):
    """Motion and deformation of an object since its reference.

    Attributes:
        shift: Displacement of its centre [m], shape (3,).
        linear: Rotation times stretch about the centre, shape (3, 3).
        ratios: Size now over size at the reference along each axis, shape (3,); all the same for a
            sphere.
    """

    shift: Array
    linear: Array
    ratios: Array


class Enclosing:
    """An object that encloses points at the reference.

    Args:
        points: The points [m], shape (n, 3).
        centre: Its centre [m], shape (3,).
        axes: The axes along which it grows, a column each, shape (3, 3).
        size: A length that grows as the object does [m].
        ridge: Pull of the ratios of growth towards a common one.
    """

    def __init__(
        self, points: Array, centre: Array, axes: Array, size: float, ridge: float
    ) -> None:
        self.centre = centre
        self.axes = axes
        self.size = size
        self._mean = points.mean(axis=0)
        self._offsets = (points - self._mean) @ axes
        self._squares = np.einsum("ij,ij->j", self._offsets, self._offsets)
        # An axis without extent has no ratio of its own.
        floor = _FLAT**2 * self._squares.max()
        self._gain = 1.0 / (self._squares + max(ridge * self._squares.mean(), floor))

    def motion_to(self, points: Array) -> ObjectMotion:
        """Return the motion that best carries the enclosed points to where they are now.

        Args:
            points: The points now [m], in the order in which they were enclosed, shape (n, 3).
        """
        mean = points.mean(axis=0)
        gain = self._gain
        covariance = (points - mean).T.dot(self._offsets)
        ratios = np.ones(3)
        rotation = np.eye(3)
        for _ in range(_MOST_TURNS):
            rotation = nearest_rotation(covariance * ratios)
            along = np.einsum("ij,ij->j", rotation, covariance)
            common = max(along.sum() / self._squares.sum(), 0.0)
            pulled = gain * along + (1.0 - gain * self._squares) * common
            before = ratios
            ratios = np.maximum(pulled, 0.0)
            if np.abs(ratios - before).max() <= _SETTLED:
                break
        linear = (rotation * ratios).dot(self.axes.T)
        shift = mean + linear.dot(self.centre - self._mean) - self.centre
        return ObjectMotion(shift, linear, ratios)


class VirtualObjectMap(PalmMap):
    """From samples to targets, counted from one reference; see `TargetMap`."""

    def __init__(
        self, method: BoundVirtualObject, sample: HumanPose, robot: RobotPosture
    ) -> None:
        super().__init__(method, sample, robot)
        self.rest = robot.q
        self._points = method.human_points
        before = self.follow(sample)[2][self._points]
        values = np.linalg.svd(before - before.mean(axis=0), compute_uv=False)
        if not values[1] > _FLATTEST * values[0]:
            raise DegeneratePointsError(
                "the points of a virtual object lie on a line", singular_values=values
            )
        self._object = method.options.enclose(before)
        follower = method.options.enclose(self.robot_points[method.robot_points])
        self._centre = follower.centre
        self._offsets = self.robot_points - follower.centre
        self._ratio = method.options.scale or follower.size / self._object.size

    def targets(self, sample: HumanPose) -> Targets:
        """Move the robot's points with its object.

        The diagnostics are in palm axes: the centres of both objects at the reference, `size_ratio`
        (k), and how the human's object moved since then (`ObjectMotion`).
        """
        _, palm, now = self.follow(sample)
        motion = self._object.motion_to(now[self._points])
        moved = self._offsets @ motion.linear.T + self._centre
        diagnostics = {
            "human_centre": self._object.centre.copy(),
            "robot_centre": self._centre.copy(),
            "size_ratio": np.array(self._ratio),
            **motion._asdict(),
        }
        return Targets(
            *self.placed(palm, moved + self._ratio * motion.shift), diagnostics
        )


class BoundVirtualObject(PalmMethod):
    """A method of this kind for two hands; see `BoundMethod`.

    Args:
        options: What encloses the points, and k.
        human: The hand that leads.
        robot: The hand that follows.

    Raises:
        InvalidOptionsError: If the human has fewer than three points, or the robot fewer than two.
    """

    needs_wrist = "the motion of the fingertips in palm axes"
    map_type = VirtualObjectMap

    def __init__(self, options: VirtualObject, human: Hand, robot: Hand) -> None:
        super().__init__(options, human, robot)
        self.options = options
        self.human_points = _tips(human, _FEWEST_HUMAN)
        self.robot_points = _tips(robot, _FEWEST_ROBOT)


def _tips(hand: Hand, fewest: int) -> Array:
    """Return the indices of the fingertips among a hand's points, or of all points if too few."""
    tips = {f"{finger}_tip" for finger in FINGERS}
    names = [point.partner or point.name for point in hand.reference_points]
    chosen = [k for k, name in enumerate(names) if name in tips]
    if len(names) < fewest:
        raise InvalidOptionsError(
            f"a virtual object needs {fewest} points, and {hand.name} has {len(names)}",
            option="method",
            value=len(names),
            advice="choose more reference points",
        )
    # Landmarks of the palm would hide the motion of the fingers.
    return np.array(chosen if len(chosen) >= fewest else range(len(names)))


def enclosing_ball(
    points: Array, surface: tuple[Array, ...] = ()
) -> tuple[Array, float]:
    """Find the smallest ball that encloses points, exactly (Welzl 1991).

    A point outside the ball of those before it lies on the surface of the ball of them all.

    Args:
        points: Points [m], shape (n, 3), n > 0.
        surface: Points that must lie on the surface [m], shape (3,) each, at most four.

    Returns:
        Centre [m], shape (3,), and radius [m].
    """
    centre = np.zeros(3)
    radius = -1.0
    if surface:
        edges = np.array(surface) - surface[0]
        # Centre of the circumscribed ball in the span of the edges.
        centre = 0.5 * np.linalg.pinv(edges).dot(np.square(edges).sum(axis=1))
        radius = float(lengths(centre))
        centre += surface[0]
    for i, point in enumerate(points if len(surface) < 4 else ()):
        if lengths(point - centre) > radius * (1.0 + _OUTSIDE):
            centre, radius = enclosing_ball(points[:i], (*surface, point))
    return centre, radius


def enclosing_ellipsoid(points: Array) -> tuple[Array, Array, Array]:
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
    _, extents, right = np.linalg.svd(points - mean)
    rank = (extents > _FLAT * max(extents[0], 1e-12)).sum()
    # In units of the extents, so that thin sets are no worse conditioned than round ones.
    shares = _ellipsoid_shares((points - mean) @ right[:rank].T / extents[:rank])
    centre = shares @ points
    offsets = points - centre
    axes, squares, _ = np.linalg.svd(rank * (offsets.T * shares) @ offsets)
    axes[:, 2] *= mirror_sign(axes)
    return centre, axes, np.sqrt(squares)


def _ellipsoid_shares(points: Array) -> Array:
    """Return each point's share in the smallest ellipsoid, adding up to 1, shape (n,)."""
    count, rank = points.shape
    lifted = np.column_stack([points, np.ones(count)])
    shares = np.full(count, 1.0 / count)
    full = rank + 1
    for _ in range(_MOST_STEPS):
        inverse = np.linalg.inv((lifted.T * shares) @ lifted)
        distances = np.einsum("ij,jk,ik->i", lifted, inverse, lifted)
        most = np.argmax(distances)
        least = np.argmin(np.where(shares > 0.0, distances, np.inf))
        above = distances[most] - full
        below = full - distances[least]
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


class VirtualObject(AlignedOptions, frozen=True):
    """Map the motion of an object that encloses the fingertips.

    Attributes:
        scale: k, the factor on the object's displacement; the ratio of the sizes at the reference
            if omitted.
    """

    bound_type = BoundVirtualObject
    scale: Positive | None = None

    def enclose(self, points: Array) -> Enclosing:
        """Return the object around points [m], shape (n, 3)."""
        raise NotImplementedError


class VirtualSphere(VirtualObject, frozen=True):
    """Map the motion of the fingertips' enclosing ball."""

    def enclose(self, points: Array) -> Enclosing:
        """Return the smallest ball; its size is the radius [m]."""
        centre, radius = enclosing_ball(points)
        return Enclosing(points, centre, np.eye(3), radius, np.inf)


class VirtualEllipsoid(VirtualObject, frozen=True):
    """Map the motion of the fingertips' enclosing ellipsoid.

    Attributes:
        ridge: Pull of the three ratios towards their common one, as a share of the points' mean
            square extent. 0 is the plain least squares; at infinity it is the sphere.
    """

    ridge: NotNegative = 0.1

    def enclose(self, points: Array) -> Enclosing:
        """Return the smallest ellipsoid; its size is the norm of its semi-axes [m]."""
        centre, axes, semi_axes = enclosing_ellipsoid(points)
        size = float(lengths(semi_axes))
        return Enclosing(points, centre, axes, size, self.ridge)


def _preset(method: VirtualObject, what: str) -> Preset:
    return Preset(
        method,
        FOLLOWING,
        f"to compare: the {what} around the fingertips moves, turns and grows; no partners",
        "gestures: a virtual object cannot tell fingers apart",
    )


PRESETS = {
    "virtual-sphere": _preset(VirtualSphere(), "ball"),
    "virtual-ellipsoid": _preset(VirtualEllipsoid(), "ellipsoid"),
}
