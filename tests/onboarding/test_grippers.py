"""Four-bar grippers: closed loops of MJCF as mimic rules, and two fingers in place of four bars."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import mujoco
import numpy as np
import pytest
from box_hands import turns

from handmap_core.ik.tasks import PointDistances
from handmap_core.se3 import Array
from handmap_qp import HandMapper
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.errors import HandError
from handmap_qp.hands import held_joints, load_hand, parse_urdf
from handmap_qp.hands.mjcf import ConvertedMjcf
from handmap_qp.human import standard_postures

RADIANS = '<compiler angle="radian"/>'
# A joint within the coupler gives each loop a second degree of freedom.
ELBOW = '<joint axis="0 1 0" pos="0 0 .01" range="-.1 .9"/>'


def _gripper(unit: str = RADIANS, elbow: str = "") -> str:
    """Return a gripper of two parallelograms, each closed by a constraint."""

    def finger(side: str, sign: int) -> str:
        return f"""
        <body name="{side}_driver" pos="{0.03 * sign} 0 0">
          <joint name="{side}_driver" axis="0 {-sign} 0" range="0 .8"/>
          <geom type="capsule" size=".004" fromto="0 0 0 0 0 .05"/>
        </body>
        <body name="{side}_link" pos="{0.01 * sign} 0 0">
          <joint name="{side}_link" axis="0 {-sign} 0" range="0 .8"/>
          <geom type="capsule" size=".004" fromto="0 0 0 0 0 .05"/>
          <body name="{side}_pad" pos="0 0 .05">
            <joint name="{side}_pad" axis="0 {sign} 0" range="-.1 .9"/>{elbow}
            <geom type="box" size=".003 .01 .02" pos="{0.01 * sign} 0 .02"/>
          </body>
        </body>"""

    loops = "".join(
        f'<connect body1="{side}_driver" body2="{side}_pad" anchor="0 0 .05"/>'
        for side in ("left", "right")
    )
    return f"""<mujoco model="gripper">{unit}
      <worldbody><body name="base"><geom type="cylinder" size=".035 .03" pos="0 0 -.03"/>
      {finger("left", 1)}{finger("right", -1)}</body></worldbody>
      <equality>{loops}<joint joint1="right_driver" joint2="left_driver"/></equality>
      <actuator><position joint="left_driver"/></actuator></mujoco>"""


def _converted(folder: Path, text: str) -> ConvertedMjcf:
    file = folder / "gripper.xml"
    file.write_text(text, encoding="utf-8")
    return ConvertedMjcf(file)


@pytest.mark.parametrize("unit", [RADIANS, ""])
def test_mimic_rules_close_the_loops_of_a_gripper(tmp_path: Path, unit: str) -> None:
    """Without a unit, a range of 0.8 degrees makes no sense."""
    converted = _converted(tmp_path, _gripper(unit))
    assert ("taken as radians" in " ".join(converted.notes)) == (unit == "")
    rules = {
        joint.get("name"): joint.find("mimic")
        for joint in ET.fromstring(converted.text).iterfind("joint")
    }
    model = converted.model
    data = mujoco.MjData(model)
    for position in np.linspace(0.0, 0.8, 5):
        for joint, name in converted.joints.items():
            slope, offset = 1.0, 0.0
            if (rule := rules[name]) is not None:
                assert rule.get("joint") == "left_driver"
                slope, offset = (
                    float(rule.get(key, "nan")) for key in ("multiplier", "offset")
                )
            data.qpos[model.jnt_qposadr[joint]] = slope * position + offset
        mujoco.mj_forward(model, data)
        closing = data.efc_type == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        assert closing.any()
        assert np.abs(data.efc_pos[closing]).max() < 1e-6


def test_a_gripper_of_four_bars_has_two_fingers(tmp_path: Path) -> None:
    found = detect(tmp_path / "gripper.urdf", _converted(tmp_path, _gripper()).text)
    assert found.spec.joints == ("left_driver",)
    assert {point.link for point in found.spec.points if "tip" in point.name} == {
        "left_pad",
        "right_pad",
    }
    np.testing.assert_allclose(found.spec.palm.distal, [0.0, 0.0, 1.0], atol=1e-9)
    # The back is away from the thumb, which is the left finger or the right one.
    thumb = next(point for point in found.spec.points if point.finger == "thumb")
    outwards = 1.0 if thumb.link == "left_pad" else -1.0
    np.testing.assert_allclose(found.spec.palm.dorsal, [-outwards, 0.0, 0.0], atol=1e-9)
    # Nothing tells which finger is the thumb.
    sure = {clue.what: clue.confidence for clue in found.clues}
    assert max(sure["thumb"], sure["fingers"]) < 0.6


@pytest.mark.parametrize("is_coupled", [True, False])
def test_jaws_that_turn_open_as_wide_as_thumb_and_index(
    tmp_path: Path, is_coupled: bool
) -> None:
    mimic = '<mimic joint="one" multiplier="-1"/>' * is_coupled
    jaws = "".join(
        f'<link name="{name}"><visual><origin xyz="0 .04 0"/><geometry>'
        f'<box size=".01 .08 .02"/></geometry></visual></link>'
        f'<joint name="{name}" type="revolute"><parent link="base"/><child link="{name}"/>'
        f'<origin xyz="{x} .05 0"/><axis xyz="0 0 1"/>'
        f'<limit lower="{low}" upper="{low + 0.8}" effort="1" velocity="4"/>{rule}</joint>'
        for name, x, low, rule in (
            ("one", 0.02, -0.6, ""),
            ("other", -0.02, -0.2, mimic),
        )
    )
    file = tmp_path / "gripper.urdf"
    file.write_text(f'<robot name="x"><link name="base"/>{jaws}</robot>')
    write_hand(detect(file), tmp_path / "hand.yaml")
    hand = load_hand(tmp_path / "hand.yaml")
    assert len(hand.joint_names) == 2 - is_coupled
    mapper = HandMapper(load_hand("human"), hand, dt=0.02)
    gaps, opened = [], []
    for name in ("flat hand", "pinch"):
        posture = standard_postures(mapper.human)[name]
        for _ in range(100):
            step = mapper.map_step(posture, np.eye(4))
        gaps.append(step.named("gaps")[0])
        opened.append(np.linalg.norm(np.subtract(*hand.points(step.command.q))))
    assert opened[0] - opened[1] == pytest.approx(gaps[0] - gaps[1], abs=0.01)


@pytest.mark.parametrize("has_ends", [True, False])
def test_jaws_have_no_exact_direction(has_ends: bool) -> None:
    """Their joints may start anywhere: these beside each other, and the tips in one plane.

    Jaws without a length lie ahead of the palm.
    """
    jaws = "".join(
        f'<link name="{name}"/><link name="{name}_end"/><joint name="{name}" type="prismatic">'
        f'<parent link="base"/><child link="{name}"/><origin xyz="{x} .06 {z}"/>'
        f'<axis xyz="{-x} 0 0"/><limit lower="0" upper=".02" effort="1" velocity="1"/></joint>'
        f'<joint name="{name}_end" type="fixed"><parent link="{name}"/>'
        f'<child link="{name}_end"/><origin xyz="{-x / 2} .04 {0.014 - z}"/></joint>'
        for name, x, z in (("one", 0.04, 0.015), ("other", -0.04, -0.015))
    )
    if not has_ends:
        end = r'<link name="\w+_end"/>|<joint name="\w+_end".*?</joint>'
        jaws = re.sub(end, "", jaws)
    found = detect(Path("x"), f'<robot name="x"><link name="base"/>{jaws}</robot>')
    assert len(found.chains) == 2
    assert found.spec.palm.distal[1] > (0.9 if has_ends else 0.99)
    assert "certain" not in {
        clue.certainty for clue in found.clues if clue.what in ("distal", "dorsal")
    }


def test_jaws_without_a_length_close(tmp_path: Path) -> None:
    """Their tips are where their knuckles are, so that their reach is 0."""
    jaws = "".join(
        f'<link name="{name}"/><joint name="{name}" type="prismatic"><parent link="base"/>'
        f'<child link="{name}"/><origin xyz="{x} .06 0"/><axis xyz="{-x} 0 0"/>'
        '<limit lower="0" upper=".04" effort="1" velocity="1"/></joint>'
        for name, x in (("one", 0.04), ("other", -0.04))
    )
    file = tmp_path / "gripper.urdf"
    file.write_text(f'<robot name="x"><link name="base"/>{jaws}</robot>')
    write_hand(detect(file), tmp_path / "hand.yaml")
    mapper = HandMapper(
        load_hand("human"), load_hand(tmp_path / "hand.yaml"), dt=1 / 30
    )
    postures = standard_postures(mapper.human)
    wide, shut = (
        [mapper.map_step(postures[name], np.eye(4)) for _ in range(60)][-1]
        for name in ("flat hand", "pinch")
    )
    (task,) = shut.asked.tasks
    assert isinstance(task, PointDistances)
    np.testing.assert_allclose(task.distances[:2], 0.0)
    assert (shut.command.q > wide.command.q + 0.01).all()


def test_what_no_motor_moves_is_held(tmp_path: Path) -> None:
    """With its elbows held, the gripper is the one without them."""
    converted = _converted(tmp_path, _gripper(elbow=ELBOW))
    reasons = held_joints(parse_urdf(converted.text))
    for elbow in ("joint3", "joint7"):
        assert reasons[elbow].text == "no motor moves it"
    with_elbows = detect(tmp_path / "gripper.urdf", converted.text).spec
    text = _converted(tmp_path, _gripper()).text
    plain = detect(tmp_path / "gripper.urdf", text).spec
    assert with_elbows.joints == plain.joints
    assert with_elbows.locked == {"joint3": 0.0, "joint7": 0.0}


def _one_jaw(jaw: str, *, has_shapes: bool) -> str:
    """Return an arm whose last joint opens a jaw beside a fixed one, whose meshes may be lost."""
    arm = ("lift", "elbow", "wrist", jaw)
    links = "".join(f'<link name="{joint}_link"/>' for joint in arm[:-2])
    joints = "".join(
        f'<joint name="{joint}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{joint}_link"/><origin xyz="{place}"/><axis xyz="0 0 1"/>'
        f'<limit lower="{lower}" upper="1.6" effort="1" velocity="3"/></joint>'
        for joint, parent, place, lower in (
            ("lift", "base", "0 0 0", -1.6),
            ("elbow", "lift_link", ".2 0 0", -1.6),
            ("wrist", "elbow_link", ".2 0 0", -1.6),
            (jaw, "wrist_link", ".03 .02 0", 0.0),
        )
    )
    ends = "".join(
        f'<link name="{joint}_link"><visual><origin xyz="{place}"/><geometry>'
        + (f'<box size="{size}"/>' if has_shapes else '<mesh filename="lost.stl"/>')
        + "</geometry></visual></link>"
        for joint, place, size in (
            ("wrist", ".06 -.01 0", ".12 .02 .02"),
            (jaw, ".045 -.015 0", ".09 .01 .02"),
        )
    )
    return f'<robot name="arm"><link name="base"/>{links}{ends}{joints}</robot>'


@pytest.mark.parametrize(
    ("jaw", "has_shapes"),
    [("j4", True), ("arm_f1x", True), ("gripper", True), ("gripper", False)],
)
def test_one_jaw_and_the_fixed_one_are_thumb_and_index(
    tmp_path: Path, jaw: str, has_shapes: bool
) -> None:
    file = tmp_path / "arm.urdf"
    file.write_text(_one_jaw(jaw, has_shapes=has_shapes), encoding="utf-8")
    found = detect(file)
    assert found.spec.joints == (jaw,)
    assert {point.name: point.link for point in found.spec.points} == {
        "thumb_tip": f"{jaw}_link",
        "index_tip": "wrist_link",
    }
    sure = {clue.what: clue.certainty for clue in found.clues}
    assert "certain" not in {sure["thumb"], sure["side"], sure["index_tip"]}
    write_hand(found, tmp_path / "hand.yaml")
    hand = load_hand(tmp_path / "hand.yaml")
    opened, closed = (
        float(np.linalg.norm(np.subtract(*hand.points(np.array([q])))))
        for q in (1.6, 0.0)
    )
    assert closed < (0.01 if has_shapes else 1e-3)
    assert opened > 0.04
    human = load_hand("human")
    mapper = HandMapper(human, hand, dt=0.02)
    postures = standard_postures(mapper.human)
    gaps = []
    for posture in ("flat hand", "pinch"):
        for _ in range(60):
            step = mapper.map_step(postures[posture], np.eye(4))
        gaps.append(np.linalg.norm(np.subtract(*hand.points(step.command.q))))
    # Without shapes, pads are balls at the tips.
    assert gaps[1] < (0.6 if has_shapes else 0.9) * gaps[0]


def _one_hinge(turn: Array, *, size: tuple[float, float, float]) -> str:
    """Return an arm with a jaw hinged beside a fixed one, which lies along the arm's last link.

    The hinge is 4 cm beside that link, and off its plane: the line to its end is oblique.

    Args:
        turn: Rotation of the arm, whose last link points along x, shape (3, 3).
        size: That of its last link [m].
    """

    def text(*xyz: float) -> str:
        return " ".join(map(str, turn @ xyz))

    def box(place: tuple[float, float, float], size: tuple[float, float, float]) -> str:
        sizes = " ".join(map(str, np.abs(turn) @ size))
        return (
            f'<visual><origin xyz="{text(*place)}"/>'
            f'<geometry><box size="{sizes}"/></geometry></visual>'
        )

    return f"""<robot name="arm"><link name="base"/><link name="arm"/>
      <joint name="lift" type="revolute"><parent link="base"/><child link="arm"/>
        <axis xyz="{text(0.0, 1.0, 0.0)}"/>
        <limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
      <link name="wrist">{box((0.06, -0.01, 0.0), size)}</link>
      <link name="gripper">{box((0.04, -0.03, -0.01), (0.09, 0.01, 0.02))}</link>
      <joint name="roll" type="revolute"><parent link="arm"/><child link="wrist"/>
        <origin xyz="{text(0.4, 0.0, 0.0)}"/><axis xyz="{text(1.0, 0.0, 0.0)}"/>
        <limit lower="-2" upper="2" effort="1" velocity="3"/></joint>
      <joint name="gripper" type="revolute"><parent link="wrist"/><child link="gripper"/>
        <origin xyz="{text(0.03, 0.03, 0.01)}"/><axis xyz="{text(0.0, 0.0, 1.0)}"/>
        <limit lower="0" upper="1.4" effort="1" velocity="3"/></joint></robot>"""


def test_a_fixed_jaw_points_along_its_own_surface_and_not_from_the_hinge() -> None:
    for turn in turns():
        found = detect(Path("x"), _one_hinge(turn, size=(0.12, 0.02, 0.02)))
        palm = found.spec.palm
        np.testing.assert_allclose(palm.distal, turn[:, 0], atol=1e-6)
        # Either jaw may be the thumb, which is on the palm's side. The moving one opens to +y.
        is_moving = "gripper" in found.chains["thumb"]
        sense = -1.0 if is_moving else 1.0
        np.testing.assert_allclose(palm.dorsal, sense * turn[:, 1], atol=1e-6)


def test_a_block_has_no_long_side_that_tells_its_direction() -> None:
    palm = detect(Path("x"), _one_hinge(np.eye(3), size=(0.12, 0.12, 0.02))).spec.palm
    assert 5.0 < np.degrees(np.arccos(palm.distal[0])) < 60.0


def test_a_wrist_is_no_jaw(tmp_path: Path) -> None:
    """Its end turns about its own axis, or nothing says that it closes on anything."""
    file = tmp_path / "arm.urdf"
    file.write_text(_one_jaw("j4", has_shapes=False), encoding="utf-8")
    with pytest.raises(HandError, match=r"one chain of .* or name the palm"):
        detect(file)


@pytest.mark.parametrize("name", ["wrist_roll", "NeckPitch", "right_ankle"])
def test_a_stump_or_a_head_is_no_jaw(tmp_path: Path, name: str) -> None:
    """A last body that comes to the surface of the one before is none if its joint says so."""
    file = tmp_path / "arm.urdf"
    file.write_text(_one_jaw(name, has_shapes=True), encoding="utf-8")
    with pytest.raises(HandError, match=r"one chain of .* or name the palm"):
        detect(file)
