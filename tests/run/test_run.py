"""`handmap_core.run`: a saved hand follows as `handmap_qp` does, without what that needs."""

from __future__ import annotations

import copy
import json
import os
import subprocess
import sys
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from pickle import dumps, loads
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from faulty_recordings import DEMO
from grip_cases import HUMAN as GRIPPING
from grip_cases import grip_follower, pick, run
from limit_judge import HUMANS, in_turns, judge, samples_of, without
from run_cases import (
    ALONE,
    FAULTS,
    ROOT,
    both_hands,
    difference,
    expected_columns,
    mapper_of,
    recording_with,
    robot_mapper_of,
    write_case,
)

from handmap_core.hands import Hand as HandProtocol
from handmap_core.run import load
from handmap_core.run import load_robot as load_saved_robot
from handmap_qp import (
    Follower,
    HandMapper,
    HumanSample,
    IkOptions,
    Teleoperation,
    load_hand,
)
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.apps.saving.cli import HandsSave
from handmap_qp.errors import HandError, InvalidInputError, InvalidOptionsError
from handmap_qp.hands import Side, load_robot
from handmap_qp.mapping import RobotMapper, get_preset
from handmap_qp.stream import RobotFollower

pytestmark = pytest.mark.slow
CASES = [
    ("three_finger", "teleoperation"),
    ("three_finger", "object"),
    ("three_finger", "paper"),
    ("panda_gripper", "teleoperation"),
    ("dex3_right", "teleoperation"),
    ("dex3_right", "picking"),
]


LOOP = ROOT / "examples" / "12_robot_computer.py"
ROBOTS = {"g1": "teleoperation", "ur5_pair": "paper"}
PINCH = next(both_hands())


