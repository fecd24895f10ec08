"""Top speeds of joints by the actuators of MJCF: as MuJoCo's own simulation, and closed forms."""

import math

import mujoco
import numpy as np
import pytest

from handmap_qp.hands import FASTEST_SPEEDS
from handmap_qp.hands.mjcf_speeds import JointDrive, peak_speeds, top_speeds

SCENE = """
<mujoco>
  <compiler angle="radian"/>
  <option gravity="0 0 0" timestep="0.0001" integrator="implicitfast">
    <flag contact="disable" limit="disable"/>
  </option>
  <worldbody>{bodies}</worldbody>
  <tendon>{tendons}</tendon>
  <actuator>{actuators}</actuator>
</mujoco>
"""
BODY = """
<body pos="0 {place} 0">
  <joint name="{name}" type="{kind}" axis="1 0 0" {joint}/>
  <geom type="capsule" size=".008" fromto="0 0 0 0 0 .05" density="1000"/>
</body>
"""
RANGE = 'range="-.3 1.4"'
# Joints and actuators: what holds the speed back differs.
CASES = {
    "drag": (f'{RANGE} armature=".0002"', "position", 'kp="6" kv="2"'),
    "damping": (f'{RANGE} damping=".4"', "position", 'kp="1"'),
    "inertia": (f'{RANGE} armature=".02"', "position", 'kp="1.5"'),
    "force": (
        f'{RANGE} damping=".05" armature=".001"',
        "position",
        'kp="20" forcerange="-.4 .4"',
    ),
    "joint force": (
        f'{RANGE} damping=".05" armature=".001" actuatorfrcrange="-.3 .3"',
        "position",
        'kp="20" kv=".2"',
    ),
    "friction": (f'{RANGE} damping=".1" frictionloss=".2"', "position", 'kp="1"'),
    "control": (f'{RANGE} damping=".2"', "position", 'kp="1" ctrlrange="0 .5"'),
    "gear": (f'{RANGE} armature=".02"', "position", 'kp=".6" gear="1.5"'),
    "backwards": (f'{RANGE} damping=".2"', "position", 'kp=".6" gear="-1.5"'),
    "motor": (f'{RANGE} damping=".1"', "motor", 'ctrlrange="-.3 .3"'),
    "speed": (RANGE, "velocity", 'kv="3" ctrlrange="-4 4"'),
}


def compiled(name: str, kind: str = "hinge") -> mujoco.MjModel:
    joint, actuator, gains = CASES[name]
    body = BODY.format(place=0, name="j", kind=kind, joint=joint)
    action = f'<{actuator} joint="j" {gains}/>'
    text = SCENE.format(bodies=body, tendons="", actuators=action)
    return mujoco.MjModel.from_xml_string(text)


def simulated(model: mujoco.MjModel) -> float:
    """Move a joint from one end of its range to the other in MuJoCo; return its largest speed."""
    data = mujoco.MjData(model)
    low, high = model.jnt_range[0]
    data.qpos[0] = low
    gear = model.actuator_gear[0, 0]
    limits = model.actuator_ctrlrange[0]
    is_servo = model.actuator_biasprm[0, 1] < 0.0
    data.ctrl[0] = gear * high if is_servo else limits.max()
    peak = 0.0
    while data.qpos[0] < high and data.time < 3.0:
        mujoco.mj_step(model, data)
        peak = max(peak, data.qvel[0])
    return peak


@pytest.mark.parametrize("name", CASES)
def test_a_top_speed_is_that_of_a_simulated_step(name: str) -> None:
    model = compiled(name)
    (speed,) = top_speeds(model).values()
    assert 0.3 < speed < 0.9 * FASTEST_SPEEDS["revolute"]
    assert speed == pytest.approx(simulated(model), rel=0.02)


def test_a_slide_is_estimated_alike() -> None:
    model = compiled("damping", "slide")
    model.jnt_range[0] = 0.0, 0.04
    # In place of "damping", by which it would move 0.1 m/s at most.
    assert top_speeds(model)[0] == pytest.approx(simulated(model), rel=0.02)


def driven(**changes: float) -> JointDrive:
    free = JointDrive(1.2, 1e-3, 0.0, 0.0, 0.0, 0.0, 0.0, math.inf, math.inf)
    return free._replace(**changes)


