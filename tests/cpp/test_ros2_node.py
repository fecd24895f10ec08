"""The node in C++ of `packages/ros2_cpp`, on stand-ins for rclcpp and the messages of ROS 2."""

from __future__ import annotations

import ast
import json
import re
import shutil
import subprocess
import xml.etree.ElementTree as ET
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from faulty_recordings import DEMO
from handmap_ros2 import bridge
from library_in_c import ROOT, run
from ros2_cases import COMMAND

from handmap_qp import Follower, HandMapper, HumanSample
from handmap_qp.se3 import Array, rotation_from_quat_wxyz

PACKAGE = ROOT / "packages" / "ros2_cpp"
PYTHON_NODE = ROOT / "packages" / "ros2" / "handmap_ros2" / "node.py"
STANDINS = ROOT / "tests" / "ros2" / "standins"
DRIVER = STANDINS / "drive_node.cpp"
SOURCES = sorted((PACKAGE / "src").glob("*.cpp"))
NODE = (PACKAGE / "src" / "hand_node.cpp").read_text("utf-8")
FOLDERS = [f"-I{STANDINS}", f"-I{PACKAGE / 'src'}"]
DT = 1.0 / 60.0


# -- what the package says


def test_its_parameters_are_those_of_the_node_in_python() -> None:
    declared = re.findall(r'declare_parameter<std::string>\("(\w+)", "([^"]*)"\)', NODE)
    (loop,) = (
        node.iter
        for node in ast.walk(ast.parse(PYTHON_NODE.read_text("utf-8")))
        if isinstance(node, ast.For) and "declare_parameter" in ast.unparse(node)
    )
    # There is no service whose address it would need.
    theirs = dict(ast.literal_eval(loop))
    del theirs["address"]
    assert dict(declared) == theirs
    file = yaml.safe_load((PACKAGE / "config" / "handmap.yaml").read_text("utf-8"))
    assert file["/**"]["ros__parameters"] == theirs


def test_its_services_are_those_of_the_node_in_python() -> None:
    former = {"clutch", "release"}
    assert {*re.findall(r'serve\("(\w+)"', NODE)} == {*bridge.SERVICES} - former


def test_the_package_names_what_it_includes() -> None:
    depends = ET.parse(PACKAGE / "package.xml").iter("depend")
    needed = {tag.text or "" for tag in depends}
    cmake = (PACKAGE / "CMakeLists.txt").read_text("utf-8")
    text = "".join(file.read_text("utf-8") for file in (PACKAGE / "src").iterdir())
    included = {*re.findall(r"#include <(\w+)/", text)} - {"handmap"}
    assert included == needed
    assert all(name in cmake for name in needed)
    # A stand-in has no name that no header of ROS has.
    headers = {*re.findall(r"#include <(\w+/[\w/.]+)>", text)}
    assert all((STANDINS / name).is_file() for name in headers if "handmap" not in name)


