"""A refusal of `handmap hands init` names its cause and a next step, and that step works."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import trimesh
from made_hands import make_hand, two_hands_mjcf

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding.init import init_hands

pytestmark = pytest.mark.slow

POINTER = (
    "version https://git-lfs.github.com/spec/v1\n"
    "oid sha256:4d7a214614ab2935c943f9e0ff69d22eadbb8f32b1258daaa5e2ca24d17e2393\nsize 12345\n"
)
XACRO = '<robot name="hand" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
MACRO = '<xacro:macro name="finger" params="side"><link name="a"/></xacro:macro>'


def _refusal(file: Path, content: str | bytes) -> str:
    """Return the message about a file with some content, without the file's name."""
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(HandError) as caught:
        init_hands(file, out=file.with_name("hand.yaml"))
    assert caught.value.file == file
    assert "\n" not in str(caught.value)
    return str(caught.value).removeprefix(f"{file}: ")


def _gripper(lower: float, upper: float, jaw: str = "") -> str:
    """Return a gripper as an exporter writes it: two fingers on a wrist, with limits."""
    fingers = "".join(
        f'<link name="finger_{side}"><visual>{jaw}<geometry><box size=".01 .01 .16"/></geometry>'
        f'<origin xyz="0 0 .08"/></visual></link><joint name="joint_{side}" type="revolute">'
        f'<parent link="body"/><child link="finger_{side}"/><origin xyz="{x} 0 .04"/>'
        f'<axis xyz="0 {sign} 0"/>'
        f'<limit lower="{lower}" upper="{upper}" effort="0" velocity="0"/></joint>'
        for side, x, sign in (("left", 0.025, 1), ("right", -0.025, -1))
    )
    return f'<robot name="gripper"><link name="body"/>{fingers}</robot>'


def test_joints_without_a_range_are_named(tmp_path: Path) -> None:
    """Exporters write [0, 0] where nobody gave limits; with limits there is a hand."""
    file = tmp_path / "gripper.urdf"
    message = _refusal(file, _gripper(0.0, 0.0))
    assert "the limits of joint_left, joint_right are equal" in message
    assert "give lower < upper in the file" in message
    file.write_text(_gripper(-0.3, 0.6))
    (hand,) = init_hands(file, out=tmp_path / "hand.yaml").hands
    assert hand.hand.joint_names == ("joint_left", "joint_right")


def test_an_arm_whose_fingers_have_no_range_says_so(tmp_path: Path) -> None:
    arm = "".join(
        f'<link name="{parent}"/><joint name="turn_{parent}" type="revolute">'
        f'<parent link="{parent}"/><child link="{child}"/><origin xyz=".3 0 0"/>'
        '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        for parent, child in (("base", "upper"), ("upper", "lower"), ("lower", "body"))
    )
    text = _gripper(0.0, 0.0).replace("</robot>", f"{arm}</robot>")
    message = _refusal(tmp_path / "arm.urdf", text)
    assert "the limits of joint_left, joint_right are equal" in message


@pytest.mark.parametrize("place", ["0 0 0", "0 0 .02"])
def test_a_last_body_all_around_its_joint_has_a_tip(tmp_path: Path, place: str) -> None:
    """A cube around a joint has no far end: its tip is on the side away from the palm."""
    file = tmp_path / "cubes.urdf"
    text = "".join(
        f'<link name="{name}"><visual><geometry><box size=".02 .02 .02"/></geometry></visual>'
        f'</link><joint name="{name}" type="revolute"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{xyz}"/><axis xyz="0 {sign} 0"/>'
        '<limit lower="0" upper="1.5" effort="1" velocity="2"/></joint>'
        for side, x, sign in (("left", 0.03, -1), ("right", -0.03, 1))
        for name, parent, xyz in (
            (f"{side}_0", "palm", f"{x} 0 .02"),
            (f"{side}_1", f"{side}_0", "0 0 .05"),
        )
    )
    text = text.replace("<visual>", f'<visual><origin xyz="{place}"/>')
    file.write_text(f'<robot name="cubes"><link name="palm"/>{text}</robot>')
    (found,) = init_hands(file, out=tmp_path / "hand.yaml").hands
    for point in found.hand.spec.points:
        if point.name.endswith("_tip"):
            assert point.xyz[2] > 0.009
            np.testing.assert_allclose(point.xyz[:2], 0.0, atol=1e-4)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("hand.usd", b"PXR-USDC\0\0\x08", ["USD", "export the robot as URDF"]),
        ("hand.usda", "#usda 1.0\ndef Xform {}", ["USD", "export the robot as URDF"]),
        ("hand.urdf", POINTER, ["git-lfs", "git lfs pull"]),
        ("hand.xml", POINTER, ["git-lfs", "git lfs pull"]),
        ("hand.zip", b"PK\x03\x04\x14\0", ["archive", "unpack it"]),
        ("hand.urdf", "\n<!DOCTYPE html><html></html>", ["web page", "raw file"]),
        ("hand.urdf", "  \n", ["is empty"]),
        ("hand.urdf", "<mujoco/>", ["<mujoco>", "end in .xml"]),
        ("hand.urdf", XACRO.format(MACRO), ["only defines xacro macros, finger,", "that calls"]),
        ("hand.urdf", XACRO.format(f'{MACRO}<xacro:finger side="left"/>'), ["xacro FILE.xacro"]),
        ("hand.urdf", XACRO.format('<xacro:include filename="a"/>'), ["xacro FILE.xacro"]),
        ("hand.urdf", XACRO.format(""), ["no links", "calls the robot's macro"]),
        ("hand.urdf", '<robot><link name="a"/><link/></robot>', ["a link without a name"]),
        ("hand.urdf", '<robot><link name="a"/><link name="b"/></robot>', ["2 roots", "join all"]),
    ],
)  # fmt: skip
def test_a_file_that_is_no_robot_says_what_it_is(
    tmp_path: Path, name: str, content: str | bytes, words: list[str]
) -> None:
    message = _refusal(tmp_path / name, content)
    for word in words:
        assert word in message


