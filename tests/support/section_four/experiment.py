"""The paper's numerical experiment (Sec. IV): two hands on one cube, a wrist arc and a synergy.

Each step follows Fig. 3 of the paper. T is estimated from the human's reference points at the start
and end of the step (eqs. 5-6), decomposed about their centroid (eqs. 2-3) and imposed on the
robot's points (eq. 7). T_rb moves the wrist, and eq. (8) with `xi = 0` the fingers:
`dq = J# (p_f - p_rb)`, without limits. `tests/support/experiment_variants.py` has other pivots and
other inverse kinematics.

The wrist carries the object, and the fingers move it in the hand (`object_poses`). There are two
models of the latter: the rigid motion that fits the motion of the contacts best (least squares),
and the quasi-static model of the paper's [22] with compliant contacts, joints and synergies. In
both, the contacts of a step are those at its start, carried by the wrist.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple, Self

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.reference.decomposition import decompose
from handmap_qp.reference.estimation import estimate_motion
from handmap_qp.se3 import affine, inverse_pose, transform_points
from section_four.contacts import Grasp
from section_four.cube import reference_grasp
from section_four.statics import grasp_matrix, quasistatic

ARC_LENGTH = 0.47
"""Length of the wrist's arc along x [m]."""
ARC_HEIGHT = 0.15
"""Height of the wrist's arc along z [m]."""

Geometry = Literal["toolbox", "ours"]


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Two hands that hold the same object, in one world.

    Attributes:
        human: Grasp of the human hand.
        robot: Grasp of the robot hand.
        human_points: The human hand with the reference points from which T is estimated (in the
            paper, the contacts).
        robot_points: The robot hand with the reference points on which T is imposed.
    """

    human: Grasp
    robot: Grasp
    human_points: Hand
    robot_points: Hand

    @classmethod
    def at_contacts(cls, human: Grasp, robot: Grasp) -> Self:
        """Return the scene with the contacts as reference points, as in the paper."""
        return cls(human, robot, human.contact_hand, robot.contact_hand)


@dataclass(frozen=True, slots=True)
class Setting:
    """Options of one run.

    Attributes:
        synergy: Number of the activated synergy, from 1.
        gamma: Activation of the synergy at the end, in its units.
        steps: Number of steps.
        start: Configuration from which T is estimated: the `previous` step (Fig. 3 of the paper),
            or the `first` one.
    """

    synergy: int = 1
    gamma: float = 1.0
    steps: int = 50
    start: Literal["previous", "first"] = "previous"


class HandMotion(NamedTuple):
    """The motion of one hand: N steps, N + 1 samples.

    Attributes:
        q: Joint angles [rad], shape (N + 1, n).
        wrist: Wrist poses, shape (N + 1, 4, 4).
        points: Reference points [m], shape (N + 1, m, 3).
    """

    q: np.ndarray
    wrist: np.ndarray
    points: np.ndarray


Transfer = Callable[
    [Scene, HandMotion, int, int, np.ndarray], tuple[np.ndarray, np.ndarray]
]
"""From the scene, the human's motion, two of its samples and the robot's points at the first one to
T, as imposed on those points, and T_rb; shape (4, 4) each."""
Follow = Callable[
    [Hand, np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]
]
"""From the robot hand, its joints, the targets of its points and that of its wrist to its joints
and its wrist after a step."""


class Run(NamedTuple):
    """One run of the experiment.

    Attributes:
        scene: Both hands at the start.
        setting: The options.
        human: Motion of the human.
        robot: Motion of the robot.
        final_targets: `T s`: the robot's initial points moved by the T from the first to the last
            configuration [m], shape (n_r, 3).
    """

    scene: Scene
    setting: Setting
    human: HandMotion
    robot: HandMotion
    final_targets: np.ndarray

    @property
    def point_rms(self) -> float:
        """RMS distance of the robot's final points from `T s` [m]."""
        return rms(self.robot.points[-1] - self.final_targets)


class Stiffnesses(NamedTuple):
    """Stiffnesses of the quasi-static model.

    The reference numbers use unit stiffness in millimetres: 1 N/mm at the contacts, 1 N mm/rad at
    the joints, 1 N mm per unit of a synergy. In SI units these are 1e3, 1e-3 and 1e-3.

    Attributes:
        contact: Stiffness of each contact, isotropic [N/m].
        joint: Stiffness of each joint [N m/rad].
        synergy: Stiffness of each synergy of the human [N m per unit].
    """

    contact: float = 1e3
    joint: float = 1e-3
    synergy: float = 1e-3


UNIT = Stiffnesses()
"""Unit stiffness with lengths in millimetres, as in the reference numbers."""