@pytest.mark.slow
@pytest.mark.parametrize("compiler", ["g++", "clang++"])
def test_each_compiler_takes_it_without_a_warning(compiler: str) -> None:
    if shutil.which(compiler) is None:
        pytest.skip(f"{compiler} is not installed")
    words = ["-std=c++17", "-fsyntax-only", "-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    for source in [*SOURCES, DRIVER]:
        run(compiler, *words, *FOLDERS, f"-I{ROOT / 'core' / 'include'}", source)


# -- what it does

Answers = list[dict[str, Any]]
Drive = Callable[..., Answers]


@pytest.fixture(scope="module")
def drive(
    prefix: Path, saved: bytes, tmp_path_factory: pytest.TempPathFactory
) -> Drive:
    """Return a function that drives a new node by lines, and returns its answers."""
    folder = tmp_path_factory.mktemp("node")
    hand, program = folder / "allegro.hand", folder / "drive_node"
    hand.write_bytes(saved)
    (library,) = prefix.glob("lib*/libhandmap.so")
    words = ["-std=c++17", "-O0", *FOLDERS, f"-I{prefix / 'include'}"]
    sources = [PACKAGE / "src" / "hand_node.cpp", DRIVER]
    linked = [library, f"-Wl,-rpath,{library.parent}", "-o", program]
    run("g++", *words, *sources, *linked)

    def answers_to(*lines: str, given: Path = hand) -> Answers:
        done = subprocess.run(
            [program, given],
            input="\n".join(lines) + "\n",
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return [json.loads(line) for line in done.stdout.splitlines()]

    return answers_to


def stamped(time: float) -> float:
    """Return a time as a stamp of ROS has it, in whole nanoseconds."""
    return int(time) + 1e-9 * int(1e9 * (time - int(time)))


def sample_at(i: int, time: float | None = None) -> str:
    """Return the request for sample `i` of the demo, which comes at a time [s]."""
    numbers = " ".join(f"{x:.17g}" for x in DEMO.landmarks[i].ravel())
    at = i * DT if time is None else time
    return f"landmarks {at:.17g} {stamped(DEMO.time[i]):.17g} {numbers}"


def joints(answers: Answers) -> Array:
    """Return the joint positions of each answer."""
    return np.array([answer["q"] for answer in answers])


@pytest.mark.slow
def test_it_commands_as_the_follower_in_python(
    drive: Drive, mapper: HandMapper
) -> None:
    answers = drive(*(sample_at(i) for i in range(120)))
    follower = Follower(deepcopy(mapper))
    for i, answer in enumerate(answers):
        sample = HumanSample(stamped(DEMO.time[i]), "right", DEMO.landmarks[i])
        step = follower.map_sample(sample, dt=DT, arrival=i * DT)
        np.testing.assert_allclose(answer["q"], step.command.q, atol=1e-9)
        assert answer["q"] == answer["trajectory"] == answer["forward"]
        assert answer["dt"] == pytest.approx(DT, abs=1e-8)
        assert tuple(answer["names"]) == mapper.robot.joint_names
        assert answer["status"] == ("released" if step.is_held else step.status)
        x, y, z, *turn = answer["wrist"]
        np.testing.assert_allclose((x, y, z), step.command.wrist[:3, 3], atol=1e-9)
        rotation = rotation_from_quat_wxyz(np.roll(turn, 1))
        np.testing.assert_allclose(rotation, step.command.wrist[:3, :3], atol=1e-9)
        assert (answer["commands"], answer["warnings"]) == (1, 0)


@pytest.mark.slow
def test_topics_are_those_of_the_node_in_python(drive: Drive) -> None:
    # The driver reads them by these names, and fails without a message.
    topics = {*bridge.messages_of(COMMAND, "hand_controller")}
    text = DRIVER.read_text("utf-8")
    assert {*re.findall(r'messages<[\w:]+>\(\s*"([\w/]+)"\)', text)} == topics
    assert drive(sample_at(0))[0]["commands"] == 1


@pytest.mark.slow
def test_silence_brakes_and_holds_and_is_reported(drive: Drive) -> None:
    moving = 45
    ticks = [f"tick {(moving + k) * DT:.17g}" for k in range(100)]
    answers = drive(*(sample_at(i) for i in range(moving)), *ticks)
    counts = [answer["commands"] for answer in answers[moving:]]
    # One command is missing at most: the node waits for three intervals.
    assert counts == [0] * counts.index(1) + [1] * (100 - counts.index(1))
    assert 1 <= counts.index(1) <= 4
    held = [answer for answer in answers[moving:] if answer["commands"]]
    before, at = joints(answers[moving - 2 : moving])
    first = held[0]
    scale = first["dt"] / DT
    assert scale <= 3.0 + 1e-6
    assert (
        np.abs(joints(held[:1])[0] - at) <= scale * np.abs(at - before) + 1e-9
    ).all()
    np.testing.assert_array_equal(joints(held[-50:]), joints(held[-1:] * 50))
    assert {answer["status"] for answer in held} <= {"released", "no landmarks come"}


@pytest.mark.slow
def test_before_the_first_sample_nothing_is_commanded(drive: Drive) -> None:
    answers = drive("tick 0.5", "tick 1.5", "call 1.6 stop", "tick 1.7")
    assert [answer["commands"] for answer in answers] == [0] * 4
    assert (answers[1]["level"], answers[1]["status"]) == (2, "no landmarks come")
    assert answers[2]["answer"] == "done"


@pytest.mark.slow
@pytest.mark.xfail(reason="after clear and engage, the node holds on: cause unknown")
def test_a_stop_lasts_until_it_is_cleared_and_engaged(drive: Drive) -> None:
    def part(first: int, last: int) -> list[str]:
        return [sample_at(i) for i in range(first, last)]

    answers = drive(
        *part(0, 45),
        f"call {44.5 * DT:.17g} stop",
        f"call {44.5 * DT:.17g} engage",
        *part(45, 100),
        f"call {99.5 * DT:.17g} clear",
        *part(100, 110),
        f"call {109.5 * DT:.17g} engage",
        *part(110, 140),
    )
    stop, engage, stopped = answers[45], answers[46], answers[47:102]
    assert (stop["answer"], stop["commands"], stop["status"]) == ("done", 1, "stopped")
    assert "call clear first" in engage["answer"]
    before, at = joints(answers[43:45])
    braked = joints([stop])[0]
    assert (np.abs(braked - at) <= 0.5 * np.abs(at - before) + 1e-9).all()
    assert {(a["status"], a["level"]) for a in stopped} == {("stopped", 1)}
    clear, cleared, again = answers[102], answers[103:113], answers[114:]
    assert clear["answer"] == "done"
    still = joints(stopped[-1:])
    assert {a["status"] for a in cleared} == {"released"}
    np.testing.assert_array_equal(joints(cleared), np.repeat(still, 10, axis=0))
    assert answers[113]["answer"] == "done"
    assert again[-1]["status"] != "released"
    assert not np.array_equal(joints(again[-1:]), still)


@pytest.mark.slow
def test_a_late_sample_moves_the_robot_no_farther_than_three_intervals(
    drive: Drive, mapper: HandMapper
) -> None:
    answers = drive(*(sample_at(i) for i in range(40)), sample_at(90, 1000.0))
    last = answers[-1]
    assert last["dt"] <= 3.0 * DT + 1e-6
    moved = np.abs(np.diff(joints(answers[-2:]), axis=0))[0]
    assert (moved <= mapper.robot.velocity_limits * 3.0 * DT + 1e-9).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("request_", "commands", "warnings"),
    [
        (f"landmarks {20 * DT} 0.3", 1, 0),  # the hand is not seen
        (f"landmarks {20 * DT} 0.3 1 2 3", 0, 1),
        (f"landmarks {20 * DT} 0.3" + " 1e30" * 63, 0, 1),
        (f"call {20 * DT} clear", 0, 0),
    ],
)
def test_input_that_cannot_be_used_is_reported_and_changes_nothing(
    request_: str, commands: int, warnings: int, drive: Drive
) -> None:
    plain = drive(*(sample_at(i) for i in range(20)))
    *_, answer = drive(*(sample_at(i) for i in range(20)), request_)
    assert (answer["commands"], answer["warnings"]) == (commands, warnings)
    if commands:
        assert answer["status"] == "released"
    if request_.startswith("call"):
        assert answer["answer"] == "no stop is in force"
    *_, after = drive(*(sample_at(i) for i in range(20)), request_, sample_at(20))
    *_, judge = drive(*(sample_at(i) for i in range(21)))
    if not commands:
        np.testing.assert_array_equal(after["q"], judge["q"])
    assert len(plain) == 20


@pytest.mark.slow
def test_a_file_that_is_no_hand_ends_the_node_in_one_line(
    drive: Drive, tmp_path: Path
) -> None:
    wrong = tmp_path / "wrong.hand"
    wrong.write_bytes(b"nothing")
    for file, said in (
        (wrong, "expected a saved hand"),
        (tmp_path / "missing", "cannot be read"),
    ):
        with pytest.raises(AssertionError, match=f"parameter robot.*{said}"):
            drive(given=file)
