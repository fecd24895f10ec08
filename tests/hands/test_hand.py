"""Hands of every kind.

Kinematics against finite differences, reference points, and descriptions that cannot be used.
"""

import xml.etree.ElementTree as ET
from pathlib import Path

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import generators, poses

from handmap_qp import HandError, InvalidInputError, PointSpec, hand_names, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import read_hand_spec
from handmap_qp.se3 import transform_points

HANDS = {name: load_hand(name) for name in hand_names()}
every_hand = pytest.mark.parametrize("hand", HANDS.values(), ids=HANDS.keys())
# Mirrored, with followers, with prismatic joints, on an arm, and cut from a robot.
KINDS = [
    n
    for n in ("human_left", "hey5", "panda_gripper", "ur5_allegro", "g1_left")
    if n in HANDS
]
each_kind = pytest.mark.parametrize("hand", [HANDS[name] for name in KINDS], ids=KINDS)


def postures(hand: Hand) -> st.SearchStrategy[np.ndarray]:
    """Draw joint angles inside a hand's limits."""
    shares = st.lists(
        st.floats(0.0, 1.0), min_size=len(hand.rest), max_size=len(hand.rest)
    ).map(np.array)
    return shares.map(
        lambda share: (
            hand.lower_limits + share * (hand.upper_limits - hand.lower_limits)
        )
    )


def in_palm(hand: Hand, q: np.ndarray) -> np.ndarray:
    """Return reference points in the palm frame, shape (m, 3)."""
    return transform_points(np.linalg.inv(hand.frame_pose("palm", q)), hand.points(q))


def test_the_hands_of_the_package_are_there() -> None:
    assert {
        "human",
        "human_left",
        "three_finger",
        "allegro_right",
        "allegro_left",
    } <= set(HANDS)


@each_kind
@settings(max_examples=12)
@given(data=st.data())
def test_point_jacobian_is_the_derivative_of_the_points(
    hand: Hand, data: st.DataObject
) -> None:
    q, pose = data.draw(postures(hand)), data.draw(poses) if hand.is_floating else None
    step = 1e-6
    slopes = [
        (hand.points(q + step * e, pose) - hand.points(q - step * e, pose)).ravel()
        / (2 * step)
        for e in np.eye(len(q))
    ]
    # Central differences: rounding 1e-16 / 1e-6 of metres, truncation 1e-12.
    np.testing.assert_allclose(
        hand.point_jacobian(q, pose), np.column_stack(slopes), atol=3e-9
    )


@each_kind
@settings(max_examples=12)
@given(data=st.data())
def test_the_wrist_pose_carries_every_point(hand: Hand, data: st.DataObject) -> None:
    if not hand.is_floating:
        pytest.skip(f"an arm carries {hand.name}; see test_compose.py")
    q, pose = data.draw(postures(hand)), data.draw(poses)
    np.testing.assert_allclose(
        hand.points(q, pose), transform_points(pose, hand.points(q)), atol=1e-12
    )
    np.testing.assert_allclose(hand.frame_pose("wrist", q, pose), pose, atol=1e-12)
    np.testing.assert_allclose(
        hand.frame_pose("palm", q, pose), pose @ hand.wrist_to_palm, atol=1e-12
    )


@every_hand
def test_a_point_lies_on_its_link_where_the_description_says(hand: Hand) -> None:
    points = hand.points(hand.rest)
    for point, position in zip(hand.reference_points, points, strict=True):
        link = hand.frame_pose(point.link, hand.rest)
        np.testing.assert_allclose(
            position, link[:3, :3] @ point.xyz + link[:3, 3], atol=1e-12
        )


@every_hand
def test_palm_axes_are_anatomical(hand: Hand) -> None:
    """Stretched fingers point distally, and closing moves their tips to the palmar side."""
    stretched = np.clip(0.0, hand.lower_limits, hand.upper_limits)
    tips = hand.with_points("fingertips")
    if "middle" not in {point.finger for point in tips.reference_points}:
        pytest.skip(f"{hand.name} is a gripper, and shut at zero")
    fingers = [
        i for i, point in enumerate(tips.reference_points) if point.finger != "thumb"
    ]
    open_tips = in_palm(tips, stretched)[fingers]
    closed_tips = in_palm(tips, hand.rest)[fingers]
    assert (open_tips[:, 1] > 0.0).all()
    assert (closed_tips[:, 2] < open_tips[:, 2]).all()


@every_hand
def test_the_thumb_is_on_its_side(hand: Hand) -> None:
    tips = hand.with_points("fingertips")
    across = dict(
        zip(
            [point.finger for point in tips.reference_points],
            in_palm(tips, hand.rest)[:, 0],
            strict=True,
        )
    )
    if "middle" not in across:
        pytest.skip(f"{hand.name} is a gripper: its sides are alike")
    sign = -1.0 if hand.side == "right" else 1.0
    assert sign * across["index"] > sign * across["middle"]


