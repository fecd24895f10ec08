"""Compare the kinematics of a converted URDF with MuJoCo's own: `kinematics_difference`."""

from __future__ import annotations

import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pinocchio as pin

from handmap_qp.hands.mjcf.convert import ConvertedMjcf
from handmap_qp.hands.urdf import parse_urdf

_POSTURES, _SEED = 20, 0
_WITHOUT_RANGE = (-1.0, 1.0)


def kinematics_difference(
    converted: ConvertedMjcf, postures: int = _POSTURES, seed: int = _SEED
) -> float:
    """Return the largest difference of link poses between Pinocchio and MuJoCo.

    Hinges, slides and balls are at random positions in their ranges, independent of couplings.

    Args:
        converted: The URDF and MuJoCo's model.
        postures: Number of random postures.
        seed: Seed of the random numbers.

    Returns:
        Largest difference of an entry of any link's pose; positions count in metres.
    """
    model, random = converted.model, np.random.default_rng(seed)
    data = mujoco.MjData(model)
    robot = pin.buildModelFromXML(_open_chain(converted.text))
    robot_data = robot.createData()
    frames = {
        body: robot.getFrameId(name, pin.FrameType.BODY) for body, name in converted.links.items()
    }
    worst = 0.0
    for _ in range(postures):
        data.qpos[:] = model.qpos0
        q = pin.neutral(robot)
        for joint in range(model.njnt):
            _place(converted, joint, random, data, robot, q)
        mujoco.mj_kinematics(model, data)
        pin.framesForwardKinematics(robot, robot_data, q)
        for body, frame in frames.items():
            pose = robot_data.oMf[frame]
            worst = max(
                worst,
                float(np.abs(pose.translation - data.xpos[body]).max()),
                float(np.abs(pose.rotation - data.xmat[body].reshape(3, 3)).max()),
            )
    return worst


def _open_chain(text: str) -> str:
    """Return the URDF without mimic rules, each joint with all limits that Pinocchio asks for."""
    robot = parse_urdf(text)
    for joint in robot.iterfind("joint"):
        if (mimic := joint.find("mimic")) is not None:
            joint.remove(mimic)
        if (limit := joint.find("limit")) is not None:
            for key in ("lower", "upper", "velocity"):
                limit.set(key, limit.get(key, "0"))
    return ET.tostring(robot, encoding="unicode")


def _place(
    converted: ConvertedMjcf,
    joint: int,
    random: np.random.Generator,
    data: mujoco.MjData,
    robot: pin.Model,
    q: np.ndarray,
) -> None:
    """Put one joint at the same random position in both models."""
    model = converted.model
    at = int(model.jnt_qposadr[joint])
    if int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_BALL):
        base = model.joint(joint).name or f"joint{joint}"
        rotation = np.eye(3)
        for axis, suffix in zip(np.eye(3), "xyz", strict=True):
            angle = random.uniform(*_WITHOUT_RANGE)
            rotation = rotation @ pin.AngleAxis(angle, axis).toRotationMatrix()
            _set(robot, q, f"{base}_{suffix}", angle)
        mujoco.mju_mat2Quat(data.qpos[at : at + 4], rotation.ravel())
    elif joint in converted.joints:
        low, high = model.jnt_range[joint] if model.jnt_limited[joint] else _WITHOUT_RANGE
        data.qpos[at] = random.uniform(low, high)
        _set(robot, q, converted.joints[joint], float(data.qpos[at]))


def _set(robot: pin.Model, q: np.ndarray, name: str, position: float) -> None:
    """Set a joint's coordinate; Pinocchio holds a continuous one as cosine and sine."""
    joint = robot.joints[robot.getJointId(name)]
    if joint.nq == 2:
        q[joint.idx_q : joint.idx_q + 2] = np.cos(position), np.sin(position)
    else:
        q[joint.idx_q] = position
