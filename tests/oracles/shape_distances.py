"""Distances of pairs of shapes over Pinocchio and coal, and the rows and bounds made of them.

The compiled core has the same (`handmap/pairs.hpp`, which says what the rows and bounds are).
"""

from __future__ import annotations

from typing import NamedTuple, Self

import numpy as np
import pinocchio as pin

from handmap_core.ik.gate import Rows
from handmap_qp.hands import ContactYield, Hand, PinocchioConfiguration, ShapePairs
from handmap_qp.ik import PointIk
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.se3 import Array, inverse_pose, lengths

TOUCHING = 1e-3
"""Pairs that are farther apart than this count as not touching [m]."""
KEPT = 2e-4
"""Pairs do not come nearer than this, or than they are at the start, where a path is measured; and
not nearer than half of it between [m]."""
# GJK starts from the last result of the pair. With coal's 1e-6 the answer depends on it by as much.
_TOLERANCE = 1e-12
# Points of a path that are measured, at most; a path that needs more counts as not clear.
_MOST_POINTS = 30
# A pair has come nearer if its distance is shorter by this [m].
_NEARER = 1e-6
# Part of the free distance that one step may use.
_GAIN = 0.85


class NearPairs(NamedTuple):
    """The pairs of shapes that are within a horizon in one posture, r of all.

    Attributes:
        pairs: Their indices, increasing, shape (r,).
        found: Signed distance, normal from the first to the second shape, and nearest point of the
            first shape, shape (r, 7).
    """

    pairs: Array
    found: Array


def overlaps_of(
    yielding: ContactYield, pairs: Array, G: Array, touching: Array, distances: Array
) -> Array:
    """Return how far pairs may overlap in one posture [m], shape (r,).

    Args:
        yielding: How pairs may overlap.
        pairs: Indices of r pairs.
        G: Rows of their distances in the active coordinates, shape (r, n).
        touching: The same of the pairs that are nearer than `TOUCHING`, shape (t, n).
        distances: Signed distances of those [m], shape (t,).
    """
    levers = np.abs(G)
    usable = np.full_like(levers, np.inf)
    np.divide(yielding.torques, levers, out=usable, where=levers > 0.0)
    forces = np.minimum(yielding.forces[pairs], usable.min(axis=1, initial=np.inf))
    weighted = yielding.compliances * G
    alone = (weighted * G).sum(axis=1)
    weights = np.clip(1.0 - distances / TOUCHING, 0.0, 1.0)
    raised = np.minimum(weighted @ touching.T, 0.0) @ weights
    gives = np.maximum(alone + raised, 0.0)
    return np.minimum(forces * gives, yielding.depths[pairs])


def _box_of(shape: pin.GeometryObject) -> tuple[Array, Array]:
    """Return two corners of the box around a shape along its own axes [m], shape (3,) each."""
    shape.geometry.computeLocalAABB()
    box = shape.geometry.aabb_local
    return np.ravel(box.min_), np.ravel(box.max_)


