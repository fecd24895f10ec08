"""Weights of joints: a waist moves less than an arm where both can, and where it must, it does."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from meeting_hands import meeting_hands
from msgspec.structs import replace

from handmap_qp import Hand, HandMapper, Teleoperation, cli, load_hand
from handmap_qp.apps.offline.leaning import measure_leaning
from handmap_qp.errors import HandError
from handmap_qp.hands.library import hand_files
from handmap_qp.hands.robot import load_robot, read_robot_spec, robot_files
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.reference import PublishedMethod
from handmap_qp.trackers import save_npz

WAIST = {"waist_yaw_joint", "waist_roll_joint", "waist_pitch_joint"}


def weighted(weight: float) -> Hand:
    """Return the robot G1 with a weight of its waist."""
    spec = read_robot_spec(robot_files()["g1"])
    return load_robot(replace(spec, joint_weights=dict.fromkeys(WAIST, weight)))


def lean_and_error(robot: Hand) -> tuple[float, float]:
    """Return how far the waist bends, and the wrists' error, medians of a motion [rad, m]."""
    hands = meeting_hands()
    humans = {side: scaled_human(each) for side, each in hands.items()}
    people = {side: human.with_points("landmarks") for side, human in humans.items()}
    preset = get_preset("teleoperation")
    method = preset.method.replaced(alignment="world")
    mapper = RobotMapper(robot, people, method, ik=preset.ik)
    bent, errors = [], []
    for k in range(0, len(hands["left"]), 2):
        landmarks = {side: each.landmarks[k] for side, each in hands.items()}
        step = mapper.map_landmarks(landmarks, dt=1.0 / 30.0)
        away = np.abs(step.command.q - robot.rest)
        bent.append(away[robot.carries_limbs].max())
        errors.append([each.wrist_error[0] for each in step.hands.values()])
    return float(np.median(bent)), float(np.median(errors))


def write_half(folder: Path) -> Path:
    """Write a robot.yaml with G1's left hand alone, and return its path."""
    left = robot_files()["g1"].parent / "left.yaml"
    file = folder / "robot.yaml"
    file.write_text(
        f"name: half\nhands: {{left: {{hand: {left}}}}}\n", encoding="utf-8"
    )
    return file


def test_a_waist_stays_up_where_arms_can_do_it() -> None:
    usual, same = (lean_and_error(robot) for robot in (load_robot("g1"), weighted(1.0)))
    assert usual[0] < 0.3 * same[0]
    # Palms are as near as before.
    assert usual[1] < same[1] + 1e-3


def test_a_heavy_joint_stands_still() -> None:
    bent, _ = lean_and_error(weighted(1e4))
    assert bent < 1e-3


def test_what_carries_another_limb_is_a_waist() -> None:
    robot = load_robot("g1")
    found = {
        name
        for name, carries in zip(robot.joint_names, robot.carries_limbs, strict=True)
        if carries
    }
    assert found == WAIST
    np.testing.assert_array_equal(robot.joint_weights[~robot.carries_limbs], 1.0)
    assert (robot.joint_weights[robot.carries_limbs] > 10.0).all()
    # One hand of it, whose other arm is locked, has the same waist.
    alone = load_hand(robot_files()["g1"].parent / "left.yaml")
    named = zip(alone.joint_names, alone.carries_limbs, strict=True)
    assert {name for name, carries in named if carries} == WAIST
    # An arm that carries a hand alone has none, and neither has a hand that floats.
    for name in ("ur5_allegro", "allegro_right"):
        assert not load_hand(name).carries_limbs.any()


def test_a_description_says_weights() -> None:
    spec = load_hand("ur5_allegro").spec
    (first, *_) = spec.all_joints
    hand = load_hand(replace(spec, joint_weights={first: 5.0}))
    expected = [5.0 if name == first else 1.0 for name in hand.joint_names]
    np.testing.assert_array_equal(hand.joint_weights, expected)


@pytest.mark.parametrize(
    ("weights", "said"),
    [
        ({"absent": 2.0}, "'absent' is not one of `joints`"),
        ({"joint_0": 0.0}, "joint_weights"),
        ({"joint_0": -1.0}, "joint_weights"),
        ({"joint_0": 1e200}, "joint_weights"),
        ({"joint_0": "heavy"}, "joint_weights"),
    ],
)
def test_wrong_weights_are_one_line(
    weights: dict[str, object], said: str, tmp_path: Path
) -> None:
    content = yaml.safe_load(hand_files()["allegro_right"].read_text(encoding="utf-8"))
    joint = content["joints"][0]
    named = {joint if key == "joint_0" else key: at for key, at in weights.items()}
    file = tmp_path / "hand.yaml"
    content["joint_weights"] = named
    file.write_text(yaml.safe_dump(content), encoding="utf-8")
    with pytest.raises(HandError, match=said) as caught:
        load_hand(file)
    assert caught.value.file == file
    assert "\n" not in str(caught.value)


def test_a_robot_with_one_hand_has_its_waist(tmp_path: Path) -> None:
    robot = load_robot(write_half(tmp_path))
    is_waist = np.isin(robot.joint_names, [*WAIST])
    np.testing.assert_array_equal(robot.joint_weights > 10.0, is_waist)