class InHandStep(NamedTuple):
    """Effect of the synergy alone in the first step, without wrist motion (Fig. 6 of the paper).

    Attributes:
        human_motion: Displacement of the object's centre in the human's hand [m], shape (3,).
        robot_motion: Displacement in the robot's hand, by wrist and fingers [m], shape (3,).
        human_forces: Change of the forces of the human's contacts on the object [N], shape
            (n_c, 3); empty by the rigid model.
        robot_forces: Change of the forces of the robot's contacts [N], likewise.
    """

    human_motion: np.ndarray
    robot_motion: np.ndarray
    human_forces: np.ndarray
    robot_forces: np.ndarray

    @property
    def angle(self) -> float:
        """Angle between the two displacements [rad]."""
        one, other = self.human_motion, self.robot_motion
        return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


@cache
def paper_scene(geometry: Geometry = "toolbox") -> Scene:
    """Return the scene of the paper's two grasps.

    Args:
        geometry: The three-fingered hand as the `toolbox` has it, or `ours`; see `reference_grasp`.

    Returns:
        The scene; the reference points are the 7 and 3 contacts.
    """
    robot = reference_grasp("three_finger", is_toolbox=geometry == "toolbox")
    return Scene.at_contacts(reference_grasp("human").grasp, robot.grasp)


def wrist_arc(steps: int) -> np.ndarray:
    """Displacement of the wrist along the paper's arc, in equal steps of x.

    The arc is read as `z = 150 mm cos(pi (x / 470 mm - 1/2))`.

    Args:
        steps: Number of steps N.

    Returns:
        Displacements since the start [m], shape (N + 1, 3).
    """
    share = np.linspace(0.0, 1.0, steps + 1)
    # The same curve as a sine, so that it is exactly zero at the start.
    return np.column_stack(
        [ARC_LENGTH * share, np.zeros(steps + 1), ARC_HEIGHT * np.sin(np.pi * share)]
    )


def human_motion(
    scene: Scene, setting: Setting, arc: np.ndarray | None = None
) -> HandMotion:
    """Human motion of Sec. IV: `q = q_i + gamma S dsigma`, the wrist on the arc, not rotating.

    Args:
        scene: Both hands at the start.
        setting: The options.
        arc: Displacements of the wrist in the first steps [m], shape (k + 1, 3), k <= N; those of
            the whole arc if omitted.

    Returns:
        The motion in these steps.
    """
    grasp = scene.human
    arc = wrist_arc(setting.steps) if arc is None else arc
    share = np.linspace(0.0, 1.0, setting.steps + 1)[: len(arc), None]
    q = grasp.q + setting.gamma * share * _synergy(setting).T
    wrist = np.tile(grasp.wrist, (len(arc), 1, 1))
    wrist[:, :3, 3] += arc
    samples = zip(q, wrist, strict=True)
    return HandMotion(
        q, wrist, np.array([scene.human_points.points(*one) for one in samples])
    )


def about_centroid(
    scene: Scene, human: HandMotion, start: int, end: int, robot_points: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return T and T_rb with rotation and deformation about the centroid; see `Transfer`."""
    before = human.points[start]
    after = human.points[end]
    motion = estimate_motion(before, after).motion
    return motion, decompose(motion, pivot=before.mean(axis=0)).rigid


def equation_8(
    hand: Hand, q: np.ndarray, targets: np.ndarray, wrist_target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Move the fingers from where T_rb brings them, without limits; see `Follow`."""
    displacement = (targets - hand.points(q, wrist_target)).ravel()
    inverse = np.linalg.pinv(hand.point_jacobian(q, wrist_target))
    return q + inverse @ displacement, wrist_target


def run_experiment(
    scene: Scene,
    setting: Setting,
    human: HandMotion | None = None,
    *,
    transfer: Transfer = about_centroid,
    follow: Follow = equation_8,
) -> Run:
    """Map a human motion step by step.

    Args:
        scene: Both hands at the start.
        setting: The options.
        human: The human motion; that of `human_motion` if omitted.
        transfer: What is imposed on the robot.
        follow: Its inverse kinematics.

    Returns:
        The motions of both hands.

    Raises:
        DegeneratePointsError: If the human's reference points do not determine T. Without a ridge,
            three points never do.
    """
    human = human or human_motion(scene, setting)
    hand = scene.robot_points
    q = [scene.robot.q]
    wrist = [scene.robot.wrist]
    points = [hand.points(q[0], wrist[0])]
    for k in range(1, len(human.q)):
        start = k - 1 if setting.start == "previous" else 0
        motion, rigid = transfer(scene, human, start, k, points[start])
        targets = transform_points(motion, points[start])
        q_new, wrist_new = follow(hand, q[-1], targets, rigid @ wrist[start])
        q.append(q_new)
        wrist.append(wrist_new)
        points.append(hand.points(q_new, wrist_new))
    whole, _ = transfer(scene, human, 0, len(human.q) - 1, points[0])
    robot = HandMotion(np.array(q), np.array(wrist), np.array(points))
    return Run(scene, setting, human, robot, transform_points(whole, points[0]))


def object_poses(
    run: Run, stiffnesses: Stiffnesses | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the object over a run, in the human's and in the robot's hand.

    Args:
        run: The run.
        stiffnesses: Stiffnesses of the quasi-static model; the rigid model if omitted.

    Returns:
        Two arrays of poses, shape (N + 1, 4, 4) each.
    """
    (human, _), (robot, _) = _carried(run, stiffnesses)
    return human, robot


def object_error(run: Run, stiffnesses: Stiffnesses | None = None) -> float:
    """Final distance between the object's centres, the paper's "trajectory error" [m]."""
    human, robot = object_poses(run, stiffnesses)
    return float(np.linalg.norm(human[-1, :3, 3] - robot[-1, :3, 3]))


def in_hand_step(
    scene: Scene, setting: Setting, stiffnesses: Stiffnesses | None = UNIT
) -> InHandStep:
    """Compute the first step of an experiment without wrist motion.

    Args:
        scene: Both hands at the start.
        setting: The options; the step is the first of `setting.steps`.
        stiffnesses: Stiffnesses of the quasi-static model; None for the rigid model.

    Returns:
        Displacements and force changes of that step.
    """
    still = human_motion(scene, setting, np.zeros((2, 3)))
    carried = _carried(run_experiment(scene, setting, still), stiffnesses)
    motions = (poses[1, :3, 3] - poses[0, :3, 3] for poses, _ in carried)
    return InHandStep(*motions, *(forces for _, forces in carried))


def rms(offsets: np.ndarray) -> float:
    """RMS length of vectors of shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=-1))))


