"""Step a hand and an object in time: `Simulator`, `Contacts`, `Episode`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from handmap_qp.apps.simulation.model import BASE, OBJECT, build_model
from handmap_qp.apps.simulation.physics import Body, Physics
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import affine, as_floats, check_pose, inverse_pose

# Friction of the stand against turning the object acts at the last levers [m]: 2/3 of the radius of
# a disc of 30 mm under even pressure.
_STAND_LEVERS = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])


class Contacts(NamedTuple):
    """Contacts between the hand and the object at one instant.

    Attributes:
        points: Places in the world [m], shape (n, 3).
        normals: Unit normals into the object, shape (n, 3).
        forces: Forces of the hand on the object, world axes [N], shape (n, 3).
        joints: Name of the joint that carries the touching link, for each contact; empty for the
            hand's base.
    """

    points: np.ndarray
    normals: np.ndarray
    forces: np.ndarray
    joints: tuple[str, ...]

    @property
    def normal_forces(self) -> np.ndarray:
        """Shares of the forces along the normals [N], shape (n,)."""
        return np.einsum("ci,ci->c", self.forces, self.normals)


class Instant(NamedTuple):
    """One instant of a simulation, or many as columns with a leading axis.

    Attributes:
        time: Simulated time [s].
        q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).
        command: Commanded joint angles [rad], shape (n,).
        wrist: Pose of the wrist, shape (4, 4).
        object_pose: Pose of the object, shape (4, 4).
        normal_force: Sum of the normal forces of the hand on the object [N].
        friction_use: Sum of the tangential forces' lengths over what friction allows; NaN without
            contact.
        links_touching: Number of joints whose links touch the object.
    """

    time: np.ndarray
    q: np.ndarray
    command: np.ndarray
    wrist: np.ndarray
    object_pose: np.ndarray
    normal_force: np.ndarray
    friction_use: np.ndarray
    links_touching: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """A simulation of T instants.

    Attributes:
        hand: The hand.
        body: The object.
        at: All instants, each field of T rows.
    """

    hand: Hand
    body: Body
    at: Instant

    @classmethod
    def of(cls, simulator: Simulator, instants: Sequence[Instant]) -> Episode:
        """Return what happened in a simulation, instant after instant."""
        columns = (np.array(column) for column in zip(*instants, strict=True))
        return cls(simulator.hand, simulator.body, Instant(*columns))

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Plain arrays by name, as written to a file."""
        return {
            **self.at._asdict(),
            "joint_names": np.array(self.hand.joint_names),
            "robot": np.array(self.hand.name),
            "object_mass": np.array(self.body.mass),
        }


