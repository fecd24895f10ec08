"""A method, a task, a layout, a format and a command of another package, each in one file.

Python, command line, wire and view know their names without another change.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.slow

METHOD = """
from typing import Annotated

import numpy as np

from handmap_qp import IkOptions, TaskRows
from handmap_qp.mapping.method import MethodOptions, Preset, Targets
from handmap_qp.options import number


class Follow(MethodOptions, frozen=True):
    \"\"\"The robot keeps its posture, and its wrist follows by a share.

    Attributes:
        wrist_share: Share of the wrist's way.
    \"\"\"

    wrist_share: Annotated[float, number(0.0, 1.0)] = 0.5

    def bind(self, human, robot):
        return Bound(self, robot)


class Bound:
    contacts, renews_reference = None, False
    needs_wrist, reference_needs_wrist = "the wrist's way", ""

    def __init__(self, options, robot):
        self.options, self.robot = options, robot

    def start_palm(self, sample):
        return np.eye(4)

    def start(self, sample, robot):
        return Map(self.options, sample, robot)


class Map:
    def __init__(self, options, sample, robot):
        self.rest, self._options, self._sample, self._robot = robot.q, options, sample, robot

    def targets(self, sample):
        shift = self._options.wrist_share * (sample.wrist - self._sample.wrist)[:3, 3]
        wrist = self._robot.wrist.copy()
        wrist[:3, 3] += shift
        return Targets(self._robot.points + shift, wrist, {"shift": shift})


PRESET = Preset(Follow(), IkOptions(), "the wrist alone", "fingers stay")
BROKEN = Follow()


class KeepTip:
    \"\"\"Keeps the first point at a height.\"\"\"

    def linearise(self, hand):
        height = np.array([1000.0 * (hand.points[0, 2] - 0.02)])
        return TaskRows(height, 1000.0 * hand.point_jacobian()[2:3])


def keep_tip(hand):
    return KeepTip()
"""
LAYOUT = """
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.trackers.layouts.angles import AngleEntry, AngleLayout

LAYOUT = AngleLayout(
    name="glove",
    title="A glove of ten joints",
    sources=("its manual",),
    unit="deg",
    axes="none",
    values="10 angles",
    arrays=("glove",),
    angles=tuple(AngleEntry(joint, joint) for joint in HUMAN_JOINTS[::2]),
)
"""
FORMAT = """
import json

import numpy as np

from handmap_qp.trackers.formats.base import Entry, RecordingFormat, build_recording


class JsonFormat(RecordingFormat):
    name, suffixes, about = "json", (".json",), "one hand as JSON"
    lacks = ("wrist", "confidence", "source")

    def entries(self, path):
        content = json.loads(path.read_text())
        return (Entry("", content["side"], len(content["time"])),)

    def read(self, path, entry):
        content = json.loads(path.read_text())
        return build_recording(path, entry, content["time"], np.array(content["landmarks"]))

    def write(self, recordings, path):
        self.check_one_per_hand(recordings)
        (one,) = recordings
        content = {"side": one.side, "time": one.time.tolist()}
        path.write_text(json.dumps(content | {"landmarks": one.landmarks.tolist()}))


FORMAT = JsonFormat()
"""
COMMAND = """
from dataclasses import dataclass


@dataclass(frozen=True)
class Greet:
    \"\"\"Greet a robot.

    Attributes:
        name: Its name.
    \"\"\"

    name: str

    def run(self):
        print(f"good day, {self.name}")
"""
ENTRY_POINTS = """[handmap_qp.commands]
greet = added_command:Greet
gone = added_command:Gone
demo = added_command:Greet
[handmap_qp.presets]
follow = added_method:PRESET
broken = added_method:BROKEN
[handmap_qp.tasks]
keep-tip = added_method:keep_tip
[handmap_qp.layouts]
glove = added_layout:LAYOUT
[handmap_qp.formats]
json = added_format:FORMAT
"""
PROGRAM = """
import numpy as np
import viser
from handmap_qp import HandMapper, IkOptions, load_hand
from handmap_qp.mapping.presets import PRESETS, preset_choice
from handmap_qp.apps.viewer.controls import SteeringControls
from service_tools import make_session, Sampler

human, robot = load_hand("human"), load_hand("three_finger")
mapper = HandMapper(human, robot, "follow")
pose = np.eye(4)
first = mapper.map_step(human.rest, pose, dt=1.0)
pose[0, 3] = 0.02
step = mapper.map_step(human.rest, pose, dt=1.0)
np.testing.assert_allclose(step.diagnostics["shift"], [0.01, 0.0, 0.0])
np.testing.assert_allclose(step.command.wrist[0, 3] - first.command.wrist[0, 3], 0.01, atol=1e-4)
assert list(PRESETS)[-1] == "follow"
height = lambda names: HandMapper(human, robot, "follow", ik=IkOptions(tasks=names)).map_step(
    human.rest, np.eye(4), dt=1.0
).points[0, 2]
assert abs(height(())) > 0.03 > 0.025 > abs(height(("keep-tip",)))
session, sample = make_session(preset="follow", options={"wrist_share": 0.25}), Sampler()
session.step(sample(), 0.0)
about = session.state(1, "", 0, 0.0).about
assert (about.preset, about.options) == ("follow", {"wrist_share": 0.25})
server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
controls = SteeringControls(server, preset_choice("follow"), ("follow",))
assert controls.controls["wrist_share"].handle.max == 1.0
server.stop()

