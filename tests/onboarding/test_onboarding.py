"""Hands found in URDFs: results, independence of names, and invalid URDFs."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from made_hands import make_hand
from strategies import generators

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding.collision_pairs import colliding_links
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.edit import described
from handmap_qp.apps.onboarding.findings import fine, warning
from handmap_qp.apps.onboarding.write import RobotSource
from handmap_qp.hands.sources import package_folder, urdf_directory, urdf_path
from handmap_qp.hands.urdf import edges, parse_urdf

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[1] / "data" / "urdf"
ROBOTS = package_folder("example-robot-data") / "robots"
G1 = ROBOTS / "g1_description" / "urdf" / "g1_29dof_with_hand_rev_1_0.urdf"
ROMEO = ROBOTS / "romeo_description" / "urdf" / "romeo.urdf"
TIAGO = ROBOTS / "tiago_description" / "robots" / "tiago.urdf"
PANDA = ROBOTS / "panda_description" / "urdf" / "panda.urdf"
DESCRIBED = ("human", "human_left", "allegro_right", "allegro_left", "three_finger")


def sure(found: Detection, what: str) -> float:
    return next(clue.confidence for clue in found.clues if clue.what == what)


def tips(found: Detection) -> dict[str | None, str]:
    """Return the fingertip's link by finger."""
    return {
        point.finger: point.link
        for point in found.spec.points
        if point.name.endswith("_tip")
    }


