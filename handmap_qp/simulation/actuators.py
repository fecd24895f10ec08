"""Actuators of the fingers: servos that are told a position, or motors that are told a torque.

Both press with `K (q_command - q) - D dq`. A servo has one stiffness and follows its own joint. The
torques of Sec. IV are those of soft synergies: the springs of joints and synergies are in series,
so that K couples the joints (the paper's [22]).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, Protocol

import mujoco
import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import finite_array, positive_number
from handmap_qp.hands.hand import Hand
from handmap_qp.simulation.physics import Physics

ActuatorKind = Literal["position", "torque"]
"""Servos (`PositionActuators`) or motors (`TorqueActuators`)."""


@dataclass(frozen=True, slots=True, eq=False)
class Drive:
    """The law of one hand's actuators, and how its model is driven.

    Attributes:
        stiffness: K [N m/rad, N/m for slides], shape (n, n).
        damping: D, critical for every mode of K and the joints' inertias [N m s/rad], shape (n, n).
        is_torque: Whether each joint's control is a torque, not a position, shape (n,).
    """

    stiffness: np.ndarray
    damping: np.ndarray
    is_torque: np.ndarray

    def controls(self, command: np.ndarray, q: np.ndarray, velocity: np.ndarray) -> np.ndarray:
        """Return the controls that a command asks for.

        Args:
            command: Commanded joint angles [rad], shape (n,).
            q: Joint angles now [rad], shape (n,).
            velocity: Joint velocities now [rad/s], shape (n,).

        Returns:
            Torques [N m], or positions [rad] for servos, shape (n,).
        """
        if not self.is_torque.any():
            return command
        torques = self.stiffness @ (command - q) - self.damping @ velocity
        return np.where(self.is_torque, torques, command)


class Actuators(Protocol):
    """A kind of actuators, for any hand."""

    def drive(self, hand: Hand, physics: Physics, inertia: np.ndarray) -> Drive:
        """Return the law for one hand.

        Args:
            hand: The hand.
            physics: Stiffness of the joints.
            inertia: Inertia felt at each joint [kg m^2], shape (n,).
        """
        ...


@dataclass(frozen=True, slots=True)
class PositionActuators:
    """Servos of `Physics.joint_stiffness`, each on its own joint."""

    def drive(self, hand: Hand, physics: Physics, inertia: np.ndarray) -> Drive:
        """Return the servos of a hand; see `Actuators`."""
        stiffness = np.diag(_joint_stiffness(hand, physics))
        return Drive(stiffness, _critical(stiffness, inertia), np.zeros(len(inertia), dtype=bool))


@dataclass(frozen=True, slots=True, eq=False)
class TorqueActuators:
    """Motors that a controller tells the torques of soft synergies, at every step of time.

    With `tau = K_q (S z - q)` and `S^T tau = K_z (z_ref - z)`, the command `q_ref = S z_ref` gives
    `tau = K (q_ref - q)`, `K = (K_q^-1 + S K_z^-1 S^T)^-1`. Without synergies K is K_q. The
    controller also gives the torques that carry the hand's own weight. An arm keeps its servos.

    Attributes:
        synergies: S, joint angles per unit of each synergy [rad], shape (n, n_z); none if omitted.
        synergy_stiffness: K_z, the same for each synergy [N m per unit].
    """

    synergies: np.ndarray | None = None
    synergy_stiffness: float = 1.0

    def __post_init__(self) -> None:
        if self.synergies is not None:
            matrix = finite_array(self.synergies, ("n", "m"), "synergies")
            object.__setattr__(self, "synergies", matrix)
        positive_number(self.synergy_stiffness, "synergy_stiffness")

    def drive(self, hand: Hand, physics: Physics, inertia: np.ndarray) -> Drive:
        """Return the motors of a hand; see `Actuators`.

        Raises:
            InvalidInputError: If the synergies are those of a hand with other joints.
        """
        compliance = np.diag(1.0 / _joint_stiffness(hand, physics))
        if self.synergies is not None:
            if len(self.synergies) != len(inertia):
                raise InvalidInputError(
                    argument="synergies",
                    expected=f"{len(inertia)} rows, as {hand.name} has joints",
                    got=f"{len(self.synergies)}",
                )
            compliance += self.synergies @ self.synergies.T / self.synergy_stiffness
        stiffness = np.linalg.inv(compliance)
        is_torque = ~_is_arm(hand)
        return Drive(stiffness, _critical(stiffness, inertia), is_torque)


def install(drive: Drive, model: Any, hand: Hand, physics: Physics) -> None:
    """Set up the actuators of a compiled model, one for each joint of the hand in order.

    Args:
        drive: The law.
        model: `mujoco.MjModel`; its actuators have affine bias.
        hand: The hand.
        physics: The largest effort of the fingers.
    """
    gains, dampings = np.diag(drive.stiffness), np.diag(drive.damping)
    is_limited = np.isfinite(physics.effort_limit) & ~_is_arm(hand)
    for i, name in enumerate(hand.joint_names):
        joint = model.joint(name).id
        if drive.is_torque[i]:
            model.actuator_gainprm[i, 0] = 1.0
            # The torque that carries the hand's own weight is the actuator's, not a passive one.
            model.jnt_actgravcomp[joint] = 1
        else:
            model.actuator_gainprm[i, 0] = gains[i]
            model.actuator_biasprm[i, :3] = 0.0, -gains[i], -dampings[i]
        if is_limited[i]:
            model.jnt_actfrclimited[joint] = 1
            model.jnt_actfrcrange[joint] = -physics.effort_limit, physics.effort_limit


def felt_inertia(model: Any, addresses: np.ndarray) -> np.ndarray:
    """Return the inertia felt at joints in the model's own posture [kg m^2], shape (n,).

    Args:
        model: `mujoco.MjModel`.
        addresses: Index of each joint in `qvel`, shape (n,).
    """
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, inertia)
    return np.diag(inertia)[addresses]


def _is_arm(hand: Hand) -> np.ndarray:
    """Return which joints are those of an arm, shape (n,)."""
    arm = () if hand.spec.arm is None else hand.spec.arm.joints
    return np.array([name in arm for name in hand.joint_names])


def _joint_stiffness(hand: Hand, physics: Physics) -> np.ndarray:
    return np.where(_is_arm(hand), physics.arm_stiffness, physics.joint_stiffness)


def _critical(stiffness: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return `2 M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2`: critical damping of each mode."""
    root = np.sqrt(np.outer(inertia, inertia))
    squares, modes = np.linalg.eigh(stiffness / root)
    return 2.0 * root * ((modes * np.sqrt(squares)) @ modes.T)
