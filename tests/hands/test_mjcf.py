"""MJCF as URDF: kinematics, limits, couplings, shapes and inertias against MuJoCo's own."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from copy import copy
from pathlib import Path

import mujoco
import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yourdfpy
from hypothesis import given, settings
from hypothesis import strategies as st

from handmap_qp import HandError, load_hand
from handmap_qp.hands.mjcf import (
    ConvertedMjcf,
    cached_urdf,
    kinematics_difference,
    write_converted,
)
from handmap_qp.hands.sources import is_mjcf, root_tag

HAND = """
<mujoco model="claw">
  <compiler angle="radian" eulerseq="xyz"/>
  <asset>
    <mesh name="wedge" vertex="0 0 0  .02 0 0  0 .03 0  0 0 .04  .02 .03 .01"/>
  </asset>
  <worldbody>
    <geom type="plane" size="1 1 .1"/>
    <body name="table" pos="0 0 -1"><geom type="box" size=".5 .5 .1"/></body>
    <body name="ball" pos="0 0 .5"><freejoint/><geom size=".03"/></body>
    <body name="palm" pos=".1 -.2 .3" euler=".3 .2 -.4">
      <freejoint name="float"/>
      <geom type="box" size=".04 .05 .01" mass=".2"/>
      <body name="knuckle" pos="0 .05 0" quat=".8 .1 .5 -.2">
        <joint name="spread" axis=".1 .2 1" pos=".003 -.002 .001" range="-.4 .4" ref=".1"/>
        <joint name="flex" axis="1 .1 0" pos="-.004 0 .002" range="-.2 1.6" damping=".3"/>
        <joint name="push" type="slide" axis="0 1 .2" range="0 .02" ref=".01"/>
        <geom type="mesh" mesh="wedge" pos=".01 .02 .03" euler=".4 .1 .2" density="900"/>
        <body name="phalanx" pos="0 .04 0" euler="0 .1 0">
          <joint name="curl" axis="1 0 0" range="0 1.8" ref="-.2"/>
          <geom type="capsule" size=".007" fromto="0 0 0 .01 .03 .002"/>
          <geom type="ellipsoid" size=".006 .012 .005" pos="0 .03 0" contype="0" conaffinity="0"/>
          <body name="tip" pos="0 .03 .001" euler="1.5707963267948966 0 0"/>
        </body>
      </body>
      <body name="stub" pos=".03 .05 0" euler="0 1.5707963267948966 0">
        <joint name="socket" type="ball" pos="0 .002 0" range="0 .7"/>
        <geom type="cylinder" size=".006 .02"/>
        <body pos="0 .04 0">
          <joint name="end" axis="1 0 0"/>
          <geom type="sphere" size=".006"/>
        </body>
      </body>
    </body>
  </worldbody>
  <tendon>
    <fixed name="cord"><joint joint="flex" coef="2"/><joint joint="push" coef="-1"/></fixed>
  </tendon>
  <equality>
    <joint joint1="curl" joint2="flex" polycoef=".05 .8 0 0 0"/>
    <weld body1="tip" body2="stub"/>
  </equality>
  <actuator><position joint="curl" forcerange="-3 3" forcelimited="true"/></actuator>
