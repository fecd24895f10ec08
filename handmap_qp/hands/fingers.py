"""The fingers of any hand: one analysis of their joints, on the hand's Pinocchio model.

The joints of a finger whose axes are nearly parallel to that of its last turning joint *flex* it.
The finger is straight where its tip is farthest from the first of these axes. It closes towards the
end of their ranges where it is shortest, or to which the ranges are longer. All other joints spread
it, or bring a thumb before the palm.
"""

import math
from collections import Counter
from collections.abc import Callable, Collection, Sequence
from functools import cached_property, lru_cache
from itertools import chain, compress
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_core.errors import HandError
from handmap_core.hands import FINGERS, THUMB, moved_by
from handmap_core.se3 import Array, lengths, unit
from .hand import Hand
from .spec import PointSpec

PARALLEL = 0.85
"""Cosine from which on two axes are parallel.

On the 30 robot hands of `benchmarks/fidelity/bench_hands.py` and the human one, joints that flex a
finger have 0.99 and more with its last joint at zero, and no other joint has more than 0.82.
"""

Place = tuple[int, Array]
"""A joint of the model, and a point's offset on it [m], shape (3,)."""

# Place of the PIP joint between knuckle and tip on a person, and the least and largest share of the
# finger at which a joint counts as one.
_PIP = 0.45
_LEAST = 0.15
_MOST = 0.88
_SAMPLES = 200
# Samples of a joint's range, and of the way from straight to one end of the ranges.
_GRID = 25
_SWEEP = 11
# Least displacement of a finger's base by a joint, relative to the reach.
_CARRIED = 0.05
# Least distance of two joints that are places of their own, relative to the reach.
_APART = 0.1
# Least relative change of a finger's length that counts as curling.
_LEAST_CURL = 0.06
# A joint of a parallelogram turns the tip by less than this per radian: a jaw that moves on a
# circle, and curls nothing.
_LEAST_TURN = 0.1
# Largest relative difference of a finger's lengths at both ends of a range, and of the ranges to
# both sides, that count as equal.
_EVEN_LENGTH = 0.08
_EVEN_RANGE = 0.25
# A finger that is this near to its full length at the zero position is straight there.
_STRAIGHT = 0.993
# Joints that are flexed by more than this at the zero position say that it is no straight one
# [rad].
_FLEXED_ZERO = 0.3
# Pinocchio's names of prismatic joints.
_PRISMATIC = {f"JointModel{axis}" for axis in ("PX", "PY", "PZ", "PrismaticUnaligned")}


class PalmKinematics:
    """Points and motions of a hand's joints in palm axes; for one user at a time."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        self._model = hand.model

    def __reduce__(self) -> tuple[type["PalmKinematics"], tuple[Hand]]:
        """Make a copy with a workspace of its own: Pinocchio 4.0 cannot read one back."""
        return PalmKinematics, (self.hand,)

    @cached_property
    def _data(self) -> pin.Data:
        """Workspace of Pinocchio, which takes longer to allocate than most of what it is for."""
        return self._model.createData()

    def points(self, q: Array, places: Sequence[Place]) -> Array:
        """Return k points [m] at joint angles of shape (..., n), shape (..., k, 3)."""
        rows = []
        # Positions of joints take a tenth of the time of their Jacobians.
        for vector in self.hand.configuration_vectors(q.reshape(-1, q.shape[-1])):
            pin.forwardKinematics(self._model, self._data, vector)
            self._find_palm()
            rows += map(self._point, places)
        return np.reshape(rows, (*q.shape[:-1], -1, 3))

    def _point(self, place: Place) -> Array:
        joint, offset = place
        return self._palm.actInv(self._data.oMi[joint].act(offset))

    def axes(
        self, q: Array, joints: Sequence[int], near: Place | None = None
    ) -> tuple[Array, Array]:
        """Return axes of k joints and a point on each.

        Args:
            q: Joint angles [rad or m], shape (n,).
            joints: Joints of the model.
            near: The points are those nearest to this one; the joints' origins if omitted.

        Returns:
            Unit vectors, zero of prismatic joints, and points [m]; shape (k, 3) each.
        """
        self._place(q)
        columns = [self._model.idx_vs[joint] for joint in joints]
        turns = self._jacobian[3:, columns].T @ self._palm.rotation
        points = np.array([self._point((joint, np.zeros(3))) for joint in joints])
        if near is not None:
            levers = self._point(near) - points
            points += (levers * turns).sum(axis=1, keepdims=True) * turns
        return turns, points

    def on_axis(self, q: Array, joint: int, near: Place) -> Place:
        """Return the point of a turning joint's axis that is nearest to another point."""
        _, (point,) = self.axes(q, [joint], near)
        return joint, self._data.oMi[joint].actInv(self._palm.act(point))

    def motion(self, q: Array, place: Place) -> Array:
        """Return a point's velocity and turn on the palm per unit of every joint, shape (6, n)."""
        self._place(q)
        # Columns of joints that move both are the same, and cancel.
        joints = [place[0], self.hand.palm_frame.parentJoint]
        moves, carries = moved_by(self._model, joints)
        columns = (moves - carries) * self._jacobian
        linear, turns = np.split(columns @ self.hand.joint_motion, 2)
        point = self._data.oMi[place[0]].act(place[1])
        # A turn w moves the point by w x p, which is -p x w.
        linear = linear - pin.skew(point) @ turns
        return np.vstack(self._palm.rotation.T @ [linear, turns])

    def _place(self, q: Array) -> None:
        # That of a single joint comes as a vector.
        self._jacobian = pin.computeJointJacobians(
            self._model, self._data, self.hand.configuration_vector(q)
        ).reshape(6, -1)
        self._find_palm()

    def _find_palm(self) -> None:
        frame = self.hand.palm_frame
        self._palm = self._data.oMi[frame.parentJoint] * frame.placement


