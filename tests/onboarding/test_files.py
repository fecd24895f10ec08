"""`handmap hands init` writes a hand.yaml that loads; `handmap hands check` finds its mistakes."""

from __future__ import annotations

import json
import re
from contextlib import nullcontext
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import msgspec
import numpy as np
import pytest
import yaml
from marks import rotated

from handmap_qp import HandError, InvalidInputError, cli, hand_names, load_hand
from handmap_qp.apps.drawing import scene
from handmap_qp.apps.onboarding import picture
from handmap_qp.apps.onboarding.check import check_hand, check_speeds
from handmap_qp.apps.onboarding.cli import HandsCheck, HandsInit, print_report
from handmap_qp.apps.onboarding.collision_pairs import colliding_links
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.findings import Found, HandReport
from handmap_qp.apps.onboarding.measure import (
    check_reach,
    check_size,
)
from handmap_qp.apps.onboarding.picture import draw_hand, picture_path
from handmap_qp.apps.onboarding.write import (
    check_free,
    hand_text,
    open_source,
    write_hand,
)
from handmap_qp.hands.library import HUMAN_HANDS, hand_files
from handmap_qp.hands.sources import urdf_directory, urdf_path
from handmap_qp.hands.spec import LimitSpec, read_hand_spec
from handmap_qp.human import standard_postures

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[1] / "data" / "urdf"
OWN = (
    "chained_mimics",
    "prismatic_fingers",
    "continuous_joints",
    "absent_limits",
    "one_finger",
    "seven_fingers",
)


@cache
def chained_mimics() -> Detection:
    """Detect a hand that many tests describe wrongly."""
    return detect(DATA / "chained_mimics.urdf")


def tables_of(check: Found) -> dict[str, Any]:
    """Return the tables of one check."""
    report = HandReport("hand")
    report.add(check)
    return report.measured


def levels(report: HandReport) -> list[str]:
    return [finding.level for finding in report.findings]


@pytest.mark.parametrize("name", OWN)
def test_what_is_written_is_what_was_found(name: str, tmp_path: Path) -> None:
    found = detect(DATA / f"{name}.urdf")
    write_hand(found, tmp_path / "hand.yaml")
    read, spec = read_hand_spec(tmp_path / "hand.yaml"), found.spec
    for key in (
        "name",
        "side",
        "palm",
        "wrist",
        "joints",
        "rest",
        "points",
        "sets",
        "reference",
        "root",
        "locked",
        "limits",
        "mimic",
    ):
        assert getattr(read, key) == getattr(spec, key), key
    hand, direct = load_hand(tmp_path / "hand.yaml"), load_hand(spec)
    np.testing.assert_array_equal(hand.points(hand.rest), direct.points(direct.rest))


@pytest.mark.parametrize("name", ["ur5_allegro", "human_left", "three_finger"])
def test_a_description_that_was_read_keeps_all_its_keys(
    name: str, tmp_path: Path
) -> None:
    """An arm, a mirrored hand, a path from the description's folder; and all optional keys."""
    spec = load_hand(name).spec
    spec = msgspec.structs.replace(
        spec,
        neutral_match=spec.rest,
        upright="+y up, -z forward",
        shapes={"a": (0, 0, 1)},
    )
    clues = chained_mimics().clues
    write_hand(Detection(spec, clues, (), {}), tmp_path / "hand.yaml")
    read = read_hand_spec(tmp_path / "hand.yaml")
    assert urdf_path(read).samefile(urdf_path(spec))
    for key in {*spec.__struct_fields__} - {"urdf", "arm", "directory", "file"}:
        assert getattr(read, key) == getattr(spec, key), key
    if spec.arm:
        assert read.arm == msgspec.structs.replace(spec.arm, directory=tmp_path)


def test_every_answer_has_its_evidence_in_the_file(tmp_path: Path) -> None:
    found = detect(DATA / "seven_fingers.urdf")
    text = " ".join(
        line.strip().lstrip("# ") for line in hand_text(found, tmp_path).splitlines()
    )
    for clue in found.clues:
        if clue.what not in ("thumb", "fingers"):
            assert clue.how in text, clue.what
    assert max(len(line) for line in hand_text(found, tmp_path).splitlines()) <= 132


