"""Variants of the paper's experiment (Sec. IV): choices that the paper leaves open.

Inverse kinematics of the robot, by `Variant.fingers`:

| fingers | inverse kinematics |
|---|---|
| `pseudoinverse` | eq. (8) with `xi = 0`: wrist by T_rb, `dq = J# (p_f - p_rb)`, limits ignored |
| `clipped` | the same, each step clipped into the position limits of the joints |
| `damped` | `PseudoinverseIk`: the cost of the QP without its limits, clipped afterwards |
| `qp` | `PointIk`: the same cost within the limits |
| `frozen` | the wrist moves by T_rb, the fingers do not move |

`damped` and `qp` solve for wrist and fingers together. In both, the rest term is off
(`rest_weight = 0`), and there are no speed limits, because a step has no duration.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Literal
from xml.etree import ElementTree as ET

import msgspec
import numpy as np
from pseudoinverse import PseudoinverseIk
from section_four.contacts import Grasp
from section_four.experiment import (
    Follow,
    HandMotion,
    Run,
    Scene,
    Setting,
    equation_8,
    run_experiment,
)

from handmap_core.ik.options import IkOptions
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf import parse_urdf, set_numbers
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.decomposition import decompose
from handmap_qp.reference.estimation import estimate_motion
from handmap_qp.se3 import affine, rigid_fit

FingerMode = Literal["pseudoinverse", "clipped", "damped", "qp", "frozen"]
Pivot = Literal["centroid", "own", "palm", "origin"]
IK = IkOptions(
    rest_weight=0.0,
    damping=0.01,
    error_damping=0.0,
    max_iterations=20,
    step_tolerance=1e-7,
    has_velocity_limits=False,
)
"""Options of the QP in the experiment: iterated to convergence, without a rest term."""


@dataclass(frozen=True)
class Variant:
    """Choices of one run.

    Attributes:
        fingers: Inverse kinematics of the fingers; see the table of this module. With `frozen`,
            T_rb is the best rigid fit of the human's points (Kabsch).
        pivot: Point about which rotation and deformation act: `centroid`, of the human's points for
            both hands (reference numbers); `own`, each hand's centroid (default of `HandMapper`);
            `palm`, of the human; `origin`, of the world (the paper read literally).
        ridge: Ridge of eq. (6); 0 is the paper's.
    """

    fingers: FingerMode = "pseudoinverse"
    pivot: Pivot = "centroid"
    ridge: float = 0.0

    def run(self, scene: Scene, setting: Setting) -> Run:
        """Run the experiment."""
        follow = _follower(self.fingers, scene)
        return run_experiment(scene, setting, transfer=self._transfer, follow=follow)

    def _transfer(
        self,
        scene: Scene,
        human: HandMotion,
        start: int,
        end: int,
        robot_points: np.ndarray,
    ) -> tuple[np.ndarray, np.ndarray]:
        before, after = human.points[start], human.points[end]
        motion = estimate_motion(before, after, ridge=self.ridge).motion
        pivot = {
            "centroid": before.mean(axis=0),
            "own": before.mean(axis=0),
            "palm": (human.wrist[start] @ scene.human.hand.wrist_to_palm)[:3, 3],
            "origin": np.zeros(3),
        }[self.pivot]
        is_frozen = self.fingers == "frozen"
        parts = decompose(motion, pivot=pivot)
        rigid = rigid_fit(before, after) if is_frozen else parts.rigid
        if self.pivot == "own":
            there = affine(np.eye(3), robot_points.mean(axis=0) - pivot)
            back = affine(np.eye(3), pivot - robot_points.mean(axis=0))
            motion, rigid = there @ motion @ back, there @ rigid @ back
        return motion, rigid


def largest_stretch(run: Run, ridge: float = 0.0) -> float:
    """Return the largest stretch factor of a step's T, in magnitude."""
    found, points = 0.0, run.human.points
    for k in range(1, len(points)):
        start = k - 1 if run.setting.start == "previous" else 0
        motion = estimate_motion(points[start], points[k], ridge=ridge).motion
        found = max(found, float(np.abs(decompose(motion).stretches).max()))
    return found


def limit_excess(run: Run) -> float:
    """Return the largest violation of the robot's joint limits [rad]."""
    hand, q = run.scene.robot_points, run.robot.q
    excess = np.maximum(hand.lower_limits - q, q - hand.upper_limits)
    return max(0.0, float(excess.max()))


def moved_scene(scene: Scene, offset: np.ndarray) -> Scene:
    """Return a scene translated by `offset` [m], shape (3,)."""
    motion = affine(np.eye(3), offset)
    human, robot = moved_grasp(scene.human, motion), moved_grasp(scene.robot, motion)
    return Scene(human, robot, scene.human_points, scene.robot_points)


def moved_grasp(grasp: Grasp, motion: np.ndarray) -> Grasp:
    """Return a grasp of a floating hand after one rigid motion of hand and object, (4, 4)."""
    return Grasp(
        grasp.hand,
        grasp.q,
        motion @ grasp.object_pose,
        grasp.contacts,
        motion @ grasp.wrist,
        grasp.shape,
    )


def _follower(fingers: FingerMode, scene: Scene) -> Follow:
    """Return a step of the inverse kinematics."""
    hand = scene.robot_points
    if fingers == "pseudoinverse":
        return equation_8
    if fingers == "clipped":
        return _clipped
    if fingers == "frozen":
        return _frozen
    solver: PointIk | PseudoinverseIk
    if fingers == "qp":
        solver = PointIk(hand, IK)
    else:
        solver = PseudoinverseIk(hand, IK, limits="clip", damping=1.0)
    solver.place(hand.configuration_vector(scene.robot.q, scene.robot.wrist))
    return partial(_solved, solver)


def _clipped(
    hand: Hand, q: np.ndarray, targets: np.ndarray, wrist_target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    q, wrist = equation_8(hand, q, targets, wrist_target)
    return np.clip(q, hand.lower_limits, hand.upper_limits), wrist


def _frozen(
    hand: Hand, q: np.ndarray, targets: np.ndarray, wrist_target: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    return q, wrist_target


def _solved(
    solver: PointIk | PseudoinverseIk,
    hand: Hand,
    q: np.ndarray,
    targets: np.ndarray,
    wrist_target: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    solver.solve(targets, wrist_target, 1.0)
    at = solver.configuration
    return at.q[hand.q_indices], at.wrist.homogeneous


def limited_hand(
    hand: Hand, rest: np.ndarray, lower: np.ndarray, upper: np.ndarray
) -> Hand:
    """Return a hand with other joint limits and another rest posture.

    Args:
        hand: The hand; its reference points are kept.
        rest: Rest posture, inside the limits [rad], shape (n,).
        lower: Lower limits [rad], shape (n,).
        upper: Upper limits [rad], shape (n,).

    Returns:
        The hand.
    """
    robot, index = (
        parse_urdf(hand.urdf_text),
        {name: i for i, name in enumerate(hand.joint_names)},
    )
    for joint in robot.iterfind("joint"):
        limit = joint.find("limit")
        if limit is not None and joint.get("name") in index:
            i = index[joint.get("name", "")]
            set_numbers(limit, lower=lower[i], upper=upper[i])
    angles = {name: float(rest[i]) for name, i in index.items()}
    spec = msgspec.structs.replace(hand.spec, rest=angles, mirror=False)
    return Hand(
        spec,
        points=hand.reference_points,
        mount=hand.mount,
        urdf_text=ET.tostring(robot, encoding="unicode"),
    )
