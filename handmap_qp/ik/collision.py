"""Self-collision avoidance: rows of the QP from coal's distances between collision shapes.

Meshes count as their convex hulls.

For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,

    d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin

becomes

    -n^T (J_b - J_a) dq <= gain (d - margin)

with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
(n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
angle x at a radius r may come r x^2 / 2 closer than the row says. The margin is for that, and
`handmap_qp.ik.limits.Gate` checks the whole displacement afterwards.

Rows are linearised where a sample starts, and hold for its whole displacement: a later iteration of
the QP has what the ones before it left. So distances are measured once a sample, where it ends, for
the check and for the rows of the next one. Where there is a horizon, a pair is measured if another
step like the last one may bring it to its margin, or if its path is not clear by travel alone.

A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
changes by at most its `travel` on a straight path in joint space, the sum of levers times turns.
What is known in one posture bounds it in another. A pair is measured again only if that bound and,
where many are due, the gap between its bounding balls are within a horizon.

Between two points of a path at which a distance is `a` and `b`, it is never below

    (a + b - travel) / 2.

Near pairs need more. Let n go from the normal at the one point to that at the other in proportion
to the path, in the axes of the last joint that moves both shapes. Two convex shapes are at least as
far apart as along n, which has no more than unit length. For each two points of theirs, the second
derivative of that is at most `(2 |change of n| + S) travel`, with S the sum of the turns between
the shapes. In those axes n changes by at most its change in the world and the sum C of the turns
that both shapes share. So the distance is never below

    min(a, b) - (2 |change of n in the world| + 2 C + S) travel / 8.

Where that does not suffice, the path is halved, until it does or a point of it is too near.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.configuration import Configuration, Placements, moved_by
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs, named_pairs
from handmap_qp.ik.limits import Rows

KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start, where a path is measured; and
not nearer than half of it between [m]."""
# GJK starts from the last result of the pair. With coal's 1e-6 the answer depends on it by as much.
_TOLERANCE = 1e-9
# Balls are quicker than distances where more pairs than this are due.
_FEW = 20
# Points of a path that are measured, at most; a path that needs more counts as not clear.
_MOST_POINTS = 30
_YZX = [1, 2, 0]
_ZXY = [2, 0, 1]
# Part of the free distance that one step may use.
_GAIN = 0.85
# Where there is a horizon, pairs get rows that may be within their margin, this distance [m], and
# what links approach each other by in a sample at this speed [m/s].
_NEAR, _APPROACH = 0.001, 0.5
# They approach by no more than this part of their travel in the last sample.
_EXPECTED = 0.25


class NearPairs(NamedTuple):
    """What is known of all pairs of shapes in one posture, k of them.

    Attributes:
        q: Pinocchio configuration of the posture, shape (nq,).
        bounds: Lower bounds of the distances of all pairs [m], shape (k,).
        pairs: Indices of the measured pairs, increasing, shape (r,).
        found: Signed distance, normal from the first to the second shape, and nearest point of the
            first shape, shape (k, 7). NaN where a pair is not measured.
        is_open: Which pairs travel alone does not show to be apart on the whole path from the
            posture before, shape (k,).
    """

    q: np.ndarray
    bounds: np.ndarray
    pairs: np.ndarray
    found: np.ndarray
    is_open: np.ndarray


