"""Parts of robots, locked joints, hands on arms.

Each against the kinematics of the robots that they were made of.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from arm_cases import arm_of, mounted
from hypothesis import given
from hypothesis import strategies as st
from strategies import generators, rotations

from handmap_core.ik.options import IkOptions
from handmap_qp import Hand, HandError, HandSpec, InvalidInputError, load_hand
from handmap_qp.hands.sources import read_urdf, urdf_directory
from handmap_qp.hands.spec import ArmSpec, LimitSpec, read_hand_spec
from handmap_qp.hands.urdf import cut_subtree, lock_joints
from handmap_qp.ik.qp import PointIk
from handmap_qp.se3 import rotation_from_rpy, rpy_from_rotation, transform_points

DATA = Path(__file__).parents[1] / "data" / "urdf"
ARMS = {name: arm_of(name) for name in ("ur5", "panda", "xarm7")}
ALLEGRO = load_hand("allegro_right")
MOUNT = (0.01, -0.02, 0.095), (0.3, -0.4, 0.5)
ON_ARM = {
    name: load_hand(mounted(ALLEGRO.spec, arm, xyz=MOUNT[0], rpy=MOUNT[1]))
    for name, arm in ARMS.items()
}
every_arm = pytest.mark.parametrize("arm", ARMS)


def pose_of(model: pin.Model, link: str, angles: dict[str, float]) -> np.ndarray:
    """Return a link's pose in a plain model; joints that are not named are at zero."""
    q, data = pin.neutral(model), model.createData()
    for name, angle in angles.items():
        q[model.joints[model.getJointId(name)].idx_q] = angle
    pin.framesForwardKinematics(model, data, q)
    return data.oMf[model.getFrameId(link, pin.FrameType.BODY)].homogeneous


def within(hand: Hand, generator: np.random.Generator) -> np.ndarray:
    """Draw joint angles inside the limits, those of an arm within half a turn."""
    return np.clip(
        generator.uniform(-np.pi, np.pi, len(hand.rest)),
        hand.lower_limits,
        hand.upper_limits,
    )


@every_arm
@given(generator=generators)
def test_the_wrist_is_where_the_arm_carries_it(
    arm: str, generator: np.random.Generator
) -> None:
    hand, spec = ON_ARM[arm], ARMS[arm]
    q = within(hand, generator)
    flange = pose_of(
        pin.buildModelFromXML(read_urdf(spec).decode()),
        spec.tip,
        dict(zip(spec.joints, q, strict=False)),
    )
    offset = np.eye(4)
    offset[:3, :3], offset[:3, 3] = rotation_from_rpy(MOUNT[1]), MOUNT[0]
    np.testing.assert_allclose(hand.frame_pose("wrist", q), flange @ offset, atol=1e-12)


@every_arm
@given(generator=generators)
def test_points_on_an_arm_are_those_of_the_hand_alone_carried_by_the_wrist(
    arm: str, generator: np.random.Generator
) -> None:
    hand = ON_ARM[arm]
    q = within(hand, generator)
    alone = ALLEGRO.points(q[len(ARMS[arm].joints) :])
    np.testing.assert_allclose(
        hand.points(q), transform_points(hand.frame_pose("wrist", q), alone), atol=1e-12
    )


@every_arm
@given(generator=generators)
def test_the_jacobian_holds_arm_and_fingers(
    arm: str, generator: np.random.Generator
) -> None:
    hand = ON_ARM[arm]
    q, step = within(hand, generator), 1e-6
    slopes = [
        (hand.points(q + step * e) - hand.points(q - step * e)).ravel() / (2 * step)
        for e in np.eye(len(q))
    ]
    # Central differences of points a metre away: rounding error 2e-16 / 1e-6.
    np.testing.assert_allclose(
        hand.point_jacobian(q), np.column_stack(slopes), atol=2e-9
    )


