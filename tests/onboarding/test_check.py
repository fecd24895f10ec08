"""`handmap hands check` finds mistakes by names, gestures, files and limits."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from made_hands import MadeHand, make_hand
from oracles.shape_distances import MeasuredPairs
from shared_hands import NAMES, load, shared_hands_folder

from handmap_qp import Hand, HandError, cli, load_hand
from handmap_qp.apps.drawing import load_shape
from handmap_qp.apps.onboarding import cli as onboarding
from handmap_qp.apps.onboarding.check import (
    _check_tips,
    _check_wrist,
    _compare_detection,
    check_hand,
    check_speeds,
)
from handmap_qp.apps.onboarding.collision_pairs import (
    find_collision_pairs,
    joined_notes,
    with_collision_pairs,
)
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.findings import Found, HandFinding, HandReport
from handmap_qp.apps.onboarding.measure import (
    check_arm,
    check_contacts,
    check_fist,
    check_fist_time,
    check_following,
    check_motion,
    check_pinches,
    measure_arm,
)
from handmap_qp.apps.onboarding.picture import hand_scene
from handmap_qp.apps.onboarding.speeds import MAKERS, maker_speed, with_speed
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.shape_pairs import ShapePairs, all_pairs
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import LimitSpec, MimicSpec
from handmap_qp.hands.urdf import origin_of, parse_urdf, set_origin
from handmap_qp.se3 import inverse_pose, transform_points

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

SHARED = shared_hands_folder()


@pytest.fixture(scope="module")
def made() -> MadeHand:
    generator = np.random.default_rng(2)
    while True:
        hand = make_hand(generator)
        if hand.has_names and hand.is_one_sided and len(hand.tips) >= 4:
            return hand


def described(tmp_path: Path, urdf: str, **changes: Any) -> Path:
    (tmp_path / "hand.urdf").write_text(urdf)
    write_hand(detect(tmp_path / "hand.urdf"), tmp_path / "hand.yaml")
    document = yaml.safe_load((tmp_path / "hand.yaml").read_text())
    (tmp_path / "hand.yaml").write_text(yaml.safe_dump({**document, **changes}))
    return tmp_path / "hand.yaml"


def found_by(check: Found) -> HandReport:
    """Return what one check finds."""
    report = HandReport("hand")
    report.add(check)
    return report


def warnings_of(report: HandReport) -> dict[str, str]:
    found: dict[str, str] = {}
    for f in report.findings:
        if f.level == "warning":
            found[f.key] = f"{found.get(f.key, '')}{f.text}; {f.change}\n"
    return found


def check(path: Path) -> HandReport:
    return check_hand(str(path), has_motion=False)


def test_a_right_description_has_no_warning(made: MadeHand, tmp_path: Path) -> None:
    report = check(described(tmp_path, made.urdf))
    assert warnings_of(report) == {}
    assert report.measured["Pinches"]
    assert any("thumb can touch" in f.text for f in report.findings)
    assert {"Pads", "Pinches", "Fingers", "Size"} <= report.measured.keys()


def test_a_palm_turned_over_is_found(made: MadeHand, tmp_path: Path) -> None:
    path = described(tmp_path, made.urdf)
    palm = yaml.safe_load(path.read_text())["palm"]
    palm["dorsal"] = [-value for value in palm["dorsal"]]
    found = warnings_of(check(described(tmp_path, made.urdf, palm=palm)))
    assert "palm.dorsal" in found
    assert "side" in found


@pytest.mark.parametrize(("angle", "is_wrong"), [(5.0, False), (35.0, True)])
def test_a_palm_turned_about_distal_is_found(
    made: MadeHand, tmp_path: Path, angle: float, is_wrong: bool
) -> None:
    palm = yaml.safe_load(described(tmp_path, made.urdf).read_text())["palm"]
    distal, dorsal = np.array(palm["distal"]), np.array(palm["dorsal"])
    turned = np.cos(np.radians(angle)) * dorsal
    turned = turned + np.sin(np.radians(angle)) * np.cross(distal, dorsal)
    palm["dorsal"] = (turned / np.linalg.norm(turned)).tolist()
    (fist,) = found_by(
        check_fist(load_hand(described(tmp_path, made.urdf, palm=palm)))
    ).findings
    (across,) = re.findall(r"(\d+) degrees off (?:its|the palm's) x axis", fist.text)
    assert float(across) == pytest.approx(angle, abs=8.0)
    found = warnings_of(check(tmp_path / "hand.yaml"))
    assert ("palm.dorsal" in found) == is_wrong


def test_exchanged_fingers_are_found(made: MadeHand, tmp_path: Path) -> None:
    document = yaml.safe_load(described(tmp_path, made.urdf).read_text())
    points = {point["name"]: point for point in document["points"]}
    one, other = points["index_tip"], points["middle_tip"]
    one["link"], other["link"] = other["link"], one["link"]
    found = warnings_of(
        check(described(tmp_path, made.urdf, points=document["points"]))
    )
    assert "finger: middle" in found["points.index_tip"]
    assert "finger: index" in found["points.middle_tip"]
    assert "order of their knuckles" in found["points"]


def test_axes_of_fingers_around_a_centre_are_compared_too() -> None:
    """Detection only guesses the palm of such a hand: a palm turned over differs enough."""
    spec = load_hand("three_finger").spec
    assert not found_by(_compare_detection(load_hand(spec))).findings
    x, y, z = spec.palm.dorsal
    palm = msgspec.structs.replace(spec.palm, dorsal=(-x, -y, -z))
    turned = load_hand(msgspec.structs.replace(spec, palm=palm))
    findings = found_by(_compare_detection(turned)).findings
    assert "palm.dorsal" in {found.key for found in findings}


def test_limits_in_degrees_are_one_finding(made: MadeHand, tmp_path: Path) -> None:
    def degrees(match: re.Match[str]) -> str:
        return f'lower="{57.3 * float(match[1])}" upper="{57.3 * float(match[2])}"'

    text = re.sub(r'lower="([^"]+)" upper="([^"]+)"', degrees, made.urdf)
    found = " ".join(warnings_of(check(described(tmp_path, text, limits={}))).values())
    assert found.count("in degrees?") == 1
    # What `hands init` writes has the true limits.
    limits = yaml.safe_load(described(tmp_path, text).read_text())["limits"]
    true = [float(upper) for upper in re.findall(r'upper="([^"]+)"', made.urdf)]
    assert sorted(one["upper"] for one in limits.values()) == pytest.approx(
        sorted(true), rel=1e-3
    )


@pytest.mark.parametrize("tag", ["visual", "collision"])
def test_missing_meshes_are_counted(made: MadeHand, tmp_path: Path, tag: str) -> None:
    mesh = f'<{tag}><geometry><mesh filename="meshes/palm.stl"/></geometry></{tag}>'
    link = f'<link name="{made.palm}"'
    text = made.urdf.replace(f"{link}/>", f"{link}>{mesh}</link>")
    found = warnings_of(check(described(tmp_path, text)))
    assert found["urdf"].startswith(f"1 of 1 {tag} meshes are missing, unreadable")
    assert "palm.stl" in found["urdf"]


def test_speeds_that_nobody_knows_are_said_and_may_be_given(
    made: MadeHand, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    urdf = tmp_path / "leap.urdf"
    urdf.write_text(re.sub('velocity="[^"]*"', 'velocity="0.5"', made.urdf))
    said = {}
    for name, speed in (("urdf", 0.5), ("given", 4.0), ("maker", 8.48)):
        file = tmp_path / f"{name}.yaml"
        words = [] if name == "urdf" else ["--speed", str(speed)]
        assert cli.main(["hands", "init", str(urdf), "--out", str(file), *words]) == 0
        hand = load_hand(file)
        assert (hand.velocity_limits == speed).all()
        assert hand.spec.speeds == name
        said[name] = [f for f in check(file).findings if "too slow" in f.text]
    assert "the same speed: a placeholder?" in said["urdf"][0].text
    # The maker's figure is proposed by the name of the file, by init too.
    assert "8.48 by the LEAP hand's URDF" in said["urdf"][0].change
    assert "8.48 by the LEAP" in capsys.readouterr().out.replace("\n", " ")
    assert said["given"] == said["maker"] == []
    words = [
        "hands",
        "init",
        str(urdf),
        "--speed",
        "0",
        "--out",
        str(tmp_path / "no.yaml"),
    ]
    assert cli.main(words) == 2
    assert "--speed: expected a speed > 0" in capsys.readouterr().err


def test_followers_do_not_hide_placeholders() -> None:
    """Followers that turn further slow some leaders: the file's speeds are the same still."""
    spec = load_hand("three_finger").spec
    limits = {joint: LimitSpec(velocity=0.5) for joint in spec.joints}
    joints = tuple(joint for joint in spec.joints if joint != "f2_distal")
    rest = {joint: spec.rest[joint] for joint in joints}
    mimic = {"f2_distal": MimicSpec("f1_distal", 1.5)}
    found = {}
    for speeds in (None, "assumed", "maker"):
        changes: dict[str, Any] = {"joints": joints, "rest": rest, "mimic": mimic}
        given = msgspec.structs.replace(spec, limits=limits, speeds=speeds, **changes)
        hand = load_hand(given)
        assert np.ptp(hand.velocity_limits) > 0.1
        (found[speeds],) = check_speeds(hand)
    assert "a placeholder?" in found[None].text
    assert "these speeds are assumed" in found["assumed"].text
    assert (found["maker"].level, found["maker"].change) == ("fine", "")