class ShapeDistances:
    """Measures signed distances of pairs of shapes.

    Args:
        model: The hand's model.
        geometry: Its collision shapes and pairs.

    Attributes:
        levers: Bound of the change of each pair's distance per change of each velocity coordinate
            [m/rad, or 1 for sliding joints], shape (k, nv); 0 for coordinates that move both shapes
            of a pair or neither.
        turns: Bound of `S + 2 C` of each pair per change of each coordinate, shape (k, nv).
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self._model = model
        self._geometry = geometry
        self._data = model.createData()
        self._shapes = geometry.createData()
        for request in self._shapes.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        self.levers, self.turns = _pair_motions(model, geometry)
        shapes = geometry.geometryObjects
        pairs = geometry.collisionPairs
        self._placed = Placements(self._shapes.oMg)
        balls = [
            (*shape.geometry.aabb_center, shape.geometry.aabb_radius)
            for shape in shapes
        ]
        self._balls = np.array(balls).reshape(-1, 4)
        self._first = np.array([pair.first for pair in pairs], dtype=int)
        self._second = np.array([pair.second for pair in pairs], dtype=int)

    def __reduce__(self) -> tuple[Any, ...]:
        """Build copies with data of their own."""
        return ShapeDistances, (self._model, self._geometry)

    def travel(self, before: np.ndarray, q: np.ndarray) -> np.ndarray:
        """Return by how much each distance changes at most between two postures [m], shape (k,)."""
        return self.levers.dot(np.abs(pin.difference(self._model, before, q)))

    def measure(
        self,
        q: np.ndarray,
        bounds: np.ndarray | float = -np.inf,
        horizon: np.ndarray | float = np.inf,
        *,
        is_path: bool = False,
    ) -> NearPairs:
        """Measure the pairs that may be within a horizon.

        Args:
            q: Pinocchio configuration, shape (nq,).
            bounds: Lower bounds of all distances there, of each pair [m], shape (k,): what was
                known in another posture, minus the travel from there.
            horizon: Distance up to which pairs are measured [m], of each pair or one for all; at
                least `KEPT`.
            is_path: Whether the hand came on a straight path from there, on which pairs may have
                touched that are apart here.
        """
        known = np.full(len(self.levers), bounds)
        # The bound is a - t, with the distance a before and the travel t. On the path from a to b,
        # it is never below (a + b - t) / 2.
        open_below = KEPT - known if is_path else np.full(len(known), -np.inf)
        self._place(q)
        due = np.flatnonzero(known <= horizon)
        if len(due) > _FEW:
            gaps = self._ball_gaps()[due]
            known[due] = np.maximum(known[due], gaps)
            due = due[gaps <= np.maximum(horizon, open_below)[due]]
        found = np.full((len(known), 7), np.nan)
        found[due] = self._compute(due)
        is_open = found[:, 0] < open_below
        known[due] = found[due, 0]
        return NearPairs(q.copy(), known, due, found, is_open)

    def _found_at(self, q: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Return what is found of some pairs in a posture; as of `NearPairs`, shape (r, 7)."""
        self._place(q)
        return self._compute(pairs)

    def _place(self, q: np.ndarray) -> None:
        pin.updateGeometryPlacements(
            self._model, self._data, self._geometry, self._shapes, q
        )

    def _ball_gaps(self) -> np.ndarray:
        """Return the distances of the bounding balls of all placed pairs [m], shape (k,)."""
        centres = self._placed.points(self._balls[:, :3])
        radii = self._balls[:, 3]
        apart = centres[self._first] - centres[self._second]
        return _norms(apart) - radii[self._first] - radii[self._second]

    def _compute(self, pairs: np.ndarray) -> np.ndarray:
        """Return distance, normal and first nearest point of some placed pairs, shape (r, 7)."""
        results = [
            pin.computeDistance(self._geometry, self._shapes, k) for k in pairs.tolist()
        ]
        found = np.empty((len(pairs), 7))
        found[:, 0] = [result.min_distance for result in results]
        if results:
            vectors = [
                part
                for each in results
                for part in (each.normal, each.getNearestPoint1())
            ]
            found[:, 1:] = np.concatenate(vectors).reshape(-1, 6)
        return found

    def is_clear(
        self, start: NearPairs, step: np.ndarray, end: NearPairs | None = None
    ) -> bool:
        """Return whether no pair of shapes touches on a straight path.

        Pairs that touch at the start already are left out.

        Args:
            start: The pairs where it begins.
            step: The path in the model's tangent space [rad or m], shape (nv,).
            end: The pairs where it ends, as measured next; measured if omitted.
        """
        turns = np.abs(step)
        if end is None:
            reached = pin.integrate(self._model, start.q, step)
            end = self.measure(
                reached, start.bounds - self.levers.dot(turns), KEPT, is_path=True
            )
        pairs = np.flatnonzero(end.is_open)
        if not len(pairs):
            return True
        before = start.found[pairs]
        after = end.found[pairs]
        is_new = np.isnan(before[:, 0])
        if is_new.any():
            before[is_new] = self._found_at(start.q, pairs[is_new])
        is_apart = before[:, 0] > 0.0
        pairs = pairs[is_apart]
        before = before[is_apart]
        after = after[is_apart]
        kept = np.minimum(before[:, 0], KEPT)
        if (after[:, 0] < kept).any():
            return False
        travel = self.levers[pairs].dot(turns)
        bend = self.turns[pairs].dot(turns)
        # Parts of the path that are not shown to be clear: ends, pairs, and what was found there.
        parts = [(0.0, 1.0, np.arange(len(pairs)), before, after)]
        taken = 0
        while parts:
            low, high, those, before, after = parts.pop()
            nearest = np.minimum(before[:, 0], after[:, 0])
            length = high - low
            turned = 2.0 * _norms(after[:, 1:4] - before[:, 1:4])
            turned += length * bend[those]
            is_open = (
                nearest - 0.125 * turned * length * travel[those] < 0.5 * kept[those]
            )
            if not is_open.any():
                continue
            if taken == _MOST_POINTS:
                return False
            those = those[is_open]
            before = before[is_open]
            after = after[is_open]
            middle = 0.5 * (low + high)
            taken = taken + 1
            between = self._found_at(
                pin.integrate(self._model, start.q, middle * step), pairs[those]
            )
            if (between[:, 0] < kept[those]).any():
                return False
            parts += (
                (middle, high, those, between, after),
                (low, middle, those, before, between),
            )
        return True