def test_closed_forms_are_met() -> None:
    drives = [
        # Without inertia a servo follows an exponential: k s / (damping + drag) at its start.
        driven(inertia=1e-9, force=1.2 * 3.0, stiffness=3.0, damping=0.4, drag=0.2),
        # Without damping it is a quarter of an oscillation: s sqrt(k / inertia).
        driven(force=1.2 * 0.05, stiffness=0.05),
        # A constant force: sqrt(2 s F / inertia), less friction.
        driven(force=0.03, friction=0.01),
        # The same, of a servo at the limit of its force.
        driven(force=1.2e4, stiffness=1e4, most=0.02),
        # Long enough against damping: F / damping.
        driven(travel=50.0, force=0.3, damping=0.1),
        # A set point of its own.
        driven(force=1.2 * 0.05, stiffness=0.05, fastest=2.0),
        # Friction that the force does not overcome.
        driven(force=0.03, friction=0.04),
    ]
    expected = [
        1.2 * 3.0 / 0.6,
        1.2 * math.sqrt(0.05 / 1e-3),
        math.sqrt(2.0 * 1.2 * 0.02 / 1e-3),
        math.sqrt(2.0 * 1.2 * 0.02 / 1e-3),
        3.0,
        2.0,
        0.0,
    ]
    np.testing.assert_allclose(peak_speeds(drives), expected, rtol=0.01, atol=1e-9)


def test_a_joint_does_not_depend_on_others() -> None:
    drives = [
        driven(force=force, damping=0.1, stiffness=force / 1.2)
        for force in (0.1, 0.3, 1.0)
    ]
    apart = [peak_speeds([drive])[0] for drive in drives]
    np.testing.assert_array_equal(peak_speeds(drives), apart)
    assert len(peak_speeds([])) == 0


def test_a_tendon_drives_its_joints_as_a_gear() -> None:
    joint = f'{RANGE} damping=".2"'
    bodies = "".join(
        BODY.format(place=i, name=f"j{i}", kind="hinge", joint=joint) for i in range(3)
    )
    tendons = (
        '<fixed name="t"><joint joint="j0" coef="1.5"/><joint joint="j1" coef="-.5"/>'
        "</fixed>"
    )
    actuators = '<position tendon="t" kp="1"/><position joint="j2" kp="1" gear="1.5"/>'
    text = SCENE.format(bodies=bodies, tendons=tendons, actuators=actuators)
    speeds = top_speeds(mujoco.MjModel.from_xml_string(text))
    assert speeds[0] == pytest.approx(speeds[2], rel=1e-9)
    assert 0.0 < speeds[1] < speeds[0]


def test_without_a_bound_nothing_is_said() -> None:
    joints = {
        "idle": RANGE,
        "endless": 'limited="false"',
        "pushed": RANGE,
        "muscle": RANGE,
        "far": f'{RANGE} armature=".0001"',
    }
    bodies = "".join(
        BODY.format(place=i, name=name, kind="hinge", joint=joint)
        for i, (name, joint) in enumerate(joints.items())
    )
    actuators = (
        '<position joint="endless" kp="1"/><motor joint="pushed"/>'
        '<muscle joint="muscle" lengthrange="0 1"/><position joint="far" kp="900"/>'
    )
    text = SCENE.format(bodies=bodies, tendons="", actuators=actuators)
    model = mujoco.MjModel.from_xml_string(text)
    # Of the last one the largest speed that is believed.
    assert top_speeds(model) == {model.joint("far").id: FASTEST_SPEEDS["revolute"]}


def test_the_fastest_of_several_actuators_counts() -> None:
    body = BODY.format(place=0, name="j", kind="hinge", joint=f'{RANGE} damping=".2"')
    both = '<position joint="j" kp=".5"/><position joint="j" kp="1"/>'
    one = '<position joint="j" kp="1"/>'
    found = [
        top_speeds(
            mujoco.MjModel.from_xml_string(
                SCENE.format(bodies=body, tendons="", actuators=actuators)
            )
        )[0]
        for actuators in (both, one)
    ]
    assert found[0] == found[1]
