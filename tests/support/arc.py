"""Section IV with gravity: two hands carry the same object along the arc (`carry`).

Each hand closes on the object without gravity, presses with forces that the statics plan, and takes
the weight. Then the human's wrist follows the paper's arc while a synergy is activated, and the
robot does what the mapping of the human's motion commands. Both are simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from checks import finite_array, positive_number
from grasp_planning import plan_grasps
from scipy.spatial.transform import Rotation
from section_four.contacts import Grasp
from section_four.experiment import HandMotion, Run, Scene

from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Episode, Simulator
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.mapping.objects import Shape
from handmap_qp.se3 import inverse_pose, transform_points

# Time to close, to rest, and to take the weight [s].
_CLOSING, _RESTING, _LOADING = 0.2, 0.2, 0.3
# An object that leaves its place in the hand by more than this is lost [m].
LOST = 0.05
# Share of the cost of tangential forces; they use up friction, normal forces do not.
_TANGENTIAL = 4.0


@dataclass(frozen=True, slots=True)
class ArcOptions:
    """How an object is carried.

    Attributes:
        normal_force: Normal force planned for every contact [N].
        duration: Time of the arc [s].
    """

    normal_force: float = 4.0
    duration: float = 4.0


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """One hand that carried its object.

    Attributes:
        episode: The simulation, its first instant with the weight taken, before the arc.
        slip: Distance that the object moved against the hand's links at the planned contacts, at
            the end [m], shape (n_c,).
        is_lost: Whether the object left its place in the hand.
        stiffness: Stiffness of the actuators [N m/rad], shape (n, n).
    """

    episode: Episode
    slip: np.ndarray
    is_lost: bool
    stiffness: np.ndarray

    @property
    def displacement(self) -> np.ndarray:
        """Displacement of the object's centre [m], shape (3,)."""
        poses = self.episode.at.object_pose
        return poses[-1, :3, 3] - poses[0, :3, 3]

    @property
    def rotation(self) -> np.ndarray:
        """Rotation of the object from start to end, shape (3, 3)."""
        poses = self.episode.at.object_pose
        return poses[-1, :3, :3] @ poses[0, :3, :3].T


@dataclass(frozen=True, slots=True, eq=False)
class ArcOutcome:
    """Both hands after the arc.

    Attributes:
        run: The mapping.
        human: What the human's object did.
        robot: What the robot's object did.
    """

    run: Run
    human: Carried
    robot: Carried

    @property
    def translation_gap(self) -> float:
        """Distance between the displacements of the two objects [m]."""
        return float(np.linalg.norm(self.human.displacement - self.robot.displacement))

    @property
    def rotation_gap(self) -> float:
        """Angle between the rotations of the two objects [rad]."""
        turn = Rotation.from_matrix(self.human.rotation.T @ self.robot.rotation)
        return float(turn.magnitude())


class SoftSimulator(Simulator):
    """A hand whose motors are told the torques of springs in series with those of the joints.

    Args:
        hand: The hand, without an arm.
        shape: The object's shape.
        physics: Contacts, actuators and time steps.
        compliance: Compliance in series with that of the joints [rad/(N m)], shape (n, n).

    Attributes:
        stiffness: K of the actuators [N m/rad], shape (n, n).
        damping: D, critical for every mode of K and the joints' inertias [N m s/rad], shape (n, n).

    Raises:
        InvalidInputError: If the compliance is of another shape.
    """

    def __init__(
        self, hand: Hand, shape: Shape, physics: Physics, compliance: npt.ArrayLike
    ) -> None:
        super().__init__(hand, shape, physics)
        count = len(hand.joint_names)
        soft = finite_array(compliance, (count, count), "compliance")
        model = self.model
        joints = np.diag(1.0 / model.actuator_gainprm[:, 0])
        self.stiffness = np.linalg.inv(joints + soft)
        self._dofs = model.jnt_dofadr[model.actuator_trnid[:, 0]]
        self.damping = _critical(self.stiffness, model.dof_M0[self._dofs])
        model.actuator_gainprm[:, 0] = 1.0
        model.actuator_biasprm[:, :3] = 0.0

    def lead(self, command: np.ndarray) -> None:
        """Tell the motors the torques of springs and dampers [N m]."""
        super().lead(command)
        joints = command[self.hand.q_indices]
        self.data.ctrl[:] = self.torques(joints, self.q, self.data.qvel[self._dofs])

    def torques(
        self, command: np.ndarray, q: np.ndarray, velocity: np.ndarray
    ) -> np.ndarray:
        """Return `K (command - q) - D dq` [N m], shape (n,)."""
        return self.stiffness @ (command - q) - self.damping @ velocity