def _synergy(setting: Setting) -> np.ndarray:
    """Return the activated synergy as a column of S, shape (20, 1)."""
    return load_synergies().matrix[:, [setting.synergy - 1]]


def _carried(
    run: Run, stiffnesses: Stiffnesses | None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return poses of the object and changes of the first step's forces, in both hands.

    The human's synergies are compliant. Of the robot, the joints are activated directly.
    """
    scene, setting = run.scene, run.setting
    share = np.full((len(run.human.q) - 1, 1), setting.gamma / setting.steps)
    robot_joints = np.eye(len(scene.robot.q))
    moved = np.diff(run.robot.q, axis=0)
    if stiffnesses is None:
        soft = stiff = None
    else:
        soft = stiffnesses
        stiff = stiffnesses._replace(synergy=np.inf)
    return [
        _carry(scene.human, run.human, _synergy(setting), share, soft),
        _carry(scene.robot, run.robot, robot_joints, moved, stiff),
    ]


def _carry(
    grasp: Grasp,
    motion: HandMotion,
    synergies: np.ndarray,
    activation: np.ndarray,
    stiffnesses: Stiffnesses | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Carry the object of a grasp along a motion of the hand.

    Args:
        grasp: The grasp at the start.
        motion: The motion of the hand.
        synergies: S, shape (n, n_z).
        activation: Change of the references of the synergies per step, shape (N, n_z).
        stiffnesses: Stiffnesses of the quasi-static model; None for the rigid model.

    Returns:
        Poses of the object, shape (N + 1, 4, 4), and the change of the forces on it in the first
        step [N], shape (n_c, 3); without stiffnesses, shape (0, 3).
    """
    hand = grasp.contact_hand
    placed = hand.configuration()
    poses = [grasp.object_pose]
    forces = np.zeros((0, 3))
    for k, (q, wrist) in enumerate(zip(motion.q[:-1], motion.wrist[1:], strict=True)):
        pose = wrist @ inverse_pose(motion.wrist[k]) @ poses[-1]
        placed.place(hand.configuration_vector(q, wrist))
        jacobian = placed.point_jacobian()[:, hand.joint_columns]
        matrix = grasp_matrix(placed.points, pose[:3, 3])
        if stiffnesses is None:
            moved = jacobian @ (motion.q[k + 1] - q)
            twist = np.linalg.lstsq(matrix.T, moved, rcond=None)[0]
        else:
            response = quasistatic(
                jacobian,
                matrix,
                synergies,
                contact_stiffness=stiffnesses.contact,
                joint_stiffness=stiffnesses.joint,
                synergy_stiffness=stiffnesses.synergy,
            )
            twist = response.object_motion @ activation[k]
            if k == 0:
                forces = (response.contact_forces @ activation[k]).reshape(-1, 3)
        turn = Rotation.from_rotvec(twist[3:]).as_matrix()
        poses.append(affine(turn @ pose[:3, :3], pose[:3, 3] + twist[:3]))
    return np.array(poses), forces