</mujoco>
"""


@pytest.fixture(scope="module")
def claw(tmp_path_factory: pytest.TempPathFactory) -> tuple[ConvertedMjcf, Path]:
    folder = tmp_path_factory.mktemp("claw")
    (folder / "claw.xml").write_text(HAND)
    converted = ConvertedMjcf(folder / "claw.xml")
    write_converted(converted, folder / "out" / "claw.urdf")
    return converted, folder / "out" / "claw.urdf"


def joint(converted: ConvertedMjcf, name: str) -> ET.Element:
    element = ET.fromstring(converted.text).find(f"joint[@name='{name}']")
    assert element is not None, name
    return element


def test_every_kind_of_joint_moves_its_links_as_in_mujoco(
    claw: tuple[ConvertedMjcf, Path],
) -> None:
    assert kinematics_difference(claw[0]) < 1e-12


def test_a_ball_joint_turns_as_three_hinges(claw: tuple[ConvertedMjcf, Path]) -> None:
    model, angles = claw[0].model, np.array([0.3, -0.5, 0.4])
    rotation = np.eye(3)
    for angle, axis in zip(angles, np.eye(3), strict=True):
        rotation = rotation @ pin.exp3(angle * axis)
    data, address = mujoco.MjData(model), model.joint("socket").qposadr[0]
    mujoco.mju_mat2Quat(data.qpos[address : address + 4], rotation.ravel())
    mujoco.mj_kinematics(model, data)
    text = claw[0].text
    robot = pin.buildModelFromXML(text)
    robot_data, q = robot.createData(), pin.neutral(robot)
    for letter, angle in zip("xyz", angles, strict=True):
        q[robot.joints[robot.getJointId(f"socket_{letter}")].idx_q] = angle
    pin.framesForwardKinematics(robot, robot_data, q)
    stub = robot_data.oMf[robot.getFrameId("stub", pin.FrameType.BODY)]
    np.testing.assert_allclose(
        stub.rotation, data.body("stub").xmat.reshape(3, 3), atol=1e-12
    )
    np.testing.assert_allclose(stub.translation, data.body("stub").xpos, atol=1e-12)


def test_the_comparison_notices_a_turned_axis(claw: tuple[ConvertedMjcf, Path]) -> None:
    converted = claw[0]
    axis = joint(converted, "curl").find("axis")
    assert axis is not None
    turned = converted.text.replace(
        '<axis xyz="1.0 0.0 0.0"', '<axis xyz="1.0 0.001 0.0"'
    )
    assert turned != converted.text
    other = copy(converted)
    other.text = turned
    assert kinematics_difference(other) > 1e-5


@settings(max_examples=15)
@given(
    st.tuples(*[st.floats(-2.0, 2.0)] * 3),
    st.floats(-1.5, 1.5),
    st.tuples(*[st.floats(-0.1, 0.1)] * 3),
    st.sampled_from(["hinge", "slide"]),
)
def test_reference_anchor_and_axis_may_be_anything(
    axis: tuple[float, ...], reference: float, anchor: tuple[float, ...], kind: str
) -> None:
    if np.linalg.norm(axis) < 0.1:
        axis = (0.3, 0.0, 1.0)
    numbers = [" ".join(map(str, values)) for values in (axis, anchor)]
    text = f"""<mujoco><worldbody><body name="a" euler="90 0 30"><geom size=".1"/>
      <body name="b" pos="0 .1 0" euler="0 90 20"><geom size=".1"/>
      <joint name="j" type="{kind}" axis="{numbers[0]}" pos="{numbers[1]}" ref="{reference}"/>
      <joint name="k" axis="0 1 0" pos=".1 0 0"/></body></body></worldbody></mujoco>"""
    converted = _converted(text)
    assert kinematics_difference(converted, postures=4) < 1e-9


def _converted(text: str) -> ConvertedMjcf:
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "model.xml"
        file.write_text(text)
        return ConvertedMjcf(file)


def test_limits_efforts_and_damping_are_those_of_the_file(
    claw: tuple[ConvertedMjcf, Path],
) -> None:
    limits = {
        name: joint(claw[0], name).find("limit")
        for name in ("spread", "push", "curl", "socket_y")
    }
    read = {
        name: (float(limit.get("lower", "nan")), float(limit.get("upper", "nan")))
        for name, limit in limits.items()
        if limit is not None
    }
    assert read == {
        "spread": (-0.4, 0.4),
        "push": (0.0, 0.02),
        "curl": (0.0, 1.8),
        "socket_y": (-0.7, 0.7),
    }
    assert limits["curl"] is not None
    assert float(limits["curl"].get("effort", "nan")) == 3.0
    dynamics = joint(claw[0], "flex").find("dynamics")
    assert dynamics is not None
    assert float(dynamics.get("damping", "nan")) == 0.3


def test_a_joint_equality_is_a_mimic_rule_about_the_reference(
    claw: tuple[ConvertedMjcf, Path],
) -> None:
    """MuJoCo's polynomial counts from qpos0: curl + 0.2 = 0.05 + 0.8 flex."""
    mimic = joint(claw[0], "curl").find("mimic")
    assert mimic is not None
    assert mimic.get("joint") == "flex"
    assert float(mimic.get("multiplier", "nan")) == pytest.approx(0.8, abs=1e-15)
    assert float(mimic.get("offset", "nan")) == pytest.approx(-0.15, abs=1e-15)