@every_arm
def test_an_arm_keeps_its_own_limits(arm: str) -> None:
    hand, spec = ON_ARM[arm], ARMS[arm]
    model = pin.buildModelFromXML(read_urdf(spec).decode())
    at = [model.joints[model.getJointId(name)] for name in spec.joints]
    count = len(spec.joints)
    assert hand.joint_names == (*spec.joints, *ALLEGRO.joint_names)
    np.testing.assert_array_equal(
        hand.lower_limits[:count],
        [model.lowerPositionLimit[joint.idx_q] for joint in at],
    )
    np.testing.assert_array_equal(
        hand.upper_limits[:count],
        [model.upperPositionLimit[joint.idx_q] for joint in at],
    )
    np.testing.assert_array_equal(
        hand.velocity_limits[:count], [model.velocityLimit[joint.idx_v] for joint in at]
    )
    np.testing.assert_array_equal(hand.lower_limits[count:], ALLEGRO.lower_limits)


@every_arm
def test_a_stretched_arm_stays_bounded_and_still(arm: str) -> None:
    """An arm with a target two metres beyond its reach ends stretched, singular and at rest."""
    hand = ON_ARM[arm]
    # An arm of a metre needs more of this damping than fingers.
    ik = PointIk(hand, IkOptions())
    ik.place(hand.configuration_vector(hand.rest))
    target = hand.frame_pose("wrist", hand.rest)
    target[:3, 3] *= 1.0 + 2.0 / np.linalg.norm(target[:3, 3])
    points = transform_points(
        target @ np.linalg.inv(hand.frame_pose("wrist", hand.rest)),
        hand.points(hand.rest),
    )
    dt, track = 1.0 / 60.0, [hand.rest]
    for _ in range(400):
        ik.solve(points, target, dt)
        track.append(ik.configuration.q[hand.q_indices].copy())
    steps = np.abs(np.diff(track, axis=0))
    assert (steps <= hand.velocity_limits * dt + 1e-9).all()
    assert (np.array(track) >= hand.lower_limits - 1e-9).all()
    assert (np.array(track) <= hand.upper_limits + 1e-9).all()
    # A last step of this size at 60 Hz is less than 0.1 rad/s; a singular arm without damping would
    # go at its speed limit.
    assert steps[-60:].max() < 0.1 * dt


def test_hand_and_arm_are_one_description_in_a_file() -> None:
    hand = load_hand("ur5_allegro")
    assert hand.joint_names == (*ARMS["ur5"].joints, *ALLEGRO.joint_names)
    assert not hand.is_floating
    assert hand.has_moving_wrist
    with pytest.raises(InvalidInputError, match="fixed wrist"):
        hand.points(hand.rest, np.eye(4))
    with pytest.raises(HandError, match="cannot float"):
        load_hand("ur5_allegro", mount="floating")


def test_links_of_the_same_name_do_not_meet() -> None:
    """Hand and arm both have a `world`, a `base_link` and materials; the hand keeps its own."""
    text = '<robot name="g"><link name="base_link"/><link name="tool0"/>{}</robot>'.format(
        '<joint name="grip" type="revolute">'
        '<parent link="base_link"/><child link="tool0"/><axis xyz="0 0 1"/>'
        '<origin xyz="0 0 0.1"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>'
    )
    spec = HandSpec(
        name="g",
        urdf="g.urdf",
        side="right",
        palm=msgspec.structs.replace(ALLEGRO.spec.palm, link="base_link"),
        wrist=msgspec.structs.replace(ALLEGRO.spec.wrist, link="base_link"),
        joints=("grip",),
        rest={"grip": 0.2},
        points=(
            msgspec.structs.replace(
                ALLEGRO.spec.points[0], link="tool0", xyz=(0.05, 0.0, 0.0)
            ),
        ),
        sets={"fingertips": (ALLEGRO.spec.points[0].name,)},
        reference="fingertips",
    )
    alone, hand = (
        Hand(spec, urdf_text=text),
        Hand(mounted(spec, ARMS["ur5"]), urdf_text=text),
    )
    flange = pose_of(
        pin.buildModelFromXML(read_urdf(ARMS["ur5"]).decode()),
        "tool0",
        ARMS["ur5"].rest,
    )
    np.testing.assert_allclose(
        hand.points(hand.rest),
        transform_points(flange, alone.points([0.2])),
        atol=1e-12,
    )


