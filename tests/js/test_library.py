"""The library in WebAssembly follows under Node as Python does."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from copy import deepcopy
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from run_cases import FAULTS, mapper_of, recording_with
from wasm_library import PACKAGE, ROOT, compiled_library

from handmap_qp import Follower, HandMapper
from handmap_qp.apps.saving import saved_bytes

pytestmark = pytest.mark.slow
MOST_BYTES = 1_000_000
HEADER = PACKAGE.parents[1] / "core" / "include" / "handmap" / "handmap.h"


@pytest.fixture(scope="module")
def library() -> Path:
    return compiled_library()


@pytest.fixture(scope="module")
def mapper() -> HandMapper:
    return mapper_of("allegro_right", "teleoperation")


@pytest.fixture(scope="module")
def outcome(
    library: Path, mapper: HandMapper, tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Any]:
    """Return what Node says of a recording with a fault."""
    if shutil.which("node") is None:
        pytest.skip("needs node")
    folder = tmp_path_factory.mktemp("node")
    (folder / "hand").write_bytes(saved_bytes(mapper))
    recording = recording_with(FAULTS[2])
    samples = [recording.sample(i) for i in range(len(recording))]
    given = [
        {
            "time": each.time,
            "landmarks": each.landmarks.ravel().tolist(),
            "valid": bool(each.valid),
            "confidence": each.confidence,
        }
        for each in samples
    ]
    (folder / "samples.json").write_text(json.dumps(given))
    program = ROOT / "tests" / "support" / "follow.mjs"
    files = [PACKAGE / "src" / "handmap.js", library, folder / "hand"]
    done = subprocess.run(
        ["node", program, *files, folder / "samples.json"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def test_it_follows_as_python_does(outcome: dict[str, Any], mapper: HandMapper) -> None:
    follower = Follower(deepcopy(mapper))
    recording = recording_with(FAULTS[2])
    assert len(outcome["commands"]) == len(recording)
    for i, command in enumerate(outcome["commands"]):
        step = follower.map_sample(recording.sample(i))
        assert step.verdict
        np.testing.assert_allclose(command["q"], step.command.q, atol=1e-9)
        np.testing.assert_allclose(
            np.reshape(command["wrist"], (4, 4)), step.command.wrist, atol=1e-9
        )
        assert command["rule"] == step.verdict.rule
        assert command["isHeld"] == step.is_held
        assert command["isGliding"] == step.is_gliding
        assert command["status"] == step.stages.ik.status


def test_it_says_what_the_hand_is(outcome: dict[str, Any], mapper: HandMapper) -> None:
    robot = mapper.robot
    assert outcome["version"] == version("handmap-core")
    assert (outcome["name"], outcome["side"]) == (robot.name, robot.side)
    assert outcome["joints"] == [*robot.joint_names]
    assert outcome["poses"] == 16 * outcome["links"]
    limits = outcome["limits"]
    np.testing.assert_array_equal([limits["lower"], limits["upper"]], robot.limits)
    np.testing.assert_array_equal(limits["speed"], robot.velocity_limits)


def test_wrong_input_is_refused_and_changes_nothing(outcome: dict[str, Any]) -> None:
    refused = outcome["refused"]
    assert {kind for kind, _ in refused.values()} == {"input", "hand"}
    assert len(refused) == 9
    assert refused["bytes"][0] == "hand"
    assert "63 numbers, got 3" in refused["few landmarks"][1]
    assert "63 numbers, got undefined" in refused["no landmarks"][1]
    # The robot brakes meanwhile: both holds are a sample apart, and it stands.
    np.testing.assert_allclose(outcome["after"], outcome["before"], atol=1e-3)


def test_hands_that_are_freed_leave_no_memory(outcome: dict[str, Any]) -> None:
    pages = outcome["pages"]
    assert pages[-1] == pages[4]


def test_it_is_small(library: Path) -> None:
    assert library.stat().st_size <= MOST_BYTES


def test_the_wrapper_has_what_its_types_say() -> None:
    source = (PACKAGE / "src" / "handmap.js").read_text()
    types = (PACKAGE / "src" / "handmap.d.ts").read_text()
    body = types[types.index("export class Hand {") :]
    for method in re.findall(r"^  (\w+)\(", body, re.MULTILINE):
        assert re.search(rf"^  {method}\(", source, re.MULTILINE), method
    # Every function of the header that works on a hand has its place in the wrapper.
    declared = set(re.findall(r"\bhandmap_\w+(?=\()", HEADER.read_text()))
    called = set(re.findall(r"\bc\.(handmap_\w+)", source))
    assert called <= declared
    assert declared - called == {"handmap_new_sample"}


def test_the_package_has_the_version_of_the_core() -> None:
    about = json.loads((PACKAGE / "package.json").read_text())
    assert about["version"] == version("handmap-core")
