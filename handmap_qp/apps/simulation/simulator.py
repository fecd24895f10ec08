"""Step a hand and an object in time: `Simulator`, `Episode`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType
from typing import Any, NamedTuple

import mujoco
import numpy as np
import pinocchio as pin
from numpy.typing import ArrayLike

from handmap_core.se3 import Array, Arrays, affine, check_pose, quat_wxyz_from_rotation
from handmap_qp.hands import Hand
from handmap_qp.mapping import Shape
from .model import MOCAP, OBJECT, TABLE, WRIST, build_model
from .physics import Physics

# Friction of the stand against turning the object acts at the last levers [m]: 2/3 of the radius of
# a disc of 30 mm under even pressure.
_STAND_LEVERS = np.array([1.0, 1.0, 1.0, 0.01, 0.01, 0.01])
# Distances beyond this are not measured [m].
_FAR = 1.0
# From Pinocchio's position and quaternion xyzw to MuJoCo's, wxyz.
_SEVEN = [0, 1, 2, 6, 3, 4, 5]


class Instant(NamedTuple):
    """One instant of a simulation, or many as columns with a leading axis.

    Attributes:
        time: Simulated time [s].
        q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).
        command: Commanded joint angles [rad], shape (n,).
        wrist: Pose of the wrist, shape (4, 4).
        object_pose: Pose of the object, shape (4, 4).
        normal_force: Sum of the normal forces of the hand on the object [N].
        links_touching: Number of joints whose links touch the object.
        torque: Torques of the actuators [N m, N], shape (n,).
    """

    time: Array
    q: Array
    command: Array
    wrist: Array
    object_pose: Array
    normal_force: Array
    links_touching: Array
    torque: Array


class Episode(NamedTuple):
    """A simulation of T instants.

    Attributes:
        hand: The hand.
        shape: The object's shape.
        at: All instants, each field of T rows.
        physics: What was assumed.
    """

    hand: Hand
    shape: Shape
    at: Instant
    physics: Physics

    @classmethod
    def of(cls, simulator: Simulator, instants: Sequence[Instant]) -> Episode:
        """Return what happened in a simulation, instant after instant."""
        columns = map(np.array, zip(*instants, strict=True))
        at = Instant(*columns)
        return cls(simulator.hand, simulator.shape, at, simulator.physics)

    @property
    def columns(self) -> Arrays:
        """Plain arrays by name, as written to a file."""
        return {
            **self.at._asdict(),
            "joint_names": np.array(self.hand.joint_names),
            "robot": np.array(self.hand.name),
            "object_mass": np.array(self.physics.mass),
        }


class Simulator:
    """A hand that holds, or is to hold, an object.

    Args:
        hand: The hand; floating, or on an arm, or fixed to the world.
        shape: The object's shape.
        physics: Contacts, actuators and time steps; the usual ones if omitted.
        table: Height of a level table that carries the object [m], in a world with z up. The hand
            passes through it. No table if omitted.
        furnish: Adds further parts to the specification before it is compiled.
        others: Further hands that float, by what the names of their bodies begin with. They are
            at rest at the origin until they are led.

    Attributes:
        hand: The hand.
        shape: The object's shape.
        physics: Contacts, actuators and time steps.
        model: The `mujoco.MjModel`.
        data: The state, `mujoco.MjData`.
        target: Commanded configuration (`Hand.configuration_vector`), shape (nq,).

    Raises:
        HandError: If the hand has no collision shapes.
    """

    def __init__(
        self,
        hand: Hand,
        shape: Shape,
        physics: Physics = Physics(),
        table: float | None = None,
        furnish: Callable[[mujoco.MjSpec], None] | None = None,
        others: Mapping[str, Hand] = MappingProxyType({}),
    ) -> None:
        self.hand = hand
        self.shape = shape
        self.physics = physics
        self.model = build_model(hand, shape, self.physics, table, furnish, others)
        self.data = mujoco.MjData(self.model)
        self._driven = _DrivenHand(hand, self.model, self.data)
        self._others = {
            prefix: _DrivenHand(other, self.model, self.data, prefix)
            for prefix, other in others.items()
        }
        self.target = hand.configuration_vector(hand.rest)
        self._due = 0.0
        # No shape has the number -1.
        self._table = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_GEOM, TABLE)
        self._collides = np.array(
            [self.model.geom_contype, self.model.geom_conaffinity]
        )
        # The actuators are in the order of the joints' names; those of further hands follow.
        own = self.model.actuator_trnid[: len(hand.joint_names), 0]
        self._places = self.model.jnt_qposadr[own]

    @property
    def time(self) -> float:
        """Simulated time since the start [s]."""
        return float(self.data.time)

    @property
    def q(self) -> Array:
        """Joint angles in the order of `hand.joint_names` [rad], shape (n,)."""
        return self.data.qpos[self._places].copy()

    @property
    def wrist(self) -> Array:
        """Pose of the wrist in the world, shape (4, 4)."""
        return self.wrist_of()

    def wrist_of(self, prefix: str = "") -> Array:
        """Return the pose of a hand's wrist in the world, shape (4, 4), by its prefix."""
        return _pose_of(self.data.site(prefix + WRIST))

    @property
    def object_pose(self) -> Array:
        """Pose of the object in the world, shape (4, 4)."""
        return self.body_pose(OBJECT)

    @property
    def links(self) -> list[str]:
        """Joints that carry links with shapes, named as in `body_pose`."""
        model = self.model
        names = {model.body(body).name for body in model.geom_bodyid}
        return sorted(names - {OBJECT, TABLE})

    def body_pose(self, name: str) -> Array:
        """Return the pose of a body in the world, shape (4, 4).

        Args:
            name: The joint of the hand that carries it, or `world`.
        """
        return _pose_of(self.data.body(name))

    def instant(self) -> Instant:
        """Return what is now."""
        forces = self.pressing().values()
        return Instant(
            time=np.array(self.time),
            q=self.q,
            command=self.target[self.hand.q_indices],
            wrist=self.wrist,
            object_pose=self.object_pose,
            normal_force=np.array(sum(forces)),
            links_touching=np.array(len(forces)),
            torque=self.data.actuator_force[: len(self._places)].copy(),
        )

    def reset(
        self,
        configuration: Array,
        object_pose: ArrayLike,
        others: Mapping[str, Array] = MappingProxyType({}),
    ) -> None:
        """Put hands and object at rest.

        Args:
            configuration: That of the hand (`Hand.configuration_vector`), shape (nq,).
            object_pose: Pose of the object, shape (4, 4).
            others: Configurations of further hands, by their prefixes; as they were if omitted.

        Raises:
            InvalidInputError: On a wrong pose.
        """
        data = self.data
        self.target = configuration
        pose = check_pose(object_pose, "object_pose")
        mujoco.mj_resetData(self.model, data)
        self.set_stand(holds=False)
        quat = quat_wxyz_from_rotation(pose[:3, :3])
        data.joint(OBJECT).qpos = np.concatenate([pose[:3, 3], quat])
        self._driven.put(configuration)
        for prefix, other in self._others.items():
            other.put(others.get(prefix, other.target))
        self._due = 0.0
        self.lead(configuration)
        mujoco.mj_forward(self.model, data)

    def set_stand(self, holds: bool) -> None:
        """Let a stand carry the object, or let go.

        The stand carries the weight m g. A push beyond the friction, mu m g along each axis of the
        world, moves the object, as on a table.
        """
        body = self.model.body(OBJECT)
        weight = body.mass * np.linalg.norm(self.physics.gravity)
        self.model.body_gravcomp[body.id] = holds
        friction = self.physics.friction * weight if holds else 0.0
        self.model.joint(OBJECT).frictionloss = friction * _STAND_LEVERS

    def set_passing(self, bodies: Collection[str]) -> None:
        """Let some links pass through the object; all others touch it.

        Args:
            bodies: Joints whose links pass, named as in `body_pose`; a later call replaces them.
        """
        model = self.model
        names = (model.body(body).name for body in model.geom_bodyid)
        touches = np.array([name not in bodies for name in names])
        model.geom_contype[:], model.geom_conaffinity[:] = self._collides * touches

    def follow(
        self,
        goal: Array,
        duration: float,
        others: Mapping[str, Array] = MappingProxyType({}),
    ) -> None:
        """Move the command at an even speed to a configuration, and simulate meanwhile.

        Args:
            goal: Commanded configuration at the end (`Hand.configuration_vector`), shape (nq,).
            duration: Time that it takes [s]. It ends at a whole step of the simulation; later calls
                make up for the rest, so that the time of a recording is kept.
            others: Commanded configurations of further hands at the end, by their prefixes.
        """
        start = self.target
        self.target = goal
        starts = {prefix: self._others[prefix].target for prefix in others}
        self._due += duration
        steps = max(1, round((self._due - self.time) / self.physics.time_step))
        for share in np.arange(1, steps + 1) / steps:
            self.lead(pin.interpolate(self.hand.model, start, goal, share))
            for prefix, end in others.items():
                other = self._others[prefix]
                model = other.hand.model
                other.lead(pin.interpolate(model, starts[prefix], end, share))
            mujoco.mj_step(self.model, self.data)
        # Contacts and velocities of the state after the last step.
        mujoco.mj_forward(self.model, self.data)

    def pressing(self) -> dict[str, float]:
        """Return the normal forces of the links on each joint that touch the object [N].

        Joints are named as in `body_pose`.
        """
        model = self.model
        held = model.geom(OBJECT).id
        force = np.zeros(6)
        found: dict[str, float] = {}
        for row, contact in enumerate(self.data.contact):
            if held in contact.geom and contact.efc_address >= 0:
                (link,) = contact.geom[contact.geom != held]
                if link == self._table:
                    continue
                mujoco.mj_contactForce(model, self.data, row, force)
                name = model.body(model.geom_bodyid[link]).name
                found[name] = found.get(name, 0.0) + force[0]
        return found

    def clearance(self, bodies: Sequence[str] = ()) -> float:
        """Return how far the object is from the hand [m], < 0 where they overlap.

        Args:
            bodies: Joints, named as in `body_pose`, whose links count; all if omitted.
        """
        model = self.model
        held = model.geom(OBJECT).id
        shapes = {*range(model.ngeom)} - {held, self._table}
        return min(
            (
                mujoco.mj_geomDistance(model, self.data, shape, held, _FAR, None)
                for shape in shapes
                if not bodies or model.body(model.geom_bodyid[shape]).name in bodies
            ),
            default=_FAR,
        )

    def lead(self, command: Array) -> None:
        """Command the joints and, of a hand that floats, the body that leads its base.

        Args:
            command: Configuration of the hand, shape (nq,).
        """
        self._driven.lead(command)


