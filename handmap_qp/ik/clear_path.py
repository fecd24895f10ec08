"""Whether shapes stay apart on a straight way in joint space, between its ends too.

A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
changes by at most `travel`, the sum of levers times turns S, and between two points of the way at
which it is `a` and `b`, it is never below

    (a + b - travel) / 2.

Where the distance d at the start does not suffice by itself, its derivative along the normal n
helps: seen from one shape, no point of the other comes nearer along n than

    d - n v - |n x w| r - S (travel + S (d + r)) / 2,

with v the relative displacement of the nearest point to first order, w the relative turn, and r the
diameter of the smaller shape's ball. Pairs that are still open are measured at the end of
the way, and it is halved until the first bound suffices, or a point of it is too near.
"""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.placements import moved_by
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.ik.distances import NearPairs, ShapeDistances
from handmap_qp.transform import frozen

_KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start [m]."""
_MOST_POINTS = 32
"""Points of a way that are measured, at most; a way that needs more counts as not clear."""


class PathStart(NamedTuple):
    """What is known of the pairs of shapes at the start of a way.

    Attributes:
        q: Pinocchio configuration, shape (nq,).
        near: The pairs within the horizon.
        jacobian: Spatial velocity at the world's origin per velocity of the model, shape (6, nv).
    """

    q: np.ndarray
    near: NearPairs
    jacobian: np.ndarray


class ClearPath:
    """Checks straight ways of a hand in joint space.

    Args:
        hand: The hand.
        shapes: Pairs of shapes that are kept apart.

    Attributes:
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (k,). The others, such as those of a floating wrist, change no distance.
    """

    def __init__(self, hand: Hand, shapes: ShapePairs) -> None:
        model, geometry = hand.model, shapes.geometry
        # The first joint of a floating hand is its free-flyer, of seven coordinates and six speeds.
        self._first_q, self._first_v = (7, 6) if hand.is_floating else (0, 0)
        self._expansion = None if hand.expansion is None else hand.expansion.matrix
        self._distances = ShapeDistances(model, geometry, np.inf)
        levers = _pair_levers(model, geometry)
        active = levers if self._expansion is None else levers @ np.abs(self._expansion)
        self.columns: np.ndarray = np.any(active > 0.0, axis=0)
        self._levers = levers
        shapes_of = geometry.geometryObjects
        first = [pair.first for pair in geometry.collisionPairs]
        second = [pair.second for pair in geometry.collisionPairs]
        moved = moved_by(model, [shape.parentJoint for shape in shapes_of])
        self._relative_support = moved[second] - moved[first]
        radii = np.array([shape.geometry.aabb_radius for shape in shapes_of])
        self._diameters = 2.0 * np.minimum(radii[first], radii[second])
        self._model, self._data = model, model.createData()

    def is_clear(self, start: PathStart, displacement: np.ndarray) -> bool:
        """Return whether no pair of shapes touches on a way.

        Pairs that touch at the start already are left out.

        Args:
            start: Where it begins.
            displacement: Displacement in the active coordinates [rad or m], shape (n,).
        """
        step = displacement if self._expansion is None else self._expansion.dot(displacement)
        turns = np.abs(step)
        travel, distances = self._levers.dot(turns), start.near.bounds
        is_open = (distances < travel + _KEPT) & (distances > 0.0)
        if not is_open.any():
            return True
        is_near = is_open[start.near.pairs].nonzero()[0]
        if len(is_near):
            pairs = start.near.pairs[is_near]
            lower = self._lower_bounds(start, is_near, step, travel[pairs])
            is_open[pairs] = lower < np.minimum(distances[pairs], _KEPT)
        pairs = is_open.nonzero()[0]
        if len(pairs) == 0:
            return True
        way = _Way(start.q, step[self._first_v :], self._first_q)
        before = distances[pairs]
        is_unknown = ~start.near.is_measured[pairs]
        if is_unknown.any():
            before[is_unknown] = self._measure(start.q, pairs[is_unknown])
        kept = np.minimum(_KEPT, before)
        after = self._measure(way.at(1.0), pairs)
        if (after < kept).any():
            return False
        return self._is_clear_between(way, pairs, (0.0, 1.0), (before, after), travel[pairs], kept)

    def _lower_bounds(
        self, start: PathStart, rows: np.ndarray, step: np.ndarray, travel: np.ndarray
    ) -> np.ndarray:
        """Bound the distances of near pairs on the whole way by their derivatives [m].

        Args:
            start: Where the way begins.
            rows: Indices of r pairs among `start.near`.
            step: Displacement of all of the model's velocity coordinates, shape (nv,).
            travel: Bound of the change of each distance [m], shape (r,).
        """
        pairs, wrenches = start.near.pairs[rows], start.near.wrenches[rows]
        distances, reach = start.near.distances[rows], self._diameters[pairs]
        twists = (self._relative_support[pairs] * step).dot(start.jacobian.T)
        normals, turns = wrenches[:, :3], twists[:, 3:]
        along = np.einsum("ij,ij->i", normals, turns)
        across = np.einsum("ij,ij->i", turns, turns) - along * along
        total = np.abs(self._relative_support[pairs]).dot(np.abs(step))
        return (
            distances
            + np.einsum("ij,ij->i", wrenches, twists)
            - np.sqrt(np.maximum(across, 0.0)) * reach
            - 0.5 * total * (travel + total * (distances + reach))
        )

    def _is_clear_between(
        self,
        way: _Way,
        pairs: np.ndarray,
        ends: tuple[float, float],
        distances: tuple[np.ndarray, np.ndarray],
        travel: np.ndarray,
        kept: np.ndarray,
    ) -> bool:
        """Halve a part of the way until the bound suffices for every pair.

        Args:
            way: The way.
            pairs: Indices of r pairs.
            ends: Where the part begins and ends, in [0, 1].
            distances: Of these pairs there [m], shape (r,) each.
            travel: Bound of the change of each distance along this part [m], shape (r,).
            kept: Distance that each pair keeps where it is measured [m], shape (r,).
        """
        open_ = (distances[0] + distances[1] - travel < kept).nonzero()[0]
        if len(open_) == 0:
            return True
        if way.points_taken >= _MOST_POINTS:
            return False
        low, high = ends
        pairs, travel, kept = pairs[open_], 0.5 * travel[open_], kept[open_]
        before, after = distances[0][open_], distances[1][open_]
        middle = 0.5 * (low + high)
        between = self._measure(way.at(middle), pairs)
        if (between < kept).any():
            return False
        return self._is_clear_between(
            way, pairs, (low, middle), (before, between), travel, kept
        ) and self._is_clear_between(way, pairs, (middle, high), (between, after), travel, kept)

    def _measure(self, q: np.ndarray, pairs: np.ndarray) -> np.ndarray:
        pin.forwardKinematics(self._model, self._data, q)
        return self._distances.measure_pairs(self._data, pairs)


class _Way:
    """A straight way of the joints; the wrist stays, because it changes no distance."""

    __slots__ = ("_first", "_start", "_step", "points_taken")

    def __init__(self, start: np.ndarray, step: np.ndarray, first: int) -> None:
        self._start, self._step, self._first = start, step, first
        self.points_taken = 0

    def at(self, part: float) -> np.ndarray:
        """Return the configuration after a part of the way, in [0, 1]."""
        self.points_taken += 1
        q = self._start.copy()
        q[self._first :] += part * self._step
        return q


@lru_cache(maxsize=32)
def _pair_levers(model: pin.Model, geometry: pin.GeometryModel) -> np.ndarray:
    """Bound the change of each pair's distance per change of each velocity coordinate.

    Returns:
        Levers [m/rad, or 1 for sliding joints], shape (k, nv); 0 for coordinates that move both
        shapes of a pair or neither.
    """
    shapes = geometry.geometryObjects
    levers = np.array([_levers(model, shape) for shape in shapes]).reshape(-1, model.nv)
    moved = moved_by(model, [shape.parentJoint for shape in shapes])
    first = [pair.first for pair in geometry.collisionPairs]
    second = [pair.second for pair in geometry.collisionPairs]
    # A coordinate that moves both shapes carries them together.
    return frozen((levers[first] + levers[second]) * (moved[first] != moved[second]))


def _levers(model: pin.Model, shape: pin.GeometryObject) -> np.ndarray:
    """Bound the speed of a shape's points per speed of each coordinate, shape (nv,)."""
    levers, joint = np.zeros(model.nv), shape.parentJoint
    shape.geometry.computeLocalAABB()
    centre = shape.placement.act(shape.geometry.aabb_center)
    # Largest distance of a point of the shape from the joint's origin.
    reach = float(np.linalg.norm(centre)) + shape.geometry.aabb_radius
    while joint > 0:
        found, v = model.joints[joint], model.joints[joint].idx_v
        is_sliding = found.shortname().startswith("JointModelP")
        levers[v : v + found.nv] = 1.0 if is_sliding else reach
        if is_sliding:
            limits = model.lowerPositionLimit, model.upperPositionLimit
            reach += max(abs(float(limit[found.idx_q])) for limit in limits)
        reach += float(np.linalg.norm(model.jointPlacements[joint].translation))
        joint = model.parents[joint]
    return levers