def test_the_file_that_xacro_macros_ask_for_has_other_words(tmp_path: Path) -> None:
    """The advice on a file of macros, followed, leads to the advice on a file to convert."""
    message = _refusal(tmp_path / "hand.xacro", XACRO.format(MACRO))
    include, call = re.findall(r"<xacro:.*?/>", message.replace(" .../", "/"))
    message = _refusal(
        tmp_path / "robot.xacro", XACRO.format(f"{MACRO}{include}{call}")
    )
    assert "xacro FILE.xacro > FILE.urdf" in message


@pytest.mark.parametrize("kind", ["urdf", "xml"])
def test_a_mesh_that_is_a_pointer_is_said(tmp_path: Path, kind: str) -> None:
    (tmp_path / "jaw.stl").write_text(POINTER)
    jaw = '<geometry><mesh filename="jaw.stl"/></geometry>'
    text = _gripper(-0.3, 0.6).replace(
        '<geometry><box size=".01 .01 .16"/></geometry>', jaw
    )
    if kind == "xml":
        bodies = "".join(
            f'<body name="{side}" pos="{x} 0 .04">'
            f'<joint name="{side}" axis="0 {sign} 0" range="-20 40"/>'
            '<geom type="mesh" mesh="jaw"/><geom size=".01" pos="0 0 .1"/></body>'
            for side, x, sign in (("left", 0.025, 1), ("right", -0.025, -1))
        )
        text = (
            '<mujoco><asset><mesh name="jaw" file="jaw.stl"/></asset><worldbody>'
            f'<body name="palm">{bodies}</body></worldbody></mujoco>'
        )
    file = tmp_path / f"gripper.{kind}"
    file.write_text(text)
    (pointed,) = init_hands(file, out=tmp_path / "a" / "hand.yaml").hands
    assert any("git lfs pull" in note for note in pointed.notes)
    trimesh.creation.box((0.01, 0.01, 0.16)).export(tmp_path / "jaw.stl")
    (pulled,) = init_hands(file, out=tmp_path / "b" / "hand.yaml").hands
    assert not any("git lfs pull" in note for note in pulled.notes)


def test_each_of_several_hands_can_be_chosen(tmp_path: Path) -> None:
    """Three hands are too many; each link that the message names leads to one."""
    hands = [make_hand(np.random.default_rng(seed)).urdf for seed in (1, 2, 3)]
    parts, roots = [], []
    for i, text in enumerate(hands):
        inside = re.sub(r"</?robot[^>]*>", "", text)
        inside = re.sub(r'(name|link|joint)="', rf'\1="hand{i}_', inside)
        first = re.search(r'<link name="(\w+)"', inside)
        assert first
        roots.append(first[1])
        parts.append(
            f'{inside}<joint name="turn{i}" type="revolute"><parent link="torso"/>'
            f'<child link="{roots[-1]}"/><origin xyz="{i} 0 0"/>'
            '<limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
        )
    text = f'<robot name="three"><link name="torso"/>{"".join(parts)}</robot>'
    file = tmp_path / "three.urdf"
    message = _refusal(file, text)
    assert "3 possible palms" in message
    assert "choose one with --root" in message
    named = re.findall(r"hand\d_\w+", message)
    assert named == roots
    for root in named:
        (hand,) = init_hands(file, out=tmp_path / root / "hand.yaml", root=root).hands
        assert load_hand(hand.file).spec.root == root


def test_two_hands_of_one_side_can_be_chosen(tmp_path: Path) -> None:
    # Neither names nor places tell one behind the other apart.
    text = two_hands_mjcf(1.0).replace("left_", "one_").replace("right_", "two_")
    text = text.replace("0 0.2 0.4", "0.2 0 0.4").replace("0 -0.2 0.4", "-0.2 0 0.4")
    message = _refusal(tmp_path / "two.xml", text)
    assert "describe each with --root and --side" in message
    for root in re.findall(r"\w+_palm", message):
        # The URDF of the refused attempt lies there.
        out = tmp_path / f"{root}.yaml"
        (hand,) = init_hands(
            tmp_path / "two.xml", out=out, root=root, side="right"
        ).hands
        assert hand.hand.side == "right"


def test_of_several_wrong_numbers_the_same_one_is_always_named(tmp_path: Path) -> None:
    """Sets of words have another order in every process."""
    limit = '<limit lower="a" upper="b" velocity="c" effort="d"/>'
    text = (
        '<robot name="x"><link name="a"/><link name="b"/><joint name="j" type="revolute">'
        f'<parent link="a"/><child link="b"/><axis xyz="0 0 1"/>{limit}</joint></robot>'
    )
    assert "<limit lower>" in _refusal(tmp_path / "x.urdf", text)
