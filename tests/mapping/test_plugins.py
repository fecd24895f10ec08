"""A method and a task of another package: Python, command line, wire and view know their names."""

from __future__ import annotations

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
    \"\"\"The robot keeps its posture, and its wrist follows by a share.\"\"\"

    wrist_share: Annotated[float, number("Share of the wrist's way.", 0.0, 1.0)] = 0.5

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
ENTRY_POINTS = """[handmap_qp.presets]
follow = added_method:PRESET
broken = added_method:BROKEN

[handmap_qp.tasks]
keep-tip = added_method:keep_tip
"""
PROGRAM = """
import numpy as np
import viser
from handmap_qp import HandMapper, IkOptions, load_hand
from handmap_qp.mapping.presets import PRESETS, preset_choice
from handmap_qp.viewer.option_controls import OptionControls
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
controls = OptionControls(server, preset_choice("follow"))
assert controls.handles["wrist_share"].max == 1.0
server.stop()
print("all well")
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Install a package with a method, and return the environment that finds it."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "added_method.py").write_text(METHOD)
    metadata = folder / "added_method-1.0.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: added-method\nVersion: 1.0\n")
    (metadata / "entry_points.txt").write_text(ENTRY_POINTS)
    root = Path(__file__).resolve().parents[2]
    paths = [str(folder), str(root), str(root / "tests")]
    return os.environ | {"PYTHONPATH": os.pathsep.join(paths)}


def test_python_the_wire_and_the_view_know_it(environment: dict[str, str]) -> None:
    command = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert (done.stdout.strip().splitlines()[-1:], done.returncode) == (["all well"], 0), (
        done.stderr
    )


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["--preset", "follow", "--wrist-share", "0.25"], 0, "wrote"),
        (["--preset", "follow", "--wrist-share", "2"], 2, "--wrist-share: expected a number in [0"),
        (["--preset", "paper", "--wrist-share", "0.25"], 2, "the preset paper has no such option"),
        (["--help"], 0, "Share of the wrist's way."),
        (["--ik.tasks", "keep-tip", "--ik.formulation", "mink", "--ik.solver", "osqp"], 0, "wrote"),
        (["--ik.tasks", "juggle"], 2, "expected keep-tip"),
    ],
    ids=["runs", "range", "another preset", "help", "task by mink", "no such task"],
)
def test_the_command_line_knows_it(
    environment: dict[str, str], tmp_path: Path, words: list[str], code: int, text: str
) -> None:
    command = [sys.executable, "-m", "handmap_qp.cli", "map", "demo", "--robot", "three_finger"]
    done = subprocess.run(
        [*command, *words],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == code, done.stderr
    assert text in " ".join((done.stdout + done.stderr).split())


def test_one_that_cannot_be_used_is_named_in_one_line(environment: dict[str, str]) -> None:
    program = "from handmap_qp import PRESETS; PRESETS['broken']"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert "PluginError" in done.stderr
    assert "added_method:BROKEN" in done.stderr