def test_the_rule_satisfies_mujocos_own_constraint(
    claw: tuple[ConvertedMjcf, Path],
) -> None:
    model = claw[0].model
    data = mujoco.MjData(model)
    for flex in (-0.1, 0.5, 1.4):
        data.qpos[model.joint("flex").qposadr[0]] = flex
        data.qpos[model.joint("curl").qposadr[0]] = 0.8 * flex - 0.15
        mujoco.mj_forward(model, data)
        # The first row: those of the weld follow.
        assert data.efc_type[0] == int(mujoco.mjtConstraint.mjCNSTR_EQUALITY)
        assert data.efc_id[0] == 0
        assert abs(data.efc_pos[0]) < 1e-14


def test_what_does_not_fit_is_said(claw: tuple[ConvertedMjcf, Path]) -> None:
    notes = "\n".join(claw[0].notes)
    for word in ("table, ball", "cord = 2 flex + -1 push", "socket_x", "weld"):
        assert word in notes, notes


@pytest.mark.parametrize(
    ("equality", "follows"),
    [
        ('<tendon tendon1="t" polycoef=".1 0 0 0 0"/>', (-2.0, 0.1)),
        ('<tendon tendon1="t" active="false"/>', None),
    ],
)
def test_a_tendon_of_fixed_length_couples_its_joints(
    equality: str, follows: tuple[float, float] | None
) -> None:
    converted = _converted(f"""<mujoco><worldbody><body name="a"><geom size=".1"/>
      <body><joint name="x" axis="1 0 0"/><geom size=".1"/>
      <body><joint name="y" axis="1 0 0"/><geom size=".1"/></body></body></body></worldbody>
      <tendon><fixed name="t"><joint joint="x" coef="2"/><joint joint="y" coef="1"/></fixed>
      </tendon>
      <equality>{equality}</equality></mujoco>""")
    mimic = joint(converted, "y").find("mimic")
    if follows is None:
        assert mimic is None
        assert "2 x + 1 y" in converted.notes[-1]
        return
    assert mimic is not None
    found = (float(mimic.get("multiplier", "nan")), float(mimic.get("offset", "nan")))
    assert found == pytest.approx(follows, abs=1e-12)


def test_masses_and_inertias_are_mujocos(claw: tuple[ConvertedMjcf, Path]) -> None:
    """The joint-space inertia matrix of the open chain agrees."""
    converted = claw[0]
    root = ET.fromstring(converted.text)
    for element in root.iterfind("joint"):
        for mimic in element.findall("mimic"):
            element.remove(mimic)
        for limit in element.findall("limit"):
            for key in ("lower", "upper", "velocity"):
                limit.set(key, limit.get(key, "0"))
    robot = pin.buildModelFromXML(ET.tostring(root, encoding="unicode"))
    names = ["spread", "flex", "push", "curl"]
    q = pin.neutral(robot)
    values = dict(zip(names, (0.2, 0.7, 0.012, 0.9), strict=True))
    model, data = converted.model, mujoco.MjData(converted.model)
    for name, value in values.items():
        q[robot.joints[robot.getJointId(name)].idx_q] = value
        data.qpos[model.joint(name).qposadr[0]] = value
    mujoco.mj_forward(model, data)
    full = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, full)
    at = [model.joint(name).dofadr[0] for name in names]
    ours = pin.crba(robot, robot.createData(), q)
    ours = np.triu(ours) + np.triu(ours, 1).T
    mine = [robot.joints[robot.getJointId(name)].idx_v for name in names]
    np.testing.assert_allclose(
        ours[np.ix_(mine, mine)], full[np.ix_(at, at)], atol=1e-9
    )