class Flexion(NamedTuple):
    """How the joints of a finger with parallel axes curl it.

    Attributes:
        signs: Sense of each about `axis`; 0 of all other joints, shape (n,).
        axis: Common axis in palm axes, shape (3,).
        knuckle: Point of the first axis nearest to the tip, in palm axes [m], shape (3,).
        straight: Joint angles where the finger is straight, others are zero, shape (n,).
        sense: Sense of the closed end about `axis`; 0 if both ends are alike.
        certainty: Confidence in the sense, from 0 to 1.
        curls: Whether they shorten the finger by more than a few hundredths.
    """

    signs: Array
    axis: Array
    knuckle: Array
    straight: Array
    sense: float
    certainty: float
    curls: bool


class Finger:
    """A finger on a hand's model; what is found by a search is found when it is first read.

    Args:
        hand: The hand.
        joints: Joints of the model that move the fingertip and not the palm, outwards.
        tip: The fingertip.
        name: Anatomical name.
        own: Those joints that move no other fingertip; all if omitted.
    """

    def __init__(
        self,
        hand: Hand,
        joints: Sequence[int],
        tip: Place,
        *,
        name: str = "",
        own: Sequence[int] = (),
    ) -> None:
        self.hand = hand
        self.joints = tuple(joints)
        self.tip = tip
        self.name = name
        self.own = tuple(own) or self.joints
        # Which joints move as each q does, and which q moves any.
        rows = [hand.model.idx_vs[joint] for joint in self.joints]
        self._moves = hand.joint_motion[rows] != 0.0
        self.moves = self._moves.any(axis=0)
        self._zero = hand.zero
        self._view = PalmKinematics(hand)

    @property
    def is_jaw(self) -> bool:
        """Whether all joints are prismatic, so that the finger can neither bend nor stretch."""
        kinds = {self.hand.model.joints[joint].shortname() for joint in self.joints}
        return bool(kinds) and kinds <= _PRISMATIC

    @cached_property
    def columns(self) -> Array:
        """Columns of q that move the finger, from the palm outwards, shape (c,)."""
        columns = np.flatnonzero(self.moves)
        # In the order of the last joints that they move: the last key counts most.
        return columns[np.lexsort([columns, *self._moves[:, columns]])]

    @cached_property
    def bending(self) -> list[int]:
        """Its own joints with axes parallel to the last one's; all if there is none."""
        turns, _ = self._view.axes(self._zero, self.own)
        parallel = np.abs(turns @ turns[-1]) > PARALLEL
        return [*compress(self.own, parallel)] or [*self.own]

    @cached_property
    def knuckle(self) -> Place:
        """The point of the first bending axis nearest to the tip, unless it is set.

        A thumb's is the origin of its first joint, a finger's without joints the palm's.
        """
        if not self.joints:
            frame = self.hand.palm_frame
            return frame.parentJoint, frame.placement.translation
        if self.name == THUMB:
            return self.own[0], np.zeros(3)
        return self._view.on_axis(self._zero, self.bending[0], self.tip)

    @cached_property
    def middle(self) -> Place:
        """The found one of a finger, else the origin of the last joint, unless it is set."""
        if not self.joints:
            return self.tip
        found = self.find_middle() if self.name != THUMB else None
        return found or (self.own[-1], np.zeros(3))

    def take(self, point: PointSpec) -> None:
        """Take knuckle or middle from a point of the description that stands for one."""
        first, last = ("cmc", "ip") if self.name == THUMB else ("mcp", "pip")
        names = point.partner, point.name
        if f"{self.name}_{first}" in names:
            self.knuckle = place_of(self.hand, point)
        if f"{self.name}_{last}" in names:
            self.middle = place_of(self.hand, point)

    @property
    def last(self) -> Place:
        """The last joint: the middle one of a thumb, else where its axis is nearest to the tip."""
        if self.name == THUMB:
            return self.middle
        return self._view.on_axis(self._zero, self.bending[-1], self.tip)

    @cached_property
    def carries_knuckle(self) -> bool:
        """Whether a joint of the finger moves its base on the palm, as a metacarpal's does."""
        for column in self.columns:
            ends = np.tile(self._zero, (2, 1))
            ends[:, column] = self.hand.limits[:, column]
            before, after = self._view.points(ends, [self.knuckle])[:, 0]
            if math.dist(before, after) > _CARRIED * self.reach:
                return True
        return False

    @property
    def between(self) -> Place | None:
        """The last joint that is apart from both knuckle and middle: the MCP joint of a thumb."""
        places = [(joint, np.zeros(3)) for joint in reversed(self.joints)]
        ends = self._view.points(self._zero, [self.knuckle, self.middle])
        for place in places[places[0][0] == self.middle[0] :]:
            (here,) = self._view.points(self._zero, [place])
            if lengths(ends - here).min() > _APART * self.reach:
                return place
        return None

    def find_middle(self) -> Place | None:
        """Find the PIP joint of a finger, or the IP joint of a thumb; None if it has none.

        A thumb's is its last bending joint, a finger's the one next to the place of a person's
        joint among those beyond the knuckle. The point lies on the joint's axis, where the axis is
        nearest to the fingertip.
        """
        view = self._view
        flexion = self.flexion
        q = flexion.straight if flexion else self._zero
        tip = view.points(q, [self.tip])[0]
        is_thumb = self.name == THUMB
        joints = self.bending
        turns, points = view.axes(q, joints, self.tip)
        if is_thumb and len(joints) < 2 and self.own[0] != joints[0]:
            # A thumb's joint at its root counts as its knuckle, whatever its axis.
            joints = [self.own[0], *joints]
            points = np.vstack([view.axes(q, joints[:1])[1], points])
        ways = np.cumsum(lengths(np.diff([*points, tip], axis=0)))
        shares = ways[:-1] / max(ways[-1], 1e-6)
        near = np.flatnonzero((shares > _LEAST) & (shares < _MOST))
        if not len(near) or not turns.any():
            return None
        best = near[-1] if is_thumb else near[np.abs(shares[near] - _PIP).argmin()]
        return view.on_axis(q, joints[best + 1], self.tip)

    @cached_property
    def reach(self) -> float:
        """Largest distance from knuckle to tip within the joint limits [m]."""
        return self._length_at(self.stretched)

    def _length_at(self, q: Array) -> float:
        return math.dist(*self._view.points(q, [self.tip, self.knuckle]))

    @cached_property
    def stretched(self) -> Array:
        """Joint angles where it has that reach [rad or m], shape (n,): random search, refined."""
        q = self._zero.copy()
        moving = np.sort(self.columns)
        low, high = self.hand.limits[:, moving]
        ends = self.tip, self.knuckle
        joints = [joint for joint, _ in ends]
        offsets = np.array([offset for _, offset in ends])
        try:
            tree = self.hand.tree
        except HandError:
            # It has a joint that the core does not have.
            tree = None

        def distances(positions: Array) -> Array:
            """Return the distance at each of T positions (T, k), shape (T,)."""
            postures = np.tile(self._zero, (len(positions), 1))
            postures[:, moving] = positions
            if tree:
                points = tree.points_on_joints(postures, joints, offsets)
                points = points.reshape(-1, 2, 3)
            else:
                points = self._view.points(postures, ends)
            return lengths(points[:, 0] - points[:, 1])

        random = np.random.default_rng(0).uniform(low, high, (_SAMPLES, len(moving)))
        samples = np.vstack([q[moving], random])
        found_distances = distances(samples)
        found = samples[found_distances.argmax()]
        best = float(found_distances.max())
        step = 0.25 * (high - low)
        while (step > 1e-3).any():
            before = best
            for change in np.vstack([[-row, row] for row in np.diag(step)]):
                tried = np.clip(found + change, low, high)
                if (reached := float(distances(tried[None])[0])) > best + 1e-9:
                    best = reached
                    found = tried
            if best == before:
                step = 0.5 * step
        q[moving] = found
        return q

    @cached_property
    def flexion(self) -> Flexion | None:
        """How it curls; None if no joint turns the tip."""
        view = self._view
        # The columns that turn the tip about the axis of the last one that does.
        turns = view.motion(self._zero, self.tip)[3:]
        sizes = np.linalg.norm(turns, axis=0)
        turning = self.columns[sizes[self.columns] > _LEAST_TURN]
        units = turns[:, turning] / sizes[turning]
        columns = turning[(np.abs(units[:, -1:].T @ units) > PARALLEL).any(axis=0)]
        if not len(columns):
            return None
        _, base, gears = self._axis(columns, self._zero)

        def lengths_at(postures: Array) -> Array:
            return lengths(view.points(postures, [self.tip])[..., 0, :] - base)

        q = self._straightened(columns, lengths_at)
        ways = ends_of(self.hand, q, gears)[::-1] - q
        bent = lengths_at(q + np.linspace(0.0, 1.0, _SWEEP)[:, None, None] * ways)
        shares = 1.0 - bent.min(axis=0) / bent[0].clip(1e-9)
        # The finger is closed where it is shorter, or to which the ranges [rad] are longer.
        travels = np.abs(gears * ways).sum(axis=1)
        by_share = shares[0] - shares[1]
        by_range = (travels[0] - travels[1]) / max(travels.sum(), 1e-9)
        has_share = abs(by_share) > _EVEN_LENGTH
        has_range = abs(by_range) > _EVEN_RANGE
        sense = float(np.sign(by_share if has_share else by_range * has_range))
        certainty = 0.75 * abs(sense)
        if has_share and has_range:
            certainty = 0.95 if by_share * by_range > 0.0 else 0.5
        senses = sense * np.sign(gears[columns])
        q[columns] = self._with_knuckle(columns, q[columns], senses)
        axis, base, gears = self._axis(columns, q)
        curls = bool(shares.max() > _LEAST_CURL)
        return Flexion(np.sign(gears), axis, base, q, sense, certainty, curls)

    @cached_property
    def closing(self) -> Array:
        """Sense in which each joint flexes the finger; 0 of all other joints, shape (n,).

        A finger that curls equally far both ways flexes to the palm's side.
        """
        found = self.flexion
        if found is None:
            return np.zeros_like(self._zero)
        dorsal = self._view.motion(self._zero, self.tip)[2] @ found.signs
        return found.signs * (found.sense or -np.sign(dorsal) or 1.0)

    def _axis(self, columns: Array, q: Array) -> tuple[Array, Array, Array]:
        """Return axis (3,), knuckle on it (3,), and the turn about it per unit of a column (n,)."""
        turns = self._view.motion(q, self.tip)[3:, columns]
        # The sense of the axis is that of the last joint, in every posture.
        axis = unit(turns[:, -1])
        gears = np.zeros_like(q)
        gears[columns] = axis @ turns
        axes, points = self._view.axes(q, self.joints, self.tip)
        turning = self._moves[:, columns[0]] & axes.any(axis=1)
        base = points[turning.argmax()]
        return axis, base, gears

    def _straightened(
        self, columns: Array, lengths_at: Callable[[Array], Array]
    ) -> Array:
        """Return the posture of some joints at which the finger is longest, else zero."""
        hand = self.hand
        q = self._zero.copy()
        best = 0.0
        # Coordinate descent: the best value of a joint depends on the others; three rounds suffice.
        for _ in range(3):
            for j in columns:
                grid = np.append(np.linspace(*hand.limits[:, j], _GRID), q[j])
                postures = np.tile(q, (len(grid), 1))
                postures[:, j] = grid
                found = lengths_at(postures)
                best = found.max()
                # Several postures are equally straight: take the one nearest to zero.
                near = grid[found >= (1.0 - 1e-4) * best]
                q[j] = near[np.argmin(np.abs(near - self._zero[j]))]
        is_straight = lengths_at(self._zero) > _STRAIGHT * best
        return self._zero.copy() if is_straight else q

    def _with_knuckle(self, columns: Array, straight: Array, sense: Array) -> Array:
        """Return a straight posture whose knuckle is stretched too, if zero is half a fist.

        The knuckle's angle does not change the finger's length, so that its zero position counts as
        straight. If the joints beyond it are flexed at zero, the knuckle is too: it is put at the
        same share of its range as they are at when straight.
        """
        lower, upper = self.hand.limits[:, columns]
        flexed = sense * (self._zero[columns] - straight)
        if sense[0] == 0.0 or len(columns) < 2 or flexed[1:].mean() < _FLEXED_ZERO:
            return straight
        open_end = np.where(sense > 0.0, lower, upper)
        share = (np.abs(straight - open_end) / (upper - lower))[1:].mean()
        knuckle = open_end[0] + sense[0] * share * (upper[0] - lower[0])
        return np.array([knuckle, *straight[1:]])


