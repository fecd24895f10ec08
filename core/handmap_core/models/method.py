"""What turns a human sample into targets of a robot; `handmap/targets.hpp` has the formulas."""

from __future__ import annotations

from typing import Literal

from .encoding import Indices, Matrix, Model, Point, Points, Pose, Rotation, Vector


class EstimatorModel(Model, frozen=True, kw_only=True):
    """The linear motion T from n points at a reference to where they are; see `MotionEstimator`.

    Attributes:
        shares: Weights of the points, which add up to 1, shape (n,).
        centroid: Their weighted centroid [m], shape (3,).
        centred: The points from their centroid [m], shape (n, 3).
        gain: Times a sample's centred points, it gives A^T without the prior, shape (3, n).
        prior_gain: Behind the prior rotation, what it adds to A, shape (3, 3).
        ridge: Pull of A towards the prior rotation.
    """

    shares: Vector
    centroid: Point
    centred: Points
    gain: Matrix
    prior_gain: Rotation
    ridge: float


class PalmModel(Model, frozen=True, kw_only=True):
    """How a robot's palm follows the human's from a reference on; see `PalmMap`.

    Attributes:
        human_wrist_to_palm: Palm in the human's wrist, shape (4, 4).
        robot_palm_to_wrist: Wrist in the robot's palm, shape (4, 4).
        is_still: Whether the robot's wrist is fixed.
        start: The robot's palm at the reference, shape (4, 4).
        alignment: From the human's world to the robot's, shape (3, 3).
        rotation: The robot's palm seen from the human's, shape (3, 3).
        origin: Its origin there [m], shape (3,).
        offset: The rest of its place, in world axes [m], shape (3,).
        human_anchor: The human's anchor in its palm [m], shape (3,).
        robot_anchor: The robot's, likewise.
        human_start: The human's anchor at the reference [m], shape (3,).
        further: Scale of the translation beyond 1.
    """

    human_wrist_to_palm: Pose
    robot_palm_to_wrist: Pose
    is_still: bool
    start: Pose
    alignment: Rotation
    rotation: Rotation
    origin: Point
    offset: Point
    human_anchor: Point
    robot_anchor: Point
    human_start: Point
    further: float


class DistancesModel(Model, frozen=True, kw_only=True):
    """Points of a hand, and the pairs of them whose p distances are asked for.

    Attributes:
        joints: Joint of each of m points, shape (m,); -1 for the world.
        offsets: Where each point is on its joint [m], shape (m, 3).
        first: One point of each pair, shape (p,).
        second: The other one, shape (p,).
    """

    joints: Indices
    offsets: Points
    first: Indices
    second: Indices


