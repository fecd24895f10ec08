"""`Hand`: any hand, human or robot, as a Pinocchio model with named reference points.

A floating hand hangs from a free-flyer, a fixed one from the world. Pinocchio sorts sibling joints
by name; `joint_names` is the order of every `q` of the API, and only this file knows both.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Sequence
from copy import copy
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_core.errors import HandError, InvalidInputError, expect
from handmap_core.hands import (
    CONTACT_GAP,
    LONGEST_STOP,
    Names,
    Side,
    Values,
    joints_at_limit,
    moved_by,
)
from handmap_core.se3 import (
    Array,
    Arrays,
    PoseLike,
    affine,
    as_floats,
    check_pose,
    frozen,
)
from .compiled import core_tree
from .configuration import PinocchioConfiguration
from .human import (
    HumanLengths,
    JointMove,
    joint_moves,
    scaled_human_urdf,
    shape_stretches,
)
from .model import (
    build_model,
    choose_mount,
    compose_urdf,
    moved_model,
    tighten_model,
)
from .sources import read_urdf
from .spec import HandSpec, Mount, PointSpec, Positions, Problems, check_point, twice
from .urdf import NO_LIMIT

if TYPE_CHECKING:
    from handmap_core import _core

Points = str | Sequence[str | PointSpec]
"""A choice of reference points: the name of a set, or names and points."""

_LINK = pin.FrameType.BODY
_JOINT = pin.FrameType.JOINT
# Made when first read, and again by a copy.
_CACHED = (
    "frames",
    "moves_wrist",
    "carries_limbs",
    "joint_weights",
    "tree",
    "_scratch",
)
_LIMB_WEIGHT = 30.0
"""Weight of a joint that carries another limb: a robot that stands falls if it bends its waist."""


class Hand:
    """A hand: a URDF in Pinocchio, the order of its joints, its frames and reference points.

    Sessions may share a hand: its arrays are read-only, and its methods return new ones.

    Args:
        spec: The description.
        points: Reference points: name of a set, names of points, or points of your own (link and
            offset). The spec's own choice if omitted.
        mount: `floating` or `fixed`, in place of the spec's.
        urdf_text: URDF to use in place of the spec's file (a scaled one, say).

    Attributes:
        spec: The description.
        name: Short name.
        side: `right` or `left`.
        mount: `floating` or `fixed`.
        is_floating: Whether the wrist is free to move.
        joint_names: The n joints of every `q` in its order, an arm's first, without followers.
        joints: The same as joints of the model.
        q_indices: Indices of the joints in a Pinocchio configuration, shape (n,).
        v_indices: Indices of the joints in the model's tangent space, shape (n,).
        limits: Position limits [rad or m], such that followers keep theirs, shape (2, n).
        lower_limits: The lower ones, shape (n,).
        upper_limits: The upper ones, shape (n,).
        velocity_limits: Speed limits [rad/s or m/s], shape (n,).
        zero: Zero, or the limit next to it, of every joint [rad or m], shape (n,).
        rest: Rest posture [rad or m], shape (n,).
        neutral_match: The spec's posture for the resting human hand [rad or m], shape (n,); None
            if it has none.
        spread: From the k active tangent coordinates (wrist and `joint_names`, in the model's
            order) to the model's: S, shape (nv, k).
        joint_motion: Motion of the model per unit of every joint: columns of S, shape (nv, n).
        active_columns: Indices of the active coordinates in the model's tangent space, shape (k,).
        joint_columns: Indices of `joint_names` in the active coordinates, shape (n,).
        all_joint_names: All movable joints: `joint_names`, then followers, then locked joints.
        all_joint_roles: What each is: `active`, `follower` or `locked`.
        rules: How followers move, by name: none follows another one.
        notes: Oddities found while building the hand, a sentence each.
        reference_points: The points in use; m of them.
        point_weights: Their weights, shape (m,).
        palm_frame: The palm's `pinocchio.Frame`, which the model does not have.
        wrist_frame: The wrist's frame, likewise.
        wrist_to_palm: Pose of the palm frame in the wrist frame, shape (4, 4).
        contact_gap: Of a human hand, `HumanLengths.contact_gap` [m].
        palm_weights: Likewise, `HumanLengths.palm_weights`, shape (5,).
        unscaled: Of a hand scaled to a person, the one that was scaled; else None.
        moves: Of a hand scaled to a person, how its joints move: see `joint_moves`.
        stretches: Likewise, factors on the shapes of fingers: see `shape_stretches`.
        parts: The hands of a robot that is moved as one (`hands.robot.joined`); else empty.
        has_floating_base: Whether that robot walks or drives.
        limb_carriers: Joints that carry a limb whose locked joints are gone from its URDF; those of
            other limbs are found there (`carries_limbs`).

    Raises:
        HandError: If spec and URDF do not fit together, naming file, key and value.
        InvalidInputError: If an argument is of another type than expected.
        MissingExtraError: If the URDF lies in a package that is not installed.
    """

    contact_gap = CONTACT_GAP
    palm_weights = frozen(np.ones(5))
    unscaled: Hand | None = None
    parts: tuple[Hand, ...] = ()
    has_floating_base = False
    limb_carriers: Names = ()

    def __init__(
        self,
        spec: HandSpec,
        *,
        points: Points | None = None,
        mount: Mount | None = None,
        urdf_text: str | None = None,
    ) -> None:
        _check_type("spec", spec, HandSpec, "a HandSpec")
        _check_type("urdf_text", urdf_text, str | None, "the text of a URDF")
        self.spec = spec
        self.moves: dict[str, JointMove] = {}
        self.stretches: Arrays = {}
        self.name = spec.name
        self.side = spec.side
        self.mount: Mount = choose_mount(spec, mount)
        self.is_floating = self.mount == "floating"
        chosen = _choose_points(spec, points)
        self.urdf_text, locked, self.rules = compose_urdf(spec, urdf_text)
        self.model = model = build_model(spec, self.urdf_text, self.mount, self.rules)
        self.notes = tighten_model(model, self.rules)
        self._index_joints(locked)
        ends = np.array([model.lowerPositionLimit, model.upperPositionLimit])
        self.limits = frozen(ends.take(self.q_indices, axis=1))
        self.lower_limits, self.upper_limits = self.limits
        self.velocity_limits = _frozen(model.velocityLimit[self.v_indices])
        self.zero = frozen(np.clip(0.0, *self.limits))
        self._take_postures()
        self._find_wrist_and_palm()
        self.use_points(chosen)

    def _take_postures(self) -> None:
        """Take over the description's postures; check them and the limits."""
        spec = self.spec
        for note in self.notes:
            warnings.warn(f"{self.name}: {note}", stacklevel=3)
        # An arm is at rest in every posture of the description.
        arm = spec.arm.rest if spec.arm else {}

        def posture(own: Positions) -> Array:
            return _frozen([(arm | own)[name] for name in self.joint_names])

        self.rest = posture(spec.rest)
        match = spec.neutral_match
        self.neutral_match = None if match is None else posture(match)
        spec.reject(self._limit_problems())

    def _limit_problems(self) -> Problems:
        """Check that limits are finite and that the description's postures lie inside them."""
        postures = {"rest": self.rest, "neutral_match": self.neutral_match}
        rows = zip(self.joint_names, *self.limits, self.velocity_limits, strict=True)
        for i, (name, lower, upper, speed) in enumerate(rows):
            interval = f"[{lower:.6g}, {upper:.6g}]"
            key = f"limits.{name}"
            if not max(-lower, upper) < NO_LIMIT:
                lacks = "has no limits in the URDF: give lower, upper and velocity"
                yield f"{name!r} {lacks}", key, name
            if not lower < upper:
                needs = f"needs limits with lower < upper, got {interval}"
                yield f"{name!r} {needs}", key, None
            if not 0.0 < speed < math.inf:
                yield f"{name!r} needs a velocity limit > 0, got {speed:.6g}", key, None
            for title, posture in postures.items():
                if posture is not None and not lower <= (at := posture[i]) <= upper:
                    outside = f"{at:.6g} is outside the joint's limits {interval}"
                    yield outside, f"{title}.{name}", float(at)

    @cached_property
    def model(self) -> pin.Model:
        """Pinocchio model, not to be changed: a floating wrist's six coordinates, then joints.

        That of a hand scaled to a person is made of the unscaled hand's: a URDF takes 20 ms.
        """
        assert self.unscaled is not None
        return moved_model(self.unscaled.model, self.moves)

    @cached_property
    def frames(self) -> dict[str, pin.Frame]:
        """Frame of the model for each link, by the link's name."""
        return {f.name: f for f in self.model.frames if f.type == _LINK}

    @cached_property
    def point_frames(self) -> tuple[pin.Frame, ...]:
        """Pinocchio frames of the reference points, which the model does not have."""
        return tuple(
            self._frame(
                point.name,
                point.link,
                f"points[{i}].link",
                affine(np.eye(3), point.xyz),
            )
            for i, point in enumerate(self.reference_points)
        )

    @cached_property
    def urdf_text(self) -> str:
        """The URDF as it was built, scaled and mirrored, with absolute paths of its meshes."""
        standard = read_urdf(self.spec)
        return compose_urdf(self.spec, scaled_human_urdf(standard, self._lengths))[0]

    @cached_property
    def _lengths(self) -> HumanLengths:
        """Lengths of a human hand; a `HandError` if it is none of this package."""
        return HumanLengths.from_urdf(read_urdf(self.spec))

    @cached_property
    def tree(self) -> _core.Tree:
        """The kinematics of the compiled core; a `HandError` if it cannot move a joint."""
        return core_tree(self)

    @property
    def wrist_speeds(self) -> tuple[float, float]:
        """Speed limits of a floating wrist [m/s, rad/s]."""
        wrist = self.spec.wrist
        return wrist.max_linear_speed, wrist.max_angular_speed

    @property
    def upright(self) -> str:
        """Axes of its world that are up and forward, such as `+z up, +x forward`."""
        return self.spec.upright

    @property
    def has_moving_wrist(self) -> bool:
        """Whether six free coordinates or the joints of an arm move the wrist."""
        return self.wrist_frame.parentJoint > 0

    @property
    def is_on_arm(self) -> bool:
        """Whether joints of an arm move the wrist."""
        return self.has_moving_wrist and not self.is_floating

    @property
    def hands(self) -> tuple[Hand, ...]:
        """The hands of a robot that is moved as one; else this hand alone."""
        return self.parts or (self,)

    @property
    def by_side(self) -> dict[Side, Hand]:
        """The same by their side."""
        return {hand.side: hand for hand in self.hands}

    @cached_property
    def moves_wrist(self) -> Array:
        """Which joints move the wrist, those of an arm, or a wrist of a robot, shape (n,)."""
        carried = [self.carries(hand.wrist_frame) for hand in self.hands]
        return frozen(np.any(carried, axis=0))

    @cached_property
    def carries_limbs(self) -> Array:
        """Which joints of an arm carry another limb too, such as a waist or a torso, shape (n,).

        A limb has a movable joint, and hangs neither from a wrist nor on the way to it.
        """
        found = np.isin(self.joint_names, self.limb_carriers)
        supports = self.model.supports
        for hand in self.hands:
            wrist = hand.wrist_frame.parentJoint
            way = {*supports[wrist]}
            for carrier in hand._carriers(way):
                common = {*supports[carrier]}
                if wrist not in common:
                    found |= np.isin(self.joints, [*common & way])
        return frozen(found)

    def _carriers(self, way: set[int]) -> Iterator[int]:
        """Yield the joint that carries each movable joint that is not on the way to the wrist."""
        model = self.model
        for joint in self.joints:
            if joint not in way:
                yield model.parents[joint]
        frame = model.getFrameId(self.spec.wrist.link, _LINK)
        before = set()
        while frame:
            before.add(frame)
            frame = model.frames[frame].parentFrame
        for name, role in zip(self.all_joint_names, self.all_joint_roles, strict=True):
            if role == "locked":
                locked = model.getFrameId(name, pin.FrameType.FIXED_JOINT)
                if locked not in before:
                    yield model.frames[locked].parentJoint

    @cached_property
    def joint_weights(self) -> Array:
        """What each joint's motion costs, 1 for most: `HandSpec.joint_weights`; shape (n,)."""
        usual = np.where(self.carries_limbs, _LIMB_WEIGHT, 1.0)
        given = self.spec.joint_weights
        named = zip(self.joint_names, usual, strict=True)
        return frozen(np.array([given.get(name, at) for name, at in named]))

    def carries(self, frame: pin.Frame) -> Array:
        """Return which joints carry a frame of the model, shape (n,)."""
        (moves,) = moved_by(self.model, [frame.parentJoint])
        return moves[self.v_indices] > 0.0

    @property
    def moves_points(self) -> Array:
        """Which joints move each reference point, shape (m, n)."""
        moves = moved_by(self.model, [f.parentJoint for f in self.point_frames])
        return moves @ np.abs(self.joint_motion) > 0.0

    @property
    def finger_joints(self) -> Array:
        """Which joints move points of each of its h hands, and no wrist, shape (h, n)."""
        moved = [hand.moves_points.any(axis=0) for hand in self.hands]
        return moved & ~self.moves_wrist

    @property
    def stop_distances(self) -> Array:
        """How far each joint moves at most while it stops [rad or m], shape (n,).

        From its speed limit and `LONGEST_STOP`, within its range.
        """
        ranges = self.upper_limits - self.lower_limits
        return np.minimum(0.5 * LONGEST_STOP * self.velocity_limits, ranges)

    @property
    def extent(self) -> float:
        """RMS distance of the reference points from their mean at rest [m]."""
        return float(np.linalg.norm(self.points(self.rest).std(axis=0)))

    def at_position_limit(self, q: Array) -> Array:
        """Return which joints are within 1e-6 rad or m of a position limit, shape (n,)."""
        return joints_at_limit(q, self.limits)

    def __repr__(self) -> str:
        """Name, side, mount, joints and points in one line."""
        counts = f"joints={len(self.joint_names)}, points={len(self.reference_points)}"
        return (
            f"Hand({self.name!r}, side={self.side!r}, mount={self.mount!r}, {counts})"
        )

    def __getstate__(self) -> Values:
        """Return all that is not cached: a copy has a workspace of its own, for another thread."""
        return {key: value for key, value in vars(self).items() if key not in _CACHED}

    def __copy__(self) -> Hand:
        """Return a hand that shares all that is not cached."""
        hand = object.__new__(type(self))
        vars(hand).update(self.__getstate__())
        return hand

    def __setstate__(self, state: Values) -> None:
        """Take over the attributes, and write-protect arrays again: pickle drops the flag."""
        vars(self).update(state)
        for value in state.values():
            if isinstance(value, Array):
                value.setflags(write=False)

    def with_points(self, points: Points | None) -> Hand:
        """Return the same hand, scaled as it is, with other reference points, as in `Hand`.

        Raises:
            HandError: If there is no such set or point.
            InvalidInputError: If it is something else than names and points.
        """
        chosen = _choose_points(self.spec, points)
        if chosen == self.reference_points:
            return self
        # All but the model is read-only, so both hands share it.
        hand = copy(self)
        hand.use_points(chosen)
        return hand

    def with_contact_gap(self, gap: float) -> Hand:
        """Return the same human hand with another contact gap [m]."""
        hand = copy(self)
        hand.contact_gap = gap
        return hand

    def with_lengths(self, lengths: HumanLengths) -> Hand:
        """Return the same human hand, scaled to a person without reading a URDF."""
        hand = copy(self)
        hand.unscaled = self
        hand._lengths = lengths
        hand.contact_gap = lengths.contact_gap
        hand.palm_weights = lengths.palm_weights
        hand.moves = joint_moves(self._lengths, lengths, mirrors=self.spec.mirror)
        hand.stretches = shape_stretches(self._lengths, lengths)
        for of_lengths in ("model", "point_frames", "urdf_text"):
            vars(hand).pop(of_lengths, None)
        return hand

    def configuration(self) -> PinocchioConfiguration:
        """Return a new workspace for this hand, for one user at a time."""
        return PinocchioConfiguration(self)

    def configuration_vector(
        self, q: ArrayLike, wrist_pose: PoseLike | None = None
    ) -> Array:
        """Compose Pinocchio's configuration vector, shape (model.nq,).

        Args:
            q: Joint angles of `joint_names` [rad or m], shape (n,); limits are not checked.
            wrist_pose: Pose of the wrist frame in the world, shape (4, 4) or a `pinocchio.SE3`; the
                identity if omitted. A fixed hand rejects it.

        Raises:
            InvalidInputError: On a wrong shape, numbers that are not finite, or a wrong wrist pose.
        """
        angles = as_floats(q, "q", shape=(len(self.joint_names),), is_finite=True)
        pose = None
        if wrist_pose is not None:
            pose = check_pose(wrist_pose, "wrist_pose")
            expected = (
                f"none: {self.name} has a fixed wrist (mount='floating' frees it)"
            )
            expect(self.is_floating, "wrist_pose", expected, value=wrist_pose)
        vector = np.zeros(self._size)
        positions = angles @ self._motion.T + self._shift
        vector[self._moving_q] = positions[: len(self._moving_q)]
        if self.is_floating:
            root = self._wrist_to_root
            if pose is not None:
                root = pin.SE3(pose) * root
            vector[:7] = pin.SE3ToXYZQUAT(root)
        return vector

    def configuration_vectors(self, q: ArrayLike) -> Array:
        """Compose Pinocchio's configuration vectors of many postures, shape (T, model.nq).

        Args:
            q: Joint angles of `joint_names` [rad or m], a row a posture, shape (T, n), or of one
                posture, (n,); limits are not checked. The wrist frame is at the origin.

        Raises:
            InvalidInputError: On a wrong shape, or anything but finite numbers.
        """
        positions = np.atleast_2d(self.all_joints(q))
        still = self.configuration_vector(self.zero)
        vectors = np.tile(still, (len(positions), 1))
        vectors[:, self._moving_q] = positions[:, : len(self._moving_q)]
        return vectors

    def all_joints(self, q: ArrayLike) -> Array:
        """Compute the positions of every movable joint, for a driver that needs them.

        Args:
            q: Joint angles of `joint_names` [rad or m], shape (n,), or a row a sample, (T, n).

        Returns:
            Positions in the order of `all_joint_names` [rad or m], shape (n_all,) or (T, n_all).

        Raises:
            InvalidInputError: On a wrong shape, or anything but finite numbers.
        """
        count = len(self.joint_names)
        angles = as_floats(q, "q", is_finite=True)
        expected = f"shape ({count},) or (T, {count})"
        is_right = angles.ndim in (1, 2) and angles.shape[-1] == count
        expect(is_right, "q", expected, value=q, got=f"shape {angles.shape}")
        return angles @ self._motion.T + self._shift

    def points(self, q: ArrayLike, wrist_pose: PoseLike | None = None) -> Array:
        """Compute the positions of the reference points in the world (eq. 4) [m], shape (m, 3).

        Args and errors are those of `configuration_vector`.
        """
        return self._placed(q, wrist_pose).points.copy()

    def point_jacobian(self, q: ArrayLike, wrist_pose: PoseLike | None = None) -> Array:
        """Compute the derivative of the reference points with respect to the joint angles.

        Args and errors are those of `configuration_vector`.

        Returns:
            Jacobian [m/rad, or 1], rows x, y, z of each point, columns of `joint_names`, (3 m, n).
        """
        return self._placed(q, wrist_pose).point_jacobian()[:, self.joint_columns]

    def frame_pose(
        self, frame: str, q: ArrayLike, wrist_pose: PoseLike | None = None
    ) -> Array:
        """Compute the pose of a frame in the world, shape (4, 4).

        Args:
            frame: `"palm"`, `"wrist"`, the name of a reference point, of a link, or of a joint
                (whose frame is its child link's), searched in this order.
            q: See `configuration_vector`.
            wrist_pose: See `configuration_vector`.

        Raises:
            InvalidInputError: If there is no such frame, or as `configuration_vector`.
        """
        _check_type("frame", frame, str, "a name")
        own = {point.name: point for point in self.point_frames}
        own |= {"palm": self.palm_frame, "wrist": self.wrist_frame}
        found = own.get(frame) or self._find(frame, "frame", _LINK, _JOINT)
        return self._placed(q, wrist_pose).frame_pose(found)

    def link_poses(
        self, links: Sequence[str], q: ArrayLike, wrist_pose: PoseLike | None = None
    ) -> Array:
        """Compute the poses of k links of the URDF in the world, shape (k, 4, 4).

        Only links are searched. The other arguments are those of `configuration_vector`.

        Raises:
            InvalidInputError: If there is no such link, or as `configuration_vector`.
        """
        expect(
            isinstance(links, Sequence) and not isinstance(links, str),
            "links",
            "names of links",
            value=links,
        )
        frames = [
            self._find(link, f"links[{i}]", _LINK) for i, link in enumerate(links)
        ]
        placed = self._placed(q, wrist_pose)
        poses = [placed.frame_pose(frame) for frame in frames]
        return np.array(poses).reshape(-1, 4, 4)

    def _index_joints(self, locked: Positions) -> None:
        """Name all joints, find them in Pinocchio's vectors, and map the active ones to all."""
        model = self.model
        rules = self.rules
        names = self.spec.all_joints
        moving = (*names, *rules)
        count = len(names)
        self.joint_names = names
        self.all_joint_names = (*moving, *locked)
        others = ("follower",) * len(rules) + ("locked",) * len(locked)
        self.all_joint_roles = ("active",) * count + others
        joints = [*map(model.getJointId, moving)]
        self.joints = joints[:count]
        self._size = model.nq
        self._moving_q = np.array(model.idx_qs)[joints]
        at_v = np.array(model.idx_vs)[joints]
        self.q_indices = frozen(self._moving_q[:count])
        self.v_indices = frozen(at_v[:count])
        self.active_columns = frozen(np.setdiff1d(np.arange(model.nv), at_v[count:]))
        self.joint_columns = frozen(
            np.searchsorted(self.active_columns, self.v_indices)
        )
        # From positions of `joint_names` to those of all joints.
        motion = np.eye(len(self.all_joint_names), count)
        shift = np.zeros(len(motion))
        for row, rule in enumerate(rules.values(), count):
            motion[row, names.index(rule.joint)] = rule.multiplier
            shift[row] = rule.offset
        shift[len(moving) :] = [*locked.values()]
        self._motion = motion
        self._shift = shift
        spread = np.eye(model.nv)
        spread[np.ix_(at_v, self.v_indices)] = motion[: len(moving)]
        self.spread = frozen(spread[:, self.active_columns])
        self.joint_motion = frozen(spread[:, self.v_indices])

    def _find_wrist_and_palm(self) -> None:
        """Find the frames of wrist and palm."""
        spec = self.spec
        palm = spec.palm
        side = np.cross(palm.distal, palm.dorsal)
        pose = affine(np.column_stack([side, palm.distal, palm.dorsal]), palm.xyz)
        self.palm_frame = self._frame("palm", palm.link, "palm.link", pose)
        wrist = spec.wrist.link
        self.wrist_frame = self._frame("wrist", wrist, "wrist.link", np.eye(4))
        spec.reject(self._wrist_problems())
        self._wrist_to_root = self.wrist_frame.placement.inverse()
        to_palm = self._wrist_to_root * self.palm_frame.placement
        self.wrist_to_palm = frozen(to_palm.homogeneous)

    def _wrist_problems(self) -> Problems:
        """Check that wrist and palm do not move with the fingers.

        Only the free-flyer or the joints of an arm may move them, and both together.
        """
        model, spec = self.model, self.spec
        frames = filter(None, (self.frames.get(point.link) for point in spec.points))
        carriers = {frame.parentJoint for frame in frames}
        wrist = self.wrist_frame.parentJoint
        palm = self.palm_frame.parentJoint
        for key, link, joint in (
            ("wrist.link", spec.wrist.link, wrist),
            ("palm.link", spec.palm.link, palm),
        ):
            # All other joints hang from it or carry it.
            related = {*model.subtrees[joint], *model.supports[joint]}
            if carriers - related or (self.is_floating and joint != 1):
                moves = f"{link!r} moves with joints of the hand"
                yield f"{moves}; it must be fixed to the root, or to an arm", key, link
        if wrist != palm:
            what = f"moves against the wrist's link {spec.wrist.link!r}"
            yield f"{spec.palm.link!r} {what}", "palm.link", spec.palm.link

    def _frame(self, name: str, link: str, key: str, pose: Array) -> pin.Frame:
        """Return a frame at a pose (4, 4) on a link, which a key of a spec names."""
        if link not in self.frames:
            raise self.spec.error(f"the URDF has no link {link!r}", key, link)
        parent = self.frames[link]
        placement = parent.placement * pin.SE3(pose)
        return pin.Frame(name, parent.parentJoint, placement, pin.FrameType.OP_FRAME)

    def use_points(self, points: tuple[PointSpec, ...]) -> None:
        """Use other reference points, while nobody else has this hand."""
        self.reference_points = points
        self.point_weights = _frozen([point.weight for point in points])
        for of_points in ("point_frames", "tree"):
            vars(self).pop(of_points, None)
        # A link that does not exist is reported here.
        len(self.point_frames)

    @cached_property
    def _scratch(self) -> PinocchioConfiguration:
        """Workspace of the methods that place the hand; most hands with other points need none."""
        return self.configuration()

    def _placed(
        self, q: ArrayLike, wrist_pose: PoseLike | None
    ) -> PinocchioConfiguration:
        self._scratch.place(self.configuration_vector(q, wrist_pose))
        return self._scratch

    def _find(self, name: str, argument: str, *kinds: pin.FrameType) -> pin.Frame:
        """Return the frame of a link or joint; by kind, as many joints are named as their link."""
        _check_type(argument, name, str, "a name")
        for kind in kinds:
            if self.model.existFrame(name, kind):
                return self.model.frames[self.model.getFrameId(name, kind)]
        raise InvalidInputError(
            f"{self.name} has no link {name!r}", argument=argument, value=name
        )