def test_the_urdf_path_is_relative_or_a_package_path(tmp_path: Path) -> None:
    beside = tmp_path / "hand.urdf"
    beside.write_text((DATA / "one_finger.urdf").read_text())
    assert yaml.safe_load(hand_text(detect(beside), tmp_path))["urdf"] == "hand.urdf"
    packaged = detect(urdf_path(load_hand("allegro_right").spec))
    assert (
        yaml.safe_load(hand_text(packaged, tmp_path))["urdf"]
        == load_hand("allegro_right").spec.urdf
    )


def test_a_missing_speed_is_the_usual_one_of_the_urdf() -> None:
    text = (DATA / "chained_mimics.urdf").read_text()
    speeds = iter(["0", *["2.5"] * 99])
    text = re.sub(r'velocity="[^"]*"', lambda _: f'velocity="{next(speeds)}"', text)
    limits = detect(Path("hand.urdf"), text).spec.limits
    assert [limit.velocity for limit in limits.values()] == [2.5]


def test_a_file_that_exists_is_kept(tmp_path: Path) -> None:
    found = detect(DATA / "one_finger.urdf")
    (tmp_path / "hand.yaml").write_text("mine")
    with pytest.raises(InvalidInputError, match="exists already"):
        check_free(tmp_path / "hand.yaml", overwrite=False)
    check_free(tmp_path / "hand.yaml", overwrite=True)
    write_hand(found, tmp_path / "hand.yaml")
    assert load_hand(tmp_path / "hand.yaml").name == "one_finger"


# Models of other packages may overlap at rest; a left twin is described as its right hand is.
OWN = {name for name in hand_names() if hand_files()[name].name == "hand.yaml"}
OWN -= {name.replace("_right", "_left") for name in OWN if name.endswith("_right")}


@pytest.mark.slow
@pytest.mark.parametrize("name", rotated(sorted(OWN - set(HUMAN_HANDS)), 3))
def test_the_hands_of_the_package_pass_their_check(name: str) -> None:
    report = check_hand(name, has_motion=False)
    assert "error" not in levels(report)
    assert "warning" not in levels(report), [
        finding for finding in report.findings if finding.level == "warning"
    ]
    assert {"point", "span mm"} <= report.measured["Fingers"][0].keys()


WRONG: dict[str, tuple[dict[str, Any], str, str]] = {
    "palm turned over": (
        {"palm": {"link": "palm", "distal": [1, 0, 0], "dorsal": [0, 0, -1]}},
        "palm.dorsal",
        "0.000, 1.000",
    ),
    "distal across": (
        {"palm": {"link": "palm", "distal": [0, 1, 0], "dorsal": [0, 0, 1]}},
        "palm.distal",
        "1.000, 0.000, 0.000",
    ),
    "other side": ({"side": "left"}, "side", "side: right"),
    "in millimetres": (
        {
            "palm": {
                "link": "palm",
                "xyz": [-90, 0, 0],
                "distal": [1, 0, 0],
                "dorsal": [0, 0, 1],
            }
        },
        "palm.xyz",
        "metres",
    ),
    "closed at rest": (
        {"rest": {"z_j1": 0.48, "a_j1": 1.6, "c_j1": 0.6, "c_j2": 0.56}},
        "rest.a_j1",
        "inwards",
    ),
    "contradiction": (
        {"mimic": {"z_j2": {"joint": "z_j1", "multiplier": 1.0}}},
        "mimic",
        "correct the URDF",
    ),
}


def described(tmp_path: Path, change: dict[str, Any]) -> Path:
    document = yaml.safe_load(hand_text(chained_mimics(), tmp_path))
    (tmp_path / "hand.yaml").write_text(yaml.safe_dump({**document, **change}))
    return tmp_path / "hand.yaml"


@pytest.mark.parametrize(("change", "where", "advice"), WRONG.values(),
                         ids=WRONG.keys())  # fmt: skip