def test_a_mount_that_is_impossible_is_rejected() -> None:
    ur5 = ARMS["ur5"]
    for changes, message in (
        ({"tip": "moon"}, "no link 'moon'"),
        ({"without": ("moon",)}, "no link 'moon'"),
        ({"urdf": "nowhere.urdf"}, "arm.urdf"),
        (
            {
                "joints": ur5.joints[:-1],
                "rest": {name: ur5.rest[name] for name in ur5.joints[:-1]},
            },
            "'wrist_3_joint' is missing",
        ),
        ({"rest": {}}, "has no rest position"),
        ({"xyz": (float("nan"), 0.0, 0.0)}, "finite"),
    ):
        with pytest.raises(HandError, match=message):
            load_hand(mounted(ALLEGRO.spec, msgspec.structs.replace(ur5, **changes)))
    twice = ArmSpec(
        name="a",
        urdf=ALLEGRO.spec.urdf,
        tip="link_0.0",
        joints=("joint_0.0",),
        rest={"joint_0.0": 0.0},
    )
    with pytest.raises(HandError, match="given twice"):
        load_hand(mounted(ALLEGRO.spec, twice))


KINDS = st.sampled_from(["revolute", "prismatic", "continuous"])


@given(
    kind=KINDS,
    axis=generators,
    pose=rotations,
    angle=st.floats(-3.0, 3.0),
    pitch=st.sampled_from([0.3, np.pi / 2, -np.pi / 2]),
)
def test_a_locked_joint_stands_where_it_was_put(
    kind: str, axis: np.random.Generator, pose: np.ndarray, angle: float, pitch: float
) -> None:
    direction, rpy = (
        axis.normal(size=3),
        [float(rpy_from_rotation(pose)[0]), pitch, 0.4],
    )
    text = (
        f'<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="{kind}">'
        '<parent link="a"/><child link="b"/>'
        f'<origin xyz="0.1 0.2 0.3" rpy="{" ".join(map(repr, rpy))}"/>'
        f'<axis xyz="{" ".join(map(repr, direction.tolist()))}"/>'
        '<limit lower="-4" upper="4" effort="1" velocity="1"/></joint></robot>'
    )
    free = pin.buildModelFromXML(text)
    data = free.createData()
    q = (
        np.array([np.cos(angle), np.sin(angle)])
        if kind == "continuous"
        else np.array([angle])
    )
    pin.framesForwardKinematics(free, data, q)
    robot = ET.fromstring(text)
    assert lock_joints(robot, {"j": angle}) == {"j": angle}
    locked = pose_of(
        pin.buildModelFromXML(ET.tostring(robot, encoding="unicode")), "b", {}
    )
    # Pinocchio normalises the axis differently, and the locked pose is converted to roll, pitch and
    # yaw.
    np.testing.assert_allclose(
        locked,
        data.oMf[free.getFrameId("b", pin.FrameType.BODY)].homogeneous,
        atol=1e-9,
    )


@pytest.mark.parametrize("name", ["g1_left", "hey5", "romeo_left", "panda_gripper"])
def test_a_hand_cut_from_a_robot_moves_as_on_it(name: str) -> None:
    hand = load_hand(name)
    root = hand.spec.root or ""
    model = pin.buildModelFromXML(read_urdf(hand.spec).decode())
    generator = np.random.default_rng(0)
    for _ in range(5):
        q = hand.lower_limits + generator.random(len(hand.rest)) * (
            hand.upper_limits - hand.lower_limits
        )
        angles = dict(zip(hand.all_joint_names, hand.all_joints(q), strict=True))
        foot = np.linalg.inv(pose_of(model, root, angles))
        for point, place in zip(hand.reference_points, hand.points(q), strict=True):
            np.testing.assert_allclose(
                place,
                transform_points(
                    foot @ pose_of(model, point.link, angles), np.array(point.xyz)
                ),
                atol=1e-12,
            )


