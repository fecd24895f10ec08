"""`Hand`: any hand, human or robot, as a Pinocchio model with named reference points.

The model holds the wrist too: a floating hand hangs from a free-flyer, a fixed one from the world.
Reference points are frames of the model, so one Pinocchio call places them all. `joint_names` owns
the order of every `q` that crosses the API; Pinocchio sorts sibling joints by name, and only this
file knows both orders.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import HandError, InvalidInputError
from handmap_qp.hands.configuration import Configuration
from handmap_qp.hands.mimic import (
    Expansion,
    MimicRule,
    expansion_matrix,
    read_mimic_rules,
    tighten_model,
)
from handmap_qp.hands.spec import HandSpec, Mount, PointSpec
from handmap_qp.hands.urdf.compose import compose_urdf
from handmap_qp.hands.urdf.elements import parse_urdf
from handmap_qp.hands.urdf.files import read_urdf as read_urdf
from handmap_qp.hands.urdf.files import urdf_path as urdf_path
from handmap_qp.transform import affine

_ROOT = "wrist_mount"


class Hand:
    """A hand.

    A URDF in Pinocchio, the order of its joints, its palm and wrist frames and its reference
    points. Sessions may share it: its arrays are read-only, and its methods return new ones.

    Args:
        spec: What the hand is.
        points: Reference points to use: the name of one of the spec's sets, names of its points, or
            points of your own (link and offset). The spec's own choice if omitted.
        mount: `floating` or `fixed`, overriding the spec's.
        urdf_text: URDF to use in place of the spec's file (a scaled one, say).

    Attributes:
        spec: The description.
        name: Short name.
        side: `right` or `left`.
        mount: `floating` or `fixed`.
        urdf_text: The URDF as it was built, after scaling and mirroring.
        model: Pinocchio model: the wrist's six coordinates first where it floats, then the joints
            in Pinocchio's order, and the reference points as its last frames.
        joint_names: Joints that are set, in the order of every `q`, those of an arm first; n of
            them. Followers of other joints (mimic) are none of them.
        q_indices: Where they are in a configuration, shape (n,).
        v_indices: Where they are in the model's tangent space, shape (n,).
        lower_limits: Lower position limits, those of the joints' followers considered [rad, or m of
            a prismatic joint], shape (n,).
        upper_limits: Upper position limits [rad or m], shape (n,).
        velocity_limits: Speed limits [rad/s or m/s], shape (n,).
        rest: Rest posture [rad or m], shape (n,).
        expansion: From the active tangent coordinates (wrist and `joint_names`, in the model's
            order; k of them) to all of the model's: S, shape (nv, k), and the followers' offsets,
            shape (nv,). None without followers: all are active.
        active_columns: Where the active coordinates are in the model's tangent space, shape (k,).
        joint_columns: Where the joints are in the active coordinates, in the order of
            `joint_names`, shape (n,).
        all_joint_names: Every movable joint of the URDF: `joint_names`, then followers, then locked
            joints.
        all_joint_roles: What each is: `active`, `follower` or `locked`.
        notes: What was found odd while building the hand, a sentence each.
        reference_points: The points in use; m of them.
        point_weights: Their weights, shape (m,).
        wrist_to_palm: Pose of the palm frame in the wrist frame, shape (4, 4).

    Raises:
        HandError: If spec and URDF do not fit together, naming file, key and value.
        MissingExtraError: If the URDF lives in a package that is not installed.
    """

    def __init__(
        self,
        spec: HandSpec,
        *,
        points: str | tuple[str | PointSpec, ...] | None = None,
        mount: Mount | None = None,
        urdf_text: str | None = None,
    ) -> None:
        self.spec = spec
        self.name = spec.name
        self.side = spec.side
        self.mount: Mount = _mount(spec, mount)
        self._file_text = read_urdf(spec) if urdf_text is None else urdf_text
        self.urdf_text, locked = compose_urdf(
            spec, self._file_text, None if spec.arm is None else read_urdf(spec.arm)
        )
        rules = self._mimic_rules()
        followers = tuple(rule.follower for rule in rules)
        self.model = _build_model(spec, self.urdf_text, self.mount, followers)
        self.joint_names = spec.all_joints
        self.all_joint_names = (*self.joint_names, *followers, *locked)
        self.all_joint_roles = (
            ("active",) * len(self.joint_names)
            + ("follower",) * len(followers)
            + ("locked",) * len(locked)
        )
        joint_ids = [self._joint_id(name) for name in self.joint_names]
        follower_ids = [self._joint_id(name) for name in followers]
        self.q_indices = _frozen([self.model.joints[i].idx_q for i in joint_ids], int)
        self.v_indices = _frozen([self.model.joints[i].idx_v for i in joint_ids], int)
        self._follower_q = np.array([self.model.joints[i].idx_q for i in follower_ids], dtype=int)
        follower_v = [self.model.joints[i].idx_v for i in follower_ids]
        self.active_columns = _frozen(np.setdiff1d(np.arange(self.model.nv), follower_v), int)
        self.joint_columns = _frozen(np.searchsorted(self.active_columns, self.v_indices), int)
        self._expansion = expansion_matrix((*self.joint_names, *followers), self.joint_names, rules)
        self.expansion = (
            _tangent_expansion(self._expansion, self.active_columns, self.joint_columns, follower_v)
            if rules
            else None
        )
        self.notes = tighten_model(self.model, rules)
        for note in self.notes:
            warnings.warn(f"{self.name}: {note}", stacklevel=2)
        self._locked = np.array(list(locked.values()))
        self.lower_limits = _frozen(self.model.lowerPositionLimit[self.q_indices])
        self.upper_limits = _frozen(self.model.upperPositionLimit[self.q_indices])
        self.velocity_limits = _frozen(self.model.velocityLimit[self.v_indices])
        self.rest = _frozen([spec.all_rest[name] for name in self.joint_names])
        self._check_limits()
        self.palm_frame_id = self._add_frame(
            "palm", spec.palm.link, _palm_in_link(spec), "palm.link"
        )
        self.wrist_frame_id = self._add_frame("wrist", spec.wrist.link, np.eye(4), "wrist.link")
        self.reference_points = self._choose_points(points)
        self.point_weights = _frozen([point.weight for point in self.reference_points])
        for i, point in enumerate(self.reference_points):
            self._add_frame(
                point.name, point.link, affine(np.eye(3), np.array(point.xyz)), f"points[{i}].link"
            )
        self.first_point_frame = len(self.model.frames) - len(self.reference_points)
        wrist, palm = (
            self.model.frames[frame] for frame in (self.wrist_frame_id, self.palm_frame_id)
        )
        self._check_wrist(wrist, palm)
        self._wrist_to_root = wrist.placement.inverse()
        self.wrist_to_palm = _frozen((self._wrist_to_root * palm.placement).homogeneous)
        self._scratch = self.configuration()

    @property
    def is_floating(self) -> bool:
        """Whether the wrist is free to move."""
        return self.mount == "floating"

    @property
    def has_moving_wrist(self) -> bool:
        """Whether anything moves the wrist.

        Six free coordinates, or the joints of an arm that the hand is mounted on.
        """
        return self.model.frames[self.wrist_frame_id].parentJoint > 0

    def at_position_limit(self, q: np.ndarray) -> np.ndarray:
        """Return which joints are within 1e-6 rad or m of a position limit, shape (n,)."""
        return (q <= self.lower_limits + 1e-6) | (q >= self.upper_limits - 1e-6)

    def __repr__(self) -> str:
        """Name, side, joints and points in one line."""
        return (
            f"Hand({self.name!r}, side={self.side!r}, mount={self.mount!r}, joints={len(self.joint_names)}, "
            f"points={len(self.reference_points)})"
        )

    def with_points(self, points: str | tuple[str | PointSpec, ...] | None) -> Hand:
        """The same hand, scaled as it is, with other reference points; arguments as of `Hand`."""
        return Hand(self.spec, points=points, mount=self.mount, urdf_text=self._file_text)

    def configuration(self) -> Configuration:
        """A new workspace for this hand, for one user at a time."""
        expansion = None if self.expansion is None else self.expansion.matrix
        return Configuration(
            self.model,
            wrist_frame=self.wrist_frame_id,
            first_point=self.first_point_frame,
            expansion=expansion,
        )

    def configuration_vector(
        self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Pinocchio's configuration vector for joint angles and a wrist pose.

        Args:
            q: Joint angles in the order of `joint_names` [rad], shape (n,).
            wrist_pose: Pose of the wrist frame in the world, shape (4, 4); the identity if omitted.
                Refused by a fixed hand.

        Returns:
            Configuration, shape (model.nq,).

        Raises:
            InvalidInputError: On a wrong shape, or a wrist pose for a fixed hand.
        """
        angles = np.asarray(q, dtype=float)
        if angles.shape != (len(self.joint_names),):
            raise InvalidInputError(
                f"q: expected shape ({len(self.joint_names)},) for {self.name}, got {angles.shape}"
            )
        if wrist_pose is not None and not self.is_floating:
            raise InvalidInputError(
                f"{self.name} has a fixed wrist: its pose cannot be given (mount='floating' frees it)"
            )
        vector = np.zeros(self.model.nq)
        self.write_configuration(vector, angles, np.eye(4) if wrist_pose is None else wrist_pose)
        return vector

    def write_configuration(
        self, vector: np.ndarray, q: np.ndarray, wrist_pose: np.ndarray
    ) -> None:
        """The same into an array of the caller's, unchecked, for use sample by sample.

        A fixed hand ignores the wrist pose.
        """
        vector[self.q_indices] = q
        if self.expansion is not None:
            matrix, offset = self._expansion
            vector[self._follower_q] = matrix[len(q) :] @ q + offset[len(q) :]
        if self.is_floating:
            vector[:7] = pin.SE3ToXYZQUAT(pin.SE3(wrist_pose) * self._wrist_to_root)

    def all_joints(self, q: npt.ArrayLike) -> np.ndarray:
        """Positions of every movable joint of the URDF, followers and locked ones among them.

        For a driver that wants them all.

        Args:
            q: Joint angles in the order of `joint_names` [rad or m], shape (n,), or one row a
                sample, shape (T, n).

        Returns:
            Positions in the order of `all_joint_names` [rad or m], shape (n_all,) or (T, n_all).
        """
        angles = np.asarray(q, dtype=float)
        moving = angles @ self._expansion.matrix.T + self._expansion.offset
        return np.concatenate(
            [moving, np.broadcast_to(self._locked, (*angles.shape[:-1], len(self._locked)))],
            axis=-1,
        )

    def points(self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None) -> np.ndarray:
        """Positions of the reference points (eq. 4).

        Args:
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Points in the world [m], shape (m, 3).
        """
        self._scratch.place_frames(self.configuration_vector(q, wrist_pose))
        return self._scratch.points.copy()

    def point_jacobian(self, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None) -> np.ndarray:
        """Derivative of the reference points with respect to the joint angles.

        Args:
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Jacobian [m/rad], rows x, y, z of each point in turn, columns in the order of
            `joint_names`, shape (3 m, n).
        """
        self._scratch.place_with_jacobians(self.configuration_vector(q, wrist_pose))
        return self._scratch.point_jacobian()[:, self.joint_columns]

    def frame_pose(
        self, frame: str, q: npt.ArrayLike, wrist_pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Pose of a link or joint, of `"palm"` or of `"wrist"` in the world.

        Args:
            frame: `"palm"`, `"wrist"`, the name of a reference point, of a link, or of a joint
                (whose frame is its child link's).
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Pose, shape (4, 4).

        Raises:
            InvalidInputError: If there is no such frame.
        """
        own = f"{_ROOT}/{frame}"
        if not self.model.existFrame(own):
            if self.model.existFrame(frame, pin.FrameType.BODY) or not self.model.existFrame(
                frame, pin.FrameType.JOINT
            ):
                return self.link_poses([frame], q, wrist_pose)[0]
            own = frame
        self._scratch.place_frames(self.configuration_vector(q, wrist_pose))
        return self._scratch.data.oMf[self.model.getFrameId(own)].homogeneous

    def link_poses(
        self, links: Sequence[str], q: npt.ArrayLike, wrist_pose: np.ndarray | None = None
    ) -> np.ndarray:
        """Poses of links in the world, where `frame_pose` would find a palm, wrist or reference point of the same name first.

        Args:
            links: Names of links of the URDF, k of them.
            q: Joint angles [rad], shape (n,).
            wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

        Returns:
            Poses, shape (k, 4, 4).

        Raises:
            InvalidInputError: If there is no such link.
        """
        for link in links:
            if not self.model.existFrame(link, pin.FrameType.BODY):
                raise InvalidInputError(f"{self.name} has no link {link!r}", value=link)
        self._scratch.place_frames(self.configuration_vector(q, wrist_pose))
        frames = [self.model.getFrameId(link, pin.FrameType.BODY) for link in links]
        return np.array([self._scratch.data.oMf[frame].homogeneous for frame in frames]).reshape(
            -1, 4, 4
        )

    def _mimic_rules(self) -> tuple[MimicRule, ...]:
        try:
            rules = read_mimic_rules(parse_urdf(self.urdf_text))
        except HandError as error:
            raise self.spec.error(
                str(error).removeprefix(f"{error.key}: "),
                key=error.key or "urdf",
                value=error.value,
            ) from error
        for rule in rules:
            if rule.follower in self.spec.all_joints:
                message = f"{rule.follower!r} mimics {rule.leader!r} and cannot be set: leave it out, or give mimic.{rule.follower}: null"
                raise self.spec.error(message, key="joints", value=rule.follower)
        return rules

    def _joint_id(self, name: str) -> int:
        if not self.model.existJointName(name):
            raise self.spec.error(
                f"the URDF has no movable joint {name!r}", key="joints", value=name
            )
        return self.model.getJointId(name)

    def _check_limits(self) -> None:
        columns = zip(
            self.joint_names,
            self.lower_limits,
            self.upper_limits,
            self.velocity_limits,
            self.rest,
            strict=True,
        )
        for name, lower, upper, speed, rest in columns:
            if not (np.isfinite(lower) and np.isfinite(upper) and lower < upper):
                message = f"{name!r} needs limits with lower < upper, got [{lower:.6g}, {upper:.6g}]: give them in `limits`"
                raise self.spec.error(message, key="urdf")
            if not (np.isfinite(speed) and speed > 0.0):
                message = (
                    f"{name!r} needs a velocity limit > 0, got {speed:.6g}: give it in `limits`"
                )
                raise self.spec.error(message, key="urdf")
            if not lower <= rest <= upper:
                message = f"{rest:.6g} rad is outside the joint's limits [{lower:.6g}, {upper:.6g}]"
                raise self.spec.error(message, key=f"rest.{name}", value=rest)

    def _choose_points(
        self, points: str | tuple[str | PointSpec, ...] | None
    ) -> tuple[PointSpec, ...]:
        named = {point.name: point for point in self.spec.points}
        if points is None or isinstance(points, str):
            set_name = points or self.spec.reference
            if set_name not in self.spec.sets:
                known = ", ".join(self.spec.sets)
                raise self.spec.error(
                    f"no set {set_name!r}; there are {known}", key="sets", value=set_name
                )
            points = self.spec.sets[set_name]
        for point in points:
            if isinstance(point, str) and point not in named:
                raise self.spec.error(
                    f"no point {point!r}; there are {', '.join(named)}", key="points", value=point
                )
        chosen = tuple(named[point] if isinstance(point, str) else point for point in points)
        if not chosen:
            raise self.spec.error("expected at least one reference point", key="points")
        return chosen

    def _add_frame(self, name: str, link: str, placement: np.ndarray, key: str) -> int:
        # By kind as well as by name: many URDFs have a joint of the same name as its link.
        if not self.model.existFrame(link, pin.FrameType.BODY):
            raise self.spec.error(f"the URDF has no link {link!r}", key=key, value=link)
        parent_id = self.model.getFrameId(link, pin.FrameType.BODY)
        parent = self.model.frames[parent_id]
        frame = pin.Frame(
            f"{_ROOT}/{name}",
            parent.parentJoint,
            parent_id,
            parent.placement * pin.SE3(placement),
            pin.FrameType.OP_FRAME,
        )
        return self.model.addFrame(frame)

    def _check_wrist(self, wrist: pin.Frame, palm: pin.Frame) -> None:
        """Refuse a wrist or palm among the fingers.

        Only the free-flyer or the joints of an arm may move them, both as one.
        """
        for key, link, frame in (
            ("wrist.link", self.spec.wrist.link, wrist),
            ("palm.link", self.spec.palm.link, palm),
        ):
            if self.is_floating and frame.parentJoint != 1:
                message = f"{link!r} moves with joints; on a floating hand it must be fixed to the root link"
                raise self.spec.error(message, key=key, value=link)
            if not self._moves_all_fingers(frame.parentJoint):
                message = f"{link!r} moves with the fingers; it must be fixed to the root link or to the end of an arm"
                raise self.spec.error(message, key=key, value=link)
        if wrist.parentJoint != palm.parentJoint:
            message = (
                f"{self.spec.palm.link!r} moves against the wrist's link {self.spec.wrist.link!r}"
            )
            raise self.spec.error(message, key="palm.link", value=self.spec.palm.link)

    def _moves_all_fingers(self, joint: int) -> bool:
        """Whether every joint is above this one or below it."""
        above = set(self.model.supports[joint])
        return all(
            other in above or joint in self.model.supports[other]
            for other in range(1, self.model.njoints)
        )


def _tangent_expansion(
    joints: Expansion, active: np.ndarray, columns: np.ndarray, follower_v: list[int]
) -> Expansion:
    """S and offset over the model's tangent space, where the wrist's coordinates stand for themselves."""
    nv, count = len(active) + len(follower_v), len(columns)
    matrix, offset = np.eye(nv)[:, active], np.zeros(nv)
    matrix[np.ix_(follower_v, columns.tolist())] = joints.matrix[count:]
    offset[follower_v] = joints.offset[count:]
    return Expansion(_frozen(matrix), _frozen(offset))


def _mount(spec: HandSpec, mount: Mount | None) -> Mount:
    """How the root of the model is held: a hand on an arm stands on the arm's foot."""
    if spec.arm is None:
        return mount or spec.wrist.mount
    if mount == "floating":
        raise spec.error(
            f"{spec.name} is mounted on {spec.arm.name}, and cannot float", key="arm", value=mount
        )
    return "fixed"


def _build_model(
    spec: HandSpec, urdf_text: str, mount: Mount, followers: tuple[str, ...]
) -> pin.Model:
    try:
        if mount == "floating":
            model = pin.buildModelFromXML(urdf_text, pin.JointModelFreeFlyer(), _ROOT)
        else:
            model = pin.buildModelFromXML(urdf_text)
    except (RuntimeError, ValueError) as error:
        raise spec.error(
            f"Pinocchio cannot read the URDF: {' '.join(str(error).split())}", key="urdf"
        ) from error
    for name, joint in zip(model.names, model.joints, strict=True):
        if name in ("universe", _ROOT):
            continue
        if name not in spec.all_joints and name not in followers:
            raise spec.error(
                f"the URDF's joint {name!r} is missing: name it here or in `locked`",
                key="joints",
                value=name,
            )
        if joint.nq != 1:
            raise spec.error(
                f"{name!r} is a {joint.shortname()}; only joints with one coordinate can be used",
                key="joints",
            )
    return model


def _palm_in_link(spec: HandSpec) -> np.ndarray:
    distal, dorsal = np.array(spec.palm.distal), np.array(spec.palm.dorsal)
    return affine(
        np.column_stack([np.cross(distal, dorsal), distal, dorsal]), np.array(spec.palm.xyz)
    )


def _frozen(values: npt.ArrayLike, dtype: type = float) -> np.ndarray:
    """Return a write-protected copy."""
    array = np.array(values, dtype=dtype)
    array.setflags(write=False)
    return array
