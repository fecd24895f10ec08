"""Self-collision avoidance: the pairs of shapes of a hand that are kept apart.

Meshes count as their convex hulls. The compiled core measures the pairs, and has the rows and the
bounds of distances (`handmap/pairs.hpp`). Here is what it needs of a hand: the shapes of each pair,
and how far a change of each coordinate moves them.
"""

from __future__ import annotations

from functools import cached_property, lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pinocchio as pin

from handmap_core.core import core, without_core
from handmap_core.errors import InvalidOptionsError
from handmap_core.ik.gate import moving_columns
from handmap_core.models import (
    CollisionModel,
    PairsModel,
    encode,
)
from handmap_core.se3 import Array, lengths, transform_points
from handmap_qp.hands import (
    ContactYield,
    Hand,
    ShapePairs,
    body_models,
    moved_by,
    named_pairs,
    pair_ends,
)

if TYPE_CHECKING:
    from handmap_core import _core


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

    def __getstate__(self) -> dict[str, object]:
        """Return the state of a copy."""
        return without_core(self)

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

        The others, such as those of a floating wrist, change no distance.

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
    """Which pairs of collision shapes the gate and the QP keep apart, and how far.

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
        self.bounds = pair_bounds(hand.model, pairs.geometry)
