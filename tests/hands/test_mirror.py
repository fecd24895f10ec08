"""Reflecting a URDF: the same q gives the mirrored posture."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from functools import cache

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from handmap_qp.errors import HandError
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.urdf import mirror, parse_urdf

MIRROR = np.diag([-1.0, 1.0, 1.0])
HUMAN = (urdf_directory() / "human" / "hand.urdf").read_text(encoding="utf-8")
# Every joint kind, general rotations and axes, an inertia with all its products.
MIXED = """
<robot name="mixed">
  <link name="root"/>
  <joint name="a" type="revolute">
    <parent link="root"/><child link="la"/>
    <origin xyz="0.1 -0.2 0.3" rpy="0.4 -0.5 0.6"/><axis xyz="0.48 0.6 0.64"/>
    <limit lower="-3" upper="3" effort="1" velocity="1"/>
  </joint>
  <link name="la">
    <inertial>
      <origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/><mass value="0.5"/>
      <inertia ixx="0.010" ixy="0.001" ixz="-0.002" iyy="0.012" iyz="0.0015" izz="0.014"/>
    </inertial>
    <visual>
      <origin xyz="0.01 0 0" rpy="1 2 3"/>
      <geometry><cylinder radius="0.01" length="0.03"/></geometry>
    </visual>
  </link>
  <joint name="b" type="prismatic">
    <parent link="la"/><child link="lb"/><origin xyz="0 0.1 0" rpy="1 0.3 -2"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <link name="lb"/>
  <joint name="c" type="continuous">
    <parent link="lb"/><child link="lc"/><origin rpy="0 1.2 0"/><axis xyz="0 -0.6 0.8"/>
    <limit effort="1" velocity="1"/>
  </joint>
  <link name="lc"/>
  <joint name="d" type="fixed">
    <parent link="lc"/><child link="tip"/><origin xyz="0.05 0.06 0.07" rpy="-1 0.2 0.9"/>
  </joint>
  <link name="tip"/>
</robot>
"""


def mirrored_urdf(text: str) -> str:
    """Mirror a URDF as text."""
    robot = parse_urdf(text)
    mirror(robot)
    return ET.tostring(robot, encoding="unicode")


@cache
def models(text: str) -> tuple[pin.Model, pin.Model]:
    """Return the models of a URDF and of its mirror image."""
    return pin.buildModelFromXML(text), pin.buildModelFromXML(mirrored_urdf(text))


def poses(model: pin.Model, q: np.ndarray) -> np.ndarray:
    """Return every frame's rotation and position, side by side, shape (frames, 3, 4)."""
    data = model.createData()
    pin.framesForwardKinematics(model, data, q)
    return np.array([placement.homogeneous[:3] for placement in data.oMf])


def full_q(model: pin.Model, angles: np.ndarray) -> np.ndarray:
    """Return angles as a configuration; a continuous joint has a cosine and a sine."""
    q = []
    for joint, angle in zip(list(model.joints)[1:], angles, strict=True):
        q += [angle] if joint.nq == 1 else [np.cos(angle), np.sin(angle)]
    return np.array(q)


@pytest.mark.parametrize("text", [HUMAN, MIXED], ids=["human", "mixed"])
@given(seed=arrays(float, 20, elements=st.floats(-1.5, 1.5)))
def test_the_same_q_gives_the_mirrored_posture(text: str, seed: np.ndarray) -> None:
    right, left = models(text)
    angles = seed[: right.njoints - 1]
    expected, got = (
        poses(right, full_q(right, angles)),
        poses(left, full_q(left, angles)),
    )
    np.testing.assert_allclose(got[:, :, 3], expected[:, :, 3] @ MIRROR, atol=1e-12)
    np.testing.assert_allclose(
        got[:, :, :3], MIRROR @ expected[:, :, :3] @ MIRROR, atol=1e-12
    )


def test_joint_axes_turn_the_other_way_round() -> None:
    right, left = models(HUMAN)
    q = np.linspace(-0.5, 0.8, 20)
    jacobians = []
    for model in (right, left):
        data = model.createData()
        pin.computeJointJacobians(model, data, q)
        jacobians.append(data.J.copy())
    assert list(right.names) == list(left.names)
    np.testing.assert_allclose(jacobians[1][3:], -MIRROR @ jacobians[0][3:], atol=1e-12)


def test_inertia_is_reflected() -> None:
    right, left = models(MIXED)
    np.testing.assert_allclose(
        left.inertias[1].lever, MIRROR @ right.inertias[1].lever, atol=1e-15
    )
    np.testing.assert_allclose(
        left.inertias[1].inertia,
        MIRROR @ right.inertias[1].inertia @ MIRROR,
        atol=1e-15,
    )


@pytest.mark.parametrize("text", [HUMAN, MIXED], ids=["human", "mixed"])
def test_twice_mirrored_is_the_original(text: str) -> None:
    once, twice = mirrored_urdf(text), mirrored_urdf(mirrored_urdf(text))
    assert mirrored_urdf(twice) == once
    angles = np.linspace(-0.7, 0.9, pin.buildModelFromXML(text).njoints - 1)
    first, last = pin.buildModelFromXML(text), pin.buildModelFromXML(twice)
    np.testing.assert_array_equal(
        poses(last, full_q(last, angles)), poses(first, full_q(first, angles))
    )


def test_limits_names_and_shapes_stay() -> None:
    before, after = ET.fromstring(HUMAN), ET.fromstring(mirrored_urdf(HUMAN))
    for path in (
        ".//limit",
        ".//geometry/*",
        ".//link",
        ".//parent",
        ".//child",
        ".//capsule",
    ):
        assert [e.attrib for e in before.iterfind(path)] == [
            e.attrib for e in after.iterfind(path)
        ], path


def test_input_with_an_encoding_declaration() -> None:
    declared = '<?xml version="1.0" encoding="utf-8"?>' + MIXED.strip()
    assert mirrored_urdf(declared) == mirrored_urdf(MIXED.strip())


def test_output_has_no_minus_zero() -> None:
    assert "-0.0 " not in mirrored_urdf(HUMAN)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("<robot>", "not valid XML"),
        ("<mujoco/>", "root <robot>"),
        (
            '<robot><link name="a"><visual><geometry><mesh filename="a.stl"/></geometry></visual>'
            "</link></robot>",
            "<mesh>",
        ),
        ('<robot><joint name="j" type="planar"/></robot>', "j: a planar joint"),
        ('<robot><joint name="j"/></robot>', "nameless joint"),
        (
            '<robot><link name="a"><visual><origin xyz="0 0"/></visual></link></robot>',
            "expected 3 number",
        ),
        (
            '<robot><link name="a"><visual><origin xyz="0 0 a"/></visual></link></robot>',
            "expected 3 number",
        ),
    ],
)
def test_a_hand_that_cannot_be_mirrored_is_rejected(text: str, message: str) -> None:
    with pytest.raises(HandError, match=message):
        mirrored_urdf(text)