def test_a_mistake_is_found_with_advice(
    tmp_path: Path, change: dict[str, Any], where: str, advice: str
) -> None:
    report = check_hand(str(described(tmp_path, change)), has_motion=False)
    matching = [
        finding
        for finding in report.findings
        if finding.key == where and finding.level in ("warning", "advice")
    ]
    assert matching, report.findings
    assert any(advice in finding.change for finding in matching)


def test_fingers_in_the_wrong_order_are_found(tmp_path: Path) -> None:
    document = yaml.safe_load(hand_text(chained_mimics(), tmp_path))
    index, ring = document["points"][1], document["points"][3]
    index["link"], ring["link"] = ring["link"], index["link"]
    report = check_hand(
        str(described(tmp_path, {"points": document["points"]})), has_motion=False
    )
    wrong = {
        finding.key: finding.change
        for finding in report.findings
        if finding.level == "warning"
    }
    assert "finger: ring" in wrong["points.index_tip"]
    assert "finger: index" in wrong["points.ring_tip"]


def test_a_point_in_the_air_is_found(tmp_path: Path) -> None:
    points = yaml.safe_load(hand_text(chained_mimics(), tmp_path))["points"]
    points[1] |= {"link": "a_l3", "xyz": [0.0, 0.0, 0.1]}
    report = check_hand(str(described(tmp_path, {"points": points})), has_motion=False)
    (found,) = (finding for finding in report.findings if finding.level == "warning")
    # The bone is 14 mm thick: 100 - 7 mm.
    assert (found.key, "93 mm outside" in found.text) == ("points.index_tip", True)


@pytest.mark.parametrize(("speed", "count"), [(0.5, 8), (2.95, 3), (3.05, 0)])
def test_joints_too_slow_for_a_fist_are_found(speed: float, count: int) -> None:
    """Proximal joints of the three-fingered hand flex by 2.44 rad; a fist needs 1.5."""
    spec = load_hand("three_finger").spec
    upper = {joint: 1.4 for joint in spec.joints if "distal" in joint}
    limits = {j: LimitSpec(velocity=speed, upper=upper.get(j)) for j in spec.joints}
    spread = {
        j: LimitSpec(velocity=speed, lower=-1.0, upper=1.0)
        for j in limits
        if "spread" in j
    }
    hand = load_hand(msgspec.structs.replace(spec, limits=limits | spread))
    report = HandReport("hand")
    report.add(check_speeds(hand))
    if count == 0:
        assert report.findings == []
        return
    (found,) = report.findings
    assert found.level == "advice"
    assert found.key.removeprefix("limits.") in spec.joints
    assert f"at {speed:g} per second" in found.text
    assert found.text.startswith(f"{count} joints are too slow")


def test_a_description_that_cannot_be_used_is_an_error(tmp_path: Path) -> None:
    report = check_hand(str(described(tmp_path, {"wrist": {"link": "a_l1"}})))
    assert levels(report) == ["error"]
    assert report.hand is None
    with pytest.raises(HandError, match="wrist"):
        print_report(report, None, as_json=False)


def test_overlapping_links_are_found() -> None:
    hand = load_hand("human", points="fingertips")
    assert colliding_links(hand, hand.rest) == []
    crossed, middle = hand.rest.copy(), hand.joint_names.index("middle_MCP_abduction")
    crossed[middle] = hand.lower_limits[middle]
    pairs = colliding_links(hand, crossed)
    assert {frozenset(link.split("_")[0] for link in pair) for pair in pairs} == {
        frozenset({"middle", "ring"})
    }


def test_reach_is_that_of_a_planar_finger() -> None:
    """Return finger 1 of the three-fingered hand: two links of 50 mm in a plane."""
    hand = load_hand("three_finger", points="fingertips")
    first, second, _ = tables_of(check_reach(hand))["Fingers"]
    assert (first["moves in"][0], second["moves in"][0]) == ("2", "3")
    # Yoshikawa's measure of a planar arm of two links is l1 l2 |sin q2|.
    assert float(first["manipulability"]) == pytest.approx(
        0.05 * 0.05 * np.sin(hand.rest[1]), rel=5e-3
    )
    # Two positions of its tip are at most twice its length apart.
    assert 150.0 < first["span mm"] <= 200.0