def test_it_follows_alone_as_the_library_does(tmp_path: Path) -> None:
    # Every fault with one hand, and every hand and method with one fault.
    cases = {f"fault{i}": (*CASES[0], fault) for i, fault in enumerate(FAULTS)}
    cases |= {f"hand{i}": (*case, FAULTS[1]) for i, case in enumerate(CASES)}
    mappers: dict[str, Any] = {}
    for name, (robot, preset, fault) in cases.items():
        mappers[name] = mapper_of(robot, preset)
        write_case(tmp_path, name, mappers[name], recording_with(fault))
    squeezing = get_preset("teleoperation")
    mappers["squeeze"] = HandMapper(
        load_hand("human", points="landmarks"),
        load_hand("allegro_right"),
        Teleoperation(squeeze=3.0),
        ik=squeezing.ik,
    )
    write_case(tmp_path, "squeeze", mappers["squeeze"], recording_with(""))
    for name, preset in ROBOTS.items():
        mappers[name] = robot_mapper_of(name, preset, PINCH)
        write_case(tmp_path, name, mappers[name], *PINCH.values())
    # A pick whose joints stay behind: the hand grips.
    mappers["grip"] = HandMapper(GRIPPING, load_hand("allegro_right"), "teleoperation")
    write_case(tmp_path, "grip", mappers["grip"], pick(opens=True))
    ran = run(grip_follower(load_hand("allegro_right")), opens=True)
    np.save(tmp_path / "grip.measured.npy", [measured for _, measured in ran])
    words = [sys.executable, str(ALONE), str(tmp_path)]
    variables = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
    done = subprocess.run(
        words, env=variables, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    said = set()
    for name, mapper in mappers.items():
        expected = expected_columns(tmp_path, name, mapper)
        with np.load(tmp_path / f"{name}.out.npz") as archive:
            found = dict(archive)
        # Redundant arms amplify rounding.
        allowed = 1e-9 if name in ROBOTS else 1e-12
        assert difference(found, expected) <= allowed, (name, cases.get(name))
        said |= {*found["said"][:, 2]}
        assert found["effort"].any() == (name == "grip")
    assert len(said) > 4, said
    assert {"numpy", "msgspec"} <= {*json.loads(done.stdout)["modules"]}


@pytest.fixture
def saved(tmp_path: Path) -> Path:
    """Save the first case, whose samples are the demo's."""
    write_case(tmp_path, "case", mapper_of(*CASES[0]), recording_with(""))
    return tmp_path / "case.hand"


def test_both_packages_are_in_one_process(saved: Path) -> None:
    follower = load(saved)
    other = Follower(mapper_of(*CASES[0]))
    q = follower.mapper.human.rest
    # Copies go on by themselves, and joint angles are read as well.
    for each in (copy.deepcopy(follower), follower):
        given = each.mapper.map_step(q, np.eye(4), dt=0.02)
        expected = copy.deepcopy(other).mapper.map_step(q, np.eye(4), dt=0.02)
        assert type(given) is type(expected)
        np.testing.assert_allclose(given.command.q, expected.command.q, atol=1e-12)
        assert given.status == expected.status
        assert given.ik.iterations == expected.ik.iterations


@pytest.mark.parametrize("way", [copy.deepcopy, lambda one: loads(dumps(one))])
def test_a_copy_has_what_is_read_only(saved: Path, way: Callable[[Any], Any]) -> None:
    follower = load(saved)
    both = [follower, way(follower)]
    for each in both:
        hand = each.mapper.robot
        arrays = [getattr(hand, name) for name in ("rest", "spread", "finger_joints")]
        assert not any(array.flags.writeable for array in arrays)
    for i in range(3):
        found, expected = (each.map_sample(DEMO.sample(i)).command for each in both)
        np.testing.assert_array_equal(found.q, expected.q)
        np.testing.assert_array_equal(found.wrist, expected.wrist)
    assert both[0].mapper.motion.time == both[1].mapper.motion.time


@pytest.fixture(scope="module")
def g1() -> RobotMapper:
    return robot_mapper_of("g1", "teleoperation", PINCH, turns_in=1.0)


@pytest.fixture
def saved_robot(g1: RobotMapper, tmp_path: Path) -> Path:
    """Save a robot with two hands."""
    write_case(tmp_path, "robot", g1, *PINCH.values())
    return tmp_path / "robot.hand"


@pytest.mark.parametrize("rates", [(60.0, 60.0), (60.0, 45.0)])
def test_a_saved_robot_keeps_its_limits_by_time_stamps(
    tmp_path: Path, rates: tuple[float, float]
) -> None:
    most = 30.0
    ik = get_preset("teleoperation").ik.replaced(max_acceleration=most)
    mapper = RobotMapper(load_robot("g1"), HUMANS, "teleoperation", ik=ik)
    file = tmp_path / "g1.hand"
    file.write_bytes(saved_bytes(mapper))
    follower, other = load_saved_robot(file), RobotFollower(mapper)
    # Hands in turns; one is away for .2 s.
    events = without(in_turns(rates, 1.0), "right", 0.5, 0.7)
    q, expected = [], []
    for samples in samples_of(events):
        own = {
            side: HumanSample(each.time, side, each.landmarks)
            for side, each in samples.items()
        }
        q.append(follower.map_samples(own).command.q)
        expected.append(other.map_samples(samples).command.q)
    worst = judge(mapper.robot, [event.time for event in events], q)
    assert 0.9 < worst.speed <= 1.0 + 1e-6
    assert 0.9 * most < worst.acceleration <= most * (1.0 + 1e-6)
    np.testing.assert_allclose(q, expected, atol=1e-9)


def test_a_robot_goes_on_as_that_of_the_library(
    saved_robot: Path, g1: RobotMapper
) -> None:
    both: list[Any] = [
        load_saved_robot(saved_robot),
        RobotFollower(copy.deepcopy(g1)),
    ]
    kinds = HumanSample, HumanSample

    def follow(i: int, *sides: Side) -> None:
        found, expected = (
            each.map_samples(
                {side: kind(**asdict(PINCH[side].sample(i))) for side in sides}
            )
            for each, kind in zip(both, kinds, strict=True)
        )
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=1e-9)
        assert found.status == expected.status
        assert [*found.hands] == [*expected.hands]

    for i in range(40):
        follow(i, "left", "right")
    both = copy.deepcopy(both)
    # The other hand has asked before the copy, and the palms are near each other.
    follow(40, "left")
    for name in ("release", "clutch"):
        for each in both:
            getattr(each.mapper, name)()
        for i in (41, 42):
            follow(i, "left", "right")