@given(poses, generators)
def test_a_wrist_away_from_the_root_carries_the_hand(
    pose: np.ndarray, generator: np.random.Generator
) -> None:
    """The wrist frame goes to the given pose, and all links keep their poses in it."""
    robot = ET.fromstring(HANDS["three_finger"].urdf_text)
    ET.SubElement(robot, "link", {"name": "flange"})
    joint = ET.SubElement(robot, "joint", {"name": "flange_joint", "type": "fixed"})
    ET.SubElement(joint, "parent", {"link": "palm"})
    ET.SubElement(joint, "child", {"link": "flange"})
    ET.SubElement(joint, "origin", {"xyz": "0.02 -0.05 0.08", "rpy": "0.4 -0.7 1.1"})
    text = ET.tostring(robot, encoding="unicode")
    wrist = msgspec.structs.replace(SPEC.wrist, link="flange")
    hand = Hand(msgspec.structs.replace(SPEC, wrist=wrist), urdf_text=text)
    q = generator.uniform(hand.lower_limits, hand.upper_limits)
    # In the plain model the root link is at the origin of the world.
    model = pin.buildModelFromXML(text)
    data = model.createData()
    full = np.zeros(model.nq)
    for name, angle in zip(hand.joint_names, q, strict=True):
        full[model.joints[model.getJointId(name)].idx_q] = angle
    pin.framesForwardKinematics(model, data, full)
    flange = data.oMf[model.getFrameId("flange")].homogeneous
    for link in ("palm", "flange", *(point.link for point in hand.reference_points)):
        in_root = data.oMf[model.getFrameId(link, pin.FrameType.BODY)].homogeneous
        expected = pose @ np.linalg.inv(flange) @ in_root
        np.testing.assert_allclose(
            hand.link_poses([link], q, pose)[0], expected, atol=1e-9
        )
    np.testing.assert_allclose(hand.frame_pose("wrist", q, pose), pose, atol=1e-12)
    np.testing.assert_allclose(
        hand.frame_pose("palm", q, pose), pose @ hand.wrist_to_palm, atol=1e-12
    )


def test_of_a_link_and_a_joint_of_one_name_the_link_is_found() -> None:
    robot = ET.fromstring(HANDS["three_finger"].urdf_text)
    ET.SubElement(robot, "link", {"name": SPEC.joints[0]})
    joint = ET.SubElement(robot, "joint", {"name": "fixture", "type": "fixed"})
    ET.SubElement(joint, "parent", {"link": "palm"})
    ET.SubElement(joint, "child", {"link": SPEC.joints[0]})
    ET.SubElement(joint, "origin", {"xyz": "0.5 0.6 0.7"})
    hand = Hand(SPEC, urdf_text=ET.tostring(robot, encoding="unicode"))
    position = hand.frame_pose(SPEC.joints[0], hand.rest)[:3, 3]
    np.testing.assert_allclose(position, [0.5, 0.6, 0.7], atol=1e-12)


def test_a_fixed_hand_rejects_a_wrist_pose() -> None:
    fixed = load_hand("three_finger", mount="fixed")
    assert fixed.model.nv == len(fixed.joint_names)
    np.testing.assert_allclose(
        fixed.points(fixed.rest), HANDS["three_finger"].points(fixed.rest), atol=1e-12
    )
    with pytest.raises(InvalidInputError, match="fixed wrist"):
        fixed.points(fixed.rest, np.eye(4))


def test_points_can_be_chosen_by_set_by_name_and_by_place() -> None:
    own = PointSpec(name="mine", link="palm", xyz=(0.01, 0.02, 0.03))
    hand = load_hand("human", points=("index_tip", own))
    assert [point.name for point in hand.reference_points] == ["index_tip", "mine"]
    np.testing.assert_allclose(
        hand.points(hand.rest)[1], [0.01, 0.02, 0.03], atol=1e-12
    )
    assert len(load_hand("human", points="landmarks").reference_points) == 21
    for bad in ("no set", ("no_point",), ()):
        with pytest.raises(HandError):
            load_hand("human", points=bad)


@pytest.mark.parametrize(
    "q",
    [np.zeros(3), np.zeros((8, 1)), 0.0],
    ids=["too few", "two-dimensional", "scalar"],
)
def test_a_posture_of_another_shape_is_rejected(q: np.ndarray) -> None:
    with pytest.raises(InvalidInputError, match="shape"):
        HANDS["three_finger"].points(q)


def broken(tmp_path: Path, change: dict, drop: str | None = None) -> Path:
    """Write the description of the three-fingered hand with some keys changed."""
    source = urdf_directory() / "three_finger" / "hand.yaml"
    document = yaml.safe_load(source.read_text())
    document["urdf"] = str(source.parent / "hand.urdf")
    document.update(change)
    document.pop(drop or "", None)
    path = tmp_path / "hand.yaml"
    path.write_text(yaml.safe_dump(document))
    return path