def _norms(vectors: np.ndarray) -> np.ndarray:
    return np.sqrt(np.einsum("ij,ij->i", vectors, vectors))


def _pair_motions(
    model: pin.Model, geometry: pin.GeometryModel
) -> tuple[np.ndarray, np.ndarray]:
    """Return levers and turns of `ShapeDistances`, shape (k, nv) each."""
    shapes = geometry.geometryObjects
    pairs = geometry.collisionPairs
    levers = np.array([_levers(model, shape) for shape in shapes]).reshape(-1, model.nv)
    moved = moved_by(model, [shape.parentJoint for shape in shapes])
    first = [pair.first for pair in pairs]
    second = [pair.second for pair in pairs]
    is_between = moved[first] != moved[second]
    turning = np.concatenate(
        [_motions(joint)[3:].any(axis=0) for joint in list(model.joints)[1:]]
    )
    has_sliding = (is_between & ~turning).any(axis=1)
    # Sliding between the shapes doubles the acceleration that turns give their points.
    relative = is_between * turning * (1.0 + has_sliding)[:, None]
    common = moved[first] * moved[second] * turning
    # A coordinate that moves both shapes carries them together.
    return (levers[first] + levers[second]) * is_between, relative + 2.0 * common


def _motions(joint: pin.JointModel) -> np.ndarray:
    """Return the motion of each coordinate in the joint's own axes, linear first, shape (6, nv)."""
    return np.reshape(joint.createData().S, (6, joint.nv))


def _levers(model: pin.Model, shape: pin.GeometryObject) -> np.ndarray:
    """Bound the speed of a shape's points per speed of each coordinate, shape (nv,).

    No lever is shorter than those of joints nearer to the shape. So times a turn of its joint, it
    bounds what that turn changes in the velocities due to those joints, too.
    """
    levers = np.zeros(model.nv)
    joint = shape.parentJoint
    longest = 0.0
    points, radius = _extent(shape)
    # Largest distance of a point of the shape from the joint's origin.
    reach = float(np.linalg.norm(points, axis=1).max()) + radius
    while joint > 0:
        found = model.joints[joint]
        axes = _motions(found)[3:].T
        is_sliding = not axes.any()
        if is_sliding:
            limits = model.lowerPositionLimit, model.upperPositionLimit
            reach += max(abs(float(limit[found.idx_q])) for limit in limits)
        elif found.nv == 1:
            # The part of an offset along an axis does not move when the joint turns.
            across = (
                float(np.linalg.norm(np.cross(points, axes), axis=1).max()) + radius
            )
            longest = max(longest, min(across, reach))
        else:
            longest = max(longest, reach)
        levers[found.idx_v : found.idx_v + found.nv] = 1.0 if is_sliding else longest
        # From the parent's origin, the shape is within the joint's offset and that reach.
        points = model.jointPlacements[joint].translation[None]
        radius = reach
        reach += float(np.linalg.norm(points))
        joint = model.parents[joint]
    return levers


def _extent(shape: pin.GeometryObject) -> tuple[np.ndarray, float]:
    """Return points and a radius about them within which a shape is, in its joint's frame.

    The corners of its bounding box, or the centre of its bounding ball if that is smaller.
    """
    geometry = shape.geometry
    place = shape.placement
    geometry.computeLocalAABB()
    least = geometry.aabb_local.min_
    most = geometry.aabb_local.max_
    if np.linalg.norm(most - least) / 2.0 > 1.001 * geometry.aabb_radius:
        points = geometry.aabb_center[None]
        radius = float(geometry.aabb_radius)
    else:
        points = np.where(list(np.ndindex(2, 2, 2)), most, least)
        radius = 0.0
    return points @ place.rotation.T + place.translation, radius


