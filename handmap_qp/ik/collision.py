"""Self-collision avoidance: rows of the QP from coal's distances between collision shapes.

Meshes count as their convex hulls.

For a pair of shapes a, b at the signed distance d, with the unit normal n from a to b,

    d(q + dq) ~ d + n^T (J_b - J_a) dq >= margin

becomes

    -n^T (J_b - J_a) dq <= gain (d - margin)

with J_a and J_b the Jacobians of the nearest points. Both lie on one line along n, so the wrench
(n, p x n) of either does for both. The first order is an approximation: a shape that turns by an
angle x at a radius r may come r x^2 / 2 closer than the row says. The margin is for that, and
the gate (`handmap_core.ik.gate`) checks the whole displacement afterwards.

Rows are linearised where a sample starts, and hold for its whole displacement: a later iteration of
the QP has what the ones before it left. Where there is a horizon, a pair gets a row if another step
like the last one may bring it to its margin.

A point of a shape moves by at most its lever times the turn of a joint. So the distance of a pair
changes by at most its `travel` on a straight path in joint space, the sum of levers times turns.

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

There the rows were wrong: a link that lies flat on another one touches it next wherever it turns
to, and a row knows one pair of points. The points that meet there are then kept apart too. With the
normal n carried by the first shape, points p of it and r of the second one, as they are at the
start,

    -n^T (J_b - J_a)(r) dq <= gain (n^T (r - p) - margin).

For the same reason the end of the QP's step is measured before that. Pairs that have rows, and that
the step brings nearer and within their margin, get such rows of the points there, with their
margin, and the QP is solved again, a few times at most. Without them, links that are pressed flat
on each other rock from corner to corner for ever.

Pairs may yield (`handmap_core.hands.contact_yield`): commanded links overlap by as much as presses
with a given force. Then all of the above counts from that overlap on, as of the posture where the
sample starts. A pair that overlaps by more, because the joints have moved since, must not come
nearer, and its row parts it.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from handmap_core.core import core
from handmap_core.errors import InvalidOptionsError
from handmap_core.ik.gate import Rows, moving_columns
from handmap_core.models import (
    CollisionModel,
    PairsModel,
    encode,
)
from handmap_core.se3 import Array, inverse_pose, lengths, transform_points
from handmap_qp.hands import (
    NEAR,
    ContactYield,
    Hand,
    PinocchioConfiguration,
    ShapePairs,
    body_models,
    moved_by,
    named_pairs,
    pair_ends,
)

if TYPE_CHECKING:
    from handmap_core import _core

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


class PairBounds:
    """What never changes of pairs of shapes: how far a change of each coordinate moves them.

    Args:
        model: The hand's model.
        geometry: Its collision shapes and pairs.

    Attributes:
        geometry: As given.
        first: Index of the first shape of each pair, shape (k,).
        second: Index of the second one.
        levers: Bound of the change of each pair's distance per change of each velocity coordinate
            [m/rad, or 1 for sliding joints], shape (k, nv); 0 for coordinates that move both shapes
            of a pair or neither.
        turns: Bound of `S + 2 C` of each pair per change of each coordinate, shape (k, nv).
        signs: 1 where a coordinate moves the first shape of a pair, -1 where it moves the second, 0
            where both or neither, shape (k, nv).
        links: Links of both shapes of each pair; at -1, there are none.
    """

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self.geometry = geometry
        self.links = (*ShapePairs(geometry, ()).links, ())
        sides = np.array(pair_ends(geometry), dtype=int)
        self.first, self.second = sides.reshape(-1, 2).T
        shapes = geometry.geometryObjects
        levers = [_levers(model, shape) for shape in shapes]
        levers = np.reshape(levers, (-1, model.nv))
        moved = moved_by(model, [shape.parentJoint for shape in shapes])
        self.signs = moved[self.first] - moved[self.second]
        is_between = self.signs != 0.0
        # A coordinate that moves both shapes carries them together.
        self.levers = (levers[self.first] + levers[self.second]) * is_between
        jacobian = pin.computeJointJacobians(
            model, model.createData(), pin.neutral(model)
        )
        turning = jacobian[3:].any(axis=0)
        has_sliding = (is_between & ~turning).any(axis=1)
        # Sliding between the shapes doubles the acceleration that turns give their points.
        sliding = is_between * has_sliding[:, None]
        self.turns = turning * (moved[self.first] + moved[self.second] + sliding)

    @cached_property
    def core(self) -> _core.PairBounds:
        """The core's own."""
        return core.PairBounds(encode(self.model()))

    def __getstate__(self) -> dict[str, Any]:
        """Return all but the core's own, which a copy makes anew."""
        return {name: value for name, value in vars(self).items() if name != "core"}

    def model(self) -> PairsModel:
        """Return the pairs as the core has them.

        Raises:
            ValueError: If a shape is not convex.
        """
        return PairsModel(
            bodies=body_models(self.geometry),
            first=self.first,
            second=self.second,
            levers=self.levers,
            turns=self.turns.astype(float),
            signs=self.signs,
        )

    def moving_columns(self, spread: Array) -> Array:
        """Return which active coordinates move the shapes of any pair against each other, (k,).

        Args:
            spread: `Hand.spread`, shape (nv, k).
        """
        return moving_columns(self.levers, spread)


pair_bounds = lru_cache(maxsize=32)(PairBounds)
"""The bounds of a model's pairs, computed once."""