@pytest.mark.slow
@pytest.mark.parametrize("name", DESCRIBED)
def test_detection_agrees_with_hand_written_descriptions(name: str) -> None:
    hand = load_hand(name, points="fingertips")
    found = detect(urdf_path(hand.spec), hand.urdf_text)
    assert tips(found) == {point.finger: point.link for point in hand.reference_points}
    by_name = {
        point.finger: point
        for point in found.spec.points
        if point.name.endswith("_tip")
    }
    for point in hand.reference_points:
        np.testing.assert_allclose(by_name[point.finger].xyz, point.xyz, atol=1e-4)
    assert found.spec.side == hand.side
    assert set(found.spec.joints) == set(hand.joint_names)
    assert found.spec.palm.link == hand.spec.palm.link
    np.testing.assert_allclose(found.spec.palm.distal, hand.spec.palm.distal, atol=1e-6)
    np.testing.assert_allclose(found.spec.palm.dorsal, hand.spec.palm.dorsal, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize(("urdf", "root", "side", "fingers", "count"), [
    (G1, "left_wrist_yaw_link", "left", 3, 7),
    (G1, "right_hand_palm_link", "right", 3, 7),
    (TIAGO, None, "right", 5, 33),
    (PANDA, None, "right", 2, 1),
    (ROMEO, "l_wrist", "left", 4, 1),
    (ROMEO, "r_wrist", "right", 4, 1),
], ids=["g1 left", "g1 right", "hey5", "panda", "romeo left", "romeo right"])  # fmt: skip
def test_a_hand_on_a_robot_is_found(
    urdf: Path, root: str | None, side: str, fingers: int, count: int
) -> None:
    found = detect(urdf, root=root)
    hand = load_hand(found.spec)
    assert (hand.side, len(tips(found)), len(hand.joint_names)) == (
        side,
        fingers,
        count,
    )


@pytest.mark.slow
def test_which_finger_is_which_on_robots() -> None:
    """Compare with the link names, which are correct for these robots."""
    for side in ("left", "right"):
        found = tips(detect(G1, root=f"{side}_hand_palm_link"))
        assert found == {
            "thumb": f"{side}_hand_thumb_2_link",
            "index": f"{side}_hand_index_1_link",
            "middle": f"{side}_hand_middle_1_link",
        }
    for finger, link in tips(detect(TIAGO)).items():
        assert link.startswith(f"hand_{finger}_flex")


def test_motors_that_move_no_finger_are_locked() -> None:
    assert set(detect(TIAGO).spec.locked) == {
        "hand_thumb_joint",
        "hand_index_joint",
        "hand_mrl_joint",
    }


@pytest.mark.parametrize(("name", "fingers", "side"), [
    ("chained_mimics",
     {"thumb": "z_tip", "index": "a_tip", "middle": "b_tip", "ring": "c_tip"}, "right"),
    ("continuous_joints", {"thumb": "w_tip", "index": "v_tip", "middle": "u_tip"}, "left"),
    ("absent_limits", {"thumb": "t_tip", "index": "i_tip", "middle": "m_tip"}, "right"),
    ("seven_fingers",
     {"thumb": "f6_tip", "index": "f0_l3", "middle": "f1_tip", "ring": "f2_l3",
      "little": "f3_tip", "finger6": "f4_l3", "finger7": "f5_tip"}, "right"),
    ("one_finger", {"index": "one_l3"}, "right"),
], ids=lambda value: value if isinstance(value, str) else "")  # fmt: skip
def test_fingers_of_hands_made_for_the_tests(
    name: str, fingers: dict[str, str], side: str
) -> None:
    found = detect(DATA / f"{name}.urdf")
    assert (tips(found), found.spec.side) == (fingers, side)
    if name != "one_finger":
        assert (
            min(
                sure(found, what)
                for what in ("palm", "thumb", "distal", "dorsal", "side")
            )
            >= 0.6
        )
    assert found.spec.palm.distal == (1.0, 0.0, 0.0)
    assert found.spec.palm.dorsal == (0.0, 0.0, 1.0)


def test_jaws_close_towards_each_other() -> None:
    found = detect(DATA / "prismatic_fingers.urdf")
    hand = load_hand(found.spec)
    assert hand.spec.palm.distal == (0.0, 0.0, -1.0)
    spreads = [
        np.linalg.norm(np.ptp(hand.points(q), axis=0))
        for q in (hand.lower_limits, hand.rest, hand.upper_limits)
    ]
    assert spreads == sorted(spreads, reverse=True)
    # Three equal fingers include no thumb, so confidence is low.
    assert max(sure(found, what) for what in ("thumb", "side", "fingers")) < 0.5


@pytest.mark.parametrize("stray", [None, 0.15, -0.15])
def test_a_tip_without_a_link_is_the_end_of_the_surface(stray: float | None) -> None:
    """A shape in a wrong place, far from its link's others, is no part of it."""
    text = (DATA / "one_finger.urdf").read_text()
    if stray:
        box = f'<visual><origin xyz="{stray} 0 0"/><geometry><box size=".02 .02 .02"/>'
        link = '<link name="one_l3">'
        text = text.replace(link, f"{link}{box}</geometry></visual>")
    found = detect(DATA / "one_finger.urdf", text)
    (tip,) = (point for point in found.spec.points if point.name == "index_tip")
    # The last bone is a box of 22 mm; the tip is inside its last slice, on its axis.
    np.testing.assert_allclose(tip.xyz, (0.022, 0.0, 0.0), atol=1e-6)


def test_missing_limits_are_assumed_and_noted() -> None:
    found = detect(DATA / "absent_limits.urdf")
    assert set(found.spec.limits) == set(found.spec.joints)
    # i_j3 has a range and no speed, i_j1 a speed and no range.
    assert found.spec.limits["i_j3"].lower is None
    assert found.spec.limits["i_j1"].velocity is None
    for joint in found.spec.limits:
        assert any(joint in note for note in found.notes)
    endless = detect(DATA / "continuous_joints.urdf")
    assert {"u_j1", "v_j1", "w_turn"} <= set(endless.spec.limits)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["human", "allegro_left", "three_finger"])
@settings(max_examples=2)
@given(generator=generators)
def test_names_and_the_order_of_the_file_do_not_matter(
    name: str, generator: np.random.Generator
) -> None:
    hand = load_hand(name)
    plain = detect(urdf_path(hand.spec), hand.urdf_text)
    new, text = renamed(hand.urdf_text, generator)
    other = detect(urdf_path(hand.spec), text)
    # Without kinematic evidence for the side, the finger names are arbitrary too.
    if sure(plain, "side") > 0.5:
        assert tips(other) == {
            finger: new[link] for finger, link in tips(plain).items()
        }
        assert other.spec.side == plain.spec.side
    else:
        assert tips(other)["thumb"] == new[tips(plain)["thumb"]]
    np.testing.assert_allclose(
        other.spec.palm.distal, plain.spec.palm.distal, atol=1e-6
    )
    np.testing.assert_allclose(
        other.spec.palm.dorsal, plain.spec.palm.dorsal, atol=1e-6
    )
    assert {
        new[joint]: value for joint, value in plain.spec.rest.items()
    } == pytest.approx(other.spec.rest)