def stiffness_of(simulator: Simulator) -> np.ndarray:
    """Return the stiffness of a hand's actuators [N m/rad], shape (n, n)."""
    if isinstance(simulator, SoftSimulator):
        return simulator.stiffness
    return np.diag(simulator.model.actuator_gainprm[:, 0])


def soft_synergy(synergy: int, physics: Physics) -> np.ndarray:
    """Return the compliance of Sec. IV: one soft synergy of the human in series with the joints.

    With `tau = K_q (S z - q)` and `S^T tau = K_z (z_ref - z)`, the command `q_ref = S z_ref` gives
    `tau = K (q_ref - q)`, `K = (K_q^-1 + S K_z^-1 S^T)^-1` (the paper's [22]). As in the reference
    numbers, K_z in N m per unit is the number that K_q is in N m/rad.

    Args:
        synergy: Number of the activated synergy, from 1.
        physics: Stiffness of the joints.

    Returns:
        `S K_z^-1 S^T` [rad/(N m)], shape (n, n).
    """
    matrix = load_synergies().matrix[:, [synergy - 1]]
    return matrix @ matrix.T / physics.joint_stiffness


def holding_forces(
    grasp: Grasp, load: npt.ArrayLike, normal_force: float
) -> np.ndarray:
    """Find contact forces that balance a load and press on the object.

    The forces minimise `sum_c (f_n - f_0)^2 + 4 |f_t|^2` subject to `G f + w = 0`.

    Args:
        grasp: The grasp, with at least three contacts that are not on one line.
        load: Wrench on the object about its centre, w, world axes [N, N m], shape (6,).
        normal_force: Wanted normal force at every contact, f_0 [N].

    Returns:
        Forces of the hand on the object, world axes [N], shape (n_c, 3).

    Raises:
        InvalidInputError: If the grasp cannot balance every load.
    """
    wrench = finite_array(load, (6,), "load")
    force = positive_number(normal_force, "normal_force")
    G, normals = grasp.matrix, grasp.normals
    count = len(normals)
    if not _is_firm(grasp):
        raise InvalidInputError(
            argument="grasp",
            expected="three contacts that are not on one line",
            got=f"{count}",
        )
    weight = np.zeros((3 * count, 3 * count))
    for c, normal in enumerate(normals):
        along = np.outer(normal, normal)
        weight[3 * c : 3 * c + 3, 3 * c : 3 * c + 3] = along + _TANGENTIAL * (
            np.eye(3) - along
        )
    system = np.block([[weight, G.T], [G, np.zeros((6, 6))]])
    right = np.concatenate([force * normals.ravel(), -wrench])
    return np.linalg.solve(system, right)[: 3 * count].reshape(-1, 3)


def squeeze(grasp: Grasp, forces: np.ndarray, stiffness: np.ndarray) -> np.ndarray:
    """Return the displacement of a command that makes contact forces, `K^-1 J^T f` [rad], (n,).

    Args:
        grasp: The grasp.
        forces: Forces of the hand on the object [N], shape (n_c, 3).
        stiffness: Stiffness of the actuators, K [N m/rad], shape (n, n).
    """
    return np.linalg.solve(stiffness, grasp.jacobian.T @ forces.ravel())


def carry(
    grasp: Grasp,
    motion: HandMotion,
    mass: float,
    physics: Physics | None = None,
    options: ArcOptions | None = None,
    compliance: np.ndarray | None = None,
) -> Carried:
    """Simulate one hand that grasps an object, takes its weight, and follows a motion.

    Args:
        grasp: The grasp at the start of the motion.
        motion: Commands of the joints and the wrist; the squeeze is added to the joints.
        mass: Mass of the object [kg].
        physics: Contacts, actuators and time steps.
        options: How the object is carried.
        compliance: Compliance in series with that of the joints (`soft_synergy`).

    Returns:
        What the object did.
    """
    physics = (physics or Physics()).replaced(mass=mass)
    options = options or ArcOptions()
    assert grasp.shape is not None
    if compliance is None:
        simulator = Simulator(grasp.hand, grasp.shape, physics)
    else:
        simulator = SoftSimulator(grasp.hand, grasp.shape, physics, compliance)
    stiffness = stiffness_of(simulator)
    weight = np.concatenate([mass * np.array(physics.gravity), np.zeros(3)])
    forces = holding_forces(grasp, weight, options.normal_force)
    offset = squeeze(grasp, forces, stiffness)
    take_hold(simulator, grasp, offset)
    instants = [simulator.instant()]
    start_q, start_wrist = simulator.q, simulator.wrist
    start_object = simulator.object_pose
    step = options.duration / (len(motion.q) - 1)
    for q, wrist in zip(motion.q[1:], motion.wrist[1:], strict=True):
        simulator.follow(simulator.hand.configuration_vector(q + offset, wrist), step)
        instants.append(simulator.instant())
    simulator.follow(simulator.target, _RESTING)
    instants.append(simulator.instant())
    episode = Episode.of(simulator, instants)
    pairs = zip(episode.at.wrist, episode.at.object_pose, strict=True)
    places = np.array([(inverse_pose(wrist) @ pose)[:3, 3] for wrist, pose in pairs])
    is_lost = bool(np.linalg.norm(places - places[0], axis=1).max() > LOST)
    slip = _slip(grasp, (start_q, start_wrist, start_object), simulator)
    is_lost = is_lost or episode.at.links_touching[-1] == 0
    return Carried(episode, slip, is_lost, stiffness)


