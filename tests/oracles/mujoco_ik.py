"""The QP of `handmap_qp.ik.qp`, formulated independently with MuJoCo and mink.

The URDF of the hand is compiled for MuJoCo. Kinematics, Jacobians, logarithms, tasks and limits are
those of MuJoCo and mink, so agreement with `handmap_qp.ik.qp` is evidence for both. Two differences
between the libraries are handled here:

- The tangent space. Pinocchio's free-flyer moves by a body twist. MuJoCo's free joint moves by a
  linear velocity in world axes and an angular velocity in body axes. The orders of the joints
  differ too. `tangent_map` returns the matrix between both spaces; it also contains mimic joints.
- The point task. mink has none. The error of a `FrameTask` without orientation cost is a
  translation in the axes of the frame, which rotate. So the derivative of its SE(3) logarithm is
  `J_point + 1/2 [e]x J_angular`, not `J_point`. The extra term is proportional to the error e. So
  all right-hand sides are scaled by one small factor (`SHRINK`): the distances of the point
  targets, mink's gains, the gain of the limits, and the time. The solution of a QP scales exactly
  with its right-hand sides, so the step is the solution divided by the factor, and the extra term
  is smaller by the factor.

mink 1.3 drops the extra term if the remaining rotation is below 1e-5 rad, which is correct for
point tasks of any length. With the exact derivative, steps to targets up to a metre away would be
wrong by up to 0.9 rad at full size, and by 9e-7 rad when scaled. For the same reason mink's step
differs slightly for a wrist whose orientation has arrived before its position.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mink
import mujoco
import numpy as np
import qpsolvers

from handmap_core.ik.options import IkOptions
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf import parse_urdf

SHRINK = 7e-7
"""Factor of all right-hand sides.