def renamed(text: str, generator: np.random.Generator) -> tuple[dict[str, str], str]:
    """Rename every link and joint to a number, and shuffle the file."""
    robot = ET.fromstring(text)
    robot.set("name", "x")
    named = [element for element in robot if element.tag in ("link", "joint")]
    numbers = generator.permutation(len(named))
    new = {
        element.get("name", ""): f"n{number}"
        for element, number in zip(named, numbers, strict=True)
    }
    for element in named:
        element.set("name", new[element.get("name", "")])
        for tag in ("parent", "child"):
            if (end := element.find(tag)) is not None:
                end.set("link", new[end.get("link", "")])
        if (mimic := element.find("mimic")) is not None:
            mimic.set("joint", new[mimic.get("joint", "")])
        robot.remove(element)
    for i in generator.permutation(len(named)):
        robot.append(named[i])
    return new, ET.tostring(robot, encoding="unicode")


@settings(max_examples=10)
@given(generator=generators)
def test_a_rest_posture_is_inside_the_limits_and_closes_the_hand(
    generator: np.random.Generator,
) -> None:
    name = str(
        generator.choice(
            ["chained_mimics", "continuous_joints", "seven_fingers", "absent_limits"]
        )
    )
    hand = load_hand(detect(DATA / f"{name}.urdf").spec)
    assert (hand.rest > hand.lower_limits).all()
    assert (hand.rest < hand.upper_limits).all()
    moved = hand.points(hand.rest) - hand.points(
        np.clip(0.0, hand.lower_limits, hand.upper_limits)
    )
    assert (moved @ np.array(hand.spec.palm.dorsal) < -0.01).all()


@pytest.mark.parametrize(("name", "message"), [
    ("no_joints", "no joint that moves"),
    ("loop", "'coupler' is the child of two joints"),
    ("two_roots", "2 roots, expected one: palm, loose"),
    ("malformed", "not valid XML"),
    ("nan_limits", "'j1': <limit lower='nan'>"),
])  # fmt: skip
def test_a_urdf_that_cannot_be_used_gets_one_clear_line(
    name: str, message: str
) -> None:
    path = DATA / f"{name}.urdf"
    with pytest.raises(HandError) as caught:
        detect(path)
    assert re.fullmatch(
        rf"{re.escape(str(path))}: .*{re.escape(message)}.*", str(caught.value)
    )


@pytest.mark.parametrize(("urdf", "root", "message"), [
    (G1, None, "2 possible palms: left_hand_palm_link, right_hand_palm_link; choose one with "
               "--root"),
    (G1, "moon", "no link 'moon'"),
    (G1, "left_hand_index_1_link", "no movable joint hangs from"),
    (ROBOTS / "ur_description" / "urdf" / "ur5_robot.urdf", None,
     "no hand found from 'world' outwards: one chain of"),
    (DATA / "absent.urdf", None, "cannot be read"),
])  # fmt: skip
def test_where_no_hand_is_found_the_next_step_is_named(
    urdf: Path, root: str | None, message: str
) -> None:
    with pytest.raises(HandError, match=message):
        detect(urdf, root=root)