def test_meshes_lie_where_mujoco_has_them(claw: tuple[ConvertedMjcf, Path]) -> None:
    """MuJoCo moves a mesh into its principal axes; the file and the origin undo it together."""
    file = claw[1]
    robot = yourdfpy.URDF.load(str(file), build_scene_graph=False).robot
    link = next(link for link in robot.links if link.name == "knuckle")
    shape = link.visuals[0]
    import trimesh

    assert shape.geometry is not None
    assert shape.geometry.mesh is not None
    assert shape.origin is not None
    mesh = trimesh.load_mesh(file.parent / shape.geometry.mesh.filename)
    corners = (
        np.array([[0, 0, 0], [20, 0, 0], [0, 30, 0], [0, 0, 40], [20, 30, 10]]) / 1e3
    )
    turn = pin.rpy.rpyToMatrix(np.zeros(3))
    for angle, axis in zip((0.4, 0.1, 0.2), np.eye(3), strict=True):
        turn = turn @ pin.AngleAxis(angle, axis).toRotationMatrix()
    wanted = corners @ turn.T + np.array([0.01, 0.02, 0.03])
    found = np.asarray(mesh.vertices) @ shape.origin[:3, :3].T + shape.origin[:3, 3]
    for corner in wanted:
        assert np.linalg.norm(found - corner, axis=1).min() < 1e-7


def test_primitives_have_whole_lengths_where_mujoco_has_half(
    claw: tuple[ConvertedMjcf, Path],
) -> None:
    robot = ET.fromstring(claw[0].text)
    box = robot.find(".//collision/geometry/box")
    lengths = {
        float(shape.get("length", "nan"))
        for shape in robot.iterfind(".//collision/geometry/cylinder")
    }
    assert box is not None
    sizes = [float(size) for size in box.get("size", "").split()]
    np.testing.assert_allclose(sizes, [0.08, 0.1, 0.02])
    assert 0.04 in lengths


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("<mujoco><worldbody/></mujoco>", "no joint moves"),
        ("<mujocoinclude/>", "include"),
        ("<mujoco><worldbody><joint/></worldbody></mujoco>", "MuJoCo cannot compile"),
        ("<mujoco><asset><mesh file='gone.stl'/></asset></mujoco>", "no joint moves"),
    ],
)
def test_a_model_without_a_hand_is_one_line(
    tmp_path: Path, text: str, word: str
) -> None:
    file = tmp_path / "model.xml"
    file.write_text(text)
    with pytest.raises(HandError) as caught:
        ConvertedMjcf(file)
    assert word in str(caught.value)
    assert "\n" not in str(caught.value)
    assert str(file) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "dropped"),
    [
        ("<mujoco><option apirate=\"200\" a='1'/>{}</mujoco>", {"apirate", "a"}),
        ("<mujoco>{}<body a=/></mujoco>", None),
    ],
)
def test_attributes_of_older_versions_are_left_out(
    tmp_path: Path, text: str, dropped: set[str] | None
) -> None:
    body = '<body><joint name="j" axis="0 1 0" range="0 90"/><geom size=".01"/></body>'
    file = tmp_path / "old.xml"
    file.write_text(text.format(f"<worldbody>{body}</worldbody>"))
    if dropped is None:
        with pytest.raises(HandError, match="MuJoCo cannot compile the MJCF: XML"):
            ConvertedMjcf(file)
    else:
        converted = ConvertedMjcf(file)
        assert set(converted.joints.values()) == {"j"}
        words = [note.split()[0] for note in converted.notes if "unknown" in note]
        assert set(words) == dropped


def test_an_unknown_attribute_is_left_out_of_the_element_that_mujoco_names(
    tmp_path: Path,
) -> None:
    """A tendon's `joint` has no range, those of bodies have: they keep it, on any line."""
    file = tmp_path / "hand.xml"
    body = (
        '<body><joint name="{}" axis="0 1 0" range="-.2 .9"/><geom size=".01"/></body>'
    )
    bodies = "\n".join(map(body.format, "xy"))
    cord = '<joint joint="x" coef="2" range="0 1"/><joint joint="y"\n range = \'0 1\' coef="1"/>'
    file.write_text(f"""<?xml version="1.0"?>
      <mujoco><compiler angle="radian"/><!-- <joint range="0 1"/> --><worldbody>{bodies}</worldbody>
      <tendon><fixed name="cord">{cord}</fixed></tendon></mujoco>""")
    converted = ConvertedMjcf(file)
    np.testing.assert_array_equal(converted.model.jnt_range, [[-0.2, 0.9]] * 2)
    unknown = [note for note in converted.notes if "unknown" in note]
    assert unknown == ["range of joint is unknown to MuJoCo: it is left out"]
    assert any("cord = 2 x + 1 y" in note for note in converted.notes)