class MeasuredPairs(CollisionLimit):
    """The pairs of a `CollisionLimit`, whose arguments it takes, with their distances."""

    def __init__(
        self, hand: Hand, pairs: ShapePairs | None = None, horizon: float = np.inf
    ) -> None:
        super().__init__(hand, pairs, horizon)
        self._spread = hand.spread
        self._model = hand.model
        self._data = hand.model.createData()
        self._shapes = self.bounds.geometry.createData()
        for request in self._shapes.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        self._yields = np.zeros(len(self.bounds.first), dtype=bool)
        if self.yielding is not None:
            self._yields = self.yielding.forces > 0.0
        boxes = [_box_of(shape) for shape in self.bounds.geometry.geometryObjects]
        corners = np.reshape(boxes, (-1, 2, 3))
        self._centres = corners.mean(axis=1)
        self._radii = 0.5 * lengths(corners[:, 1] - corners[:, 0])

    @classmethod
    def of(cls, ik: PointIk) -> Self:
        """Return the pairs that a solver keeps apart."""
        limit = ik.gate.collisions
        assert limit is not None
        shapes = ShapePairs(limit.bounds.geometry, (), yielding=limit.yielding)
        return cls(ik.hand, shapes, limit.horizon)

    def overlaps(self, q: Array, near: NearPairs) -> Array:
        """Return how far pairs may overlap in a posture [m], shape (r,).

        Args:
            q: Pinocchio configuration, shape (nq,).
            near: The pairs, measured there.
        """
        if self.yielding is None:
            return np.zeros(len(near.pairs))
        touching = self.within(q, TOUCHING)
        jacobian = pin.computeJointJacobians(self._model, self._data, q)
        G, others = (
            self._turns_apart(each, jacobian) @ self._spread
            for each in (near, touching)
        )
        distances = touching.found[:, 0]
        return overlaps_of(self.yielding, near.pairs, G, others, distances)

    def _turns_apart(self, near: NearPairs, jacobian: Array) -> Array:
        """Return minus the derivatives of r distances, shape (r, c), by columns (6, c)."""
        normals = near.found[:, 1:4]
        wrenches = np.hstack([normals, np.cross(near.found[:, 4:], normals)])
        return self.bounds.signs[near.pairs] * wrenches.dot(jacobian)

    def within(self, q: Array, horizon: Array | float = np.inf) -> NearPairs:
        """Measure the pairs within a horizon.

        Args:
            q: Pinocchio configuration, shape (nq,).
            horizon: Largest distance [m], of each pair or one for all; infinite for all pairs.
        """
        pairs = np.flatnonzero(self._least(self._place(q)) <= horizon)
        found = self._found(pairs)
        is_near = (
            found[:, 0] <= np.broadcast_to(horizon, self.bounds.first.shape)[pairs]
        )
        return NearPairs(pairs[is_near], found[is_near])

    def nearest(self, q: Array) -> float:
        """Return the smallest signed distance of all pairs at a configuration, shape (nq,) [m]."""
        least = self._least(self._place(q))
        assert len(least), "a hand without pairs of shapes"
        nearest = np.inf
        # Most pairs are farther apart than the nearest one whatever their shapes are.
        for k in np.argsort(least).tolist():
            if least[k] > nearest:
                break
            result = pin.computeDistance(self.bounds.geometry, self._shapes, k)
            nearest = min(nearest, result.min_distance)
        return nearest

    def _least(self, poses: Array) -> Array:
        """Return a distance that each pair has at least, that of balls around both [m]."""
        centres = (poses[:, :3, :3] @ self._centres[..., None])[..., 0] + poses[
            :, :3, 3
        ]
        first, second = self.bounds.first, self.bounds.second
        apart = lengths(centres[first] - centres[second])
        return apart - self._radii[first] - self._radii[second]

    def _found_at(self, q: Array, pairs: Array) -> Array:
        """Return what is found of some pairs in a posture; as of `NearPairs`, shape (r, 7)."""
        self._place(q)
        return self._found(pairs)

    def _found(self, pairs: Array) -> Array:
        """Return what is found of some pairs where the shapes have been placed, shape (r, 7)."""
        found = np.empty((len(pairs), 7))
        for row, k in zip(found, pairs.tolist(), strict=True):
            result = pin.computeDistance(self.bounds.geometry, self._shapes, k)
            row[0] = result.min_distance
            row[1:4] = result.normal
            row[4:] = result.getNearestPoint1()
        return found

    def _place(self, q: Array) -> Array:
        """Place all shapes in a posture, and return their poses, shape (s, 4, 4)."""
        geometry = self.bounds.geometry
        pin.updateGeometryPlacements(self._model, self._data, geometry, self._shapes, q)
        poses = [pose.homogeneous for pose in self._shapes.oMg]
        return np.reshape(poses, (-1, 4, 4))

    def met_on(self, q: Array, displacement: Array) -> NearPairs | None:
        """Return what meets on a straight path; None if no pair of shapes does.

        Pairs that touch at the start already are left out.

        Args:
            q: Pinocchio configuration where it begins, shape (nq,).
            displacement: Displacement in the active coordinates [rad or m], shape (n,).

        Returns:
            The pairs that come too near first, by halving; none where it takes too many points to
            know. Their points where the path begins: distance along the normal, the normal, and the
            point of the second shape, shape (r, 7).
        """
        step = self._spread.dot(displacement)
        turns = np.abs(step)
        travel = self.bounds.levers.dot(turns)
        bend = self.bounds.turns.dot(turns)
        pairs, before = self.within(q, KEPT + travel)
        there = pin.integrate(self._model, q, step)
        ends = np.array([before, self._found_at(there, pairs)])
        # Distances count from here on: 0, or what yields may overlap.
        floors = -self.overlaps(q, NearPairs(pairs, before))
        room = before[:, 0] - floors
        # On a path from a to b, the distance is never below (a + b - travel) / 2.
        is_open = ends[..., 0].sum(axis=0) - travel[pairs] < KEPT + 2.0 * floors
        is_open &= (room > 0.0) | self._yields[pairs]
        pairs, floors, room = pairs[is_open], floors[is_open], room[is_open]
        ends = ends[:, is_open]
        # What they keep where the path is measured, and between. Below the floor, come no nearer.
        slack = np.minimum(room, KEPT)
        is_below = room <= 0.0
        kept = np.full_like(travel, KEPT)
        kept[pairs] = np.where(is_below, ends[0, :, 0] - _NEARER, floors + slack)
        midway = kept.copy()
        midway[pairs] -= 0.5 * np.where(is_below, KEPT, slack)
        met = self._meetings(q, there, pairs, ends[1], kept[pairs])
        if len(met.pairs):
            return met
        # Parts of the path that are not shown to be clear: pairs, and what was found at both ends.
        parts = [(0.0, 1.0, pairs, ends)]
        taken = 0
        while parts:
            low, high, pairs, ends = parts.pop(0)
            length = high - low
            turned = 2.0 * lengths(ends[1, :, 1:4] - ends[0, :, 1:4])
            turned += length * bend[pairs]
            bent = 0.125 * turned * length * travel[pairs]
            nearest = ends[..., 0].min(axis=0)
            is_open = nearest - bent < midway[pairs]
            if not is_open.any():
                continue
            if taken == _MOST_POINTS:
                return NearPairs(pairs[:0], ends[0, :0])
            taken += 1
            pairs = pairs[is_open]
            first, last = ends[:, is_open]
            middle = 0.5 * (low + high)
            there = pin.integrate(self._model, q, middle * step)
            between = self._found_at(there, pairs)
            met = self._meetings(q, there, pairs, between, kept[pairs])
            if len(met.pairs):
                return met
            parts.append((low, middle, pairs, np.array([first, between])))
            parts.append((middle, high, pairs, np.array([between, last])))
        return None

    def _meetings(
        self, q: Array, there: Array, pairs: Array, found: Array, least: Array
    ) -> NearPairs:
        """Return what was found too near in one posture, `there`, of the same points in another."""
        meets = found[:, 0] < least
        pairs, found = pairs[meets], found[meets]
        moved = self._place(q) @ inverse_pose(self._place(there))
        first = moved[self.bounds.first[pairs], :3]
        second = moved[self.bounds.second[pairs], :3]
        # As columns: distances along the normals, normals, and points of both shapes.
        apart, normals, points = np.split(found[..., None], (1, 4), axis=1)
        turned = first[..., :3] @ normals
        begins = first[..., :3] @ points + first[..., 3:]
        ends = second[..., :3] @ (points + apart * normals) + second[..., 3:]
        gaps = turned.mT @ (ends - begins)
        return NearPairs(pairs, np.hstack([gaps, turned, ends])[..., 0])

    def rows(
        self,
        configuration: PinocchioConfiguration,
        near: NearPairs,
        margins: Array | float | None = None,
    ) -> Rows:
        """Linearise the distances of the measured pairs as rows `G dq <= h`.

        Args:
            configuration: Of the hand, placed with Jacobians.
            near: What `within` found there, or `met_on` on a path from there.
            margins: Distance that all pairs keep [m], or each of them, shape (k,); `margin` if
                omitted.

        Returns:
            G, shape (r, n) over the active coordinates; h [m], shape (r,), negative where a pair is
            nearer than the margin.
        """
        pairs, found = near
        G = self._turns_apart(near, configuration.data.J)
        kept = self.margin if margins is None else margins
        kept = kept[pairs] if isinstance(kept, np.ndarray) else kept
        kept = kept - self.overlaps(configuration.q, near)
        return configuration.contracted(G), _GAIN * (found[:, 0] - kept)