def urdf_of(*joints: str) -> str:
    """Make a URDF of joints about y from lines `name parent child x y z [leader factor]`."""
    rows = [line.split() for line in joints]
    links = dict.fromkeys(name for row in rows for name in row[1:3])
    text = "".join(f'<link name="{name}"/>' for name in links)
    for name, parent, child, x, y, z, *leader in rows:
        mimic = (
            f'<mimic joint="{leader[0]}" multiplier="{leader[1]}"/>' if leader else ""
        )
        kind = "fixed" if name.startswith("end") else "revolute"
        limits = (
            '<limit lower="-2" upper="1.5" effort="1" velocity="1"/>'
            if leader
            else '<limit lower="-0.1" upper="1.5" effort="1" velocity="1"/>'
        )
        text += (
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{x} {y} {z}"/><axis xyz="0 1 0"/>{limits}{mimic}</joint>'
        )
    return f'<robot name="x">{text}</robot>'


def test_a_metacarpal_that_carries_two_fingers_is_no_palm() -> None:
    fingers = [
        line
        for name, root, y in (
            ("i", "palm", 0.03),
            ("m", "palm", 0.01),
            ("r", "arch", -0.01),
            ("l", "arch", -0.03),
        )
        for line in (
            f"{name}1 {root} {name}_1 0.08 {y} 0",
            f"{name}2 {name}_1 {name}_2 0.04 0 0",
            f"end_{name} {name}_2 {name}_tip 0.03 0 0",
        )
    ]
    found = detect(
        DATA / "x.urdf", urdf_of("arch0 palm arch 0.01 0 0", *fingers), thumb="i_1"
    )
    assert found.spec.palm.link == "palm"
    assert len(tips(found)) == 4
    assert "arch0" in found.spec.joints
    assert sum("arch0" in chain for chain in found.chains.values()) == 2


@pytest.mark.parametrize("is_driven", [False, True])
def test_the_bar_of_a_linkage_is_no_finger(is_driven: bool) -> None:
    """A parallelogram: the end of the bar stays at a fixed point of the finger on the crank.

    The finger may have a joint beyond the linkage that has a motor of its own.
    """
    sides = [
        line
        for name, y, sign in (("a", 0.03, 1), ("b", -0.03, 1))
        for line in (
            f"{name}_crank palm {name}_1 0.02 {y} 0"
            + ("" if name == "a" else " a_crank 1"),
            f"{name}_finger {name}_1 {name}_2 0.05 0 0 a_crank -1",
            f"{name}_last {name}_2 {name}_5 0.03 0 0"
            + ("" if is_driven else " a_crank 0.5"),
            f"end_{name} {name}_5 {name}_tip 0.03 0 0",
            f"{name}_bar palm {name}_3 0.02 {y} {0.02 * sign} a_crank 1",
            f"end_{name}3 {name}_3 {name}_bar_end 0.05 0 0",
        )
    ]
    found = detect(DATA / "x.urdf", urdf_of(*sides))
    assert set(tips(found).values()) == {"a_tip", "b_tip"}
    assert sum("linkage" in note for note in found.notes) == 2


def _fingers(palm: str, *roots: tuple[str, float]) -> list[str]:
    return [
        line
        for name, y in roots
        for line in (
            f"{name}1 {palm} {name}_1 0.08 {y} 0",
            f"{name}2 {name}_1 {name}_2 0.04 0 0",
            f"end_{name} {name}_2 {name}_tip 0.03 0 0",
        )
    ]


def test_two_hands_on_wrists_of_one_base_are_two_hands() -> None:
    """The base, of which short chains branch, is no palm with two fingers and a leg."""
    text = urdf_of(
        "hip base leg 0 0 -0.1",
        "end_foot leg foot 0 0 -0.1",
        *[
            line
            for side, sign in (("left", -1), ("right", 1))
            for line in (
                f"{side}_x base {side}_wrist 0 {-0.2 * sign} 0",
                f"{side}_y {side}_wrist {side}_palm 0 0 0",
                *_fingers(
                    f"{side}_palm",
                    *[
                        (f"{side}_{name}", sign * y)
                        for name, y in (
                            ("thumb", 0.05),
                            ("index", 0.02),
                            ("ring", -0.02),
                        )
                    ],
                ),
            )
        ],
    )
    with pytest.raises(HandError, match="2 possible palms: left_palm, right_palm"):
        detect(DATA / "x.urdf", text)
    for side in ("left", "right"):
        found = detect(DATA / "x.urdf", text, root=f"{side}_palm")
        assert found.spec.side == side
        assert len(tips(found)) == 3


