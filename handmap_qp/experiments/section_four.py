"""The paper's numerical experiment (Sec. IV): two hands on one cube, a wrist arc and a synergy.

Each step follows Fig. 3 of the paper. T is estimated from the human's reference points at the start
and end of the step (eqs. 5-6), decomposed about a pivot (eqs. 2-3) and imposed on the robot's
points (eq. 7). T_rb moves the wrist, and eq. (8) the fingers. Choices that the paper leaves open
are fields of `Setting`. For the motion of the object see `handmap_qp.experiments.held_object`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, Self
from xml.etree import ElementTree as ET

import msgspec
import numpy as np

from handmap_qp.experiments.followers import FingerMode, make_follower
from handmap_qp.grasp import Contact, Grasp
from handmap_qp.grasp.paper_cube import read_cube_figures, reference_grasp
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.synergies import load_synergies
from handmap_qp.hands.urdf import get_numbers, parse_urdf, set_numbers
from handmap_qp.mapping.decomposition import decompose
from handmap_qp.mapping.estimation import estimate_motion
from handmap_qp.se3 import affine, rigid_fit, transform_points

ARC_LENGTH = 0.47
"""Length of the wrist's arc along x [m]."""
ARC_HEIGHT = 0.15
"""Height of the wrist's arc along z [m]."""

Pivot = Literal["centroid", "own", "palm", "origin"]
Start = Literal["previous", "first"]
Geometry = Literal["toolbox", "ours"]

# Azimuth in the palm of the first joint of each finger of the three-fingered hand [rad].
_AZIMUTHS = {"f1_proximal": 0.0, "f2_spread": 2.0 * np.pi / 3.0, "f3_spread": -2.0 * np.pi / 3.0}


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
        return cls(
            human,
            robot,
            human.hand.with_points(human.point_specs),
            robot.hand.with_points(robot.point_specs),
        )

    def moved(self, offset: np.ndarray) -> Self:
        """Return the scene translated by `offset` [m], shape (3,)."""
        motion = affine(np.eye(3), np.asarray(offset, dtype=float))
        return type(self)(
            self.human.moved(motion), self.robot.moved(motion), self.human_points, self.robot_points
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
        fingers: Inverse kinematics of the fingers; see `handmap_qp.experiments.followers`. With
            `frozen`, T_rb is the best rigid fit of the human's points (Kabsch).
        ridge: Ridge of eq. (6); 0 is the paper's.
    """

    synergy: int = 1
    gamma: float = 1.0
    steps: int = 50
    pivot: Pivot = "centroid"
    start: Start = "previous"
    fingers: FingerMode = "pseudoinverse"
    ridge: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class HandMotion:
    """The motion of one hand: N steps, N + 1 samples.

    Attributes:
        q: Joint angles [rad], shape (N + 1, n).
        wrist: Wrist poses, shape (N + 1, 4, 4).
        points: Reference points [m], shape (N + 1, m, 3).
    """

    q: np.ndarray
    wrist: np.ndarray
    points: np.ndarray


@dataclass(frozen=True, slots=True, eq=False)
class Run:
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
        hand = self.scene.robot_points
        return max(
            0.0,
            float(
                np.maximum(hand.lower_limits - self.robot.q, self.robot.q - hand.upper_limits).max()
            ),
        )


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
                origin, "xyz", [x + shift * np.cos(azimuth), y + shift * np.sin(azimuth), z]
            )
    return Hand(
        hand.spec,
        points="contacts",
        mount="floating",
        urdf_text=ET.tostring(robot, encoding="unicode"),
    )


def limited_hand(hand: Hand, rest: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> Hand:
    """Return a hand with other joint limits and another rest posture.

    Args:
        hand: The hand; its reference points are kept.
        rest: Rest posture, inside the limits [rad], shape (n,).
        lower: Lower limits [rad], shape (n,).
        upper: Upper limits [rad], shape (n,).

    Returns:
        The hand.
    """
    robot, index = parse_urdf(hand.urdf_text), {name: i for i, name in enumerate(hand.joint_names)}
    for joint in robot.iterfind("joint"):
        limit = joint.find("limit")
        if limit is not None and joint.get("name") in index:
            i = index[joint.get("name", "")]
            set_numbers(limit, "lower", [lower[i]])
            set_numbers(limit, "upper", [upper[i]])
    angles = {name: float(rest[i]) for name, i in index.items()}
    spec = msgspec.structs.replace(hand.spec, rest=angles, mirror=False)
    return Hand(
        spec,
        points=hand.reference_points,
        mount=hand.mount,
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
    grasp, hand = scene.human, scene.human_points
    share = np.linspace(0.0, 1.0, setting.steps + 1)[:, None]
    q = grasp.q + setting.gamma * share * load_synergies().matrix[:, setting.synergy - 1]
    wrist = np.tile(
        np.eye(4) if grasp.wrist_pose is None else grasp.wrist_pose, (setting.steps + 1, 1, 1)
    )
    wrist[:, :3, 3] += wrist_arc(setting.steps)
    return HandMotion(
        q, wrist, np.array([hand.points(*sample) for sample in zip(q, wrist, strict=True)])
    )


def run_experiment(scene: Scene, setting: Setting, human: HandMotion | None = None) -> Run:
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
    follower = make_follower(
        setting.fingers, scene.robot_points, scene.robot.q, scene.robot.wrist_pose
    )
    q, wrist, points = [follower.q], [follower.wrist], [follower.points]
    targets, stretches = [], []
    for k in range(1, len(human.q)):
        start = k - 1 if setting.start == "previous" else 0
        motion, rigid, factors = _step_motion(scene, setting, human, start, k, points[start])
        targets.append(transform_points(motion, points[start]))
        follower.follow(targets[-1], rigid @ wrist[start])
        q.append(follower.q)
        wrist.append(follower.wrist)
        points.append(follower.points)
        stretches.append(factors)
    whole = _step_motion(scene, setting, human, 0, len(human.q) - 1, points[0])[0]
    robot = HandMotion(np.array(q), np.array(wrist), np.array(points))
    return Run(
        scene,
        setting,
        human,
        robot,
        np.array(targets),
        transform_points(whole, points[0]),
        np.array(stretches),
    )


def rms(offsets: np.ndarray) -> float:
    """RMS length of vectors of shape (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(np.square(offsets), axis=-1))))


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
