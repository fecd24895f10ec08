"""Distances between collision shapes by coal, only where they can be small.

Two shapes whose bounding balls are farther apart than a horizon are not measured. All others are
measured in one call of Pinocchio. Its results are read through views of its memory, because reading
them one by one takes longer than the measurement.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.placements import homogeneous, placement_views
from handmap_qp.transform import lengths

# GJK starts from the last result of the pair. With coal's 1e-6 the answer depends on it by as much.
_TOLERANCE = 1e-9


class NearPairs(NamedTuple):
    """Pairs of shapes within the horizon, r of them.

    Attributes:
        pairs: Their indices, increasing, shape (r,).
        distances: Signed distances, negative where shapes overlap [m], shape (r,).
        wrenches: Unit force along the normal from the first to the second shape, and its moment
            about the world's origin: `(n, p x n)`, shape (r, 6).
        bounds: Lower bounds of the distances of all pairs [m], shape (k,).
        is_measured: Where the bound is the distance itself, shape (k,).
    """

    pairs: np.ndarray
    distances: np.ndarray
    wrenches: np.ndarray
    bounds: np.ndarray
    is_measured: np.ndarray


class ShapeDistances:
    """Measures signed distances of pairs of shapes.

    Args:
        model: The hand's model.
        geometry: Its collision shapes and pairs.
        horizon: Pairs farther apart than this are left out [m].
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel, horizon: float) -> None:
        self._model, self._geometry = model, geometry
        self._data = geometry.createData()
        for request in self._data.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        shapes, pairs = geometry.geometryObjects, geometry.collisionPairs
        for shape in shapes:
            shape.geometry.computeLocalAABB()
        self._first = np.array([pair.first for pair in pairs], dtype=int)
        self._second = np.array([pair.second for pair in pairs], dtype=int)
        centres = np.array([shape.geometry.aabb_center for shape in shapes]).reshape(-1, 3)
        self._centres = homogeneous(centres)
        radii = np.array([shape.geometry.aabb_radius for shape in shapes])
        self._radii, self._horizon = radii[self._first] + radii[self._second], horizon
        self._placed = placement_views(self._data.oMg)
        _check_results(model, geometry)
        self._results = _view_results(self._data)
        self._distances = self._results[:, 0]
        self._is_active = np.ones(len(pairs), dtype=bool)

    def measure(self, configuration: Configuration) -> NearPairs:
        """Measure the pairs within the horizon.

        Args:
            configuration: Of the hand, placed.
        """
        pin.updateGeometryPlacements(self._model, configuration.data, self._geometry, self._data)
        gaps = self._ball_gaps()
        may_be_near = gaps <= self._horizon
        self._activate(may_be_near)
        pin.computeDistances(self._geometry, self._data)
        bounds = np.where(may_be_near, self._distances, gaps)
        pairs = (bounds <= self._horizon).nonzero()[0]
        results = self._results[pairs]
        wrenches = results[:, 1:].copy()
        # np.cross takes three times as long.
        moments = results.take(_POINT_NEXT, 1) * results.take(_NORMAL_LAST, 1)
        moments -= results.take(_POINT_LAST, 1) * results.take(_NORMAL_NEXT, 1)
        wrenches[:, 3:] = moments
        return NearPairs(pairs, results[:, 0], wrenches, bounds, may_be_near)

    def measure_all(self, configuration: Configuration) -> np.ndarray:
        """Return the signed distances of all pairs [m], shape (k,).

        Args:
            configuration: Of the hand, placed.
        """
        pin.updateGeometryPlacements(self._model, configuration.data, self._geometry, self._data)
        self._activate(np.ones(len(self._is_active), dtype=bool))
        pin.computeDistances(self._geometry, self._data)
        return self._distances.copy()

    def measure_pairs(self, data: pin.Data, pairs: np.ndarray) -> np.ndarray:
        """Return the signed distances of some pairs [m], shape (r,).

        Args:
            data: Data of the hand's model, its joints placed.
            pairs: Indices of the pairs, shape (r,).
        """
        pin.updateGeometryPlacements(self._model, data, self._geometry, self._data)
        wanted = np.zeros(len(self._is_active), dtype=bool)
        wanted[pairs] = True
        self._activate(wanted)
        pin.computeDistances(self._geometry, self._data)
        return self._distances[pairs]

    def _ball_gaps(self) -> np.ndarray:
        """Return the distances of the bounding balls of all pairs [m], shape (k,)."""
        centres = self._placed.points(self._centres)
        return lengths(centres.take(self._first, 0) - centres.take(self._second, 0)) - self._radii

    def _activate(self, wanted: np.ndarray) -> None:
        """Choose the pairs that `computeDistances` measures."""
        changed = (wanted != self._is_active).nonzero()[0]
        for k in changed.tolist():
            if wanted[k]:
                self._data.activateCollisionPair(k)
            else:
                self._data.deactivateCollisionPair(k)
        self._is_active = wanted


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


# Columns of the results, in the order of the factors of p x n.
_NORMAL_NEXT, _NORMAL_LAST = np.array([2, 3, 1]), np.array([3, 1, 2])
_POINT_NEXT, _POINT_LAST = np.array([5, 6, 4]), np.array([6, 4, 5])