def test_slow_joints_follow_less() -> None:
    spec = load_hand("three_finger").spec
    report = found_by(check_following(load_hand(with_speed(spec, 0.5))))
    (finding,) = report.findings
    own, fast, _ = re.findall(r"[\d.]+", finding.text)
    assert finding.level == "advice"
    assert float(own) < 0.8 < float(fast)
    assert f"{fast} if the joints could do 4 rad/s" in finding.text
    # The hand has 4 rad/s itself.
    (whole,) = found_by(check_following(load_hand(spec))).findings
    assert whole.level == "fine"
    assert f"follows {fast} of your fingers" in whole.text


@pytest.mark.parametrize(
    ("name", "is_slow"),
    [
        ("svh_right", True),
        ("inspire_right", True),
        ("shadow_right", False),
        ("allegro_right", False),
    ],
)
def test_the_time_for_a_fist_is_said_and_a_person_is_faster_than_some(
    name: str, is_slow: bool
) -> None:
    hand = load_hand(name)
    report = found_by(check_fist_time(hand))
    (finding,) = report.findings
    assert ("a person is faster" in finding.text) == is_slow
    assert finding.level == ("advice" if is_slow else "fine")
    assert ("assumed" in finding.text) == (hand.spec.speeds == "assumed")
    (time,) = re.findall(r"takes ([\d.]+) s from a flat hand to a fist", finding.text)
    (rows,) = report.measured.values()
    by_joint = {f"limits.{row['slowest joint']}": row["s"] for row in rows}
    assert by_joint[finding.key] == max(by_joint.values())
    assert by_joint[finding.key] == pytest.approx(float(time), abs=0.01)
    # The makers' figures are true: nothing is left to correct.
    known = load_hand(msgspec.structs.replace(hand.spec, speeds="maker"))
    (finding,) = found_by(check_fist_time(known)).findings
    assert "true limits" not in finding.change


