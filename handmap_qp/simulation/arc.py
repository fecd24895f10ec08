"""Section IV with gravity: two hands carry the same object along the arc (`carry_along_arc`).

Each hand closes on the object without gravity, presses with forces that the statics plan, and takes
the weight. Then the human's wrist follows the paper's arc while a synergy is activated, and the
robot does what the mapping of the human's motion commands. Both are simulated.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.errors import InvalidInputError
from handmap_qp.experiments.section_four import HandMotion, Run, Scene, Setting, run_experiment
from handmap_qp.grasp.contacts import Grasp
from handmap_qp.grasp.objects import Shape
from handmap_qp.grasp.planning import plan_grasps
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.se3 import inverse_pose, transform_points
from handmap_qp.simulation.actuators import (
    ActuatorKind,
    Actuators,
    PositionActuators,
    TorqueActuators,
)
from handmap_qp.simulation.episode import Episode, Recorder
from handmap_qp.simulation.physics import Body, MeshShape, Physics
from handmap_qp.simulation.simulator import Simulator
from handmap_qp.simulation.squeeze import holding_forces, squeeze

# Time to close, to rest, and to take the weight [s].
_CLOSING, _RESTING, _LOADING = 0.2, 0.2, 0.3
# An object that leaves its place in the hand by more than this is lost [m].
LOST = 0.05


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
        poses = self.episode.object_pose
        return poses[-1, :3, 3] - poses[0, :3, 3]

    @property
    def rotation(self) -> np.ndarray:
        """Rotation of the object from start to end, shape (3, 3)."""
        poses = self.episode.object_pose
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


def carry_along_arc(
    scene: Scene,
    setting: Setting,
    mass: float = 0.1,
    physics: Physics | None = None,
    options: ArcOptions | None = None,
    actuators: ActuatorKind = "position",
) -> ArcOutcome:
    """Simulate both hands of Sec. IV.

    Args:
        scene: Both grasps; each knows its object's shape.
        setting: Synergy, its activation, and the mapping.
        mass: Mass of the object [kg].
        physics: Contacts, actuators and time steps.
        options: How the object is carried.
        actuators: Kind of the fingers' actuators; see `soft_synergy`.

    Returns:
        The outcome for human and robot.

    Raises:
        InvalidInputError: If a grasp has fewer than three contacts, or no shape.
    """
    run = run_experiment(scene, setting)
    physics = physics or Physics()
    of_human = of_robot = PositionActuators()
    if actuators == "torque":
        of_human, of_robot = soft_synergy(setting.synergy, physics), TorqueActuators()
    human = carry(scene.human, run.human, mass, physics, options, of_human)
    robot = carry(scene.robot, run.robot, mass, physics, options, of_robot)
    return ArcOutcome(run, human, robot)


def soft_synergy(synergy: int, physics: Physics) -> TorqueActuators:
    """Return the human's actuators of Sec. IV: one soft synergy in series with the joints.

    As in the reference numbers, K_z in N m per unit is the number that K_q is in N m/rad.

    Args:
        synergy: Number of the activated synergy, from 1.
        physics: Stiffness of the joints.
    """
    matrix = load_synergies().matrix[:, [synergy - 1]]
    return TorqueActuators(matrix, physics.joint_stiffness)


def carry(
    grasp: Grasp,
    motion: HandMotion,
    mass: float,
    physics: Physics | None = None,
    options: ArcOptions | None = None,
    actuators: Actuators | None = None,
) -> Carried:
    """Simulate one hand that grasps an object, takes its weight, and follows a motion.

    Args:
        grasp: The grasp at the start of the motion.
        motion: Commands of the joints and the wrist; the squeeze is added to the joints.
        mass: Mass of the object [kg].
        physics: Contacts, actuators and time steps.
        options: How the object is carried.
        actuators: What moves the joints; servos if omitted.

    Returns:
        What the object did.
    """
    physics, options = physics or Physics(), options or ArcOptions()
    assert grasp.shape is not None
    simulator = Simulator(grasp.hand, Body(grasp.shape, mass), physics, actuators)
    weight = np.concatenate([mass * np.array(physics.gravity), np.zeros(3)])
    forces = holding_forces(grasp, weight, options.normal_force)
    offset = squeeze(grasp, forces, simulator.stiffness)
    take_hold(simulator, grasp, offset)
    recorder = Recorder(simulator)
    recorder.sample()
    start_q, start_wrist = simulator.q, simulator.wrist
    start_object = simulator.object_pose
    step = options.duration / (len(motion.q) - 1)
    for q, wrist in zip(motion.q[1:], motion.wrist[1:], strict=True):
        simulator.follow(q + offset, wrist, step)
        recorder.sample()
    simulator.hold(_RESTING)
    recorder.sample()
    episode = recorder.episode()
    places = episode.object_in_wrist[:, :3, 3]
    is_lost = bool(np.linalg.norm(places - places[0], axis=1).max() > LOST)
    slip = _slip(grasp, (start_q, start_wrist, start_object), simulator)
    is_lost = is_lost or episode.touching[-1] == 0
    return Carried(episode, slip, is_lost, simulator.stiffness)


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
    simulator.reset(grasp.q, wrist, grasp.object_pose)
    simulator.set_gravity(0.0)
    simulator.follow(grasp.q + offset, wrist, _CLOSING)
    simulator.hold(_RESTING)
    for share in np.linspace(0.1, 1.0, 10):
        simulator.set_gravity(float(share))
        simulator.hold(_LOADING / 10.0)
    simulator.hold(_RESTING)


def _slip(
    grasp: Grasp, start: tuple[np.ndarray, np.ndarray, np.ndarray], simulator: Simulator
) -> np.ndarray:
    """Return how far links and object came apart at the places where they touched first."""
    q, wrist, pose = start
    links = [contact.link for contact in grasp.contacts]
    places = grasp.points

    def on_links(angles: np.ndarray, base: np.ndarray) -> np.ndarray:
        return grasp.hand.link_poses(links, angles, base if grasp.hand.is_floating else None)

    before, after = on_links(q, wrist), on_links(simulator.q, simulator.wrist)
    carried = [
        transform_points(b @ inverse_pose(a), place)
        for a, b, place in zip(before, after, places, strict=True)
    ]
    moved = transform_points(simulator.object_pose @ inverse_pose(pose), places)
    return np.linalg.norm(moved - np.array(carried), axis=1)


def planned_scene(
    robot: Hand,
    shape: Shape | MeshShape,
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
        InvalidInputError: If the wrist of the robot cannot move, the shape is a mesh, or fewer than
            `rank + 1` grasps have three contacts.
    """
    if isinstance(shape, MeshShape):
        raise InvalidInputError(
            argument="--object", expected="a box, a sphere or a cylinder on the arc", got="a mesh"
        )
    chosen = []
    for hand in (load_hand("human"), robot):
        planned = plan_grasps(hand, shape, samples=samples, seed=seed, progress=progress)
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
    return len(grasp.contacts) >= 3 and np.linalg.matrix_rank(grasp.matrix, tol=1e-6) == 6


def arc_row(outcome: ArcOutcome) -> dict[str, Any]:
    """Describe both hands after the arc in a row of a table."""
    setting = outcome.run.setting
    row: dict[str, Any] = {
        "synergy": setting.synergy,
        "gamma": setting.gamma,
        "fingers": setting.fingers,
    }
    for name, carried in (("human", outcome.human), ("robot", outcome.robot)):
        force = carried.episode.force
        row |= {
            f"{name} lost": "yes" if carried.is_lost else "no",
            f"{name} slip mm": round(1e3 * float(carried.slip.max()), 1),
            f"{name} force N": f"{force[0]:.1f} to {force[-1]:.1f}",
        }
    is_any_lost = outcome.human.is_lost or outcome.robot.is_lost
    row["translation differs mm"] = "-" if is_any_lost else round(1e3 * outcome.translation_gap, 1)
    row["rotation differs deg"] = (
        "-" if is_any_lost else round(float(np.degrees(outcome.rotation_gap)), 1)
    )
    return row