def test_a_recording_is_followed_in_one_go(saved: Path) -> None:
    recording = recording_with(FAULTS[1])
    table = Follower(mapper_of(*CASES[0])).map_samples(recording)
    found = load(saved).map_samples(recording)
    # The last column is CPU time.
    np.testing.assert_allclose(found.rows[:, :-1], table.rows[:, :-1], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: b"", "another or a damaged file"),
        (lambda content: content[:-100], "another or a damaged file"),
        (lambda content: b"PK" + content, "another or a damaged file"),
        (
            lambda content: content.replace(b"handmap hand", b"\xffandmap hand", 1),
            "another or a damaged file",
        ),
        (lambda content: b"\x91" * 100_000, "another or a damaged file"),
        (
            lambda content: content[:-900] + b"?" + content[-899:],
            "damaged; copy it again",
        ),
        (
            lambda content: content.replace(b"0.2.0", b"0.1.9", 1),
            "of version 0.1.9, expected 0.2.0",
        ),
        (
            lambda content: content.replace(b"form\x09", b"form\x0b", 1),
            "of form 11, expected 10 or less; install a newer handmap-core",
        ),
    ],
    ids=["empty", "torn", "other", "text", "nested", "damaged", "version", "form"],
)
def test_another_file_is_refused(
    saved: Path, change: Callable[[bytes], bytes], said: str
) -> None:
    saved.write_bytes(change(saved.read_bytes()))
    with pytest.raises(HandError, match=said) as error:
        load(saved)
    assert error.value.file == saved


def test_what_reads_a_file_is_said(saved: Path, saved_robot: Path) -> None:
    with pytest.raises(HandError, match="one hand; load reads it"):
        load_saved_robot(saved)
    with pytest.raises(HandError, match="two hands; load_robot reads it"):
        load(saved_robot)


@pytest.mark.parametrize(
    "form", [None, 1, 2, 3, 4], ids=["unnamed", "1", "2", "3", "4"]
)
def test_a_file_of_a_former_form_says_how_to_save_it_again(
    saved: Path, form: int | None
) -> None:
    content = msgspec.msgpack.decode(saved.read_bytes())
    del content["form"]
    content |= {} if form is None else {"form": form}
    saved.write_bytes(msgspec.msgpack.encode(content))
    with pytest.raises(HandError, match=r"of form [1-4], .* save it again"):
        load(saved)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda tree: tree["robot"].pop("model"), "`model`"),
        (lambda tree: tree["robot"]["model"].pop("nq"), "`nq`"),
        (lambda tree: tree["robot"].update(side="middle"), "side"),
        (lambda tree: tree["robot"].update(joint_names=[]), "does not fit"),
        (lambda tree: tree["settings"]["ik"].update(damping=-1.0), "damping"),
        (lambda tree: tree["method"].update(type="other"), "type"),
        (lambda tree: tree["robot"]["grasp"][0].update(joint=999), "does not fit"),
        (lambda tree: tree["method"]["model"].update(human_points=3), "does not fit"),
    ],
    ids=["record", "field", "side", "joints", "options", "method", "pad", "targets"],
)
def test_fields_of_another_version_are_refused(
    saved: Path, change: Callable[[dict[str, Any]], object], said: str
) -> None:
    content = msgspec.msgpack.decode(saved.read_bytes())
    tree = msgspec.msgpack.decode(content["body"])
    change(tree)
    content["body"] = msgspec.msgpack.encode(tree)
    content["checksum"] = zlib.crc32(content["core"], zlib.crc32(content["body"]))
    saved.write_bytes(msgspec.msgpack.encode(content))
    with pytest.raises(HandError, match=said) as error:
        load(saved)
    assert error.value.file == saved
    assert "save it again" in str(error.value)


def test_wrong_samples_leave_the_hand_where_it_is(saved: Path) -> None:
    follower = load(saved)
    landmarks = DEMO.landmarks[0]
    first = follower.map_sample(HumanSample(0.0, "right", landmarks))
    hole = landmarks.copy()
    hole[3, 1] = np.nan
    for wrong, argument in (
        ((0.1, "right", hole), "landmarks"),
        ((0.1, "right", landmarks[:20]), "landmarks"),
        ((np.nan, "right", landmarks), "time"),
        ((0.1, "left", landmarks), "side"),
        ((0.1, "right", landmarks, 2.0 * np.eye(4)), "wrist"),
    ):
        with pytest.raises(InvalidInputError) as error:
            follower.map_sample(HumanSample(*wrong))
        assert error.value.argument == argument
    others: tuple[Any, ...] = (landmarks, None, {"right": first})
    for wrong in others:
        with pytest.raises(InvalidInputError, match="a HumanSample"):
            follower.map_sample(wrong)
    motion = follower.mapper.motion
    np.testing.assert_array_equal(
        motion.q[follower.mapper.robot.q_indices], first.command.q
    )


