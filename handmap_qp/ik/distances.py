"""Distances between collision shapes by coal, only where they can be small.

A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
changes by at most its `travel` from one posture to another, the sum of levers times turns, and what
was known at the one bounds it at the other. A pair is measured again only if that bound and the gap
between its bounding balls are both within a horizon.

All pairs are measured in one call of Pinocchio. Its results are read through views of its memory,
because reading them one by one takes longer than the measurement.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import CROSS, Configuration
from handmap_qp.hands.placements import homogeneous, moved_by, placement_views
from handmap_qp.transform import frozen, lengths

# GJK starts from the last result of the pair. With coal's 1e-6 the answer depends on it by as much.
_TOLERANCE = 1e-9


class Gaps(NamedTuple):
    """Some pairs of shapes in one posture, r of them.

    Attributes:
        distances: Signed distances, negative where shapes overlap [m], shape (r,).
        normals: Unit normals from the first to the second shape, in the world, shape (r, 3).
    """

    distances: np.ndarray
    normals: np.ndarray


class NearPairs(NamedTuple):
    """All pairs of shapes in one posture, k of them, and which are near.

    Attributes:
        pairs: Indices of the pairs within the horizon, increasing, shape (r,).
        bounds: Lower bounds of the distances of all pairs [m], shape (k,).
        is_measured: Where the bound is the distance, near pairs among them, shape (k,).
        found: Distance, normal and first nearest point, where they were measured, shape (k, 7).
    """

    pairs: np.ndarray
    bounds: np.ndarray
    is_measured: np.ndarray
    found: np.ndarray

    @property
    def distances(self) -> np.ndarray:
        """Signed distances of the near pairs [m], shape (r,)."""
        return self.bounds[self.pairs]

    @property
    def wrenches(self) -> np.ndarray:
        """Of each near pair `(n, p x n)`, shape (r, 6).

        The unit force along the normal from the first to the second shape, and its moment about the
        world's origin.
        """
        found = self.found[self.pairs]
        wrenches, normals = found[:, 1:].copy(), found[:, 1:4]
        # Rows of -[p]x: np.cross takes three times as long.
        crosses = found[:, 4:].dot(CROSS).reshape(-1, 3, 3)
        wrenches[:, 3:] = np.matmul(normals[:, None], crosses)[:, 0]
        return wrenches

    def gaps(self, pairs: np.ndarray) -> Gaps:
        """Return pairs that were measured."""
        return Gaps(self.bounds[pairs], self.found[pairs, 1:4])

    def add(self, pairs: np.ndarray, results: np.ndarray) -> None:
        """Note what was measured of further pairs.

        Args:
            pairs: Indices of the pairs, shape (r,).
            results: Distance, normal and first nearest point of each, shape (r, 7).
        """
        self.found[pairs], self.bounds[pairs] = results, results[:, 0]
        self.is_measured[pairs] = True


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
        self._distances = self._results[:, 0]
        self._is_active = np.ones(len(pairs), dtype=bool)
        # What is known in the last posture.
        self._q = pin.neutral(model)
        self._posture = b""
        self._bounds = np.full(len(pairs), -np.inf)
        self._is_measured = np.zeros(len(pairs), dtype=bool)
        self._found = np.empty((len(pairs), 7))
        # A posture of its own, for ways between samples.
        self._elsewhere = model.createData()

    def measure(self, configuration: Configuration, horizon: np.ndarray | float) -> NearPairs:
        """Measure the pairs within a horizon.

        Args:
            configuration: Of the hand, placed.
            horizon: Distance up to which pairs are measured [m], of each pair, shape (k,), or one
                for all.
        """
        self._go_to(configuration.q)
        due = ((self._bounds <= horizon) & ~self._is_measured).nonzero()[0]
        if len(due):
            self._refresh(configuration, due, horizon)
        pairs = (self._bounds <= horizon).nonzero()[0]
        return NearPairs(pairs, self._bounds, self._is_measured, self._found)

    def _go_to(self, q: np.ndarray) -> None:
        """Bound all distances in another posture."""
        posture = q.tobytes()
        if posture == self._posture:
            return
        turns = np.abs(q[self._joints] - self._q[self._joints])
        # New arrays: those of the last posture may be in use.
        self._bounds = self._bounds - self._joint_levers.dot(turns)
        count = len(self._bounds)
        self._is_measured = np.zeros(count, dtype=bool)
        self._found = np.empty((count, 7))
        self._q, self._posture = q.copy(), posture

    def _refresh(
        self, configuration: Configuration, due: np.ndarray, horizon: np.ndarray | float
    ) -> None:
        """Bound the distances of some pairs by their balls, and measure those that may be near."""
        data = configuration.data
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)
        gaps = self._ball_gaps(due)
        is_near = gaps <= (horizon[due] if isinstance(horizon, np.ndarray) else horizon)
        self._bounds[due] = np.maximum(self._bounds[due], gaps)
        near = due[is_near]
        self._found[near] = results = self._compute(near)
        self._bounds[near], self._is_measured[near] = results[:, 0], True

    def measure_all(self, configuration: Configuration) -> np.ndarray:
        """Return the signed distances of all pairs [m], shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        data = configuration.data
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)
        return self._compute(np.arange(len(self._is_active)))[:, 0]

    def gaps_at(self, q: np.ndarray, pairs: np.ndarray) -> Gaps:
        """Measure some pairs in any posture, as `results_at`."""
        results = self.results_at(q, pairs)
        return Gaps(results[:, 0], results[:, 1:4])

    def results_at(self, q: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        """Measure some pairs in any posture, without changing what is known of the last one.

        Args:
            q: Pinocchio configuration, shape (nq,).
            pairs: Indices of the pairs, shape (r,).

        Returns:
            Distance, normal and first nearest point of each, shape (r, 7).
        """
        self._place_elsewhere(q)
        return self._compute(pairs)

    def bound_at(self, q: np.ndarray, bounds: np.ndarray) -> NearPairs:
        """Bound all pairs in any posture by their balls; none is measured.

        Args:
            q: Pinocchio configuration, shape (nq,).
            bounds: Lower bounds that are known there [m], shape (k,).
        """
        self._place_elsewhere(q)
        count = len(bounds)
        gaps = self._ball_gaps(np.arange(count))
        nothing = np.zeros(0, dtype=int)
        is_measured, found = np.zeros(count, dtype=bool), np.empty((count, 7))
        return NearPairs(nothing, np.maximum(bounds, gaps), is_measured, found)

    def _place_elsewhere(self, q: np.ndarray) -> None:
        pin.forwardKinematics(self._model, self._elsewhere, q)
        pin.updateGeometryPlacements(self._model, self._elsewhere, self._geometry, self._data)

    def _ball_gaps(self, pairs: np.ndarray) -> np.ndarray:
        """Return the distances of the bounding balls of some pairs [m], shape (r,)."""
        centres = self._placed.points(self._centres)
        first, second = centres.take(self._first[pairs], 0), centres.take(self._second[pairs], 0)
        return lengths(first - second) - self._radii[pairs]

    def _compute(self, pairs: np.ndarray) -> np.ndarray:
        """Return distance, normal and first nearest point of some placed pairs, shape (r, 7)."""
        wanted = np.zeros(len(self._is_active), dtype=bool)
        wanted[pairs] = True
        changed = (wanted != self._is_active).nonzero()[0]
        for k in changed.tolist():
            if wanted[k]:
                self._data.activateCollisionPair(k)
            else:
                self._data.deactivateCollisionPair(k)
        self._is_active = wanted
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
    levers = np.array([_levers(model, shape) for shape in shapes]).reshape(-1, model.nv)
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


def _levers(model: pin.Model, shape: pin.GeometryObject) -> np.ndarray:
    """Bound the speed of a shape's points per speed of each coordinate, shape (nv,)."""
    levers, joint = np.zeros(model.nv), shape.parentJoint
    shape.geometry.computeLocalAABB()
    centre = shape.placement.act(shape.geometry.aabb_center)
    # Largest distance of a point of the shape from the joint's origin.
    reach = float(np.linalg.norm(centre)) + shape.geometry.aabb_radius
    while joint > 0:
        found, v = model.joints[joint], model.joints[joint].idx_v
        is_sliding = _is_sliding(found)
        levers[v : v + found.nv] = 1.0 if is_sliding else reach
        if is_sliding:
            limits = model.lowerPositionLimit, model.upperPositionLimit
            reach += max(abs(float(limit[found.idx_q])) for limit in limits)
        reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = model.parents[joint]
    return levers