def nearing(
    view: PalmKinematics,
    ends: Array,
    tips: Sequence[Place],
    i: int,
) -> float:
    """Return how much nearer a tip is to all others in the second of two postures (2, n) [m]."""
    points = view.points(ends, tips)
    before, after = lengths(points - points[:, i : i + 1]).sum(axis=1)
    return float(before - after)


def ends_of(hand: Hand, q: Array, signs: ArrayLike) -> Array:
    """Return two postures: joints with a sign at one end of their range, then the other, (2, n)."""
    limits = np.where(np.greater(signs, 0.0), hand.limits, hand.limits[::-1])
    return np.where(signs, limits, q)


@lru_cache(maxsize=32)
def find_fingers(hand: Hand) -> dict[str, Finger]:
    """Find the fingers that a hand's description names, once: a reach takes a search.

    Points that it names after landmarks (as name or partner) are taken from there. Otherwise the
    tip is the finger's named point farthest from the palm when stretched.

    Returns:
        Fingers by name, in the order of `FINGERS`.
    """
    tips = {f: place_of(hand, point) for f, point in finger_tips(hand).items()}
    supports = hand.model.supports
    in_palm = {*supports[hand.palm_frame.parentJoint]}
    chains = {f: sorted({*supports[joint]} - in_palm) for f, (joint, _) in tips.items()}
    shared = Counter(chain(*chains.values()))
    fingers = {}
    for finger, joints in chains.items():
        own = [joint for joint in joints if shared[joint] == 1]
        fingers[finger] = Finger(hand, joints, tips[finger], name=finger, own=own)
    # Of several points that stand for a landmark, the first one counts.
    for point in reversed(hand.spec.points):
        if point.finger in fingers:
            fingers[point.finger].take(point)
    return fingers


