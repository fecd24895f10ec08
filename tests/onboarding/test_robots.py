"""`handmap hands init` finds both hands of a robot; `handmap robots` lists, shows, checks it."""

from __future__ import annotations

import json
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
import yaml
from made_hands import two_hands_mjcf
from marks import full
from PIL import Image

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding import cli as onboarding
from handmap_qp.apps.onboarding.check import check_robot
from handmap_qp.apps.onboarding.describe import list_robots
from handmap_qp.apps.onboarding.detect import detect, detect_hands
from handmap_qp.cli import main
from handmap_qp.hands.robot import load_robot, robot_files
from handmap_qp.hands.sources import package_folder
from handmap_qp.hands.spec import read_hand_spec

pytestmark = pytest.mark.slow

ROBOTS = package_folder("example-robot-data") / "robots"
G1 = ROBOTS / "g1_description" / "urdf" / "g1_29dof_with_hand_rev_1_0.urdf"
INSTALLED = [row["name"] for row in list_robots() if row["available"] == "yes"]


@pytest.mark.parametrize(
    ("urdf", "palms"),
    [
        (G1, ("left_hand_palm_link", "right_hand_palm_link")),
        (ROBOTS / "romeo_description/urdf/romeo.urdf", ("l_wrist", "r_wrist")),
        # Its base has wheels, which branch like fingers.
        (ROBOTS / "tiago_description/robots/tiago_dual.urdf",
         ("hand_left_palm_link", "hand_right_palm_link")),
        (ROBOTS / "talos_data/robots/talos_full_v2.urdf",
         ("gripper_left_base_link", "gripper_right_base_link")),
        (ROBOTS / "alex_description/urdf/alex_psyonic_hands.urdf",
         ("Left_thumb_base", "Right_thumb_base")),
        (ROBOTS / "pr2_description/urdf/pr2.urdf",
         ("l_gripper_palm_link", "r_gripper_palm_link")),
    ],
    ids=["g1", "romeo", "tiago", "talos", "alex", "pr2"],
)  # fmt: skip
def test_both_palms_of_a_robot_are_found(urdf: Path, palms: tuple[str, str]) -> None:
    left, right = detect_hands(urdf)
    assert (left.spec.palm.link, right.spec.palm.link) == palms
    assert left.spec.name.removesuffix("left") == right.spec.name.removesuffix("right")
    assert (left.spec.side, right.spec.side) == ("left", "right")
    assert left.spec.root is None


def test_both_are_what_each_is_alone() -> None:
    for found in detect_hands(G1):
        root = f"{found.spec.side}_hand_palm_link"
        alone = detect(G1, root=root, base="pelvis")
        assert alone == found