With smaller factors rounding errors dominate, with larger ones the rotation of a point task.
"""

_MOUNT = "mujoco_mount"
# MuJoCo needs masses even for kinematics alone. By default it would fuse links without joints into
# their parents.
_COMPILER = {
    "fusestatic": "false",
    "boundmass": "1",
    "boundinertia": "1",
    "discardvisual": "true",
    "autolimits": "true",
}


class MujocoIk:
    """Formulate the QP of `handmap_qp.ik.qp.PointIk` with mink on MuJoCo.

    Position and speed limits are mink's stacked rows. They contradict each other if a joint is
    outside its limits by more than its speed limit allows within one sample; the QP then has no
    solution. Acceleration limits and self-collision avoidance are not included.

    Args:
        hand: The hand.
        options: Weights, as of `PointIk`.
        shrink: See the module's text.

    Attributes:
        model: MuJoCo's model; its sites are the reference points.
    """

    def __init__(
        self, hand: Hand, options: IkOptions, *, shrink: float = SHRINK
    ) -> None:
        self.hand = hand
        self.options = options
        self.shrink = shrink
        self.model = mujoco_model(hand)
        self._configuration = mink.Configuration(self.model)
        # Mimic joints are joints of their own here, as in Pinocchio's model; the tangent map
        # couples them to their leaders.
        names = [name for name in hand.model.names if name in hand.all_joint_names]
        self._q_indices = np.array(
            [self.model.joint(name).qposadr[0] for name in names]
        )
        self._v_indices = np.array([self.model.joint(name).dofadr[0] for name in names])
        self._hand_q = np.array(
            [hand.model.joints[hand.model.getJointId(name)].idx_q for name in names]
        )
        self._hand_v = np.array(
            [hand.model.joints[hand.model.getJointId(name)].idx_v for name in names]
        )
        self._points = [
            mink.FrameTask(f"{_MOUNT}/{point.name}", "site", cost, 0.0)
            for point, cost in zip(
                hand.reference_points, options.point_costs(hand), strict=True
            )
        ]
        self._wrist = mink.FrameTask(
            hand.spec.wrist.link, "body", *options.wrist_costs, gain=shrink
        )
        is_active = np.array([name in hand.joint_names for name in names])
        rest_cost = np.zeros(self.model.nv)
        rest_cost[self._v_indices[is_active]] = options.rest_weight
        self._rest = mink.PostureTask(self.model, rest_cost, gain=shrink)
        self._rest.set_target(self.qpos(hand.configuration_vector(hand.rest)))
        self._limits = self._make_limits()

    def place(self, q: np.ndarray) -> None:
        """Put the model at a configuration.

        Args:
            q: Pinocchio configuration, shape (nq,).
        """
        self._configuration.update(self.qpos(q))

    def qpos(self, q: np.ndarray) -> np.ndarray:
        """Return MuJoCo's configuration for one of Pinocchio, shape (model.nq,)."""
        qpos = self.model.qpos0.copy()
        if self.hand.is_floating:
            qpos[:3] = q[:3]
            qpos[3:7] = q[[6, 3, 4, 5]]
        qpos[self._q_indices] = q[self._hand_q]
        return qpos

    def tangent_map(self) -> np.ndarray:
        """Return the matrix from our displacement to MuJoCo's at this configuration, shape (nv, k).

        Its columns are orthonormal if the hand has no mimic joints.
        """
        T = np.zeros((self.model.nv, self.model.nv))
        if self.hand.is_floating:
            T[:3, :3] = (
                self._configuration.get_transform_frame_to_world(self._root, "body")
                .rotation()
                .as_matrix()
            )
            T[3:6, 3:6] = np.eye(3)
        T[self._v_indices, self._hand_v] = 1.0
        return T @ self.hand.spread

    def problem(
        self, point_targets: np.ndarray, wrist_target: np.ndarray | None, dt: float
    ) -> qpsolvers.Problem:
        """Return MuJoCo's QP of one iteration at the present configuration, in active coordinates.

        Args:
            point_targets: Targets of the reference points [m], shape (m, 3).
            wrist_target: Target of the wrist frame, shape (4, 4); None leaves it free.
            dt: Time for the displacement [s].

        Returns:
            The problem, its right-hand sides at full size.
        """
        errors = []
        for task, target in zip(self._points, point_targets, strict=True):
            here = self._configuration.get_transform_frame_to_world(
                task.frame_name, "site"
            )
            near = here.translation() + self.shrink * (target - here.translation())
            task.set_target(
                mink.SE3.from_rotation_and_translation(here.rotation(), near)
            )
            errors.append(task.cost[:3] * (target - here.translation()))
        # Points and wrist, and their errors.
        parts: list[tuple[list[mink.Task], np.ndarray]] = [
            ([*self._points], np.concatenate(errors))
        ]
        if wrist_target is not None:
            self._wrist.set_target(mink.SE3.from_matrix(wrist_target))
            error = self._wrist.cost * self._wrist.compute_error(self._configuration)
            parts.append(([self._wrist], error))
        T = self.tangent_map()
        problem = self._built([*[t for part, _ in parts for t in part], self._rest], dt)
        # mink's DampingTask excludes the floating base, and its lm_damping grows with the squared
        # error.
        damping = np.zeros(T.shape[1])
        for tasks, error in parts:
            squares = np.diag(T.T @ np.asarray(self._built(tasks).P) @ T)
            damping += np.linalg.norm(error) * np.sqrt(np.maximum(squares, 0.0))
        damping[: 3 if self.hand.is_floating else 0] = 0.0
        damping = self.options.damping**2 + self.options.error_damping * damping
        P = T.T @ np.asarray(problem.P) @ T
        G = None if problem.G is None else np.asarray(problem.G) @ T
        h = None if problem.h is None else problem.h / self.shrink
        return qpsolvers.Problem(
            P + np.diag(damping), T.T @ problem.q / self.shrink, G, h
        )

    def _built(self, tasks: list[mink.Task], dt: float = 1.0) -> qpsolvers.Problem:
        return mink.build_ik(
            self._configuration,
            tasks,
            self.shrink * dt,
            damping=0.0,
            limits=self._limits,
        )

    @property
    def _root(self) -> str:
        return self.model.body(int(self.model.jnt_bodyid[0])).name

    def _make_limits(self) -> list[mink.Limit]:
        limits: list[mink.Limit] = [
            mink.ConfigurationLimit(self.model, gain=self.shrink)
        ]
        if self.options.has_velocity_limits:
            speeds = dict(
                zip(self.hand.joint_names, self.hand.velocity_limits, strict=True)
            )
            limits.append(mink.VelocityLimit(self.model, speeds))
            if self.hand.is_floating:
                wrist = self.hand.spec.wrist
                limits.append(
                    mink.FreeJointVelocityLimit(
                        self.model, wrist.max_linear_speed, wrist.max_angular_speed
                    )
                )
        return limits


def mujoco_model(hand: Hand) -> mujoco.MjModel:
    """Return the kinematics of a hand as a MuJoCo model.

    Args:
        hand: The hand.

    Returns:
        The compiled model: a free joint first where the wrist floats, then the URDF's joints in the
            file's order, the URDF's links
        as bodies and the reference points as sites.
    """
    robot = parse_urdf(hand.urdf_text)
    for link in robot.iterfind("link"):
        for part in list(link):
            link.remove(part)
    ET.SubElement(ET.SubElement(robot, "mujoco"), "compiler", _COMPILER)
    spec = mujoco.MjSpec.from_string(ET.tostring(robot, encoding="unicode"))
    if hand.is_floating:
        spec.worldbody.first_body().add_freejoint()
    for point in hand.reference_points:
        spec.body(point.link).add_site(name=f"{_MOUNT}/{point.name}", pos=point.xyz)
    return spec.compile()
