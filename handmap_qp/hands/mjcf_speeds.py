"""How fast the actuators of a MuJoCo model move its joints: `top_speeds`.

MJCF has no speed limits. What bounds a joint there is the force of its actuator against damping,
friction and inertia.
"""

from collections import defaultdict
from typing import NamedTuple

import mujoco
import numpy as np

from handmap_core.se3 import Array
from .mjcf_couplings import fixed_tendon
from .urdf import FASTEST_SPEEDS

# Step of the integration, and its longest time [s].
_STEP = 2.5e-4
_LONGEST = 5.0
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
_JOINTS = {
    int(mujoco.mjtTrn.mjTRN_JOINT),
    int(mujoco.mjtTrn.mjTRN_JOINTINPARENT),
}
_TENDON = int(mujoco.mjtTrn.mjTRN_TENDON)
_FIXED_GAIN = int(mujoco.mjtGain.mjGAIN_FIXED)
_BIASES = {int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE)}
_INTEGRATOR = int(mujoco.mjtDyn.mjDYN_INTEGRATOR)
# Activations that the control reaches in time.
_DYNAMICS = {
    _INTEGRATOR,
    int(mujoco.mjtDyn.mjDYN_NONE),
    int(mujoco.mjtDyn.mjDYN_FILTER),
    int(mujoco.mjtDyn.mjDYN_FILTEREXACT),
}


class JointDrive(NamedTuple):
    """One joint, and an actuator that moves it away from the end of its range.

    The joint is at 0 where it starts. Its equation of motion is, of MuJoCo's ("Computation",
    Equations of motion and Actuation model), that of one degree of freedom with all others at rest:

        inertia dv/dt = clip(force - stiffness q - drag v, -most, most) - damping v - friction.

    Attributes:
        travel: Width of its range [rad or m].
        inertia: Diagonal entry of the inertia matrix in the model's reference posture, with the
            armature [kg m^2 or kg].
        damping: Damping of the joint [N m s or N s/m].
        friction: Its dry friction [N m or N].
        force: Force of the actuator where it starts [N m or N].
        stiffness: Gain of the actuator's position [N m/rad or N/m].
        drag: Gain of its speed [N m s/rad or N s/m].
        most: Limit of its force; infinite without one [N m or N].
        fastest: Speed of the actuator's own set point; infinite without one [rad/s or m/s].
    """

    travel: float
    inertia: float
    damping: float
    friction: float
    force: float
    stiffness: float
    drag: float
    most: float
    fastest: float


def top_speeds(model: mujoco.MjModel) -> dict[int, float]:
    """Return the largest speed that an actuator gives each joint on its way along its range.

    The speed is the peak of the response to one step of the control, from one end of the range at
    rest to the other (`peak_speeds`), without gravity, springs and contacts: the simulated joint
    follows no command faster. It is a property of the file, and a real motor may differ.

    Returns:
        Speeds by the index of hinges and slides with a range, at most `FASTEST_SPEEDS` [rad/s or
        m/s]; of several actuators the fastest. Joints whose actuators do not bound a force or a
        speed, or that have none, are missing.
    """
    drives = defaultdict[int, list[JointDrive]](list)
    for actuator in range(model.nu):
        for joint, factor in _moved(model, actuator).items():
            drive = _drive(model, actuator, joint, factor)
            if drive:
                drives[joint].append(drive)
    joints = [joint for joint, each in drives.items() for _ in each]
    speeds = peak_speeds([drive for each in drives.values() for drive in each])
    found = dict[int, float]()
    for joint, speed in zip(joints, speeds.tolist(), strict=True):
        found[joint] = max(speed, found.get(joint, 0.0))
    return {
        joint: min(speed, FASTEST_SPEEDS[_kind(model, joint)])
        for joint, speed in found.items()
        if speed > 0.0
    }