def _levers(model: pin.Model, shape: pin.GeometryObject) -> Array:
    """Bound the speed of a shape's points per speed of each coordinate, shape (nv,).

    No lever is shorter than those of joints nearer to the shape. So times a turn of its joint, it
    bounds what that turn changes in the velocities due to those joints, too.
    """
    levers = np.zeros(model.nv)
    joint = shape.parentJoint
    longest = 0.0
    points, radius = _extent(shape)
    # Largest distance of a point of the shape from the joint's origin.
    reach = lengths(points).max() + radius
    while joint > 0:
        found = model.joints[joint]
        axes = np.reshape(found.createData().S, (6, found.nv))[3:].T
        if axes.any():
            across = reach
            if found.nv == 1:
                # The part of an offset along an axis does not move when the joint turns.
                across = lengths(np.cross(points, axes)).max() + radius
            lever = longest = max(longest, min(across, reach))
        else:
            limits = model.lowerPositionLimit, model.upperPositionLimit
            reach += np.abs(limits)[:, found.idx_q].max()
            lever = 1.0
        levers[found.idx_v :][: found.nv] = lever
        # From the parent's origin, the shape is within the joint's offset and that reach.
        points = model.jointPlacements[joint].translation[None]
        radius = reach
        reach += lengths(points[0])
        joint = model.parents[joint]
    return levers


def _extent(shape: pin.GeometryObject) -> tuple[Array, float]:
    """Return corners of a box, or the middle and radius of a ball, about a shape in its joint."""
    geometry = shape.geometry
    geometry.computeLocalAABB()
    box = geometry.aabb_local
    points = np.where(list(np.ndindex(2, 2, 2)), box.max_, box.min_)
    radius = 0.0
    if lengths(box.max_ - box.min_) / 2.0 > 1.001 * geometry.aabb_radius:
        points = geometry.aabb_center[None]
        radius = geometry.aabb_radius
    return transform_points(shape.placement.homogeneous, points), radius


@lru_cache(maxsize=32)
def _collision_model(
    margin: float, horizon: float, yielding: ContactYield | None
) -> CollisionModel:
    """Return how pairs are kept apart, as the core has it; people share it."""
    return CollisionModel(margin=margin, horizon=horizon, yielding=yielding)


class CollisionLimit:
    """Measures signed distances of pairs of collision shapes, and keeps them apart by rows.

    Args:
        hand: The hand.
        pairs: The pairs to keep apart; those that the hand's description names if omitted.
        horizon: Pairs that are farther apart than their margin and this get no row [m]; in short
            samples the horizon is nearer, as links do not come that far. Infinite by default: every
            pair has a row, in an order that never changes.

    Attributes:
        margin: Distance to keep [m]; `horizon` as given.
        yielding: How far the pairs may overlap; None for not at all.
        model: These as the core has them.
        bounds: How far changes of coordinates move the pairs.
        columns: Which active coordinates move the shapes of any pair against each other, shape
            (n,). The others, such as those of a floating wrist, change no distance.

    Raises:
        InvalidOptionsError: If the hand names no pairs.
        HandError: If a link does not exist or has no collision shape, or a shape cannot be read.
    """

    def __init__(
        self, hand: Hand, pairs: ShapePairs | None = None, horizon: float = np.inf
    ) -> None:
        spec = hand.spec.collision
        if pairs is None:
            if not spec:
                raise InvalidOptionsError(
                    f"{hand.name} names no links to keep apart",
                    option="avoids_self_collision",
                    advice="add collision.pairs to its hand.yaml",
                )
            pairs = named_pairs(hand, spec.pairs)
        self.margin = spec.margin if spec else 0.0
        self.horizon = horizon
        self.yielding = pairs.yielding
        self.model = _collision_model(self.margin, horizon, self.yielding)
        self._spread = hand.spread
        self._model = hand.model
        self.bounds = pair_bounds(hand.model, pairs.geometry)
        self.columns = self.bounds.moving_columns(hand.spread)

    # Workspaces of Pinocchio are large, and the compiled core needs none.

    @cached_property
    def _data(self) -> pin.Data:
        return self._model.createData()

    @cached_property
    def _shapes(self) -> pin.GeometryData:
        shapes = self.bounds.geometry.createData()
        for request in shapes.distanceRequests:
            request.gjk_tolerance = request.epa_tolerance = _TOLERANCE
        return shapes

    def overlaps(self, q: Array, near: NearPairs) -> Array:
        """Return how far pairs may overlap in a posture [m], shape (r,).

        Args:
            q: Pinocchio configuration, shape (nq,).
            near: The pairs, measured there.
        """
        if self.yielding is None:
            return np.zeros(len(near.pairs))
        touching = self.within(q, NEAR)
        jacobian = pin.computeJointJacobians(self._model, self._data, q)
        G, others = (
            self._turns_apart(each, jacobian) @ self._spread
            for each in (near, touching)
        )
        return self.yielding.overlaps(near.pairs, G, others, touching.found[:, 0])

    @cached_property
    def _yields(self) -> Array:
        """Which pairs may ever overlap, shape (k,)."""
        if self.yielding is None:
            return np.zeros(len(self.bounds.first), dtype=bool)
        return self.yielding.forces > 0.0

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
        found = self._found_at(q, np.arange(len(self.bounds.first)))
        pairs = np.flatnonzero(found[:, 0] <= horizon)
        return NearPairs(pairs, found[pairs])

    def _found_at(self, q: Array, pairs: Array) -> Array:
        """Return what is found of some pairs in a posture; as of `NearPairs`, shape (r, 7)."""
        self._place(q)
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