class Simulator:
    """A hand that holds, or is to hold, an object.

    Args:
        hand: The hand; floating, or on an arm, or fixed to the world.
        body: The object.
        physics: Contacts, actuators and time steps; the usual ones if omitted.
        compliance: Compliance in series with that of the joints [rad/(N m)], shape (n, n), as of
            soft synergies; for motors (`Physics.actuators`).

    Attributes:
        hand: The hand.
        body: The object.
        physics: Contacts, actuators and time steps.
        parts: The model and where its parts are.
        data: `mujoco.MjData`, the state.

    Raises:
        HandError: If the hand has no collision shapes.
    """

    def __init__(
        self,
        hand: Hand,
        body: Body,
        physics: Physics | None = None,
        compliance: np.ndarray | None = None,
    ) -> None:
        self.hand = hand
        self.body = body
        self.physics = physics or Physics()
        self.parts = build_model(hand, body, self.physics, compliance)
        self.data = mujoco.MjData(self.parts.model)
        self._target: tuple[np.ndarray, np.ndarray | None] | None = None

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return float(self.data.time)

    @property
    def q(self) -> np.ndarray:
        """Joint angles in the order of `hand.joint_names` [rad], shape (n,)."""
        return self.data.qpos[self.parts.joint_q].copy()

    @property
    def wrist(self) -> np.ndarray:
        """Pose of the wrist in the world, shape (4, 4)."""
        if not self.hand.is_floating:
            return self.hand.frame_pose("wrist", self.q)
        return self._pose_of(BASE) @ self._base_to_wrist

    @property
    def object_pose(self) -> np.ndarray:
        """Pose of the object in the world, shape (4, 4)."""
        return self._pose_of(OBJECT)

    @property
    def target(self) -> tuple[np.ndarray, np.ndarray | None]:
        """Commanded joint angles [rad], shape (n,), and wrist pose, None if it does not float."""
        assert self._target is not None, "reset first"
        return self._target

    def instant(self) -> Instant:
        """Return what is now."""
        contacts = self.contacts()
        pressing = contacts.normal_forces
        sliding = contacts.forces - pressing[:, None] * contacts.normals
        allowed = self.physics.friction * pressing.sum()
        used = np.linalg.norm(sliding, axis=1).sum()
        return Instant(
            time=np.array(self.time),
            q=self.q,
            command=self.target[0],
            wrist=self.wrist,
            object_pose=self.object_pose,
            normal_force=pressing.sum(),
            friction_use=np.array(used / allowed if allowed > 0.0 else np.nan),
            links_touching=np.array(len(set(contacts.joints))),
        )

    def reset(
        self, q: npt.ArrayLike, wrist: npt.ArrayLike | None, object_pose: npt.ArrayLike
    ) -> None:
        """Put hand and object at rest.

        Args:
            q: Joint angles [rad], shape (n,).
            wrist: Pose of the wrist, shape (4, 4); None for a hand that does not float.
            object_pose: Pose of the object, shape (4, 4).

        Raises:
            InvalidInputError: On a wrong shape, or a wrist for a hand that does not float.
        """
        angles = as_floats(q, "q", shape=(len(self.hand.joint_names),), is_finite=True)
        pose = check_pose(object_pose, "object_pose")
        place = None if wrist is None else check_pose(wrist, "wrist")
        if self.hand.is_floating == (place is None):
            raise InvalidInputError(
                argument="wrist",
                expected="a pose for a floating hand, else None",
                value=wrist,
            )
        parts, data = self.parts, self.data
        mujoco.mj_resetData(parts.model, data)
        self.set_stand(holds=False)
        is_there = parts.all_q >= 0
        data.qpos[parts.all_q[is_there]] = self.hand.all_joints(angles)[is_there]
        data.joint(OBJECT).qpos = _sevens(pose[None])[0]
        if place is not None:
            (base,) = _sevens(place[None] @ inverse_pose(self._base_to_wrist))
            data.joint(BASE).qpos = base
            self._lead_base(base)
        self._control(angles)
        self._target = (angles, place)
        mujoco.mj_forward(parts.model, data)

    def set_stand(self, holds: bool) -> None:
        """Let a stand carry the object, or let go.

        The stand carries the weight m g. A push beyond the friction, mu m g along each axis of the
        world, moves the object, as on a table.
        """
        model, held = self.parts.model, self.parts.object
        weight = model.body_mass[held] * np.linalg.norm(self.physics.gravity)
        friction = self.physics.friction * weight if holds else 0.0
        model.body_gravcomp[held] = holds
        model.joint(OBJECT).frictionloss = friction * _STAND_LEVERS

    def follow(
        self, q: npt.ArrayLike, wrist: np.ndarray | None, duration: float
    ) -> None:
        """Move the command in a straight line to a posture, and simulate meanwhile.

        Args:
            q: Commanded joint angles at the end [rad], shape (n,).
            wrist: Commanded wrist pose at the end, shape (4, 4); None for a hand that does not
                float.
            duration: Time that it takes [s], rounded to whole steps of the simulation.
        """
        goal = np.array(q, dtype=float)
        start, start_wrist = self.target
        steps = max(1, round(duration / self.physics.time_step))
        shares = np.arange(1, steps + 1) / steps
        bases = None
        if wrist is not None and start_wrist is not None:
            places = poses_between(start_wrist, wrist, shares)
            bases = _sevens(places @ inverse_pose(self._base_to_wrist))
        for k, share in enumerate(shares):
            self._control(start + share * (goal - start))
            if bases is not None:
                self._lead_base(bases[k])
            mujoco.mj_step(self.parts.model, self.data)
        self._target = (goal, None if wrist is None else wrist.copy())
        # Contacts and velocities of the state after the last step.
        mujoco.mj_forward(self.parts.model, self.data)

    def hold(self, duration: float) -> None:
        """Keep the last command, and simulate."""
        self.follow(*self.target, duration)

    def contacts(self) -> Contacts:
        """Return the contacts between the hand and the object."""
        model, data = self.parts.model, self.data
        contact = data.contact
        is_object = data.contact.geom == model.geom(OBJECT).id
        rows = np.flatnonzero(is_object.any(axis=1) & (contact.efc_address >= 0))
        forces = np.zeros((len(rows), 6))
        for row, force in zip(rows, forces, strict=True):
            mujoco.mj_contactForce(model, data, row, force)
        # A frame's x axis points from the first geom to the second, on which the force acts.
        signs = np.where(is_object[rows, 1], 1.0, -1.0)
        frames = signs[:, None, None] * contact.frame[rows].reshape(-1, 3, 3)
        bodies = model.geom_bodyid[contact.geom[rows][~is_object[rows]]]
        names = [model.body(body).name for body in bodies]
        return Contacts(
            points=contact.pos[rows],
            normals=frames[:, 0],
            forces=np.einsum("cij,ci->cj", frames, forces[:, :3]),
            joints=tuple(n if self.hand.model.existJointName(n) else "" for n in names),
        )

    def _control(self, command: np.ndarray) -> None:
        """Tell the actuators a command [rad], shape (n,)."""
        data, parts = self.data, self.parts
        data.ctrl[:] = parts.controls(
            command, data.qpos[parts.joint_q], data.qvel[parts.joint_v]
        )

    def _lead_base(self, base: np.ndarray) -> None:
        """Move the body that leads the floating base."""
        # The only one.
        self.data.mocap_pos[0], self.data.mocap_quat[0] = base[:3], base[3:]

    @cached_property
    def _base_to_wrist(self) -> np.ndarray:
        """The wrist's pose in the floating base, shape (4, 4)."""
        base = self.hand.configuration_vector(self.hand.rest, np.eye(4))[:7]
        return inverse_pose(affine(Rotation.from_quat(base[3:]).as_matrix(), base[:3]))

    def _pose_of(self, name: str) -> np.ndarray:
        """Return the pose of a body in the world, shape (4, 4)."""
        body = self.data.body(name)
        return affine(body.xmat.reshape(3, 3), body.xpos)


def poses_between(start: np.ndarray, end: np.ndarray, shares: np.ndarray) -> np.ndarray:
    """Return poses at shares of the way: positions in a line, rotations about one axis.

    Args:
        start: Pose at share 0, shape (4, 4).
        end: Pose at share 1, shape (4, 4).
        shares: Between 0 and 1, shape (k,).

    Returns:
        Poses, shape (k, 4, 4).
    """
    turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
    poses = np.tile(start, (len(shares), 1, 1))
    poses[:, :3, :3] = (
        Rotation.from_rotvec(np.outer(shares, turn)).as_matrix() @ start[:3, :3]
    )
    poses[:, :3, 3] += np.outer(shares, end[:3, 3] - start[:3, 3])
    return poses


def _sevens(poses: np.ndarray) -> np.ndarray:
    """Return poses (k, 4, 4) as positions and quaternions wxyz, as MuJoCo has them, (k, 7)."""
    # A copy: SciPy before 1.16 takes no array that is read-only.
    quats = Rotation.from_matrix(poses[:, :3, :3].copy()).as_quat()
    return np.hstack([poses[:, :3, 3], quats[:, [3, 0, 1, 2]]])