@pytest.mark.parametrize(
    ("on_wrist", "beside", "palm"),
    [
        # An object of a scene, and a hand whose fingers are all on its wrist.
        ("abcde", "object", "inner"),
        # A thumb, and the other fingers on a joint through the palm.
        ("abcd", "thumb", "base"),
    ],
)
def test_what_is_beside_a_whole_hand_is_no_finger(
    on_wrist: str, beside: str, palm: str
) -> None:
    row = [(name, 0.02 * i) for i, name in enumerate(on_wrist)]
    text = urdf_of(
        "wrist base inner 0.02 0 0",
        *_fingers("inner", *row),
        *_fingers("base", (beside, -0.05)),
    )
    found = detect(DATA / "x.urdf", text)
    assert found.spec.palm.link == palm
    assert len(tips(found)) == 5


def test_a_head_is_no_palm_and_a_motor_no_finger() -> None:
    eyes = (
        f"{side}_eye head {side}_eye 0.05 {y} 0"
        for side, y in (("l", 0.03), ("r", -0.03))
    )
    hand = _fingers("palm", ("a", 0.02), ("b", -0.02), ("c", 0.0))
    text = urdf_of(
        "neck base head 0.5 0 0",
        *eyes,
        "arm base elbow 0 0.2 0",
        "elbow elbow palm 0 0.4 0",
        *hand,
        "motor palm tool 0.05 0.04 0.02",
    )
    found = detect(DATA / "x.urdf", text)
    assert found.spec.palm.link == "palm"
    assert set(tips(found).values()) == {"a_tip", "b_tip", "c_tip"}


def test_a_urdf_in_millimetres_is_recognised() -> None:
    text = (DATA / "one_finger.urdf").read_text()
    large = re.sub(
        r'(xyz|size)="([^"]*)"',
        lambda m: f'{m[1]}="{" ".join(str(1e3 * float(x)) for x in m[2].split())}"',
        text,
    )
    with pytest.raises(HandError, match="millimetres"):
        detect(DATA / "one_finger.urdf", large)


def test_the_last_joints_of_a_thumb_flex_it() -> None:
    """An inner joint of the Allegro hand's thumb shortens it more than its last two together."""
    folder = ROBOTS / "allegro_hand_description" / "urdf"
    rest = detect(folder / "allegro_right_hand.urdf").spec.rest
    assert rest["joint_13.0"] == 0.0
    assert min(rest["joint_14.0"], rest["joint_15.0"]) > 0.5


def test_given_side_thumb_and_name_are_used() -> None:
    found = detect(
        urdf_directory() / "three_finger" / "hand.urdf",
        side="left",
        thumb="finger2_distal",
        name="mine",
    )
    assert (found.spec.name, found.spec.side, tips(found)["thumb"]) == (
        "mine",
        "left",
        "finger2_tip",
    )
    with pytest.raises(HandError, match="'moon'"):
        detect(urdf_directory() / "three_finger" / "hand.urdf", thumb="moon")


def test_a_finger_of_another_name_given_as_the_thumb_loses_no_finger() -> None:
    hand = load_hand("human")
    found = tips(
        detect(urdf_path(hand.spec), hand.urdf_text, thumb="little_DIP_flexion")
    )
    assert found["thumb"] == "little_tip"
    assert {*found.values()} == {*tips(detect(urdf_path(hand.spec))).values()}


def test_a_hand_can_keep_its_arm() -> None:
    found = detect(G1, root="left_hand_palm_link", base="torso_link")
    hand = load_hand(found.spec)
    assert hand.has_moving_wrist
    assert len(hand.joint_names) == 7 + 7
    assert hand.joint_names[0] == "left_shoulder_pitch_joint"
    with pytest.raises(HandError, match="no joint moves between"):
        detect(G1, root="left_hand_palm_link", base="left_wrist_yaw_link")
    with pytest.raises(HandError, match="does not hang from"):
        detect(G1, root="left_hand_palm_link", base="right_shoulder_pitch_link")