from handmap_qp import load_layout, read_recording
from handmap_qp.trackers.formats import DEMO_FILE, write_recordings

demo = read_recording(DEMO_FILE, "right")
assert "the words about the source" in write_recordings([demo], "demo.json")
np.testing.assert_array_equal(read_recording("demo.json").landmarks, demo.landmarks)

layout = load_layout("glove")
assert layout.read(np.full(10, 5.0), time=0.0, side="right").valid
session = make_session(input="landmarks", hand_length=0.19, layout="glove")
step = session.step(sample(0.0, wrist=None, landmarks=None, values=(5.0,) * 10), 0.0)
assert (session.state(2, "", 0, 0.0).about.layout, step.rule) == ("glove", "")
print("all well")
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Install a package with one of each, and return the environment that finds it."""
    folder = tmp_path_factory.mktemp("site")
    for name, text in {
        "method": METHOD,
        "layout": LAYOUT,
        "format": FORMAT,
        "command": COMMAND,
    }.items():
        (folder / f"added_{name}.py").write_text(text)
    metadata = folder / "added_method-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(
        "Metadata-Version: 2.1\nName: added-method\nVersion: 1.0\n"
    )
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    root = Path(__file__).resolve().parents[2]
    paths = [str(folder), str(root), str(root / "tests" / "support")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def test_python_the_wire_and_the_view_know_them(
    environment: dict[str, str], tmp_path: Path
) -> None:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(
        command,
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.stdout.strip().splitlines()[-1:], done.returncode) == (
        ["all well"],
        0,
    ), done.stderr


MAP = "map demo --robot three_finger"
GLOVE = "map glove.npz --layout glove --robot three_finger --side right"
LINES = (
    (f"{MAP} --preset follow --wrist-share 0.25", 0, "wrote"),
    (
        f"{MAP} --preset follow --wrist-share 2",
        2,
        "--wrist-share: expected a number in [0",
    ),
    (
        f"{MAP} --preset paper --wrist-share 0.25",
        2,
        "Homogeneous has no such option",
    ),
    (f"{MAP} --help", 0, "Share of the wrist's way."),
    ("convert demo::right demo.json", 0, "wrote demo.json"),
    ("map demo.json --robot three_finger --out out.npz", 0, "wrote out.npz"),
    ("convert --help", 0, ",json}"),
    ("layouts glove", 0, "A glove of ten joints"),
    ("layouts", 0, "glove"),
    (GLOVE, 0, "wrote"),
    (f"{GLOVE} --ik.tasks keep-tip --ik.formulation mink --ik.solver osqp", 0, "wrote"),
    (f"{MAP} --ik.tasks juggle", 2, "expected keep-tip"),
    ("--help", 0, "greet Greet a robot."),
    ("greet --name leap", 0, "good day, leap"),
    ("greet --nam leap", 2, "--name"),
    ("greed", 2, "greet"),
    ("--help", 0, "gone the command gone of added_command:Gone cannot be loaded"),
    ("gone", 2, "cannot be loaded"),
    ("demo --help", 0, "Map a human hand's motion"),
    ("--completion bash", 0, "greet"),
)
COMMANDS = """
import contextlib, io, json, sys
import numpy as np
from handmap_qp.cli import main

angles = 30.0 + 20.0 * np.sin(np.arange(30)[:, None] / 5.0 + np.arange(10))
np.savez("glove.npz", time=np.arange(30) / 60.0, glove=angles)
for line in json.loads(sys.argv[1]):
    with contextlib.redirect_stdout(io.StringIO()) as page, contextlib.redirect_stderr(page):
        try:
            code = main(line.split())
        except SystemExit as end:
            code = end.code
    print(json.dumps([code, " ".join(page.getvalue().split())]))
"""


def test_the_command_line_knows_them(
    environment: dict[str, str], tmp_path: Path
) -> None:
    # One process for all: importing takes most of the time.
    lines = json.dumps([line for line, _, _ in LINES])
    command = [sys.executable, "-c", COMMANDS, lines]
    done = subprocess.run(
        command,
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    answers = map(json.loads, done.stdout.splitlines())
    for (line, code, text), (found, page) in zip(LINES, answers, strict=True):
        assert (found, text in page) == (code, True), (line, page)


def test_one_that_cannot_be_used_is_named_in_one_line(
    environment: dict[str, str],
) -> None:
    program = "from handmap_qp import PRESETS; PRESETS['broken']"
    command = [sys.executable, "-c", program]
    done = subprocess.run(
        command, env=environment, capture_output=True, text=True, check=False
    )
    assert "PluginError" in done.stderr
    assert "added_method:BROKEN" in done.stderr