def _choose_points(spec: HandSpec, points: Points | None) -> tuple[PointSpec, ...]:
    """Resolve a choice of reference points."""
    if points is None or isinstance(points, str):
        points = _look_up(spec, "set", spec.sets, points or spec.reference)
    _check_type(
        "points", points, tuple | list, "the name of a set, or names and points"
    )
    named = {point.name: point for point in spec.points}
    chosen = tuple(
        _look_up(spec, "point", named, point)
        if isinstance(point, str)
        else _checked_point(point, f"points[{i}]")
        for i, point in enumerate(points)
    )
    if not chosen:
        raise spec.error("expected at least one reference point", "points")
    spec.reject(twice([point.name for point in chosen], "points"))
    return chosen


def _checked_point(point: PointSpec, argument: str) -> PointSpec:
    """Check a point that the caller built."""
    _check_type(argument, point, PointSpec, "a name or a PointSpec")
    try:
        return check_point(point)
    except HandError as error:
        argument = f"{argument}.{error.key}" if error.key else argument
        raise InvalidInputError(
            error.problem, argument=argument, value=error.value
        ) from error


def _look_up(spec: HandSpec, kind: str, named: Values, name: str) -> Any:
    """Return a set or a point by its name."""
    if name not in named:
        known = ", ".join(named)
        message = f"no {kind} {name!r}; there are {known}"
        raise spec.error(message, f"{kind}s", name)
    return named[name]


def _check_type(argument: str, value: Any, kind: Any, expected: str) -> None:
    expect(isinstance(value, kind), argument, expected, value=value)


def _frozen(values: ArrayLike) -> Array:
    """Return a write-protected copy as floats."""
    return frozen(np.array(values, dtype=float))