def test_an_unknown_attribute_of_an_attached_file_is_refused_in_its_words(
    tmp_path: Path,
) -> None:
    """Its line is one of the other file, which is not read again."""
    part = tmp_path / "part.xml"
    part.write_text(
        '<mujoco><worldbody><body name="s"><geom size=".01" foo="3"/></body></worldbody></mujoco>'
    )
    file = tmp_path / "hand.xml"
    file.write_text(
        f'''<mujoco><asset><model name="x" file="{part}"/></asset><worldbody>
        <body name="b"><attach model="x" body="s" prefix="p"/></body></worldbody></mujoco>'''
    )
    with pytest.raises(HandError, match="unrecognized attribute: 'foo'"):
        ConvertedMjcf(file)


def test_the_root_tells_what_a_file_is(tmp_path: Path) -> None:
    assert (
        root_tag(b"<?xml version='1.0'?>\n<!-- <robot> --><mujoco model='a'>")
        == "mujoco"
    )
    assert root_tag('<?xml version="1.0"?><robot/>'.encode("utf-16")) == "robot"
    assert root_tag(b"solid cube") == ""
    assert not is_mjcf(tmp_path / "gone.xml")


def test_a_description_may_name_an_mjcf_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    model = tmp_path / "claw.xml"
    model.write_text(HAND)
    (tmp_path / "my.yaml").write_text("""
name: claw
urdf: claw.xml
root: palm
side: right
palm: {link: palm, distal: [0, 1, 0], dorsal: [0, 0, 1]}
wrist: {link: palm}
joints: [spread, flex, push]
rest: {spread: 0, flex: .3, push: .01}
locked: {socket_x: 0, socket_y: 0, socket_z: 0, end: 0}
limits: {spread: {velocity: 5}, flex: {velocity: 5}, push: {velocity: 1}}
points: [{name: tip, link: tip}]
sets: {tips: [tip]}
reference: tips
""")
    hand = load_hand(tmp_path / "my.yaml")
    assert hand.joint_names == ("spread", "flex", "push")
    first = cached_urdf(model)
    assert cached_urdf(model) == first
    model.write_text(HAND.replace('model="claw"', 'model="other_claw"'))
    assert cached_urdf(model) != first


@pytest.mark.parametrize("place", ["assets", "elsewhere/meshes", None])
def test_meshes_are_found_by_their_names_or_have_balls_in_their_place(
    tmp_path: Path, place: str | None
) -> None:
    file = tmp_path / "hand.xml"
    file.write_text("""
      <mujoco><compiler meshdir="assets"/>
        <asset>
          <texture name="skin" type="2d" file="skin.png"/><material name="skin" texture="skin"/>
          <mesh name="part" file="part.stl"/>
        </asset>
        <worldbody><body name="palm"><geom type="mesh" mesh="part" material="skin"/>
          <body name="tip" pos="0.1 0 0"><joint name="bend" range="0 90"/>
            <geom size="0.01" material="skin"/></body></body></worldbody>
      </mujoco>""")
    if place:
        (tmp_path / place).mkdir(parents=True)
        trimesh.creation.box((0.02, 0.03, 0.04)).export(tmp_path / place / "part.stl")
    # Folders of meshes are looked for beside the file.
    if place == "elsewhere/meshes":
        (tmp_path / "elsewhere/meshes").rename(tmp_path / "meshes")
    converted = ConvertedMjcf(file)
    robot = ET.fromstring(converted.text)
    palm = next(link for link in robot.iter("link") if link.get("name") == "palm")
    assert (palm.find("collision/geometry/mesh") is None) == (place is None)
    notes = [note for note in converted.notes if "missing meshes: part" in note]
    assert len(notes) == (place is None)
