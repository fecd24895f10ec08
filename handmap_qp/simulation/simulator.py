"""Step a hand and an object in time: `Simulator`, and what it measures: `Contacts`."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation, Slerp

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import finite_array
from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import affine, check_pose, inverse_pose
from handmap_qp.simulation.actuators import Actuators, PositionActuators
from handmap_qp.simulation.model import MOCAP, OBJECT, build_model
from handmap_qp.simulation.physics import Body, Physics

# Friction of the stand against turning the object acts at this lever [m]: 2/3 of the radius of a
# disc of 30 mm under even pressure.
_STAND_LEVER = 0.01


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


class Simulator:
    """A hand that holds, or is to hold, an object.

    Args:
        hand: The hand; floating, or on an arm, or fixed to the world.
        body: The object.
        physics: Contacts, stiffness and time steps; the usual ones if omitted.
        actuators: What moves the joints; servos if omitted.

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
        actuators: Actuators | None = None,
    ) -> None:
        self.hand, self.body = hand, body
        self.physics = physics or Physics()
        self.parts = build_model(hand, body, self.physics, actuators or PositionActuators())
        self.data = mujoco.MjData(self.parts.model)
        self._target: tuple[np.ndarray, np.ndarray | None] | None = None
        self._geom_joint = self._joints_of_geoms()

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
        base = self._pose_at(self.parts.base_q)
        return base @ self._base_to_wrist

    @property
    def object_pose(self) -> np.ndarray:
        """Pose of the object in the world, shape (4, 4)."""
        return self._pose_at(self.parts.object_q)

    @property
    def command(self) -> np.ndarray:
        """Commanded joint angles [rad], shape (n,)."""
        assert self._target is not None, "reset first"
        return self._target[0].copy()

    @property
    def stiffness(self) -> np.ndarray:
        """Stiffness K of the actuators, torque per displacement [N m/rad], shape (n, n)."""
        return self.parts.drive.stiffness

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
        angles = finite_array(q, (len(self.hand.joint_names),), "q")
        pose = check_pose(object_pose, "object_pose")
        place = None if wrist is None else check_pose(wrist, "wrist")
        if self.hand.is_floating == (place is None):
            raise InvalidInputError(
                argument="wrist", expected="a pose for a floating hand, else None", value=wrist
            )
        mujoco.mj_resetData(self.parts.model, self.data)
        self.set_gravity(1.0)
        self.set_stand(holds=False)
        for address, value in zip(self.parts.all_q, self.hand.all_joints(angles), strict=True):
            if address >= 0:
                self.data.qpos[address] = value
        self._set_pose(self.parts.object_q, pose)
        self._control(angles)
        if place is not None:
            base = place @ inverse_pose(self._base_to_wrist)
            self._set_pose(self.parts.base_q, base)
            values = self.data.qpos[self.parts.base_q : self.parts.base_q + 7]
            self.data.mocap_pos[self._mocap] = values[:3]
            self.data.mocap_quat[self._mocap] = values[3:]
        self._target = (angles, place)
        mujoco.mj_forward(self.parts.model, self.data)

    def set_stand(self, holds: bool) -> None:
        """Let a stand carry the object, or let go.

        The stand carries the weight m g. A push beyond the friction, mu m g along each axis of the
        world, moves the object, as on a table.
        """
        model, held = self.parts.model, self.parts.object
        first = model.body_dofadr[held]
        weight = float(model.body_mass[held] * np.linalg.norm(self.physics.gravity))
        friction = self.physics.friction * weight if holds else 0.0
        model.body_gravcomp[held] = float(holds)
        model.dof_frictionloss[first : first + 3] = friction
        model.dof_frictionloss[first + 3 : first + 6] = _STAND_LEVER * friction

    def set_gravity(self, share: float) -> None:
        """Set gravity to a share of its full value."""
        self.parts.model.opt.gravity[:] = share * np.array(self.physics.gravity)

    def follow(self, q: npt.ArrayLike, wrist: np.ndarray | None, duration: float) -> None:
        """Move the command in a straight line to a posture, and simulate meanwhile.

        Args:
            q: Commanded joint angles at the end [rad], shape (n,).
            wrist: Commanded wrist pose at the end, shape (4, 4); None for a hand that does not
                float.
            duration: Time that it takes [s], rounded to whole steps of the simulation.
        """
        assert self._target is not None, "reset first"
        goal = np.asarray(q, dtype=float)
        start, start_wrist = self._target
        steps = max(1, round(duration / self.physics.time_step))
        places = self._places_between(start_wrist, wrist, steps)
        data, model, mocap = self.data, self.parts.model, self._mocap
        for k in range(steps):
            self._control(start + (k + 1) / steps * (goal - start))
            if places is not None:
                data.mocap_pos[mocap], data.mocap_quat[mocap] = places[0][k], places[1][k]
            mujoco.mj_step(model, data)
        self._target = (goal.copy(), None if wrist is None else wrist.copy())
        # Contacts and velocities of the state after the last step.
        mujoco.mj_forward(self.parts.model, self.data)

    def hold(self, duration: float) -> None:
        """Keep the last command, and simulate."""
        assert self._target is not None, "reset first"
        self.follow(*self._target, duration)

    def _control(self, command: np.ndarray) -> None:
        """Tell the actuators a command [rad], shape (n,)."""
        data, parts = self.data, self.parts
        q, velocity = data.qpos[parts.joint_q], data.qvel[parts.joint_v]
        data.ctrl[:] = parts.drive.controls(command, q, velocity)

    def contacts(self) -> Contacts:
        """Return the contacts between the hand and the object."""
        points, normals, forces, joints = [], [], [], []
        held = self.parts.model.geom(OBJECT).id
        wrench = np.zeros(6)
        for index in range(self.data.ncon):
            contact = self.data.contact[index]
            if held not in contact.geom:
                continue
            other = int(contact.geom[0] if contact.geom[1] == held else contact.geom[1])
            if other not in self._geom_joint or contact.efc_address < 0:
                continue
            mujoco.mj_contactForce(self.parts.model, self.data, index, wrench)
            frame = contact.frame.reshape(3, 3)
            # The frame's x axis points from the first geom to the second, on which the force acts.
            sign = 1.0 if contact.geom[1] == held else -1.0
            points.append(contact.pos.copy())
            normals.append(sign * frame[0])
            forces.append(sign * (frame.T @ wrench[:3]))
            joints.append(self._geom_joint[other])
        shape = (-1, 3)
        return Contacts(
            np.array(points).reshape(shape),
            np.array(normals).reshape(shape),
            np.array(forces).reshape(shape),
            tuple(joints),
        )

    @cached_property
    def _base_to_wrist(self) -> np.ndarray:
        """Return the wrist's pose in the floating base, shape (4, 4)."""
        vector = self.hand.configuration_vector(self.hand.rest, np.eye(4))
        return inverse_pose(_pose_of_seven(vector[:7]))

    @cached_property
    def _mocap(self) -> int:
        """Return the index of the body that leads the base; -1 on a hand that does not float."""
        return int(self.parts.model.body(MOCAP).mocapid[0]) if self.hand.is_floating else -1

    def _places_between(
        self, start: np.ndarray | None, end: np.ndarray | None, steps: int
    ) -> tuple[np.ndarray, np.ndarray] | None:
        """Return positions and quaternions (wxyz) of the base on the way to a wrist pose.

        Shapes are (steps, 3) and (steps, 4); the start is not among them.
        """
        if start is None or end is None:
            return None
        shares = np.arange(1, steps + 1) / steps
        ends = Rotation.from_matrix([start[:3, :3], end[:3, :3]])
        wrist_to_base = inverse_pose(self._base_to_wrist)
        turns = Slerp([0.0, 1.0], ends)(shares)
        places = start[:3, 3] + shares[:, None] * (end[:3, 3] - start[:3, 3])
        places = places + turns.apply(wrist_to_base[:3, 3])
        quats = (turns * Rotation.from_matrix(wrist_to_base[:3, :3])).as_quat()
        return places, quats[:, [3, 0, 1, 2]]

    def _pose_at(self, address: int) -> np.ndarray:
        values = self.data.qpos[address : address + 7]
        w, x, y, z = values[3:]
        return affine(Rotation.from_quat([x, y, z, w]).as_matrix(), values[:3].copy())

    def _set_pose(self, address: int, pose: np.ndarray) -> None:
        # A copy, because SciPy before 1.17 takes no read-only array.
        x, y, z, w = Rotation.from_matrix(np.array(pose[:3, :3])).as_quat()
        self.data.qpos[address : address + 7] = (*pose[:3, 3], w, x, y, z)

    def _joints_of_geoms(self) -> dict[int, str]:
        """Return the joint that carries each geom of the hand."""
        model, names = self.parts.model, {}
        for geom in range(model.ngeom):
            body = model.body(model.geom_bodyid[geom]).name
            if body != OBJECT:
                names[geom] = body.removesuffix("_body") if body.endswith("_body") else ""
        return names


def _pose_of_seven(values: np.ndarray) -> np.ndarray:
    return affine(Rotation.from_quat(values[3:7]).as_matrix(), values[:3].copy())