@pytest.mark.parametrize("name", ["g1_arm_left", "tiago_arm"])
def test_a_hand_on_its_robot_moves_with_the_arm_alone(name: str) -> None:
    hand = load_hand(name)
    model = pin.buildModelFromXML(read_urdf(hand.spec).decode())
    assert hand.has_moving_wrist
    assert not hand.is_floating
    assert hand.all_joint_names == (
        *hand.joint_names,
        *sorted(hand.spec.locked, key=hand.all_joint_names.index),
    )
    angles = dict(zip(hand.all_joint_names, hand.all_joints(hand.rest), strict=True))
    foot = np.linalg.inv(pose_of(model, hand.spec.root or "", angles))
    np.testing.assert_allclose(
        hand.frame_pose("wrist", hand.rest),
        foot @ pose_of(model, hand.spec.wrist.link, angles),
        atol=1e-12,
    )


def test_a_part_that_is_not_there_cannot_be_cut_out() -> None:
    with pytest.raises(HandError, match="no link 'moon'"):
        cut_subtree(ET.fromstring('<robot><link name="earth"/></robot>'), "moon")


def test_limits_replace_those_of_the_file() -> None:
    first = ALLEGRO.joint_names[0]
    hand = load_hand(
        msgspec.structs.replace(
            ALLEGRO.spec, limits={first: LimitSpec(upper=0.2, velocity=3.0)}
        )
    )
    assert (hand.lower_limits[0], hand.upper_limits[0], hand.velocity_limits[0]) == (
        ALLEGRO.lower_limits[0],
        0.2,
        3.0,
    )
    np.testing.assert_array_equal(hand.upper_limits[1:], ALLEGRO.upper_limits[1:])


def test_files_extend_others_and_keep_their_paths(tmp_path: Path) -> None:
    base = urdf_directory() / "three_finger" / "hand.yaml"
    (tmp_path / "mine.yaml").write_text(f"extends: {base}\nname: mine\nside: left\n")
    mine = read_hand_spec(tmp_path / "mine.yaml")
    assert (mine.name, mine.side, mine.joints) == (
        "mine",
        "left",
        read_hand_spec(base).joints,
    )
    hand = load_hand(tmp_path / "mine.yaml")
    np.testing.assert_array_equal(
        hand.points(hand.rest), load_hand("three_finger").points(hand.rest)
    )


def test_files_that_extend_each_other_are_rejected(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text("extends: b.yaml\n")
    (tmp_path / "b.yaml").write_text("extends: a.yaml\n")
    with pytest.raises(HandError, match="circle"):
        read_hand_spec(tmp_path / "a.yaml")


def test_shapes_that_a_file_has_in_wrong_places_are_moved() -> None:
    spec = load_hand("three_finger").spec
    robot = ET.fromstring(read_urdf(spec))
    link = next(
        link for link in robot.iter("link") if link.find("collision") is not None
    )
    for tag in ("visual", "collision"):
        shape = link.find(tag)
        assert shape is not None
        shape.set("name", "stray")
    text = ET.tostring(robot, encoding="unicode")
    way = (0.01, 0.02, -0.03)
    moved = Hand(msgspec.structs.replace(spec, shapes={"stray": way}), urdf_text=text)
    for kind in (pin.GeometryType.COLLISION, pin.GeometryType.VISUAL):
        own, plain = (
            pin.buildGeomFromUrdfString(moved.model, urdf, kind).geometryObjects
            for urdf in (moved.urdf_text, Hand(spec, urdf_text=text).urdf_text)
        )
        for shape, other in zip(own, plain, strict=True):
            frame = moved.model.frames[shape.parentFrame].placement
            ends = [frame.actInv(s.placement).translation for s in (shape, other)]
            is_stray = shape.name == f"{link.get('name')}_0"
            wanted = way if is_stray else (0.0, 0.0, 0.0)
            np.testing.assert_allclose(ends[0] - ends[1], wanted, atol=1e-12)
    spec = msgspec.structs.replace(spec, shapes={"nobody": way})
    with pytest.raises(HandError, match="no shape of the URDF is named 'nobody'"):
        Hand(spec, urdf_text=text)