def peak_speeds(drives: list[JointDrive]) -> Array:
    """Integrate each joint from rest, and return its largest speed, shape (n,) [rad/s or m/s].

    Euler steps, implicit in position and speed while the force is not at its limit, and in the
    damping else. A joint ends where it has travelled its range, or slows down.
    """
    if not drives:
        return np.zeros(0)
    travel, inertia, damping, friction, force, stiffness, drag, most, fastest = (
        np.array(drives).T
    )
    q = np.zeros(len(drives))
    v = np.zeros(len(drives))
    peak = np.zeros(len(drives))
    free = inertia + _STEP * (damping + drag) + _STEP**2 * stiffness
    held = inertia + _STEP * damping
    for _ in range(round(_LONGEST / _STEP)):
        wanted = force - stiffness * q - drag * v
        is_held = np.abs(wanted) > most
        limited = np.clip(wanted, -most, most)
        pushed = np.where(is_held, limited, force - stiffness * q)
        # Friction stops a joint, and does not turn it back.
        v = np.maximum(inertia * v + _STEP * (pushed - friction), 0.0)
        v /= np.where(is_held, held, free)
        # At the end of its range a joint is done.
        v[q >= travel] = 0.0
        is_slowing = v < peak
        peak = np.maximum(peak, v)
        q += _STEP * v
        if (is_slowing | (v <= 0.0)).all():
            break
    return np.minimum(peak, fastest)


def _kind(model: mujoco.MjModel, joint: int) -> str:
    return "prismatic" if model.jnt_type[joint] == _SLIDE else "revolute"


def _moved(model: mujoco.MjModel, actuator: int) -> dict[int, float]:
    """Return the joints that an actuator moves, with the change of its length per unit of each."""
    target = int(model.actuator_trnid[actuator, 0])
    gear = float(model.actuator_gear[actuator, 0])
    kind = model.actuator_trntype[actuator]
    factors = dict[int, float]()
    if kind in _JOINTS:
        factors = {target: gear}
    elif kind == _TENDON:
        # The lever of a tendon that is no sum of joints depends on the posture.
        levers = fixed_tendon(model, target)
        factors = {moved: gear * lever for moved, lever in levers.items()}
    return {
        joint: factor
        for joint, factor in factors.items()
        if factor
        and model.jnt_limited[joint]
        and model.jnt_type[joint] in (_HINGE, _SLIDE)
    }


def _drive(
    model: mujoco.MjModel, actuator: int, joint: int, factor: float
) -> JointDrive | None:
    """Return the equation of motion of a joint under one actuator; None if nothing bounds it.

    A servo gets the control of the other end of the range, another actuator its largest one.
    """
    bias = int(model.actuator_biastype[actuator])
    dynamics = int(model.actuator_dyntype[actuator])
    gain = float(model.actuator_gainprm[actuator, 0])
    if (
        int(model.actuator_gaintype[actuator]) != _FIXED_GAIN
        or bias not in _BIASES
        or dynamics not in _DYNAMICS
        or gain == 0.0
    ):
        return None
    offset, per_length, per_speed = (
        model.actuator_biasprm[actuator, :3].tolist() if bias else (0.0, 0.0, 0.0)
    )
    low, high = model.jnt_range[joint].tolist()
    # Towards positive joint positions: the range and MuJoCo's limits of force are about even.
    start = factor * low
    is_limited = bool(model.actuator_ctrllimited[actuator])
    ends = model.actuator_ctrlrange[actuator].tolist()
    fastest = np.inf
    is_servo = per_length < 0.0
    if is_servo:
        control = -(offset + per_length * factor * high) / gain
        if dynamics == _INTEGRATOR:
            if is_limited:
                fastest = max(map(abs, ends)) * abs(gain / per_length / factor)
        elif is_limited:
            control = float(np.clip(control, *ends))
    elif is_limited and dynamics != _INTEGRATOR:
        control = max(ends) if gain * factor > 0.0 else min(ends)
    else:
        return None
    dof = model.jnt_dofadr[joint]
    most = np.inf
    if model.actuator_forcelimited[actuator]:
        most = np.abs(model.actuator_forcerange[actuator]).max() * abs(factor)
    if model.jnt_actfrclimited[joint]:
        most = min(most, np.abs(model.jnt_actfrcrange[joint]).max())
    return JointDrive(
        travel=high - low,
        inertia=float(model.dof_M0[dof]),
        damping=float(np.ravel(model.dof_damping[dof])[0]),
        friction=float(model.dof_frictionloss[dof]),
        force=factor * (gain * control + offset + per_length * start),
        stiffness=-per_length * factor**2,
        drag=-per_speed * factor**2,
        most=float(most),
        fastest=float(fastest),
    )