def test_reach_of_a_hand_on_an_arm_is_that_of_the_hand() -> None:
    on_arm, alone = (
        tables_of(check_reach(load_hand(name, points="fingertips")))["Fingers"]
        for name in ("ur5_allegro", "allegro_right")
    )
    for one, other in zip(on_arm, alone, strict=True):
        assert one["moves in"] == other["moves in"]
        assert one["manipulability"] == other["manipulability"]
        # Both spans are estimated from random postures; the arm would add a metre.
        assert one["span mm"] == pytest.approx(other["span mm"], rel=0.05)


def test_a_human_hand_has_the_size_of_one() -> None:
    hand = load_hand("human", points="fingertips", hand_length=0.19)
    length, cloud, _ = (row["value"] for row in tables_of(check_size(hand))["Size"])
    # Bones are 0.990 of it, and straight fingers lean away from their metacarpals.
    assert float(length.split()[0]) == pytest.approx(190.0, abs=3.0)
    own, humans = cloud.split("; a person's: ")
    assert own == humans


def test_the_standard_motion_is_inside_the_human_limits_and_moves() -> None:
    human = load_hand("human")
    for name, posture in standard_postures(human).items():
        assert (posture >= human.lower_limits).all()
        assert (posture <= human.upper_limits).all()
        assert np.abs(posture - human.rest).max() > 0.3, name
    flat, fist = standard_postures(human)["flat hand"], standard_postures(human)["fist"]
    tips = load_hand("human", points="fingertips")
    assert tips.points(flat)[2, 1] > tips.points(fist)[2, 1] + 0.05


def assert_halves_show_something(path: Path) -> None:
    """Assert that both halves of a picture on white show something."""
    from matplotlib.image import imread

    for half in np.array_split(imread(path)[..., :3], 2, axis=1):
        assert 0.02 < (half.min(axis=2) < 0.9).mean() < 0.6


