"""Motion of a held object, and changes of the contact forces (Sec. IV).

The wrist carries the object, and the fingers move it in the hand. There are two models of the
latter: the rigid motion that fits the motion of the contacts best (least squares), and the
quasi-static model of the paper's [22] with compliant contacts, joints and synergies. In both, the
contacts of a step are those at its start, carried by the wrist.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.experiments.section_four import HandMotion, Run, Scene, Setting, run_experiment
from handmap_qp.grasp import Grasp, QuasiStatic, grasp_matrix, quasistatic
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.se3 import affine, inverse_pose, transform_points


@dataclass(frozen=True, slots=True)
class Stiffnesses:
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


def object_poses(run: Run, stiffnesses: Stiffnesses | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Poses of the object over a run, in the human's and in the robot's hand.

    Args:
        run: The run.
        stiffnesses: Stiffnesses of the quasi-static model; the rigid model if omitted.

    Returns:
        Two arrays of poses, shape (N + 1, 4, 4) each.
    """
    scene, setting = run.scene, run.setting
    synergy = load_synergies().matrix[:, [setting.synergy - 1]]
    activation = np.full((setting.steps, 1), setting.gamma / setting.steps)
    human = _carry(scene.human, run.human, stiffnesses, synergy, activation)
    return human, _carry(scene.robot, run.robot, stiffnesses, None, np.diff(run.robot.q, axis=0))


def object_error(run: Run, stiffnesses: Stiffnesses | None = None) -> float:
    """Final distance between the object's centres, the paper's "trajectory error".

    Args:
        run: The run.
        stiffnesses: As for `object_poses`.

    Returns:
        The distance [m].
    """
    human, robot = object_poses(run, stiffnesses)
    return float(np.linalg.norm(human[-1, :3, 3] - robot[-1, :3, 3]))


@dataclass(frozen=True, slots=True, eq=False)
class InHandStep:
    """Effect of the synergy alone in the first step, without wrist motion (Fig. 6 of the paper).

    Attributes:
        human_motion: Displacement of the object's centre in the human's hand [m], shape (3,).
        robot_motion: Displacement in the robot's hand, by wrist and fingers [m], shape (3,).
        robot_wrist_part: Part of `robot_motion` that is due to T_rb on the wrist [m], shape (3,).
        human_forces: Change of the forces of the human's contacts on the object [N], shape
            (n_c, 3).
        robot_forces: Change of the forces of the robot's contacts [N], likewise.
    """

    human_motion: np.ndarray
    robot_motion: np.ndarray
    robot_wrist_part: np.ndarray
    human_forces: np.ndarray
    robot_forces: np.ndarray

    @property
    def angle(self) -> float:
        """Angle between the two displacements [rad]."""
        return angle_between(self.human_motion, self.robot_motion)


def in_hand_step(
    scene: Scene, setting: Setting, stiffnesses: Stiffnesses = UNIT, *, is_rigid: bool = False
) -> InHandStep:
    """Compute the first step of an experiment without wrist motion.

    Args:
        scene: Both hands at the start.
        setting: The options; the step is the first of `setting.steps`.
        stiffnesses: Stiffnesses of the quasi-static model, which gives the forces in any case.
        is_rigid: Whether the rigid model gives the motion, instead of the quasi-static one.

    Returns:
        Displacements and force changes of that step.
    """
    share = setting.gamma / setting.steps
    synergy = load_synergies().matrix[:, [setting.synergy - 1]]
    q = np.array([scene.human.q, scene.human.q + share * synergy[:, 0]])
    wrist = np.tile(
        np.eye(4) if scene.human.wrist_pose is None else scene.human.wrist_pose, (2, 1, 1)
    )
    points = np.array([scene.human_points.points(*sample) for sample in zip(q, wrist, strict=True)])
    step = run_experiment(scene, setting, HandMotion(q, wrist, points))
    model = None if is_rigid else stiffnesses
    dq = np.diff(step.robot.q, axis=0)
    human = _carry(scene.human, step.human, model, synergy, np.array([[share]]))
    robot = _carry(scene.robot, step.robot, model, None, dq)
    carried = step.robot.wrist[1] @ inverse_pose(step.robot.wrist[0])
    centre, carried_centre = scene.robot.centre, transform_points(carried, scene.robot.centre)
    hands = _contact_hand(scene.human), _contact_hand(scene.robot)
    by_human = _answer(
        hands[0], q[0], wrist[0], scene.human.centre, synergy, stiffnesses, stiffnesses.synergy
    )
    by_robot = _answer(
        hands[1], step.robot.q[0], step.robot.wrist[1], carried_centre, None, stiffnesses, np.inf
    )
    return InHandStep(
        human_motion=human[1, :3, 3] - human[0, :3, 3],
        robot_motion=robot[1, :3, 3] - robot[0, :3, 3],
        robot_wrist_part=carried_centre - centre,
        human_forces=(share * by_human.contact_forces[:, 0]).reshape(-1, 3),
        robot_forces=(by_robot.contact_forces @ dq[0]).reshape(-1, 3),
    )


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    """Angle between two vectors [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def _carry(
    grasp: Grasp,
    motion: HandMotion,
    stiffnesses: Stiffnesses | None,
    synergies: np.ndarray | None,
    activation: np.ndarray,
) -> np.ndarray:
    """Poses of the object over a motion of a hand, shape (N + 1, 4, 4).

    Args:
        grasp: The grasp at the start.
        motion: The motion of the hand.
        stiffnesses: Stiffnesses of the quasi-static model; None for the rigid model.
        synergies: S, shape (n, n_z); None if the joints are activated directly.
        activation: Change of the references of synergies or joints per step, shape (N, n_z or n).
    """
    hand, poses = _contact_hand(grasp), [grasp.object_pose]
    for k in range(len(motion.q) - 1):
        q, wrist = motion.q[k], motion.wrist[k + 1]
        pose = wrist @ inverse_pose(motion.wrist[k]) @ poses[-1]
        if stiffnesses is None:
            transposed = grasp_matrix(hand.points(q, wrist), pose[:3, 3]).T
            twist = np.linalg.lstsq(
                transposed, hand.point_jacobian(q, wrist) @ (motion.q[k + 1] - q), rcond=None
            )[0]
        else:
            stiff = np.inf if synergies is None else stiffnesses.synergy
            twist = (
                _answer(hand, q, wrist, pose[:3, 3], synergies, stiffnesses, stiff).object_motion
                @ activation[k]
            )
        poses.append(
            affine(
                Rotation.from_rotvec(twist[3:]).as_matrix() @ pose[:3, :3], pose[:3, 3] + twist[:3]
            )
        )
    return np.array(poses)


def _answer(
    hand: Hand,
    q: np.ndarray,
    wrist: np.ndarray,
    centre: np.ndarray,
    synergies: np.ndarray | None,
    stiffnesses: Stiffnesses,
    synergy_stiffness: float,
) -> QuasiStatic:
    """Quasi-static response of a grasp per unit of each synergy, or per radian of each joint."""
    return quasistatic(
        hand.point_jacobian(q, wrist),
        grasp_matrix(hand.points(q, wrist), centre),
        np.eye(len(q)) if synergies is None else synergies,
        contact_stiffness=stiffnesses.contact,
        joint_stiffness=stiffnesses.joint,
        synergy_stiffness=synergy_stiffness,
    )


# Grasps compare by identity, and sweeps use the same ones many times.
@lru_cache(maxsize=8)
def _contact_hand(grasp: Grasp) -> Hand:
    return grasp.hand.with_points(grasp.point_specs)
