"""`handmap_run`: a saved hand follows as `handmap_qp` does, without what that needs."""

from __future__ import annotations

import copy
import json
import os
import pkgutil
import subprocess
import sys
import tomllib
import zlib
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
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
    SOURCES,
    both_hands,
    difference,
    expected_columns,
    mapper_of,
    recording_with,
    robot_mapper_of,
    write_case,
)

import handmap_qp
from handmap_qp import (
    Follower,
    HandMapper,
    HumanSample,
    IkOptions,
    Teleoperation,
    load_hand,
)
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.errors import HandError, InvalidOptionsError
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


ROBOTS = {"g1": "teleoperation", "ur5_pair": "paper"}
PINCH = next(both_hands())


def test_it_follows_alone_as_the_library_does(site: Path, tmp_path: Path) -> None:
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
    variables = {"PATH": os.environ["PATH"], "PYTHONPATH": str(site)}
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
def saved(site: Path, tmp_path: Path) -> Path:
    """Save the first case, whose samples are the demo's."""
    write_case(tmp_path, "case", mapper_of(*CASES[0]), recording_with(""))
    return tmp_path / "case.hand"


def test_both_packages_are_in_one_process(saved: Path) -> None:
    import handmap_run

    follower = handmap_run.load(saved)
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


@pytest.fixture(scope="module")
def g1() -> RobotMapper:
    return robot_mapper_of("g1", "teleoperation", PINCH, turns_in=1.0)


@pytest.fixture
def saved_robot(site: Path, g1: RobotMapper, tmp_path: Path) -> Path:
    """Save a robot with two hands."""
    write_case(tmp_path, "robot", g1, *PINCH.values())
    return tmp_path / "robot.hand"


@pytest.mark.parametrize("rates", [(60.0, 60.0), (60.0, 45.0)])
def test_a_saved_robot_keeps_its_limits_by_time_stamps(
    site: Path, tmp_path: Path, rates: tuple[float, float]
) -> None:
    import handmap_run
    from handmap_run.saving import saved

    most = 30.0
    ik = get_preset("teleoperation").ik.replaced(max_acceleration=most)
    mapper = RobotMapper(load_robot("g1"), HUMANS, "teleoperation", ik=ik)
    file = tmp_path / "g1.hand"
    file.write_bytes(saved(mapper))
    follower, other = handmap_run.load_robot(file), RobotFollower(mapper)
    # Hands in turns; one is away for .2 s.
    events = without(in_turns(rates, 1.0), "right", 0.5, 0.7)
    q, expected = [], []
    for samples in samples_of(events):
        own = {
            side: handmap_run.HumanSample(each.time, side, each.landmarks)
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
    import handmap_run

    both: list[Any] = [
        handmap_run.load_robot(saved_robot),
        RobotFollower(copy.deepcopy(g1)),
    ]
    kinds = handmap_run.HumanSample, HumanSample

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
    for each in both:
        each.mapper.configure(ik=each.mapper.ik.replaced(rest_weight=0.1))
    follow(43, "left", "right")


def test_a_recording_is_followed_in_one_go(saved: Path) -> None:
    import handmap_run
    from handmap_run.human import Recording as Columns

    recording = recording_with(FAULTS[1])
    table = Follower(mapper_of(*CASES[0])).map_samples(recording)
    columns = Columns(**asdict(recording))
    found = handmap_run.load(saved).map_samples(columns)
    # The last column is CPU time.
    np.testing.assert_allclose(found.rows[:, :-1], table.rows[:, :-1], atol=1e-12)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: b"", "another or a damaged file"),
        (lambda content: content[:-100], "another or a damaged file"),
        (lambda content: b"PK" + content, "another or a damaged file"),
        (
            lambda content: content[:-900] + b"?" + content[-899:],
            "damaged; copy it again",
        ),
        (
            lambda content: content.replace(b"0.2.0", b"0.1.9", 1),
            "of version 0.1.9, expected 0.2.0",
        ),
        (
            lambda content: content.replace(b"form\x01", b"form\x09", 1),
            "of form 9, expected 2 or less; install a newer handmap-run",
        ),
    ],
    ids=["empty", "torn", "other", "damaged", "version", "form"],
)
def test_another_file_is_refused(
    saved: Path, change: Callable[[bytes], bytes], said: str
) -> None:
    import handmap_run

    saved.write_bytes(change(saved.read_bytes()))
    with pytest.raises(handmap_run.HandError, match=said) as error:
        handmap_run.load(saved)
    assert error.value.file == saved


def test_what_reads_a_file_is_said(saved: Path, saved_robot: Path) -> None:
    import handmap_run

    with pytest.raises(handmap_run.HandError, match="one hand; load reads it"):
        handmap_run.load_robot(saved)
    with pytest.raises(handmap_run.HandError, match="two hands; load_robot reads it"):
        handmap_run.load(saved_robot)