@pytest.fixture
def small_pictures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Draw a quarter of the pixels."""
    for module in (picture, scene):
        monkeypatch.setattr(module, "PANEL", (380, 410))


@pytest.mark.slow
@pytest.mark.usefixtures("small_pictures")
def test_a_picture_is_drawn_without_shapes(tmp_path: Path) -> None:
    text = "\n".join(
        line
        for line in (DATA / "chained_mimics.urdf").read_text().splitlines()
        if "<visual>" not in line and "<collision>" not in line
    )
    path = tmp_path / "hand.urdf"
    path.write_text(text)
    draw_hand(load_hand(detect(path, text).spec), tmp_path / "hand.png")
    assert_halves_show_something(tmp_path / "hand.png")


def test_pictures_lie_beside_their_descriptions(tmp_path: Path) -> None:
    assert picture_path(str(tmp_path / "mine.yaml"), "hand") == tmp_path / "mine.png"
    assert picture_path("three_finger", "hand") is None


@pytest.mark.slow
@pytest.mark.usefixtures("small_pictures")
def test_init_and_check_commands(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "new" / "hand.yaml"
    HandsInit(
        urdf=urdf_directory() / "three_finger" / "hand.urdf",
        name="mine",
        out=out,
        json=True,
    ).run()
    said = json.loads(capsys.readouterr().out)
    assert (said["name"], said["out"]) == ("mine", str(out))
    assert {"palm", "thumb", "side", "rest"} <= {row["what"] for row in said["found"]}
    HandsCheck(hand=str(out), json=True).run()
    report = json.loads(capsys.readouterr().out)
    assert len(report["A standard motion"]) == 5
    assert_halves_show_something(Path(report["picture"]))
    HandsCheck(hand="three_finger", motion=False).run()
    assert "findings" in capsys.readouterr().out
    (tmp_path / "broken.yaml").write_text("name: x")
    with pytest.raises(HandError, match="missing"):
        HandsCheck(hand=str(tmp_path / "broken.yaml")).run()


CLAW = """<mujoco model="claw"><compiler angle="radian"/><worldbody><body name="palm">
<geom type="box" size=".03 .04 .01"/>%s</body></worldbody></mujoco>"""
FINGER = """<body name="base_{0}" pos="{1} {2} 0" euler="0 0 {3}">
<joint name="flex_{0}" axis="-1 0 0" range="0 1.5"/>
<geom type="capsule" size=".008" fromto="0 0 0 0 .04 0"/>
<body name="end_{0}" pos="0 .04 0"><joint name="curl_{0}" axis="-1 0 0" range="0 1.5"/>
<geom type="capsule" size=".007" fromto="0 0 0 0 .03 0"/></body></body>"""


PLACES = {
    "index": (-0.03, 0.04, 0.0),
    "middle": (0.0, 0.04, 0.0),
    "ring": (0.03, 0.04, 0.0),
}


def write_claw(model: Path) -> None:
    fingers = [FINGER.format(name, *place) for name, place in PLACES.items()]
    thumb = FINGER.format("thumb", -0.03, -0.03, 1.2)
    model.write_text(CLAW % "".join([*fingers, thumb]))


def test_edit_of_an_mjcf_file_writes_nothing_before_it_saves(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    editor = pytest.importorskip("handmap_qp.apps.onboarding.editor")
    model = tmp_path / "scene.xml"
    write_claw(model)
    opened = []
    monkeypatch.setattr(editor, "showing", lambda *_, **__: nullcontext())
    monkeypatch.setattr(editor, "run_frames", lambda _: None)
    monkeypatch.setattr(
        editor,
        "HandEditor",
        lambda *given: opened.append(given) or SimpleNamespace(tick=None),
    )
    for _ in range(2):
        editor.HandsEdit(str(model)).run()
        assert [*tmp_path.iterdir()] == [model]
    _, found, out, *_ = opened[-1]
    write_hand(found, out)
    hand = load_hand(out)
    assert hand.spec.urdf == "scene.xml"
    assert "flex_thumb" in hand.joint_names


def test_init_takes_an_mjcf_file(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    model = tmp_path / "scene.xml"
    write_claw(model)
    out = tmp_path / "made" / "claw.yaml"
    HandsInit(model, side="right", out=out).run()
    printed = capsys.readouterr().out
    assert (
        f"wrote {out.parent / 'scene.urdf'}, with the kinematics of {model}" in printed
    )
    assert "MuJoCo has no speed limits: the URDF has 5 rad/s and 0.1 m/s" in printed
    hand = load_hand(out)
    assert hand.spec.urdf == "scene.urdf"
    assert set(hand.joint_names) == {
        f"{j}_{f}" for j in ("flex", "curl") for f in (*PLACES, "thumb")
    }
    model.unlink()
    assert load_hand(out).joint_names == hand.joint_names
    with pytest.raises(InvalidInputError, match="exists already"):
        HandsInit(model, out=out).run()
    with pytest.raises(InvalidInputError, match=r"ends in \.yaml"):
        HandsInit(model, out=tmp_path / "folder").run()
    assert not (tmp_path / "folder").exists()
    model.write_text("<mujoco/>")
    with pytest.raises(HandError, match="no joint moves"):
        HandsInit(model, out=tmp_path / "other" / "claw.yaml").run()
    assert not (tmp_path / "other").exists()


def test_a_conversion_that_moves_otherwise_than_mujoco_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mjcf = pytest.importorskip("handmap_qp.hands.mjcf")
    monkeypatch.setattr(mjcf, "kinematics_difference", lambda _: 1e-3)
    file = tmp_path / "arm.xml"
    file.write_text(
        "<mujoco><worldbody><body name='base'><body name='link' pos='0 0 .1'>"
        "<joint name='hinge'/><geom size='.01'/></body></body></worldbody></mujoco>"
    )
    with pytest.raises(HandError, match=r"differ from MuJoCo's by 1.0e-03 m"):
        open_source(file, tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["arm.xml"]


def test_a_recording_in_place_of_a_robot_is_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "hand.npz"
    np.savez(file, landmarks=np.zeros((2, 21, 3)))
    assert cli.main(["hands", "init", str(file)]) == 2
    said = capsys.readouterr().err
    assert "arrays (npz), such as a recording of a human hand" in said
    assert "handmap retarget FILE --robot HAND" in said
    assert said.count("\n") == 1
