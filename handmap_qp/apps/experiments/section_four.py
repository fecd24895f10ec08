"""The paper's numerical experiment (Sec. IV): two hands on one cube, a wrist arc and a synergy.

Each step follows Fig. 3 of the paper. T is estimated from the human's reference points at the start
and end of the step (eqs. 5-6), decomposed about a pivot (eqs. 2-3) and imposed on the robot's
points (eq. 7). T_rb moves the wrist, and eq. (8) the fingers. Choices that the paper leaves open
are fields of `Setting`. Inverse kinematics of the robot, by `Setting.fingers`:

| fingers | inverse kinematics |
|---|---|
| `pseudoinverse` | eq. (8) with `xi = 0`: wrist by T_rb, `dq = J# (p_f - p_rb)`, limits ignored |
| `clipped` | the same, each step clipped into the position limits of the joints |
| `damped` | `PseudoinverseIk`: the cost of the QP without its limits, clipped afterwards |
| `qp` | `PointIk`: the same cost within the limits |
| `frozen` | the wrist moves by T_rb, the fingers do not move |

`damped` and `qp` solve for wrist and fingers together. In both, the rest term is off
(`rest_weight = 0`), and there are no speed limits, because a step has no duration.

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
from xml.etree import ElementTree as ET

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.grasp.contacts import Contact, Grasp
from handmap_qp.apps.grasp.paper_cube import read_cube_figures, reference_grasp
from handmap_qp.apps.grasp.statics import QuasiStatic, grasp_matrix, quasistatic
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.hands.urdf import get_numbers, parse_urdf, set_numbers
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.pseudoinverse import PseudoinverseIk
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.decomposition import decompose
from handmap_qp.mapping.estimation import estimate_motion
from handmap_qp.se3 import affine, inverse_pose, rigid_fit, transform_points

ARC_LENGTH = 0.47
"""Length of the wrist's arc along x [m]."""
ARC_HEIGHT = 0.15
"""Height of the wrist's arc along z [m]."""
IK = IkOptions(
    rest_weight=0.0,
    damping=0.01,
    error_damping=0.0,
    max_iterations=20,
    step_tolerance=1e-7,
    has_velocity_limits=False,
)
"""Options of the QP in the experiment: iterated to convergence, without a rest term."""

FingerMode = Literal["pseudoinverse", "clipped", "damped", "qp", "frozen"]
Pivot = Literal["centroid", "own", "palm", "origin"]
Start = Literal["previous", "first"]
Geometry = Literal["toolbox", "ours"]

# Azimuth in the palm of the first joint of each finger of the three-fingered hand [rad].
_AZIMUTHS = {
    "f1_proximal": 0.0,
    "f2_spread": 2.0 * np.pi / 3.0,
    "f3_spread": -2.0 * np.pi / 3.0,
}
_STEP_TIME = 1.0


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

    def moved(self, offset: np.ndarray) -> Self:
        """Return the scene translated by `offset` [m], shape (3,)."""
        motion = affine(np.eye(3), np.asarray(offset, dtype=float))
        return type(self)(
            self.human.moved(motion),
            self.robot.moved(motion),
            self.human_points,
            self.robot_points,
        )


@dataclass(frozen=True, slots=True)
class Setting:
    """Options of one run.

    Attributes:
        synergy: Number of the activated synergy, from 1.
        gamma: Activation of the synergy at the end, in its units.
        steps: Number of steps.
        pivot: Point about which rotation and deformation act: `centroid`, of the human's points for
            both hands (reference numbers); `own`, each hand's centroid (default of `HandMapper`);
            `palm`, of the human; `origin`, of the world (the paper read literally).
        start: Configuration from which T is estimated: the `previous` step (Fig. 3 of the paper),
            or the `first` one.
        fingers: Inverse kinematics of the fingers; see the table of this module. With `frozen`,
            T_rb is the best rigid fit of the human's points (Kabsch).
        ridge: Ridge of eq. (6); 0 is the paper's.
    """

    synergy: int = 1
    gamma: float = 1.0
    steps: int = 50
    pivot: Pivot = "centroid"
    start: Start = "previous"
    fingers: FingerMode = "pseudoinverse"
    ridge: float = 0.0


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