def take_hold(simulator: Simulator, grasp: Grasp, offset: np.ndarray) -> None:
    """Close on the object without gravity, then let its weight come.

    Args:
        simulator: The simulation; it is reset.
        grasp: The grasp.
        offset: Displacement of the command that presses [rad], shape (n,).
    """
    wrist = grasp.wrist_pose if grasp.hand.is_floating else None
    if grasp.hand.is_floating and wrist is None:
        wrist = np.eye(4)
    simulator.reset(
        simulator.hand.configuration_vector(grasp.q, wrist), grasp.object_pose
    )
    gravity = simulator.model.opt.gravity
    gravity[:] = 0.0
    simulator.follow(
        simulator.hand.configuration_vector(grasp.q + offset, wrist), _CLOSING
    )
    simulator.follow(simulator.target, _RESTING)
    for share in np.linspace(0.1, 1.0, 10):
        gravity[:] = share * np.array(simulator.physics.gravity)
        simulator.follow(simulator.target, _LOADING / 10.0)
    simulator.follow(simulator.target, _RESTING)


def _slip(
    grasp: Grasp, start: tuple[np.ndarray, np.ndarray, np.ndarray], simulator: Simulator
) -> np.ndarray:
    """Return how far links and object came apart at the places where they touched first."""
    q, wrist, pose = start
    links = [contact.link for contact in grasp.contacts]
    places = grasp.points

    def on_links(angles: np.ndarray, base: np.ndarray) -> np.ndarray:
        return grasp.hand.link_poses(
            links, angles, base if grasp.hand.is_floating else None
        )

    before, after = on_links(q, wrist), on_links(simulator.q, simulator.wrist)
    carried = [
        transform_points(b @ inverse_pose(a), place)
        for a, b, place in zip(before, after, places, strict=True)
    ]
    moved = transform_points(simulator.object_pose @ inverse_pose(pose), places)
    return np.linalg.norm(moved - np.array(carried), axis=1)


def planned_scene(
    robot: Hand,
    shape: Shape,
    *,
    rank: int = 0,
    samples: int = 60,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Scene:
    """Plan a grasp of the human's hand and one of the robot's, of the same object.

    Args:
        robot: The robot hand; it must float.
        shape: Shape of the object.
        rank: Which grasps: 0 for the best of each hand, 1 for the second best, and so on.
        samples: Number of palm poses tried for each hand.
        seed: Seed of the random numbers.
        progress: Called after each palm pose with the number done.

    Returns:
        The scene, with the contacts as reference points.

    Raises:
        InvalidInputError: If the wrist of the robot cannot move, or fewer than `rank + 1` grasps
            have three contacts.
    """
    chosen = []
    for hand in (load_hand("human"), robot):
        planned = plan_grasps(
            hand, shape, samples=samples, seed=seed, progress=progress
        )
        firm = [one.grasp for one in planned if _is_firm(one.grasp)]
        if len(firm) <= rank:
            raise InvalidInputError(
                argument="robot",
                expected=f"a hand with {rank + 1} grasps of three contacts on this object",
                got=f"{hand.name} with {len(firm)} among {samples}",
            )
        chosen.append(firm[rank])
    return Scene.at_contacts(*chosen)


def _is_firm(grasp: Grasp) -> bool:
    """Return whether a grasp can balance every load."""
    return (
        len(grasp.contacts) >= 3 and np.linalg.matrix_rank(grasp.matrix, tol=1e-6) == 6
    )


def _critical(stiffness: np.ndarray, inertia: np.ndarray) -> np.ndarray:
    """Return `2 M^1/2 (M^-1/2 K M^-1/2)^1/2 M^1/2`: critical damping of each mode.

    M is diagonal: the inertia felt at each joint in the model's own posture [kg m^2], shape (n,).
    """
    root = np.sqrt(np.outer(inertia, inertia))
    squares, modes = np.linalg.eigh(stiffness / root)
    return 2.0 * root * ((modes * np.sqrt(squares)) @ modes.T)