def test_wrong_arguments_are_found_at_once(saved: Path, saved_robot: Path) -> None:
    for load_it, file in (
        (load, saved),
        (load_saved_robot, saved_robot),
    ):
        wrong: Any = "x"
        with pytest.raises(InvalidInputError, match=r"smoothing: .*'x'"):
            load_it(file, smoothing=wrong)
        with pytest.raises(InvalidOptionsError, match=r"rejoin: .*glide, clutch"):
            load_it(file, rejoin=wrong)
    follower = load_saved_robot(saved_robot)
    sample = HumanSample(0.0, "right", DEMO.landmarks[0])
    cases: list[tuple[Any, str]] = [
        (sample, "samples: expected a HumanSample of each hand"),
        ({"left": DEMO.landmarks[0]}, "sample: expected a HumanSample"),
        ({"left": sample}, "side: expected samples of a left hand"),
        ({"middle": sample}, "side: expected left and right"),
        ({}, "hands: expected a sample of one at least"),
    ]
    for samples, said in cases:
        with pytest.raises(InvalidInputError, match=said):
            follower.map_samples(samples)
    follower.map_samples({"right": sample})


@pytest.mark.parametrize(
    ("options", "option"),
    [
        ({"method": "fingertip-vectors"}, "method"),
        ({"ik": IkOptions(solver="proxqp")}, "formulation"),
        ({"ik": IkOptions(formulation="direct")}, "formulation"),
        ({"tasks": [object()]}, "tasks"),
    ],
)
def test_what_python_alone_does_is_not_saved(
    options: dict[str, Any], option: str
) -> None:
    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("three_finger"), **options)
    with pytest.raises(InvalidOptionsError) as error:
        saved_bytes(mapper)
    assert error.value.option == option


def test_the_command_tells_whether_a_hand_has_changed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    command = HandsSave
    out = tmp_path / "my.hand"
    command("three_finger", out).run()
    command("three_finger", out, check=True).run()
    assert "is up to date" in capsys.readouterr().out
    for changed in (
        command("three_finger", out, side="left", check=True),
        command("panda_gripper", out, check=True),
        command("g1", out, check=True),
        command("three_finger", out, check=True, arguments=MappingArguments("object")),
    ):
        with pytest.raises(HandError, match="have changed"):
            changed.run()


def test_the_loop_of_the_page_runs(saved: Path) -> None:
    words = [str(LOOP), str(saved), str(saved.with_suffix(".right.npz"))]
    variables = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
    out = subprocess.check_output([sys.executable, *words], env=variables, text=True)
    assert out.startswith(" 0.00 s")
    assert len(out.splitlines()) == 5


ATTRIBUTES = [
    name for name, value in vars(HandProtocol).items() if isinstance(value, property)
]
KINEMATIC = {"tree", "model", "point_frames", "wrist_frame", "palm_frame"}
"""Compared by what is computed with them."""


def check_equal(found: Any, expected: Any, name: str) -> None:
    """Check that two attributes of hands are equal, points and hands by their names."""
    if isinstance(expected, np.ndarray):
        np.testing.assert_allclose(found, expected, atol=1e-12, err_msg=name)
    elif name in ("hands", "parts"):
        assert [hand.name for hand in found] == [hand.name for hand in expected], name
    elif name == "reference_points":
        places = [(point.name, point.link, point.xyz) for point in found]
        assert places == [(each.name, each.link, each.xyz) for each in expected]
    elif name == "rules":
        assert [*found] == [*expected]
    else:
        assert found == expected, name


def check_same_hand(found: HandProtocol, expected: HandProtocol) -> None:
    """Check that a saved hand has all attributes of the one that was saved."""
    assert len(ATTRIBUTES) > 25
    for name in {*ATTRIBUTES} - KINEMATIC - {"unscaled"}:
        check_equal(getattr(found, name), getattr(expected, name), name)