class Run(NamedTuple):
    """One run of the experiment.

    Attributes:
        scene: Both hands at the start.
        setting: The options.
        human: Motion of the human.
        robot: Motion of the robot.
        targets: Targets of the robot's points at each step [m], shape (N, n_r, 3).
        final_targets: `T s`: the robot's initial points moved by the T from the first to the last
            configuration [m], shape (n_r, 3).
        stretches: Stretch factors of each step's T, shape (N, 3).
    """

    scene: Scene
    setting: Setting
    human: HandMotion
    robot: HandMotion
    targets: np.ndarray
    final_targets: np.ndarray
    stretches: np.ndarray

    @property
    def point_rms(self) -> float:
        """RMS distance of the robot's final points from `T s` [m]."""
        return rms(self.robot.points[-1] - self.final_targets)

    @property
    def limit_excess(self) -> float:
        """Largest violation of the robot's joint limits [rad]."""
        hand, q = self.scene.robot_points, self.robot.q
        return max(
            0.0, float(np.maximum(hand.lower_limits - q, q - hand.upper_limits).max())
        )


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
            (n_c, 3).
        robot_forces: Change of the forces of the robot's contacts [N], likewise.
    """

    human_motion: np.ndarray
    robot_motion: np.ndarray
    human_forces: np.ndarray
    robot_forces: np.ndarray

    @property
    def angle(self) -> float:
        """Angle between the two displacements [rad]."""
        return angle_between(self.human_motion, self.robot_motion)


@cache
def paper_scene(geometry: Geometry = "toolbox") -> Scene:
    """Return the scene of the paper's two grasps.

    The toolbox's planner mounted the fingers of the three-fingered hand 50/3 mm too far out, and
    numbers computed with the toolbox belong to that hand and its joint angles (`toolbox`). The
    correct hand reaches the same contacts from the same palm pose at other joint angles (`ours`).

    Args:
        geometry: `toolbox` or `ours`.

    Returns:
        The scene; the reference points are the 7 and 3 contacts.
    """
    robot = reference_grasp("three_finger")
    if geometry == "ours":
        return Scene.at_contacts(reference_grasp("human").grasp, robot.grasp)
    hand = toolbox_hand(robot.grasp.hand)
    # Normals are the same in the world, but the links have other orientations.
    links = hand.link_poses(
        [contact.link for contact in robot.grasp.contacts],
        robot.published_q,
        robot.grasp.wrist_pose,
    )
    contacts = tuple(
        Contact(contact.link, contact.xyz, tuple(normal @ pose[:3, :3]), contact.finger)
        for contact, normal, pose in zip(
            robot.grasp.contacts, robot.grasp.normals, links, strict=True
        )
    )
    grasp = Grasp(
        hand,
        robot.published_q,
        robot.grasp.object_pose,
        contacts,
        robot.grasp.wrist_pose,
        robot.grasp.shape,
    )
    return Scene.at_contacts(reference_grasp("human").grasp, grasp)


def toolbox_hand(hand: Hand) -> Hand:
    """Return the three-fingered hand of the toolbox's planner: fingers 50/3 mm farther out.

    Args:
        hand: The three-fingered hand.

    Returns:
        The hand of the reference numbers of Sec. IV.
    """
    shift = float(read_cube_figures("three_finger")["published"]["finger_shift"])
    robot = parse_urdf(hand.urdf_text)
    for joint in robot.iterfind("joint"):
        azimuth, origin = _AZIMUTHS.get(joint.get("name", "")), joint.find("origin")
        if azimuth is not None and origin is not None:
            x, y, z = get_numbers(origin, "xyz", 3)
            set_numbers(
                origin,
                "xyz",
                [x + shift * np.cos(azimuth), y + shift * np.sin(azimuth), z],
            )
    return Hand(
        hand.spec,
        points="contacts",
        mount="floating",
        urdf_text=ET.tostring(robot, encoding="unicode"),
    )


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


def human_motion(scene: Scene, setting: Setting) -> HandMotion:
    """Human motion of Sec. IV: `q = q_i + gamma S dsigma`, the wrist on the arc, not rotating."""
    share = np.linspace(0.0, 1.0, setting.steps + 1)
    return _activated(scene, setting, share, wrist_arc(setting.steps))


def run_experiment(
    scene: Scene, setting: Setting, human: HandMotion | None = None
) -> Run:
    """Map a human motion step by step.

    Args:
        scene: Both hands at the start.
        setting: The options.
        human: The human motion; that of `human_motion` if omitted.

    Returns:
        The motions of both hands.

    Raises:
        DegeneratePointsError: If the human's reference points do not determine T. Without a ridge,
            three points never do.
    """
    human = human or human_motion(scene, setting)
    hand, q, wrist = scene.robot_points, [scene.robot.q], [scene.robot.wrist]
    follow = _follower(setting.fingers, hand, q[0], wrist[0])
    points, targets, stretches = [hand.points(q[0], wrist[0])], [], []
    for k in range(1, len(human.q)):
        start = k - 1 if setting.start == "previous" else 0
        motion, rigid, factors = _step_motion(
            scene, setting, human, start, k, points[start]
        )
        targets.append(transform_points(motion, points[start]))
        q_new, wrist_new = follow(q[-1], targets[-1], rigid @ wrist[start])
        q.append(q_new)
        wrist.append(wrist_new)
        points.append(hand.points(q_new, wrist_new))
        stretches.append(factors)
    whole = _step_motion(scene, setting, human, 0, len(human.q) - 1, points[0])[0]
    return Run(
        scene,
        setting,
        human,
        HandMotion(np.array(q), np.array(wrist), np.array(points)),
        np.array(targets),
        transform_points(whole, points[0]),
        np.array(stretches),
    )


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
    human, robot = (hand.carry(stiffnesses) for hand in _held(run))
    return human, robot


def object_error(run: Run, stiffnesses: Stiffnesses | None = None) -> float:
    """Final distance between the object's centres, the paper's "trajectory error" [m]."""
    human, robot = object_poses(run, stiffnesses)
    return float(np.linalg.norm(human[-1, :3, 3] - robot[-1, :3, 3]))


def in_hand_step(
    scene: Scene,
    setting: Setting,
    stiffnesses: Stiffnesses = UNIT,
    *,
    is_rigid: bool = False,
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
    share = np.array([0.0, 1.0 / setting.steps])
    step = run_experiment(
        scene, setting, _activated(scene, setting, share, np.zeros((2, 3)))
    )
    hands = _held(step)
    poses = [hand.carry(None if is_rigid else stiffnesses) for hand in hands]
    human, robot = (pose[1, :3, 3] - pose[0, :3, 3] for pose in poses)
    return InHandStep(
        human, robot, *(hand.force_changes(stiffnesses) for hand in hands)
    )


def angle_between(one: np.ndarray, other: np.ndarray) -> float:
    """Angle between two vectors [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(one, other)), one @ other))