def test_a_file_of_the_first_version_is_read(saved: Path) -> None:
    import handmap_run

    content = msgspec.msgpack.decode(saved.read_bytes())
    # It did not name its form.
    del content["form"]
    tree = msgspec.msgpack.decode(content["body"], ext_hook=msgspec.msgpack.Ext)
    for hand in ("human", "robot"):
        del tree[hand]["has_floating_base"]
    content["body"] = msgspec.msgpack.encode(tree)
    content["checksum"] = zlib.crc32(content["body"])
    saved.write_bytes(msgspec.msgpack.encode(content))
    sample = handmap_run.HumanSample(0.0, "right", DEMO.landmarks[0])
    assert not handmap_run.load(saved).map_sample(sample).is_held


def test_other_names_are_of_another_version(saved: Path) -> None:
    import handmap_run
    from handmap_run.form import File, decode
    from handmap_run.models import encode

    file = msgspec.msgpack.decode(saved.read_bytes(), type=File)
    tree = decode(file.body)
    del tree["robot"]["tree_model"]
    body = encode(tree)
    file = msgspec.structs.replace(file, body=body, checksum=zlib.crc32(body))
    saved.write_bytes(msgspec.msgpack.encode(file))
    with pytest.raises(
        handmap_run.HandError, match=r"does not fit this version.*tree_model"
    ):
        handmap_run.load(saved)


def test_wrong_samples_leave_the_hand_where_it_is(saved: Path) -> None:
    import handmap_run

    follower = handmap_run.load(saved)
    landmarks = DEMO.landmarks[0]
    first = follower.map_sample(handmap_run.HumanSample(0.0, "right", landmarks))
    hole = landmarks.copy()
    hole[3, 1] = np.nan
    for wrong, argument in (
        ((0.1, "right", hole), "landmarks"),
        ((0.1, "right", landmarks[:20]), "landmarks"),
        ((np.nan, "right", landmarks), "time"),
        ((0.1, "left", landmarks), "side"),
        ((0.1, "right", landmarks, 2.0 * np.eye(4)), "wrist"),
    ):
        with pytest.raises(handmap_run.InvalidInputError) as error:
            follower.map_sample(handmap_run.HumanSample(*wrong))
        assert error.value.argument == argument
    for wrong in (landmarks, None, {"right": first}):
        with pytest.raises(handmap_run.InvalidInputError, match="a HumanSample"):
            follower.map_sample(wrong)
    motion = follower.mapper.motion
    np.testing.assert_array_equal(
        motion.q[follower.mapper.robot.q_indices], first.command.q
    )


def test_wrong_arguments_are_found_at_once(saved: Path, saved_robot: Path) -> None:
    import handmap_run

    for load, file in (
        (handmap_run.load, saved),
        (handmap_run.load_robot, saved_robot),
    ):
        wrong: Any = "x"
        with pytest.raises(handmap_run.InvalidInputError, match=r"smoothing: .*'x'"):
            load(file, smoothing=wrong)
        with pytest.raises(
            handmap_run.InvalidOptionsError, match=r"rejoin: .*glide, clutch"
        ):
            load(file, rejoin=wrong)
    follower = handmap_run.load_robot(saved_robot)
    sample = handmap_run.HumanSample(0.0, "right", DEMO.landmarks[0])
    cases: tuple[tuple[Any, str], ...] = (
        (sample, "samples: expected a HumanSample of each hand"),
        ({"left": DEMO.landmarks[0]}, "sample: expected a HumanSample"),
        ({"left": sample}, "side: expected samples of a left hand"),
        ({"middle": sample}, "side: expected left and right"),
        ({}, "hands: expected a sample of one at least"),
    )
    for samples, said in cases:
        with pytest.raises(handmap_run.InvalidInputError, match=said):
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
    site: Path, options: dict[str, Any], option: str
) -> None:
    from handmap_run.saving import saved

    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("three_finger"), **options)
    with pytest.raises(InvalidOptionsError) as error:
        saved(mapper)
    assert error.value.option == option


def test_the_command_tells_whether_a_hand_has_changed(
    site: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    project = tomllib.loads((SOURCES / "pyproject.toml").read_text())["project"]
    import handmap_run

    assert project["version"] == handmap_run.__version__ == handmap_qp.__version__
    points = project["entry-points"]["handmap_qp.commands"]
    command = pkgutil.resolve_name(points["hands save"])
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
    words = [str(SOURCES / "loop.py"), str(saved), str(saved.with_suffix(".right.npz"))]
    variables = {"PATH": os.environ["PATH"], "PYTHONPATH": os.pathsep.join(sys.path)}
    out = subprocess.check_output([sys.executable, *words], env=variables, text=True)
    assert out.startswith(" 0.00 s")
    assert len(out.splitlines()) == 5


def test_a_wrist_need_not_be_the_root(site: Path, tmp_path: Path) -> None:
    import handmap_run

    robot = load_hand("three_finger")
    robot._wrist_to_root = pin.SE3.Random()
    human = load_hand("human", points="landmarks")
    write_case(tmp_path, "case", HandMapper(human, robot), recording_with(""))
    own = handmap_run.load(tmp_path / "case.hand").mapper.robot
    wrist = pin.SE3.Random().homogeneous
    expected = robot.configuration_vector(robot.rest, wrist)
    found = own.configuration_vector(robot.rest, wrist)
    # Both signs of a quaternion are one rotation.
    expected[3:7] *= np.sign(expected[3:7].dot(found[3:7]))
    np.testing.assert_allclose(found, expected, atol=1e-12)