class _DrivenHand:
    """A hand in a model, driven by its actuators and by the body that leads its base.

    Args:
        hand: The hand.
        model: The model.
        data: The state.
        prefix: What the names of its bodies, joints and actuators begin with.

    Attributes:
        hand: The hand.
        target: Last commanded configuration, shape (nq,).
    """

    def __init__(
        self,
        hand: Hand,
        model: mujoco.MjModel,
        data: mujoco.MjData,
        prefix: str = "",
    ) -> None:
        self.hand = hand
        self.target = hand.configuration_vector(hand.rest)
        self._data = data
        self._prefix = prefix
        self._actuators = [model.actuator(prefix + n).id for n in hand.joint_names]
        self._mocap = (
            int(model.body(prefix + MOCAP).mocapid[0]) if hand.is_floating else -1
        )

    def put(self, configuration: Array) -> None:
        """Put the hand at rest in a configuration, shape (nq,)."""
        model = self.hand.model
        for joint in model.joints[1:]:
            own = configuration[joint.idx_q :][: joint.nq]
            name = self._prefix + model.names[joint.id]
            self._data.joint(name).qpos = own[_SEVEN] if joint.nq == 7 else own
        self.lead(configuration)

    def lead(self, command: Array) -> None:
        """Command the joints, and the base if the hand floats, by a configuration, (nq,)."""
        self.target = command
        self._data.ctrl[self._actuators] = command[self.hand.q_indices]
        if self._mocap >= 0:
            base = command[_SEVEN]
            self._data.mocap_pos[self._mocap] = base[:3]
            self._data.mocap_quat[self._mocap] = base[3:]


def _pose_of(part: Any) -> Array:
    """Return the pose of a body or site in the world, shape (4, 4)."""
    return affine(part.xmat.reshape(3, 3), part.xpos)