def rms(offsets: np.ndarray) -> float:
    """RMS length of vectors of shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=-1))))


def _activated(
    scene: Scene, setting: Setting, share: np.ndarray, offsets: np.ndarray
) -> HandMotion:
    """Human motion by shares of the activation (N + 1,) and shifts of the wrist (N + 1, 3)."""
    grasp = scene.human
    synergy = load_synergies().matrix[:, setting.synergy - 1]
    q = grasp.q + setting.gamma * share[:, None] * synergy
    wrist = np.tile(grasp.wrist, (len(share), 1, 1))
    wrist[:, :3, 3] += offsets
    samples = zip(q, wrist, strict=True)
    return HandMotion(
        q, wrist, np.array([scene.human_points.points(*one) for one in samples])
    )


def _follower(
    fingers: FingerMode, hand: Hand, q: np.ndarray, wrist: np.ndarray
) -> Callable[[np.ndarray, np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Return a step of the inverse kinematics: from q, targets and wrist target to q and wrist."""
    solver: PointIk | PseudoinverseIk
    if fingers in ("qp", "damped"):
        if fingers == "qp":
            solver = PointIk(hand, IK)
        else:
            solver = PseudoinverseIk(hand, IK, limits="clip", damping=1.0)
        solver.place(hand.configuration_vector(q, wrist))

        def solve(
            q: np.ndarray, targets: np.ndarray, wrist_target: np.ndarray
        ) -> tuple[np.ndarray, np.ndarray]:
            solver.solve(targets, wrist_target, _STEP_TIME)
            at = solver.configuration
            return at.q[hand.q_indices], at.wrist.homogeneous

        return solve

    def equation_8(
        q: np.ndarray, targets: np.ndarray, wrist_target: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        if fingers != "frozen":
            # Use the Jacobian after T_rb, where the finger motion starts.
            displacement = (targets - hand.points(q, wrist_target)).ravel()
            q = q + np.linalg.pinv(hand.point_jacobian(q, wrist_target)) @ displacement
        if fingers == "clipped":
            q = np.clip(q, hand.lower_limits, hand.upper_limits)
        return q, wrist_target

    return equation_8


def _step_motion(
    scene: Scene,
    setting: Setting,
    human: HandMotion,
    start: int,
    end: int,
    robot_points: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """T and T_rb between two samples, as imposed on the robot's points, and the stretches."""
    before, after = human.points[start], human.points[end]
    motion = estimate_motion(before, after, ridge=setting.ridge).motion
    pivot = {
        "centroid": before.mean(axis=0),
        "own": before.mean(axis=0),
        "palm": (human.wrist[start] @ scene.human.hand.wrist_to_palm)[:3, 3],
        "origin": np.zeros(3),
    }[setting.pivot]
    parts = decompose(motion, pivot=pivot)
    rigid = rigid_fit(before, after) if setting.fingers == "frozen" else parts.rigid
    if setting.pivot == "own":
        there = affine(np.eye(3), robot_points.mean(axis=0) - pivot)
        back = affine(np.eye(3), pivot - robot_points.mean(axis=0))
        motion, rigid = there @ motion @ back, there @ rigid @ back
    return motion, rigid, parts.stretches


class _HeldObject(NamedTuple):
    """An object in a hand that moves.

    Attributes:
        grasp: The grasp at the start.
        motion: The motion of the hand.
        synergies: S, shape (n, n_z); the identity if the joints are activated directly.
        activation: Change of the references of synergies or joints per step, shape (N, n_z).
        is_stiff: Whether the synergies are rigid.
    """

    grasp: Grasp
    motion: HandMotion
    synergies: np.ndarray
    activation: np.ndarray
    is_stiff: bool

    def carry(self, stiffnesses: Stiffnesses | None) -> np.ndarray:
        """Poses of the object, shape (N + 1, 4, 4); by the rigid model without stiffnesses."""
        hand, (q, wrist, _), poses = (
            self.grasp.contact_hand,
            self.motion,
            [self.grasp.object_pose],
        )
        for k in range(len(q) - 1):
            pose = self._carried(k, poses[-1])
            if stiffnesses is None:
                transposed = grasp_matrix(
                    hand.points(q[k], wrist[k + 1]), pose[:3, 3]
                ).T
                moved = hand.point_jacobian(q[k], wrist[k + 1]) @ (q[k + 1] - q[k])
                twist = np.linalg.lstsq(transposed, moved, rcond=None)[0]
            else:
                twist = (
                    self._response(k, pose, stiffnesses).object_motion
                    @ self.activation[k]
                )
            turn = Rotation.from_rotvec(twist[3:]).as_matrix()
            poses.append(affine(turn @ pose[:3, :3], pose[:3, 3] + twist[:3]))
        return np.array(poses)

    def force_changes(self, stiffnesses: Stiffnesses) -> np.ndarray:
        """Change of the forces on the object in the first step [N], shape (n_c, 3)."""
        response = self._response(
            0, self._carried(0, self.grasp.object_pose), stiffnesses
        )
        return (response.contact_forces @ self.activation[0]).reshape(-1, 3)

    def _carried(self, k: int, pose: np.ndarray) -> np.ndarray:
        """Pose of the object after the wrist's motion in a step."""
        return self.motion.wrist[k + 1] @ inverse_pose(self.motion.wrist[k]) @ pose

    def _response(
        self, k: int, pose: np.ndarray, stiffnesses: Stiffnesses
    ) -> QuasiStatic:
        """Quasi-static response in a step, per unit of each synergy or radian of each joint."""
        hand, q, wrist = (
            self.grasp.contact_hand,
            self.motion.q[k],
            self.motion.wrist[k + 1],
        )
        return quasistatic(
            hand.point_jacobian(q, wrist),
            grasp_matrix(hand.points(q, wrist), pose[:3, 3]),
            self.synergies,
            contact_stiffness=stiffnesses.contact,
            joint_stiffness=stiffnesses.joint,
            synergy_stiffness=np.inf if self.is_stiff else stiffnesses.synergy,
        )


def _held(run: Run) -> tuple[_HeldObject, _HeldObject]:
    """Return the object in the human's and in the robot's hand."""
    scene, setting = run.scene, run.setting
    synergy = load_synergies().matrix[:, [setting.synergy - 1]]
    share = np.full((len(run.human.q) - 1, 1), setting.gamma / setting.steps)
    joints = np.eye(len(scene.robot.q))
    return (
        _HeldObject(scene.human, run.human, synergy, share, is_stiff=False),
        _HeldObject(
            scene.robot, run.robot, joints, np.diff(run.robot.q, axis=0), is_stiff=True
        ),
    )