@pytest.mark.parametrize("name", ["shadow_right", "inspire_right", "ur5_allegro"])
def test_a_saved_hand_has_what_the_hand_has(tmp_path: Path, name: str) -> None:
    mapper = mapper_of(name, "teleoperation")
    write_case(tmp_path, "case", mapper, recording_with(""))
    own = load(tmp_path / "case.hand").mapper
    check_same_hand(own.robot, mapper.robot)
    check_same_hand(own.human, mapper.human)


def test_a_saved_robot_has_what_the_robot_has(
    saved_robot: Path, g1: RobotMapper
) -> None:
    own = load_saved_robot(saved_robot).mapper
    check_same_hand(own.robot, g1.robot)
    for side, source in own.sources.items():
        check_same_hand(source.robot, g1.sources[side].robot)
    # It walks.
    own.base_pose = np.eye(4)


def test_a_robot_whose_options_alone_keep_links_apart(tmp_path: Path) -> None:
    ik = get_preset("object").ik.replaced(avoids_self_collision=True)
    mapper = RobotMapper(load_robot("g1"), HUMANS, "object", ik=ik)
    file = tmp_path / "g1.hand"
    file.write_bytes(saved_bytes(mapper))
    follower = load_saved_robot(file)
    assert [*follower.mapper.pinching] == [*mapper.pinching] == []
    library = RobotFollower(mapper)
    # Python maps first samples, and those of one hand.
    turns: list[tuple[Side, ...]] = [("left", "right"), ("left",), ("right",)]
    for i, sides in enumerate(4 * turns):
        samples = {side: PINCH[side].sample(i) for side in sides}
        found, expected = (
            each.map_samples(samples).command for each in (follower, library)
        )
        np.testing.assert_allclose(found.q, expected.q, atol=1e-9)


def test_settings_are_saved(tmp_path: Path) -> None:
    mapper = HandMapper(
        load_hand("human", points="landmarks"),
        load_hand("three_finger"),
        preset="teleoperation",
        scale=0.5,
        avoids_contact=False,
        ik=IkOptions(damping=0.7),
        dt=0.02,
        joint_tolerance=0.1,
        quat_order="xyzw",
    )
    write_case(tmp_path, "case", mapper, recording_with(FAULTS[1]))
    follower = load(tmp_path / "case.hand")
    own = follower.mapper
    assert own.ik == mapper.ik
    assert own.dt == mapper.dt
    assert own.joint_tolerance == mapper.joint_tolerance
    assert own.quat_order == mapper.quat_order
    library = Follower(mapper)
    for i in range(30):
        sample = DEMO.sample(i)
        found = follower.map_sample(sample)
        expected = library.map_sample(sample)
        np.testing.assert_allclose(found.command.q, expected.command.q, atol=1e-12)
        wrist = expected.command.wrist
        np.testing.assert_allclose(found.command.wrist, wrist, atol=1e-12)
        assert found.asked.margins is expected.asked.margins is None


@pytest.mark.parametrize("name", ["three_finger", "shadow_right", "allegro_right"])
def test_a_saved_hand_is_where_its_wrist_is(tmp_path: Path, name: str) -> None:
    robot = load_hand(name)
    human = load_hand("human", points="landmarks")
    write_case(tmp_path, "case", HandMapper(human, robot), recording_with(""))
    mapper = load(tmp_path / "case.hand").mapper
    own = mapper.robot
    robot = HandMapper(human, robot).robot
    wrist = pin.SE3.Random().homogeneous
    expected = robot.configuration_vector(robot.rest, wrist)
    found = own.configuration_vector(robot.rest, wrist)
    # Both signs of a quaternion are one rotation.
    expected[3:7] *= np.sign(expected[3:7].dot(found[3:7]))
    np.testing.assert_allclose(found, expected, atol=1e-12)
    one, other = robot.configuration(), own.configuration()
    for placed in (one, other):
        placed.place(expected)
    np.testing.assert_allclose(other.points, one.points, atol=1e-12)
    np.testing.assert_allclose(other.data.J, one.data.J, atol=1e-12)
    np.testing.assert_allclose(other.point_jacobian(), one.point_jacobian(), atol=1e-12)
    np.testing.assert_allclose(
        other.wrist.homogeneous, one.wrist.homogeneous, atol=1e-12
    )
    np.testing.assert_allclose(
        own.points(robot.rest, wrist), robot.points(robot.rest, wrist), atol=1e-12
    )