def test_one_palm_of_a_robot_is_chosen_by_its_root_or_side() -> None:
    (found,) = detect_hands(G1, root="left_hand_palm_link")
    assert found == detect(G1, root="left_hand_palm_link")
    with pytest.raises(HandError, match=r"2 possible palms: .*choose one with --root"):
        detect_hands(G1, side="left")


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder into which `hands init` wrote G1, beside a hand that is none of its."""
    folder = tmp_path_factory.mktemp("g1")
    (folder / "hand.yaml").write_text("name: another", encoding="utf-8")
    with chdir(folder):
        assert main(["hands", "init", str(G1), "--name", "g1"]) == 0
    return folder


def test_it_writes_a_robot_and_its_hands(written: Path) -> None:
    assert {file.name for file in written.iterdir()} == {
        "hand.yaml",
        "left.yaml",
        "right.yaml",
        "robot.yaml",
    }
    assert (written / "hand.yaml").read_text(encoding="utf-8") == "name: another"
    robot = load_robot(written / "robot.yaml")
    assert robot.name == "g1"
    assert len(robot.by_side["left"].joint_names) == 3 + 2 * 14
    assert len(load_hand(written / "left.yaml").joint_names) == 3 + 14


def test_the_robot_of_the_package_is_what_it_writes(written: Path) -> None:
    for name in ("left.yaml", "right.yaml", "robot.yaml"):
        packaged = robot_files()["g1"].with_name(name)
        own, theirs = (
            yaml.safe_load(file.read_text(encoding="utf-8"))
            for file in (written / name, packaged)
        )
        # That it walks is what a person adds.
        assert theirs.pop("base", "floating") == "floating"
        assert own == theirs
    spec = read_hand_spec(written / "left.yaml")
    assert spec.collision is not None
    assert {name for pair in spec.collision.pairs for name in pair} <= {
        link for link in load_hand(spec).urdf_text.split('"') if link.startswith("left")
    }


def test_files_that_exist_are_kept(
    written: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = {file.name: file.read_bytes() for file in written.iterdir()}
    arguments = ["hands", "init", str(G1), "--out", str(written / "robot.yaml")]
    assert main(arguments) == 2
    assert "robot.yaml exists already" in capsys.readouterr().err
    assert {file.name: file.read_bytes() for file in written.iterdir()} == before


def test_init_says_what_it_found_as_json(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "two.xml").write_text(two_hands_mjcf(), encoding="utf-8")
    out, words = tmp_path / "robot.yaml", ["hands", "init", str(tmp_path / "two.xml")]
    assert main([*words, "--out", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["out"] == str(out)
    assert [hand["name"] for hand in said["hands"]] == [
        f"{said['name']}_left",
        f"{said['name']}_right",
    ]
    assert {row["what"] for row in said["hands"][0]["found"]} >= {"palm", "side"}


def test_a_robot_in_mjcf_is_converted_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "two.xml").write_text(two_hands_mjcf(), encoding="utf-8")
    out = tmp_path / "own" / "hand.yaml"
    assert main(["hands", "init", str(tmp_path / "two.xml"), "--out", str(out)]) == 0
    printed = capsys.readouterr().out
    assert printed.count("with the kinematics of") == 1
    robot = load_robot(out.with_name("robot.yaml"))
    assert robot.name == "two"
    left, right = (hand.moves_wrist for hand in robot.by_side.values())
    names = np.array(robot.by_side["left"].joint_names)
    assert names[left & right].tolist() == ["torso_joint"]
    assert names[left ^ right].tolist() == [
        f"{side}_{part}_joint" for side in ("left", "right") for part in ("arm", "palm")
    ]


def test_two_hands_of_one_side_get_those_of_their_names(tmp_path: Path) -> None:
    (tmp_path / "two.xml").write_text(two_hands_mjcf(1.0), encoding="utf-8")
    words = ["hands", "init", str(tmp_path / "two.xml")]
    assert main([*words, "--out", str(tmp_path / "hand.yaml")]) == 0
    for side in ("left", "right"):
        spec = read_hand_spec(tmp_path / f"{side}.yaml")
        assert (spec.side, spec.palm.link) == (side, f"{side}_palm")


def test_the_list_names_all_robots(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "list", "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["name"] for row in rows] == [*robot_files()]


def test_show_names_the_joints_by_part(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "show", "g1", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["base"] == "pelvis"
    parts = {row["joint"]: row["part"] for row in said["joints"]}
    assert parts["waist_yaw_joint"] == "shared"
    assert parts["left_elbow_joint"] == "left arm"
    assert parts["right_hand_thumb_0_joint"] == "right hand"
    assert {row["side"] for row in said["hands"]} == {"left", "right"}


def test_check_draws_the_robot(
    written: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    # A quarter of the picture's size.
    monkeypatch.setattr("handmap_qp.apps.onboarding.picture.PANEL", (190, 205))
    monkeypatch.setattr("handmap_qp.apps.drawing.scene.PANEL", (190, 205))
    file = str(written / "robot.yaml")
    assert main(["robots", "check", file, "--no-motion", "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {row["level"] for row in said["findings"]} <= {"advice", "fine"}
    keys = {row["key"].partition(":")[0] for row in said["findings"]}
    assert keys == {"left", "right", "rest"}
    with Image.open(said["picture"]) as picture:
        assert picture.format == "PNG"
        assert len(set(picture.convert("L").tobytes())) > 50


# The suite checks one robot of another kind than G1, which another test checks and draws.
@pytest.mark.parametrize(
    "name", [name if name == "ur5_pair" else full(name) for name in INSTALLED]
)
def test_the_robots_of_the_package_pass_their_check(name: str) -> None:
    report = check_robot(name, has_motion=False)
    assert report.findings[0].level in ("advice", "fine"), report.findings


def test_a_contradiction_ends_with_exit_code_1(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Arms in each other: both palms are in the same place."""
    # Another test looks at the picture.
    monkeypatch.setattr(onboarding, "draw_robot", lambda *_: None)
    text = robot_files()["ur5_pair"].read_text(encoding="utf-8")
    text = text.replace(
        "left.yaml", str(robot_files()["ur5_pair"].parent / "left.yaml")
    )
    file = tmp_path / "robot.yaml"
    file.write_text(text.replace("-0.35", "0.3").replace("0.35", "0.3"))
    with pytest.raises(SystemExit) as end:
        main(["robots", "check", str(file), "--no-motion"])
    assert end.value.code == 1
    printed = capsys.readouterr().out
    assert "overlap" in printed
    assert "move the arms apart" in printed


def test_a_robot_that_cannot_be_loaded_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for command in ("show", "check"):
        assert main(["robots", command, str(tmp_path / "robot.yaml")]) == 2
        printed = capsys.readouterr()
        assert printed.out == ""
        assert printed.err.count("\n") == 1