def test_directions_are_no_surer_than_the_fingertips_that_they_are_measured_with() -> (
    None
):
    made = make_hand(np.random.default_rng(0))
    robot = parse_urdf(made.urdf)
    carriers = {parent for _, parent, _ in edges(robot)}
    for joint, _, child in list(edges(robot)):
        if child not in carriers and joint.get("type") == "fixed":
            cut = next(link for link in robot.iter("link") if link.get("name") == child)
            robot.remove(joint)
            robot.remove(cut)
    whole, bare = (
        {clue.what: clue.certainty for clue in detect(Path("x.urdf"), text).clues}
        for text in (made.urdf, ET.tostring(robot, "unicode"))
    )
    for what in ("distal", "dorsal", "palm origin", "rest"):
        assert whole[what] in ("certain", "likely")
        assert bare[what].startswith("a guess")


def test_what_a_measurement_contradicts_is_a_guess() -> None:
    found = detect(Path("x.urdf"), make_hand(np.random.default_rng(0)).urdf)
    wrong = warning("palm.dorsal", "the fingers close elsewhere", "correct it")
    clues = {
        clue.what: clue for clue in found.doubted([wrong, fine("palm", "so")]).clues
    }
    assert clues["dorsal"].certainty.startswith("a guess")
    assert clues["dorsal"].how.endswith("but the fingers close elsewhere")
    assert clues["distal"] == next(c for c in found.clues if c.what == "distal")


def test_names_of_all_fingers_decide_which_one_is_the_thumb() -> None:
    made = next(
        hand
        for seed in range(50)
        if (hand := make_hand(np.random.default_rng(seed))).has_names
        and len(hand.tips) == 4
    )
    swapped = made.urdf.replace("thumb", "#").replace("middle", "thumb")
    found = detect(Path("x.urdf"), swapped.replace("#", "middle"))
    clues = {clue.what: clue for clue in found.clues}
    assert "thumb" in clues["thumb"].answer
    # The places say something else, so nobody is sure.
    assert clues["thumb"].certainty == "likely"


def claw(radius: float) -> str:
    """Return a hand of three like fingers around a centre; their joints turn both ways."""
    parts = ['<link name="base"/>']
    limit = '<limit lower="-1.57" upper="1.57" velocity="5" effort="1"/>'
    for k, angle in enumerate((0.0, 2.0944, 4.1888)):
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        parent, place = "base", f'xyz="{x} {y} 0.03" rpy="0 0 {angle}"'
        for j in range(2):
            name = f"f{k}_{j}"
            parts.append(
                f"""<link name="{name}"><collision><origin xyz="0 0 0.035"/>
                <geometry><box size="0.016 0.016 0.07"/></geometry></collision></link>
                <joint name="j{name}" type="revolute"><parent link="{parent}"/>
                <child link="{name}"/><origin {place}/><axis xyz="0 1 0"/>{limit}</joint>"""
            )
            parent, place = name, 'xyz="0 0 0.07"'
    return f'<robot name="claw">{"".join(parts)}</robot>'


@pytest.mark.parametrize(("radius", "is_opened"), [(0.05, True), (0.15, False)])
def test_fingers_that_would_cross_at_rest_are_opened(
    tmp_path: Path, radius: float, is_opened: bool
) -> None:
    urdf = tmp_path / "claw.urdf"
    urdf.write_text(claw(radius))
    found = detect(urdf)
    before = load_hand(found.spec)
    assert bool(colliding_links(before, before.rest)) == is_opened
    done = described(found, RobotSource(urdf, str(urdf)))
    hand = load_hand(done.spec)
    assert not colliding_links(hand, hand.rest)
    assert (done.spec.rest != found.spec.rest) == is_opened
    # Half open still, where that is possible; and these links are kept apart now.
    assert (np.abs(hand.rest) <= np.abs(before.rest)).all()
    assert hand.rest.any()
    (clue,) = (clue for clue in done.clues if clue.what == "rest")
    assert ("the thumb met links there" in clue.how) == is_opened
    assert done.spec.collision is not None
    assert any(one[:2] != other[:2] for one, other in done.spec.collision.pairs)