def finger_by_joint(hand: Hand) -> dict[str, str]:
    """Return the finger of each joint that moves one finger alone, by their names.

    Joints that follow others count too; those of a wrist, an arm or a palm have no finger.

    Args:
        hand: The hand.
    """
    return {
        hand.model.names[joint]: name
        for name, finger in find_fingers(hand).items()
        for joint in finger.own
    }


def partner_names(robot: Hand, landmarks: Collection[str]) -> list[str]:
    """Return the name of the human point that each reference point of a robot corresponds to.

    It is the point's `partner`, else the landmark of its own name. A point with neither corresponds
    to `<finger>_tip` if it is the last point of a named finger: the farthest from the palm with the
    hand stretched.

    Args:
        robot: The robot hand.
        landmarks: Names of the human's points.

    Returns:
        Names in the order of `robot.reference_points`; a point's own name where there is no such
        landmark.
    """
    tips = finger_tips(robot).items()
    last = {point.name: f"{finger}_tip" for finger, point in tips}
    return [
        point.partner
        or (point.name if point.name in landmarks else last.get(point.name, point.name))
        for point in robot.reference_points
    ]


def finger_tips(hand: Hand) -> dict[str, PointSpec]:
    """Return the description's point at each finger's tip: a named one, else the farthest out."""
    view = PalmKinematics(hand)

    def reach(point: PointSpec) -> float:
        return math.hypot(*view.points(hand.zero, [place_of(hand, point)])[0])

    tips = {}
    for finger in FINGERS:
        points = [point for point in hand.spec.points if point.finger == finger]
        named = [p for p in points if f"{finger}_tip" in (p.partner, p.name)]
        if named:
            tips[finger] = named[0]
        elif points:
            tips[finger] = max(points, key=reach)
    return tips


def place_of(hand: Hand, point: PointSpec) -> Place:
    """Return the joint of the model that carries a point, and the point's offset on it."""
    frame = hand.frames[point.link]
    return frame.parentJoint, frame.placement.act(np.array(point.xyz))
