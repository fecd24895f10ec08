"""Pairs of collision shapes that are kept apart; see `handmap/pair_models.hpp`."""

from __future__ import annotations

from typing import Literal

from .encoding import Indices, Matrix, Model, Point, Points, Pose, Vector


class ShapeModel(Model, frozen=True, kw_only=True):
    """A convex shape, around its own origin.

    Attributes:
        kind: What it is. The fields that do not belong to it are 0, or empty.
        half: Half the sides of a box [m], shape (3,); of a capsule, half its length along z.
        radius: Of a sphere or capsule [m].
        corners: Of a convex hull [m], shape (n, 3).
    """

    kind: Literal["box", "sphere", "capsule", "convex"]
    half: Point
    radius: float
    corners: Points


class BodyModel(Model, frozen=True, kw_only=True):
    """A shape on a joint.

    Attributes:
        joint: Index of the joint; -1 for the world.
        placement: The shape on it, shape (4, 4).
        shape: The shape.
        centre: Middle of a ball around the shape, on the joint [m], shape (3,).
        radius: Radius of that ball [m].
    """

    joint: int
    placement: Pose
    shape: ShapeModel
    centre: Point
    radius: float


class PairsModel(Model, frozen=True, kw_only=True):
    """Pairs of shapes, and how far a change of each coordinate moves them.

    Attributes:
        bodies: The shapes.
        first: Index of the first shape of each of k pairs, shape (k,).
        second: Index of the second one.
        levers: Bound of the change of each pair's distance per change of each coordinate [m/rad, or
            1 for sliding joints], shape (k, nv); 0 for those that move both shapes or neither.
        turns: Bound of `S + 2 C` (`ik.collision`) of each pair per change of each coordinate.
        signs: 1 where a coordinate moves the first shape of a pair, -1 where it moves the second, 0
            where both or neither, shape (k, nv).
    """

    bodies: tuple[BodyModel, ...]
    first: Indices
    second: Indices
    levers: Matrix
    turns: Matrix
    signs: Matrix


class YieldModel(Model, frozen=True, kw_only=True):
    """How far pairs of shapes may overlap in commands; see `hands.contact_yield`.

    Attributes:
        forces: Largest force between the shapes of each pair [N], shape (k,); 0 for pairs that
            must not overlap.
        depths: Largest overlap of each pair [m], shape (k,).
        compliances: Turn of each active coordinate by a torque of position control [rad/(N m),
            m/N], shape (n,); 0 for those that are no finger's.
        torques: Largest torque of each active coordinate [N m, N], shape (n,).
    """

    forces: Vector
    depths: Vector
    compliances: Vector
    torques: Vector


class CollisionModel(Model, frozen=True, kw_only=True):
    """How pairs of shapes are kept apart.

    Attributes:
        margin: Distance that they keep [m].
        horizon: Pairs that are farther apart than their margin and this get no row [m]; infinite
            for none.
        yielding: How far they may overlap; None for not at all.
    """

    margin: float
    horizon: float
    yielding: YieldModel | None