SPEC = read_hand_spec(urdf_directory() / "three_finger" / "hand.yaml")
FIRST = SPEC.joints[0]
POINT = msgspec.to_builtins(SPEC.points[0])
BROKEN = {
    "unknown key": ({"colour": "red"}, None, "colour"),
    "missing key": ({}, "joints", "joints"),
    "wrong type": ({"joints": 3}, None, "joints"),
    "side": ({"side": "both"}, None, "side"),
    "rest outside limits": ({"rest": {**SPEC.rest, FIRST: 9.0}}, None, f"rest.{FIRST}"),
    "rest of no joint": ({"rest": {**SPEC.rest, "elbow": 0.0}}, None, "rest"),
    "matched outside limits": (
        {"neutral_match": {**SPEC.rest, FIRST: 9.0}},
        None,
        f"neutral_match.{FIRST}",
    ),
    "matched of no joint": (
        {"neutral_match": {**SPEC.rest, "elbow": 0.0}},
        None,
        "neutral_match",
    ),
    "matched of some joints": ({"neutral_match": {FIRST: 0.5}}, None, "neutral_match"),
    "matched of no joints": ({"neutral_match": {}}, None, "neutral_match"),
    "matched of text": (
        {"neutral_match": {**SPEC.rest, FIRST: "open"}},
        None,
        "neutral_match",
    ),
    "unknown joint": (
        {"joints": [*SPEC.joints, "elbow"], "rest": {**SPEC.rest, "elbow": 0.0}},
        None,
        "joints",
    ),
    "forgotten joint": (
        {
            "joints": list(SPEC.joints[1:]),
            "rest": {name: SPEC.rest[name] for name in SPEC.joints[1:]},
        },
        None,
        "joints",
    ),
    "joint twice": ({"joints": [*SPEC.joints, FIRST]}, None, "joints"),
    "unknown link": (
        {
            "points": [
                {**POINT, "link": "moon"},
                *map(msgspec.to_builtins, SPEC.points[1:]),
            ]
        },
        None,
        "points[0].link",
    ),
    "palm on no link": (
        {
            "palm": {
                "link": "moon",
                "distal": [1.0, 0.0, 0.0],
                "dorsal": [0.0, 0.0, 1.0],
            }
        },
        None,
        "palm.link",
    ),
    "palm askew": (
        {
            "palm": {
                "link": "palm",
                "distal": [1.0, 0.0, 0.0],
                "dorsal": [1.0, 0.0, 0.0],
            }
        },
        None,
        "palm.dorsal",
    ),
    "no weight": (
        {
            "points": [
                {**POINT, "weight": 0.0},
                *map(msgspec.to_builtins, SPEC.points[1:]),
            ]
        },
        None,
        "points[0].weight",
    ),
    "set of no point": ({"sets": {"fingertips": ["moon"]}}, None, "sets.fingertips"),
    "unknown set": ({"reference": "toes"}, None, "reference"),
    "no urdf": ({"urdf": "nowhere.urdf"}, None, "urdf"),
    "wrist on a finger": ({"wrist": {"link": SPEC.points[0].link}}, None, "wrist.link"),
}


@pytest.mark.parametrize(("change", "drop", "key"), BROKEN.values(), ids=BROKEN.keys())
def test_a_broken_description_is_named_by_file_and_key(
    tmp_path: Path, change: dict, drop: str | None, key: str
) -> None:
    path = broken(tmp_path, change, drop)
    with pytest.raises(HandError) as caught:
        load_hand(path)
    assert str(path) in str(caught.value)
    assert key in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "- 1", "a: [", "\x00"], ids=["empty", "list", "torn", "binary"]
)
def test_a_file_that_is_not_a_description_is_rejected(
    tmp_path: Path, text: str
) -> None:
    path = tmp_path / "hand.yaml"
    path.write_text(text)
    with pytest.raises(HandError, match=r"hand\.yaml"):
        load_hand(path)


@pytest.mark.parametrize(
    "urdf", ["<robot", "<robot name='x'/>", ""], ids=["torn", "empty robot", "empty"]
)
def test_a_urdf_that_cannot_be_used_is_rejected(tmp_path: Path, urdf: str) -> None:
    (tmp_path / "x.urdf").write_text(urdf)
    with pytest.raises(HandError):
        load_hand(broken(tmp_path, {"urdf": "x.urdf"}))


def test_names_and_paths_that_lead_nowhere_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(HandError, match="three_finger"):
        load_hand("no_such_hand")
    with pytest.raises(HandError, match="cannot be read"):
        load_hand(tmp_path / "absent.yaml")
    with pytest.raises(InvalidInputError, match="human hand"):
        load_hand("three_finger", hand_length=0.19)


@pytest.mark.parametrize("name", ["allegro_right", "barrett"])
def test_vectors_of_many_postures_are_those_of_each(name: str) -> None:
    hand = load_hand(name)
    shares = np.random.default_rng(0).uniform(size=(4, len(hand.rest)))
    q = hand.lower_limits + shares * (hand.upper_limits - hand.lower_limits)
    expected = [hand.configuration_vector(row) for row in q]
    np.testing.assert_allclose(
        hand.configuration_vectors(q), expected, rtol=0.0, atol=1e-15
    )
    one = hand.configuration_vectors(q[0])
    np.testing.assert_allclose(one, expected[:1], rtol=0.0, atol=1e-15)
    for wrong in (q[:, :-1], [q[0].tolist(), [1.0]], np.full_like(q, np.nan)):
        with pytest.raises(InvalidInputError, match="q"):
            hand.configuration_vectors(wrong)