class CollisionLimit:
    """Rows that keep pairs of collision shapes apart.

    Args:
        hand: The hand.
        pairs: The pairs to keep apart; those that the hand's description names if omitted.
        horizon: Pairs that are farther apart than their margin and this get no row [m]; in short
            samples the horizon is nearer, as links do not come that far. Infinite by default: every
            pair has a row, in an order that never changes.

    Attributes:
        pairs: The links of each pair; a link with several shapes has several.
        margin: Distance to keep [m].
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (n,). The others, such as those of a floating wrist, change no distance.

    Raises:
        InvalidOptionsError: If the hand names no pairs.
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """

    def __init__(
        self, hand: Hand, *, pairs: ShapePairs | None = None, horizon: float = np.inf
    ) -> None:
        spec = hand.spec.collision
        if pairs is None:
            if spec is None:
                raise InvalidOptionsError(
                    option="avoids_self_collision",
                    problem=f"{hand.name} names no links to keep apart",
                    advice="add collision.pairs to its hand.yaml",
                )
            pairs = named_pairs(hand, spec.pairs)
        self.margin = spec.margin if spec else 0.0
        self.pairs = pairs.links
        self._horizon = horizon
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._distances = ShapeDistances(hand.model, pairs.geometry)
        levers = self._distances.levers
        if self._expansion is not None:
            levers = levers @ np.abs(self._expansion)
        self.columns: np.ndarray = np.any(levers > 0.0, axis=0)
        pairs_of = pairs.geometry.collisionPairs
        shapes = pairs.geometry.geometryObjects
        supports = moved_by(hand.model, [shape.parentJoint for shape in shapes])
        first, second = (
            [getattr(pair, end) for pair in pairs_of] for end in ("first", "second")
        )
        self._opposing_support = supports[first] - supports[second]

    def distances(self, configuration: Configuration) -> np.ndarray:
        """Return signed distances of all pairs [m], negative where shapes overlap, shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        return self._distances.measure(configuration.q).bounds

    def measure(
        self,
        q: np.ndarray,
        dt: float = np.inf,
        margins: np.ndarray | None = None,
        *,
        before: NearPairs | None = None,
        after_step: bool = False,
    ) -> NearPairs:
        """Measure the pairs that get rows, and those that may have touched since another posture.

        Args:
            q: Pinocchio configuration, shape (nq,).
            dt: Time of the sample [s], in which links approach each other.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.
            before: What is known in another posture; nothing if omitted.
            after_step: Whether `q` ends a sample that began at `before`, and the next one is
                expected to move as far.
        """
        reach = np.inf if self._horizon == np.inf else _NEAR + _APPROACH * dt
        reach = max(min(reach, self._horizon), KEPT)
        bounds = -np.inf
        if before is not None:
            travel = self._distances.travel(before.q, q)
            bounds = before.bounds - travel
            if after_step and reach < np.inf:
                reach = np.minimum(_NEAR + _EXPECTED * travel, reach)
        horizon = (self.margin if margins is None else margins) + reach
        return self._distances.measure(q, bounds, horizon, is_path=after_step)

    def is_clear(
        self, start: NearPairs, displacement: np.ndarray, end: NearPairs | None = None
    ) -> bool:
        """Return whether no pair of shapes touches on a straight path.

        Args:
            start: The pairs where it begins.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
            end: The pairs where it ends, as measured next; measured if omitted.
        """
        step = (
            displacement
            if self._expansion is None
            else self._expansion.dot(displacement)
        )
        return self._distances.is_clear(start, step, end)

    def rows(
        self,
        configuration: Configuration,
        near: NearPairs,
        margins: np.ndarray | None = None,
    ) -> Rows:
        """Linearise the distances of the measured pairs as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            near: What `measure` found there.
            margins: Distance that each of all pairs keeps [m], shape (k,); `margin` if omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        pairs = near.pairs
        normals = near.found[pairs, 1:4]
        points = near.found[pairs, 4:]
        # np.cross takes five times as long.
        moments = (
            points[:, _YZX] * normals[:, _ZXY] - points[:, _ZXY] * normals[:, _YZX]
        )
        wrenches = np.hstack([normals, moments])
        G = self._opposing_support[pairs] * wrenches.dot(configuration.joint_jacobian())
        kept = self.margin if margins is None else margins[pairs]
        return configuration.contracted(G), _GAIN * (near.bounds[pairs] - kept)
