"""Distances between collision shapes by coal, only where they can be small.

A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
changes by at most its `travel` from one posture to another, the sum of levers times turns, and what
was known at the one bounds it at the other. A pair is measured again only if that bound and, where
many are due, the gap between its bounding balls are within a horizon.

All pairs are measured in one call of Pinocchio. Its results are read through views of its memory,
because reading them one by one takes longer than the measurement.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.placements import homogeneous, moved_by, placement_views
from handmap_qp.se3 import frozen, lengths

# Columns of `NearPairs.found` whose products make `(n, p x n)`: those of the first row, from the
# fourth on times those of the second, summed by the matrix. np.cross takes three times as long.
_FACTORS = np.array([1, 2, 3, 5, 6, 4, 6, 4, 5]), np.array([3, 1, 2, 2, 3, 1])
_SUMS = np.zeros((9, 6))
_SUMS[range(6), range(6)], _SUMS[range(6, 9), range(3, 6)] = 1.0, -1.0
KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start, where a way is measured; and
not nearer than half of it between [m]."""
# GJK starts from the last result of the pair. With coal's 1e-6 the answer depends on it by as much.
_TOLERANCE = 1e-9
# Balls are quicker than distances where more pairs than this are due.
_FEW = 20


class NearPairs(NamedTuple):
    """What is known of all pairs of shapes in one posture, k of them.

    Attributes:
        q: Pinocchio configuration of the posture, shape (nq,).
        bounds: Lower bounds of the distances of all pairs [m], shape (k,).
        pairs: Indices of the measured pairs, increasing, shape (r,).
        found: Distance, normal and first nearest point of each, shape (r, 7). Normals go from the
            first to the second shape; distances are negative where shapes overlap.
        is_open: Which of them travel alone does not show to be apart on the whole way from the
            posture before, shape (r,). It shows so of all pairs that are not measured.
    """

    q: np.ndarray
    bounds: np.ndarray
    pairs: np.ndarray
    found: np.ndarray
    is_open: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """Signed distances of the measured pairs [m], shape (r,)."""
        return self.found[:, 0]

    @property
    def wrenches(self) -> np.ndarray:
        """Of each measured pair `(n, p x n)`, shape (r, 6).

        The unit force along the normal from the first to the second shape, and its moment about the
        world's origin.
        """
        products = self.found.take(_FACTORS[0], 1)
        products[:, 3:] *= self.found.take(_FACTORS[1], 1)
        return products.dot(_SUMS)

    def places(self, pairs: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
        """Return where pairs are among the measured ones, shape (r,).

        And which of them are there, shape (r,); None for all.
        """
        if not len(self.pairs):
            return np.zeros(len(pairs), dtype=int), np.zeros(len(pairs), dtype=bool)
        places = self.pairs.searchsorted(pairs)
        there = self.pairs.take(places, mode="clip")
        # Whole arrays compare fastest as bytes.
        return places, None if there.tobytes() == pairs.tobytes() else there == pairs


class ShapeDistances:
    """Measures signed distances of pairs of shapes.

    Args:
        model: The hand's model.
        geometry: Its collision shapes and pairs.

    Attributes:
        levers: Bound of the change of each pair's distance per change of each velocity coordinate
            [m/rad, or 1 for sliding joints], shape (k, nv); 0 for coordinates that move both shapes
            of a pair or neither.
        relative_turns: Where a coordinate turns one shape of a pair and not the other 1, or 2 if
            another one between the two slides, shape (k, nv). Times travel and turns, that bounds
            the acceleration of a point of the one shape seen from the other on a straight way.
        common_turns: 1 where a coordinate turns both, shape (k, nv).
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self._model, self._geometry = model, geometry
        self._data = geometry.createData()
        for request in self._data.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        shapes, pairs = geometry.geometryObjects, geometry.collisionPairs
        self.levers, self.relative_turns, self.common_turns = _pair_motions(model, geometry)
        # The first joint of a floating hand has seven coordinates and six speeds, and its levers
        # are 0. All other joints have one of each.
        is_floating = model.njoints > 1 and model.joints[1].nq == 7
        self._joints = slice(7 if is_floating else 0, None)
        self._joint_levers = np.ascontiguousarray(self.levers[:, 6 if is_floating else 0 :])
        self._first = np.array([pair.first for pair in pairs], dtype=int)
        self._second = np.array([pair.second for pair in pairs], dtype=int)
        centres = np.array([shape.geometry.aabb_center for shape in shapes]).reshape(-1, 3)
        self._centres = homogeneous(centres)
        radii = np.array([shape.geometry.aabb_radius for shape in shapes])
        self._radii = radii[self._first] + radii[self._second]
        self._placed = placement_views(self._data.oMg)
        _check_results(model, geometry)
        self._results = _view_results(self._data)
        self._active = set(range(len(pairs)))
        # A posture of its own, for ways between samples.
        self._elsewhere = model.createData()

    def __reduce__(self) -> tuple[Any, ...]:
        """Build copies anew: results are views of coal's memory."""
        return ShapeDistances, (self._model, self._geometry)

    def measure(
        self,
        configuration: Configuration,
        horizon: np.ndarray | float,
        before: NearPairs | None = None,
    ) -> NearPairs:
        """Measure the pairs that may be within a horizon.

        Args:
            configuration: Of the hand, placed.
            horizon: Distance up to which pairs are measured [m], of each pair, shape (k,), or one
                for all.
            before: What is known in another posture; nothing if omitted.
        """
        q = configuration.q.copy()
        if before is None:
            bounds = np.full(len(self._radii), -np.inf)
        else:
            turns = np.abs(q[self._joints] - before.q[self._joints])
            bounds = before.bounds - self._joint_levers.dot(turns)
        return self._measure(configuration.data, q, bounds, horizon, is_way=False)

    def follow(
        self,
        configuration: Configuration,
        horizon: np.ndarray | float,
        start: NearPairs,
        travel: np.ndarray,
    ) -> NearPairs:
        """Measure the pairs that may be within a horizon, or may have touched on a way.

        Args:
            configuration: Of the hand, placed where the way ends.
            horizon: As of `measure`, at least `KEPT`.
            start: The pairs where it begins.
            travel: By how much each distance changes on it at most [m], shape (k,).
        """
        q, bounds = configuration.q.copy(), start.bounds - travel
        return self._measure(configuration.data, q, bounds, horizon, is_way=True)

    def follow_to(self, q: np.ndarray, start: NearPairs, travel: np.ndarray) -> NearPairs:
        """Measure the pairs that may have touched on a way to any posture.

        Args:
            q: Pinocchio configuration where the way ends, shape (nq,).
            start: The pairs where it begins.
            travel: By how much each distance changes on it at most [m], shape (k,).
        """
        pin.forwardKinematics(self._model, self._elsewhere, q)
        return self._measure(self._elsewhere, q, start.bounds - travel, KEPT, is_way=True)

    def _measure(
        self,
        data: pin.Data,
        q: np.ndarray,
        bounds: np.ndarray,
        horizon: np.ndarray | float,
        *,
        is_way: bool,
    ) -> NearPairs:
        due = (bounds <= horizon).nonzero()[0]
        self._place(data)
        # The bound is a - t, with the distance a before and the travel t. On the way from a to b,
        # it is never below (a + b - t) / 2.
        open_below = KEPT - bounds.take(due) if is_way else np.full(len(due), -np.inf)
        if len(due) > _FEW:
            gaps = self._ball_gaps(due)
            bounds[due] = np.maximum(bounds.take(due), gaps)
            within = horizon.take(due) if isinstance(horizon, np.ndarray) else horizon
            is_near = gaps <= np.maximum(within, open_below)
            due, open_below = due.compress(is_near), open_below.compress(is_near)
        found = self._compute(due)
        distances = found[:, 0]
        bounds[due] = distances
        return NearPairs(q, bounds, due, found, distances < open_below)

    def measure_all(self, configuration: Configuration) -> np.ndarray:
        """Return the signed distances of all pairs [m], shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        self._place(configuration.data)
        return self._compute(np.arange(len(self._radii)))[:, 0]

    def found_at(self, q: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Measure some pairs in any posture.

        Args:
            q: Pinocchio configuration, shape (nq,).
            pairs: Indices of the pairs, shape (r,).

        Returns:
            Distance, normal and first nearest point of each, shape (r, 7).
        """
        pin.forwardKinematics(self._model, self._elsewhere, q)
        self._place(self._elsewhere)
        return self._compute(pairs)

    def _place(self, data: pin.Data) -> None:
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)

    def _ball_gaps(self, pairs: np.ndarray) -> np.ndarray:
        """Return the distances of the bounding balls of some pairs [m], shape (r,)."""
        centres = self._placed.points(self._centres)
        first, second = (centres.take(ends.take(pairs), 0) for ends in (self._first, self._second))
        return lengths(first - second) - self._radii.take(pairs)

    def _compute(self, pairs: np.ndarray) -> np.ndarray:
        """Return distance, normal and first nearest point of some placed pairs, shape (r, 7)."""
        wanted = set(pairs.tolist())
        for k in self._active - wanted:
            self._data.deactivateCollisionPair(k)
        for k in wanted - self._active:
            self._data.activateCollisionPair(k)
        self._active = wanted
        if wanted:
            pin.computeDistances(self._geometry, self._data)
        return self._results[pairs]