def test_a_joint_that_is_faster_stays_so() -> None:
    """What is said of 4 rad/s slows no joint: one that does more follows as well as it does."""
    spec = load_hand("three_finger").spec
    mixed = np.where(np.arange(len(spec.joints)) % 2, 0.5, 30.0)
    found = {}
    for speeds in (mixed, mixed.clip(4.0)):
        report = found_by(check_following(load_hand(with_speed(spec, speeds))))
        found[report.findings[0].level] = re.findall(r"\.\d+", report.findings[0].text)
    assert found["advice"][1] == found["fine"][0]


def test_every_maker_figure_has_a_source() -> None:
    names = "|".join(MAKERS).split("|")
    assert len(names) == len({*names})
    assert len(MAKERS) == 18
    for speed, source in MAKERS.values():
        assert 0.1 <= speed <= 15.0
        assert len(source) > 20
    spec = load_hand("three_finger").spec
    for name, speed in (
        ("robotiq_hande", 0.15),
        ("hand-e", 0.15),
        ("inmoov_hand_eef", None),
        ("ability_hand", 8.07),
        ("capability", None),
    ):
        said = maker_speed(msgspec.structs.replace(spec, name=name))
        assert (said and said[0]) == speed, name


def test_a_contradiction_is_an_exit_code(
    made: MadeHand,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # Other tests look at pictures.
    monkeypatch.setattr(onboarding, "draw_hand", lambda *_: None)
    file = described(tmp_path, made.urdf)
    words = ["hands", "check", str(file), "--no-motion", "--json"]
    assert cli.main(words) == 0
    text = file.read_text().replace("side: right", "side: left")
    file.write_text(text)
    capsys.readouterr()
    with pytest.raises(SystemExit) as end:
        cli.main(words)
    assert end.value.code == 1
    said = json.loads(capsys.readouterr().out)
    assert said["findings"][0]["level"] == "warning"


def test_a_pad_that_is_larger_than_its_phalanx_is_said(
    made: MadeHand, tmp_path: Path
) -> None:
    tip = made.tips["index"]
    ball = '<collision><geometry><sphere radius="0.2"/></geometry></collision>'
    link = f'<link name="{tip}"'
    text = made.urdf.replace(f"{link}/>", f"{link}>{ball}</link>")
    file = described(tmp_path, made.urdf)
    assert "points.index" not in warnings_of(check(file))
    (tmp_path / "hand.urdf").write_text(text)
    said = warnings_of(check(file))["points.index"]
    assert "too much for its phalanx" in said


def test_a_mesh_in_millimetres_is_said_and_not_used(
    made: MadeHand, tmp_path: Path
) -> None:
    trimesh.creation.box((20.0, 80.0, 90.0)).export(tmp_path / "palm.stl")
    mesh = '<collision><geometry><mesh filename="palm.stl"/></geometry></collision>'
    link = f'<link name="{made.palm}"'
    text = made.urdf.replace(f"{link}/>", f"{link}>{mesh}</link>")
    report = check(described(tmp_path, text))
    assert "of no link's size: palm.stl" in warnings_of(report)["urdf"]
    assert report.hand is not None
    sizes = []
    for shape in read_collision_shapes(report.hand).geometryObjects:
        shape.geometry.computeLocalAABB()
        sizes.append(
            np.ptp([shape.geometry.aabb_local.min_, shape.geometry.aabb_local.max_])
        )
    assert max(sizes) < 0.5


@pytest.mark.parametrize(
    ("collision", "said"),
    [
        ('<geometry><box size="0.03 0.09 0.1"/></geometry>', ""),
        ('<geometry><box size="0.02 0.06 0.07"/></geometry>', ""),
        ('<geometry><box size="0.09 0.27 0.3"/></geometry>', "end 100 mm apart"),
        ('<origin xyz="0 0.2 0"/><geometry><sphere radius="0.05"/></geometry>', "205"),
        ("<geometry><sphere/></geometry>", "malformed"),
        (
            '<origin xyz="0 0"/><geometry><sphere radius="0.05"/></geometry>',
            "malformed",
        ),
        ("", "malformed"),
    ],
)
def test_collision_shapes_that_contradict_the_visual_ones_are_said(
    made: MadeHand,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    collision: str,
    said: str,
) -> None:
    visual = '<visual><geometry><box size="0.03 0.09 0.1"/></geometry></visual>'
    link = f'<link name="{made.palm}"'
    shapes = f"{visual}<collision>{collision}</collision>"
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(made.urdf.replace(f"{link}/>", f"{link}>{shapes}</link>"))
    file = tmp_path / "hand.yaml"
    assert cli.main(["hands", "init", str(urdf), "--out", str(file), "--json"]) == 0
    notes = " ".join(json.loads(capsys.readouterr().out)["notes"])
    found = warnings_of(check(file)).get("urdf", "")
    for words in (notes, found):
        assert (f"of {made.palm} " in words) == bool(said)
        assert said in words


def test_a_pair_of_links_that_do_not_exist_is_found(
    made: MadeHand, tmp_path: Path
) -> None:
    pairs = {"pairs": [["moon", made.palm]]}
    found = warnings_of(check(described(tmp_path, made.urdf, collision=pairs)))
    assert "'moon' is not a link" in found["collision.pairs[0]"]


def named_as_links(text: str) -> str:
    """Give every joint the name of its child link, as in the Shadow hand's URDF."""
    pattern = r'<joint name="([^"]+)" type="[^"]+"><parent link="[^"]+"/><child link="([^"]+)"/>'
    for joint, child in re.findall(pattern, text):
        text = text.replace(f'<joint name="{joint}"', f'<joint name="{child}"')
    return text


def with_joint(made: MadeHand, kind: str, *, is_above: bool) -> str:
    parent, child = ("w", made.palm) if is_above else (made.palm, "w")
    joint = (
        f'<link name="w"/><joint name="free" type="{kind}"><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/></joint></robot>'
    )
    return made.urdf.replace("</robot>", joint)


@pytest.mark.parametrize(
    "change", ["named as links", "floating", "planar", "floating above", "planar above"]
)
def test_odd_urdfs_are_found_checked_and_drawn(
    made: MadeHand, tmp_path: Path, change: str
) -> None:
    kind, _, above = change.partition(" ")
    if change == "named as links":
        text = named_as_links(made.urdf)
    else:
        text = with_joint(made, kind, is_above=bool(above))
    report = check(described(tmp_path, text))
    assert report.hand is not None
    assert set(report.hand.joint_names).isdisjoint({"free"})
    assert {p.finger for p in report.hand.spec.points} == set(made.tips)
    if change == "named as links":
        assert len(hand_scene(report.hand).points) == len(made.tips)


def test_balls_without_a_size_are_drawn_as_nothing(
    made: MadeHand, tmp_path: Path
) -> None:
    ball = "<visual><geometry><sphere radius='0'/></geometry></visual></link>"
    text = re.sub(r'(<link name="[^"]+")/>', rf"\1>{ball}", made.urdf)
    report = check(described(tmp_path, text))
    assert report.hand is not None
    assert len(hand_scene(report.hand).points) == len(made.tips)


def test_a_fixed_hand_is_drawn_with_its_palm() -> None:
    shape = load_shape(load_hand("allegro_right", mount="fixed"))
    assert shape.without_arm().links.keys() == shape.links.keys()


def test_a_xacro_file_is_named_as_such(tmp_path: Path) -> None:
    (tmp_path / "hand.urdf").write_text(
        '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:include filename="finger.xacro"/><link name="a"/></robot>'
    )
    with pytest.raises(HandError, match="is xacro, not URDF: convert it"):
        detect(tmp_path / "hand.urdf")


def test_wrist_joints_above_the_root_are_advice() -> None:
    (found,) = found_by(_check_wrist(load_hand("g1_right"))).findings
    assert found.key == "root"
    assert "right_wrist_yaw_joint" in found.text
    assert "--base" in found.change


def test_pads_meet_where_the_thumb_opposes() -> None:
    """Fingers 1 and 2 of the three-fingered hand close onto the thumb in a plane."""
    hand = load_hand("three_finger")
    pinches = found_by(check_pinches(hand)).measured["Pinches"]
    assert [pinch["touch"] for pinch in pinches] == ["yes", "yes"]


def test_a_thumb_that_opposes_nothing_is_found(made: MadeHand, tmp_path: Path) -> None:
    document = yaml.safe_load(described(tmp_path, made.urdf).read_text())
    still = {joint: {"lower": -0.001, "upper": 0.001} for joint in document["joints"]}
    rest = dict.fromkeys(document["joints"], 0.0)
    path = described(tmp_path, made.urdf, limits=still, rest=rest)
    assert "touches no finger" in warnings_of(check(path))["points"]


@pytest.mark.slow
def test_an_arm_does_not_hide_what_the_hand_reaches() -> None:
    """The same hand alone and on its arm reaches the same postures."""
    alone, on_arm = (
        found_by(check_motion(load_hand(name))).measured["A standard motion"]
        for name in ("g1_left", "g1_arm_left")
    )
    for one, other in zip(alone, on_arm, strict=True):
        assert other["error mm"] == pytest.approx(one["error mm"], abs=3.0)


def test_the_picture_shows_all_points() -> None:
    hand = load_hand(urdf_directory() / "allegro_right" / "hand.yaml")
    assert len(hand.reference_points) < len(hand.spec.points)
    scene = hand_scene(hand.with_points([point.name for point in hand.spec.points]))
    assert len(scene.points) == len(hand.spec.points)


@pytest.mark.skipif(SHARED is None, reason="LEAP is not here: set HANDMAP_HANDS")
def test_axes_of_leap_that_were_called_certain_are_refuted(tmp_path: Path) -> None:
    assert SHARED is not None
    write_hand(
        detect(SHARED / "leap_hand" / "leap_hand_right.urdf"), tmp_path / "leap.yaml"
    )
    document = yaml.safe_load((tmp_path / "leap.yaml").read_text())
    distal, dorsal = np.array([0.93, -0.36, -0.01]), np.array([-0.21, -0.56, 0.8])
    distal /= np.linalg.norm(distal)
    dorsal -= (dorsal @ distal) * distal
    dorsal /= np.linalg.norm(dorsal)
    document["palm"] |= {"distal": distal.tolist(), "dorsal": dorsal.tolist()}
    (tmp_path / "old.yaml").write_text(yaml.safe_dump(document))
    found = warnings_of(check(tmp_path / "old.yaml"))
    assert {"palm.distal", "palm.dorsal"} <= found.keys()


def test_pairs_for_self_collision_are_apart_at_rest_and_named() -> None:
    hand = load_hand("allegro_right")
    collision = find_collision_pairs(hand, all_pairs(hand))
    assert collision is not None
    described_hand = load_hand(msgspec.structs.replace(hand.spec, collision=collision))
    limit = MeasuredPairs(described_hand)
    configuration = described_hand.configuration()
    configuration.place(described_hand.configuration_vector(described_hand.rest))
    assert limit.within(configuration.q).found[:, 0].min() > collision.margin
    links = {frozenset(pair) for pair in collision.pairs}
    # Thumb and every fingertip; index and ring are no neighbours.
    assert {
        frozenset({"link_15.0_tip", f"link_{i}.0_tip"}) for i in (3, 7, 11)
    } <= links
    assert frozenset({"link_3.0_tip", "link_11.0_tip"}) not in links


def test_pairs_for_self_collision_let_pinches_close() -> None:
    hand = load_hand("allegro_right")
    collision = find_collision_pairs(hand, all_pairs(hand))
    assert collision is not None
    # A pinch counts as closed with surfaces nearer than 3 mm.
    assert collision.margin < 0.001


@pytest.mark.parametrize(
    "name",
    ["allegro_right", "g1_right", "hey5", "leap_right", "svh_right", "ur5_allegro"],
)
def test_contacts_leave_the_joints_of_right_hands_their_range(name: str) -> None:
    if name in NAMES and SHARED is None:
        pytest.skip("set HANDMAP_HANDS")
    hand = load(name)
    report = found_by(check_contacts(hand))
    assert {each.level for each in report.findings} <= {"fine"}
    rows = report.measured["A tour of gestures"]
    assert [row["joint"] for row in rows] == [*hand.joint_names]
    assert max(row["without contacts"] for row in rows) > 0.5


def test_a_joint_that_contacts_lock_is_found(tmp_path: Path) -> None:
    # A ball on the palm, 0.6 rad of flexion away from a finger that cannot go around it.
    hand = load_hand("three_finger")
    q = hand.rest.copy()
    q[hand.joint_names.index("f1_proximal")] += 0.6
    palm, distal = hand.link_poses(["palm", "finger1_distal"], q)
    x, y, z = transform_points(inverse_pose(palm), distal[:3, 3])
    ball = (
        f'<collision><origin xyz="{x} {y} {z}"/><geometry><sphere radius="0.012"/>'
        "</geometry></collision>"
    )
    link = '<link name="palm">'
    urdf = tmp_path / "hand.urdf"
    urdf.write_text(hand.urdf_text.replace(link, link + ball))
    locked = load_hand(msgspec.structs.replace(hand.spec, urdf=str(urdf)))
    found = warnings_of(found_by(check_contacts(locked)))
    assert found
    assert all("palm and finger1" in line for line in found["urdf"].splitlines())
    report = check_hand("three_finger")
    assert "A tour of gestures" in report.measured


@pytest.mark.skipif(SHARED is None, reason="set HANDMAP_HANDS")
def test_coarse_shapes_at_a_joint_are_left_out() -> None:
    # A box of the palm and the thumb's base, 2 mm inside to 4 mm apart, halved the thumb's range.
    robot = load("svh_right")
    joined = all_pairs(robot).joined
    assert {frozenset(links) for links in joined} == {
        frozenset({"right_hand_e1", "right_hand_a"})
    }


def test_links_that_are_always_close_are_noted(tmp_path: Path) -> None:
    pairs = ShapePairs(pin.GeometryModel(), (), (("a", "b"), ("a", "b")))
    (note,) = joined_notes(pairs)
    assert note.startswith("a and b are close in every posture")


def test_a_hand_without_shapes_has_no_pairs(made: MadeHand, tmp_path: Path) -> None:
    hand = load_hand(described(tmp_path, made.urdf))
    assert find_collision_pairs(hand, all_pairs(hand)) is None
    found = detect(tmp_path / "hand.urdf")
    assert with_collision_pairs(found, hand).spec.collision is None


@pytest.mark.parametrize("shape", ["star", "chain"])
def test_many_links_beside_the_fingers_are_no_obstacle(
    made: MadeHand, shape: str
) -> None:
    """Sensors and bolts: 1,500 links on the palm, or in a row."""
    parts = []
    for i in range(1500):
        parent = made.palm if shape == "star" or i == 0 else f"x{i - 1}"
        parts.append(
            f'<link name="x{i}"/><joint name="jx{i}" type="fixed"><parent link="{parent}"/>'
            f'<child link="x{i}"/></joint>'
        )
    text = made.urdf.replace("</robot>", "".join(parts) + "</robot>")
    found, plain = (detect(Path("x.urdf"), urdf) for urdf in (text, made.urdf))
    assert found.spec.palm == plain.spec.palm
    assert found.spec.points == plain.spec.points


def test_a_chain_that_crashes_urdf_readers_is_refused(made: MadeHand) -> None:
    parts = [
        f'<link name="x{i}"/><joint name="jx{i}" type="fixed">'
        f'<parent link="{made.palm if i == 0 else f"x{i - 1}"}"/><child link="x{i}"/></joint>'
        for i in range(5000)
    ]
    with pytest.raises(HandError, match=r"chain of 5001 links .*expected at most 2000"):
        detect(
            Path("x.urdf"), made.urdf.replace("</robot>", "".join(parts) + "</robot>")
        )


def test_the_reach_of_an_arm_is_a_line_with_a_scale() -> None:
    assert not measure_arm(load_hand("allegro_right")).any()
    reach = measure_arm(load_hand("ur5_allegro"))
    assert reach is not None
    # A UR5 reaches 0.85 m; wrist and flange add to it, so from rest at most twice a metre.
    assert reach.shape == (26,)
    assert 0.3 < np.median(reach) < reach.max() < 2.0
    short = measure_arm(load_hand("g1_arm_left"))
    assert short is not None
    assert np.median(short) < np.median(reach)
    (line,) = found_by(check_arm(load_hand("g1_arm_left"))).findings
    assert line.level == "advice"
    assert "directions from rest" in line.text


def test_a_fingertip_outside_its_shapes_is_found() -> None:
    hand = load_hand("allegro_right")
    robot = parse_urdf(hand.urdf_text)
    # The index finger's tip is a link of its own, on the last joint.
    links = {link.get("name"): link for link in robot.iterfind("link")}
    for name in ("link_3.0", "link_3.0_tip"):
        for shape in links[name].iterfind("collision"):
            pose = origin_of(shape)
            pose[1, 3] += 0.018
            set_origin(shape, pose)
    text = ElementTree.tostring(robot, encoding="unicode")
    (found,) = _check_tips(Hand(hand.spec, urdf_text=text))
    assert isinstance(found, HandFinding)
    assert found.key == "points.index"
    assert re.match(r"the fingertip is \d+ mm outside the shapes", found.text)
    assert "`shapes`" in found.change
    assert list(_check_tips(hand)) == []