def test_a_robots_weight_overrules_those_of_its_hands(tmp_path: Path) -> None:
    files = {}
    for side in ("left", "right"):
        content = yaml.safe_load(
            (robot_files()["g1"].parent / f"{side}.yaml").read_text(encoding="utf-8")
        )
        content["joint_weights"] = {"waist_yaw_joint": 3.0, "waist_roll_joint": 4.0}
        files[side] = tmp_path / f"{side}.yaml"
        files[side].write_text(yaml.safe_dump(content), encoding="utf-8")
    file = tmp_path / "robot.yaml"
    hands = "{left: {hand: left.yaml}, right: {hand: right.yaml}}"
    weights = "{waist_roll_joint: 7.0}"
    file.write_text(
        f"name: two\nhands: {hands}\njoint_weights: {weights}\n", encoding="utf-8"
    )
    robot = load_robot(file)
    by_name = dict(zip(robot.joint_names, robot.joint_weights.tolist(), strict=True))
    assert by_name["waist_yaw_joint"] == 3.0
    assert by_name["waist_roll_joint"] == 7.0


def test_a_robots_wrong_weight_names_its_own_file() -> None:
    spec = read_robot_spec(robot_files()["g1"])
    with pytest.raises(HandError, match="not one of the robot's joints") as caught:
        load_robot(replace(spec, joint_weights={"tail": 2.0}))
    assert caught.value.file == spec.file
    assert caught.value.value == "tail"


def test_the_published_method_weighs_joints_alike() -> None:
    spec = load_hand("g1_arm_left").spec
    weights = dict(zip(spec.all_joints, np.linspace(0.5, 20.0, 30), strict=False))
    robot = load_hand(replace(spec, joint_weights=weights))
    preset = get_preset("teleoperation")
    ik = preset.ik.replaced(max_acceleration=60.0, takes_detours=False)
    assert isinstance(preset.method, Teleoperation)
    human = load_hand("human_left", points="landmarks")
    by_core = HandMapper(human, robot, preset.method, ik=ik)
    published = HandMapper(
        human,
        robot,
        PublishedMethod(preset.method),
        ik=ik.replaced(formulation="direct"),
    )
    hands = meeting_hands()
    for k in range(0, 200, 20):
        one, other = (
            mapper.map_landmarks(hands["left"].landmarks[k], dt=0.1)
            for mapper in (by_core, published)
        )
        np.testing.assert_allclose(one.command.q, other.command.q, atol=1e-8)


def test_a_robot_with_one_hand_leans_as_one_whose_other_arm_is_still(
    tmp_path: Path,
) -> None:
    whole, half = load_robot("g1"), load_robot(write_half(tmp_path))
    alone = load_hand(robot_files()["g1"].parent / "left.yaml")
    shares = np.linspace(0.0, 1.0, 11)[:, None]
    moved = alone.rest + shares * (alone.upper_limits - alone.rest)
    by_name = dict(zip(alone.joint_names, moved.T, strict=True))
    found = []
    for robot in (alone, half, whole):
        # The other arm, which only the whole robot has, stays at rest.
        q = np.tile(robot.rest, (len(shares), 1))
        for i, name in enumerate(robot.joint_names):
            q[:, i] = by_name.get(name, q[:, i])
        found.append(measure_leaning(robot, q))
    for leaning in found:
        assert {*leaning.joints} == WAIST
        assert leaning.bent_share == pytest.approx(1 / len(shares))
        assert leaning.median == pytest.approx(found[0].median)
        rows = {row["joint"]: row["most"] for row in leaning.rows}
        for name in WAIST:
            i = alone.joint_names.index(name)
            expected = alone.upper_limits[i] - alone.rest[i]
            assert rows[name] == pytest.approx(expected)


def test_what_a_torso_slides_is_in_millimetres() -> None:
    robot = load_robot("tiago_dual")
    (torso,) = np.flatnonzero(robot.carries_limbs)
    q = np.tile(robot.rest, (3, 1))
    q[:, torso] += [0.0, 0.01, 0.02]
    leaning = measure_leaning(robot, q)
    assert leaning.median == pytest.approx(10.0)
    assert leaning.bent_share == 0.0
    # An arm that carries a hand alone cannot lean.
    arm = load_hand("ur5_allegro")
    still = measure_leaning(arm, arm.rest[None])
    assert still.rows == []
    assert np.isnan([still.median, still.bent_share]).all()


@pytest.mark.slow
def test_retarget_says_how_far_a_robot_with_one_hand_leans(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    # A narrow terminal breaks the row.
    monkeypatch.setenv("COLUMNS", "200")
    robot = str(write_half(tmp_path))
    made = meeting_hands()["left"].part(slice(None, None, 6))
    recording = tmp_path / "left.npz"
    save_npz(
        recording,
        {
            "time": made.time,
            # A wrist at z = 0 would be one of a picture.
            "landmarks": made.landmarks + np.array([0.0, 0.0, 1.0]),
            "handedness": np.array("left"),
        },
    )
    # Its own hand's recording is enough, and one of both hands has it.
    for words in ([str(recording)], ["demo"]):
        out = str(tmp_path / "out.npz")
        assert cli.main(["retarget", *words, "--robot", robot, "--out", out]) == 0
        printed = capsys.readouterr().out
        (row,) = [line for line in printed.splitlines() if "leans" in line]
        assert all(joint in row for joint in WAIST)
    wrong = ["retarget", "demo::right", "--robot", robot, "--out", out]
    assert cli.main(wrong) == 2
    assert "right hand" in capsys.readouterr().err