class TeleoperationModel(Model, frozen=True, kw_only=True):
    """What `Teleoperation` is for two hands, whatever the reference.

    The human has n_h reference points, the robot m, and both have f fingers. There are r rows of
    distances: f from each tip to its knuckle, and the others from the thumb's tip to another one.
    Of c pairs of links that are kept apart, some belong to a pinch.

    Attributes:
        human_points: Number of the human's reference points, n_h.
        rest: Joint positions of the robot that match the human's rest posture, shape (n,).
        regularisation: Share of the weights of the rest term and of the damping, shape (n,).
        estimator: T of the points `shape_points` in palm axes.
        shape_points: Points of the human that T is estimated from, shape (s,).
        from_points: The human's point that each distance is from, shape (r,).
        to_points: The one that it is to, shape (r,).
        partners: The human's point that each point of the robot follows, shape (m,).
        starts: The human's knuckle of the same finger, shape (m,).
        finger_of: Finger of each point of the robot, shape (m,).
        human_reach: Largest distance of each tip from its knuckle [m], shape (f,).
        aim_slopes: Wanted distance of each row over the human's, shape (r,).
        aim_offsets: What is added to that [m], shape (r,).
        least_aims: Its least value [m], shape (r,).
        largest_aims: Its largest value [m], shape (r,); infinite for none.
        extension_weights: Weight of each finger's extension, shape (f,).
        pinch_weight: Weight of a closed pinch.
        pinch_from: Gap of thumb and finger at which the row of a pinch begins [m].
        pinch_over: Gap over which its weight rises to full [m].
        likeness: How far the hands are alike, from 0 to 1.
        robot_centre: Centre of the robot's points at rest, in palm axes [m], shape (3,).
        offsets: The robot's points from there, to be turned by T [m], shape (m, 3).
        ratio: Reach of the robot's fingers over the human's.
        gain: Part of the human's residual that the robot's points take over.
        directions: Share of the direction of the human's finger in each point, shape (m,).
        bases: Where the finger of each point begins, in palm axes [m], shape (m, 3).
        ratios: Robot's vector from there over the human's, shape (m,).
        carried: Share of the motion of the human's knuckle that the base follows, shape (m,).
        base_margins: Margin of each pair of links [m], shape (c,).
        pinch_pairs: Pairs that belong to a pinch, shape (k,).
        pinch_of_pair: Which pinch it is, shape (k,).
        pinch_margins: Their margin [m], shape (k,).
        contact_slope: Rise of a pinch's margin with the gap of thumb and finger.
        contact_from: Gap at which it rises [m].
        contact_most: Largest rise [m].
        open_from: Distance of the thumb's tip from all segments from which on it is open [m].
        open_over: How much farther it is wholly open [m].
        straight_from: Share of its reach from which on a finger is straight.
        straight_over: How much more it is wholly straight.
        straight_less: How much nearer thumb and a straight finger are where their row begins [m].
        segment_starts: The human's point at which each segment of a finger begins, of those that
            both hands have but the thumb, shape (s,).
        segment_ends: The one at which it ends, shape (s,).
        segment_from: The robot's point at which its segment begins, shape (s,); -1 for the base.
        segment_to: The one at which it ends, shape (s,).
        segment_bases: Base of the robot's finger, in palm axes [m], shape (s, 3).
        segment_touching: Distance of the robot's thumb from the segment where they touch [m], (s,).
        lying_weight: How far a thumb that lies on a segment is led by it, from 0 to 1.
        lying_from: Distance from the human's segment below which the thumb lies on it [m].
        lying_over: How much nearer it wholly does [m].
        lying_extension: Share of the weight of the thumb's extension that is left there.
        skin_gap: Distance of the human's landmarks at skin contact [m].
        tips_from: Gap of the tips below which the pinch row alone leads them [m].
        tips_over: How much wider it is where the segment wholly leads [m].
        pinch_rests: What each pinch adds to `rest`, shape (r - f, n).
        rest_from: Gap of thumb and finger below which it does [m].
        rest_over: How much smaller the gap is where it adds all of that [m].
        distances: The robot's distances, one for each row.
    """

    human_points: int
    rest: Vector
    regularisation: Vector
    estimator: EstimatorModel
    shape_points: Indices
    from_points: Indices
    to_points: Indices
    partners: Indices
    starts: Indices
    finger_of: Indices
    human_reach: Vector
    aim_slopes: Vector
    aim_offsets: Vector
    least_aims: Vector
    largest_aims: Vector
    extension_weights: Vector
    pinch_weight: float
    pinch_from: float
    pinch_over: float
    likeness: float
    robot_centre: Point
    offsets: Points
    ratio: float
    gain: float
    directions: Vector
    bases: Points
    ratios: Vector
    carried: Vector
    base_margins: Vector
    pinch_pairs: Indices
    pinch_of_pair: Indices
    pinch_margins: Vector
    contact_slope: float
    contact_from: float
    contact_most: float
    open_from: float
    open_over: float
    straight_from: float
    straight_over: float
    straight_less: float
    segment_starts: Indices
    segment_ends: Indices
    segment_from: Indices
    segment_to: Indices
    segment_bases: Points
    segment_touching: Vector
    lying_weight: float
    lying_from: float
    lying_over: float
    lying_extension: float
    skin_gap: float
    tips_from: float
    tips_over: float
    pinch_rests: Matrix
    rest_from: float
    rest_over: float
    distances: DistancesModel


class HomogeneousModel(Model, frozen=True, kw_only=True):
    """The paper's method from one reference of both hands on; see `HomogeneousMap`.

    Attributes:
        rigid_from: Where the rigid part of T comes from.
        rest: Joint positions that the QP's rest term pulls to, shape (n,).
        estimator: T of the human's n_h points.
        stretch_min: Smallest stretch that is imposed.
        stretch_max: Largest stretch that is imposed.
        deformation_gain: Exponent of the stretch.
        scale: Factor on translations.
        pivot: Where rotation and deformation of the human act [m], shape (3,).
        origin: The origin of the human's world, taken to the robot's by shifts [m], shape (3,).
        alignment: From the human's world to the robot's, shape (3, 3).
        human_wrist: The human's wrist at the reference, shape (4, 4); None if it is not needed.
        robot_wrist: The robot's wrist there, from its pivot, shape (4, 4).
        human_offsets: The human's points from the pivot [m], shape (n_h, 3).
        robot_offsets: The robot's points from its pivot [m], shape (n_r, 3).
        share: Share of each human point's residual in each point of the robot, (n_r, n_h).
    """

    rigid_from: Literal["points", "wrist", "none"]
    rest: Vector
    estimator: EstimatorModel
    stretch_min: float
    stretch_max: float
    deformation_gain: float
    scale: float
    pivot: Point
    origin: Point
    alignment: Rotation
    human_wrist: Pose | None
    robot_wrist: Pose
    human_offsets: Points
    robot_offsets: Points
    share: Matrix