@lru_cache(maxsize=32)
def _check_results(model: pin.Model, geometry: pin.GeometryModel) -> None:
    """Check once for each hand that results can be read through a view.

    On data of its own: GJK would start from the results of the check.
    """
    trial = geometry.createData()
    pin.updateGeometryPlacements(model, model.createData(), geometry, trial, pin.neutral(model))
    pin.computeDistances(geometry, trial)
    read = [
        [result.min_distance, *result.normal.tolist(), *result.getNearestPoint1().tolist()]
        for result in trial.distanceResults
    ]
    if not np.array_equal(_view_results(trial), np.array(read).reshape(-1, 7)):
        raise RuntimeError("coal's distance, normal and nearest point do not lie side by side")


def _view_results(data: pin.GeometryData) -> np.ndarray:
    """View all results as an array that follows every measurement.

    Distance, normal and first nearest point lie in this order in coal's `DistanceResult`, and
    results are evenly spaced, which `_check_results` checks.

    Returns:
        Distance, normal and first nearest point of every pair, shape (k, 7), read-only.
    """
    results = data.distanceResults
    count = len(results)
    if not count:
        return np.zeros((0, 7))
    first, second = (
        results[i].normal.__array_interface__["data"][0] - 8 for i in (0, min(1, count - 1))
    )
    stride = second - first if count > 1 else 56
    if stride % 8:
        raise RuntimeError("coal's distances are not evenly spaced in memory")
    # The last result's block ends with its nearest point.
    doubles = ctypes.c_double * (stride * (count - 1) // 8 + 7)
    block = np.ctypeslib.as_array(doubles.from_address(first))
    return np.lib.stride_tricks.as_strided(block, (count, 7), (stride, 8), writeable=False)


@lru_cache(maxsize=32)
def _pair_motions(
    model: pin.Model, geometry: pin.GeometryModel
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return levers, relative turns and common turns of `ShapeDistances`, shape (k, nv) each."""
    shapes = geometry.geometryObjects
    axes = _axes(model)
    levers = np.array([_levers(model, axes, shape) for shape in shapes]).reshape(-1, model.nv)
    moved = moved_by(model, [shape.parentJoint for shape in shapes])
    first = [pair.first for pair in geometry.collisionPairs]
    second = [pair.second for pair in geometry.collisionPairs]
    is_between = moved[first] != moved[second]
    # A coordinate that moves both shapes carries them together.
    pair_levers = (levers[first] + levers[second]) * is_between
    turning = np.concatenate([_turning(joint) for joint in list(model.joints)[1:]])
    has_sliding = np.any(is_between & (turning == 0.0), axis=1)
    relative_turns = is_between * turning * (1.0 + has_sliding)[:, None]
    common_turns = moved[first] * moved[second] * turning
    return frozen(pair_levers), frozen(relative_turns), frozen(common_turns)


def _turning(joint: pin.JointModel) -> np.ndarray:
    """Return 1 for velocity coordinates of a joint that turn, 0 for those that slide, shape (nv,).

    A free-flyer slides first.
    """
    if _is_sliding(joint):
        return np.zeros(joint.nv)
    return np.repeat([0.0, 1.0], 3) if joint.nv == 6 else np.ones(joint.nv)


def _is_sliding(joint: pin.JointModel) -> bool:
    return joint.shortname().startswith("JointModelP")


def _levers(model: pin.Model, axes: np.ndarray, shape: pin.GeometryObject) -> np.ndarray:
    """Bound the speed of a shape's points per speed of each coordinate, shape (nv,).

    No lever is shorter than those of joints nearer to the shape. So times a turn of its joint, it
    bounds what that turn changes in the velocities due to those joints, too.

    Args:
        model: The hand's model.
        axes: Axis of each joint in its own frame, shape (njoints, 3); 0 if it has none or several.
        shape: The shape.
    """
    levers, joint, longest = np.zeros(model.nv), shape.parentJoint, 0.0
    points, radius = _extent(shape)
    # Largest distance of a point of the shape from the joint's origin.
    reach = float(np.linalg.norm(points, axis=1).max()) + radius
    while joint > 0:
        found, v, axis = model.joints[joint], model.joints[joint].idx_v, axes[joint]
        is_sliding = _is_sliding(found)
        if axis.any():
            # The part of an offset along an axis does not move when the joint turns.
            across = float(np.linalg.norm(np.cross(points, axis), axis=1).max()) + radius
            longest = max(longest, min(across, reach))
        elif not is_sliding:
            longest = max(longest, reach)
        levers[v : v + found.nv] = 1.0 if is_sliding else longest
        if is_sliding:
            limits = model.lowerPositionLimit, model.upperPositionLimit
            reach += max(abs(float(limit[found.idx_q])) for limit in limits)
        # From the parent's origin, the shape is within the joint's offset and that reach.
        points, radius = model.jointPlacements[joint].translation[None], reach
        reach += float(np.linalg.norm(points))
        joint = model.parents[joint]
    return levers


def _extent(shape: pin.GeometryObject) -> tuple[np.ndarray, float]:
    """Return points and a radius about them within which a shape is, in its joint's frame.

    The corners of its bounding box, or the centre of its bounding ball if that is smaller.
    """
    geometry, place = shape.geometry, shape.placement
    geometry.computeLocalAABB()
    least, most = geometry.aabb_local.min_, geometry.aabb_local.max_
    chosen = np.array(list(np.ndindex(2, 2, 2)))
    corners = np.where(chosen, most, least)
    if np.linalg.norm(most - least) / 2.0 > 1.001 * geometry.aabb_radius:
        corners, radius = geometry.aabb_center[None], float(geometry.aabb_radius)
    else:
        radius = 0.0
    return corners @ place.rotation.T + place.translation, radius


def _axes(model: pin.Model) -> np.ndarray:
    """Return the axis that each joint turns about, in its own frame, shape (njoints, 3).

    0 for joints that slide or have several axes.
    """
    data, axes = model.createData(), np.zeros((model.njoints, 3))
    jacobian = pin.computeJointJacobians(model, data, pin.neutral(model))
    for joint in range(1, model.njoints):
        if model.nvs[joint] == 1:
            axes[joint] = data.oMi[joint].rotation.T @ jacobian[3:, model.idx_vs[joint]]
    return axes
