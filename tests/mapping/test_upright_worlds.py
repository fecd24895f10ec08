"""A tracker's up and forward are the robot's: found by layouts and descriptions, or by gestures."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any, get_args

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from reach_cases import HUMAN, reaching_hand

from handmap_core.human.recording import axis_direction, mirrored, upright_axes
from handmap_core.mapping.alignment import (
    rotation_of,
    rotation_onto,
)
from handmap_qp import HandError, InvalidInputError, cli, load_hand
from handmap_qp.apps.arguments import MappingArguments, MethodFlags
from handmap_qp.apps.offline.comparison import in_world_of
from handmap_qp.apps.service.opening import read_choice
from handmap_qp.client.messages import PROTOCOL, Open
from handmap_qp.mapping import find_alignment
from handmap_qp.mapping.presets import PRESETS, get_preset, preset_choice
from handmap_qp.trackers.formats.archive import NpzFormat
from handmap_qp.trackers.layouts import LAYOUTS, tables
from handmap_qp.trackers.layouts.base import Axis
from handmap_qp.trackers.layouts.tables import load_layout

PAIRS = [
    f"{up} up, {forward} forward"
    for up, forward in product(get_args(Axis), repeat=2)
    if up[1] != forward[1]
]
HEADSET = "+y up, -z forward"
ARM = load_hand("ur5_allegro")
BARE = load_hand("allegro_right")


@pytest.mark.parametrize("standing", PAIRS)
def test_all_pairs_of_axes_are_laid_onto_each_other(standing: str) -> None:
    assert len(PAIRS) == 24
    robot = load_hand(msgspec.structs.replace(ARM.spec, upright=standing))
    for tracker in PAIRS:
        rotation = rotation_onto(robot, tracker)
        assert rotation is not None
        np.testing.assert_array_equal(rotation @ rotation.T, np.eye(3))
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        for one, other in zip(tracker.split()[::2], standing.split()[::2], strict=True):
            laid = rotation @ axis_direction(one)
            np.testing.assert_array_equal(laid, axis_direction(other))


def test_y_up_is_a_headset_on_a_robot() -> None:
    expected = [[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]
    np.testing.assert_array_equal(rotation_of("y-up"), expected)
    assert find_alignment(get_preset("paper").method, ARM, HEADSET) == {
        "alignment": "y-up"
    }
    assert rotation_onto(BARE, HEADSET) is None


@pytest.mark.parametrize(
    "upright",
    [
        "+y up, -y forward",
        "+y up",
        "-z forward",
        "y up, z forward",
        "+w up, -z forward",
        "+y up, -z forward.",
    ],
)
def test_what_is_no_frame_is_one_clear_error(upright: str) -> None:
    with pytest.raises(InvalidInputError, match="at right angles"):
        upright_axes(upright)
    with pytest.raises(InvalidInputError, match="at right angles"):
        reaching_hand(upright=upright)


@pytest.mark.parametrize("upright", [1, None, b"+y up, -z forward", ["x"]])
def test_what_is_no_text_is_one_clear_error(upright: Any) -> None:
    with pytest.raises(InvalidInputError, match="upright: expected axes"):
        reaching_hand(upright=upright)


def test_a_robot_whose_axes_are_one_is_refused() -> None:
    with pytest.raises(HandError, match="upright"):
        msgspec.structs.replace(ARM.spec, upright="+x up, -x forward")


def test_layouts_state_what_their_world_is() -> None:
    said = {name: one.upright for name, one in LAYOUTS.items()}
    headsets = {"openxr26", "webxr25", "visionpro27", "leap26", "unity26"}
    assert {name for name, axes in said.items() if axes == HEADSET} == headsets
    assert said["visionpro25"] == "+z up, +y forward"
    assert sum(axes != "" for axes in said.values()) == len(headsets) + 1


@pytest.mark.parametrize("preset", PRESETS)
def test_the_alignment_is_found_for_arms_alone(preset: str) -> None:
    method = get_preset(preset).method
    found = find_alignment(method, ARM, HEADSET)
    # The preset for a fixed wrist lays palms on each other.
    own = {} if preset == "fixed_wrist" else {"alignment": "y-up"}
    assert found == own
    assert find_alignment(method, ARM, "") == {}
    assert find_alignment(method, BARE, HEADSET) == {}
    method.replaced(**find_alignment(method, ARM, "-x up, +z forward")).check()


@pytest.mark.parametrize("chosen", ["world", "palm", "y-up"])
def test_the_users_own_choice_wins(chosen: str, tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    file.write_text(f"alignment: {chosen}\n")
    flags = MappingArguments(method=MethodFlags(alignment=chosen))
    for arguments in (flags, MappingArguments(options=file)):
        choice = arguments.preset_for(HUMAN, ARM, "+z up, +y forward")
        assert choice.method.values["alignment"] == chosen
    request = opened(layout="webxr25", options={"alignment": chosen})
    assert read_choice(request, HUMAN, ARM).method.values["alignment"] == chosen


def test_another_world_of_the_robot_counts() -> None:
    robot = load_hand(msgspec.structs.replace(ARM.spec, upright=HEADSET))
    choice = MappingArguments().preset_for(HUMAN, robot, HEADSET)
    assert choice.method.values["alignment"] == "world"


def opened(**changes: Any) -> Open:
    values: dict[str, Any] = {
        "protocol": PROTOCOL,
        "seq": 1,
        "robot": "ur5_allegro",
        "input": "landmarks",
    }
    return Open(**values | changes)


def test_the_service_finds_it_by_layout_or_axes() -> None:
    for said in ({"layout": "webxr25"}, {"upright": HEADSET}):
        choice = read_choice(opened(**said), HUMAN, ARM)
        assert choice.method.values["alignment"] == "y-up"
    for said in ({}, {"layout": "mediapipe21"}):
        choice = read_choice(opened(**said), HUMAN, ARM)
        assert choice.method.values["alignment"] == "world"
    given = {"type": "open", "protocol": PROTOCOL, "seq": 1, "robot": "x"}
    assert msgspec.convert(given | {"upright": HEADSET}, Open).upright == HEADSET
    with pytest.raises(msgspec.ValidationError, match="upright"):
        msgspec.convert(given | {"upright": "+y up, -y forward"}, Open)


def test_the_mirror_stands_across_the_tracker() -> None:
    wrist = np.tile(np.eye(4), (180, 1, 1))
    wrist[:, :3, :3] = pin.exp3(np.array([0.4, -0.2, 0.7]))
    for axes in PAIRS:
        given = reaching_hand(wrist=wrist, upright=axes)
        other = mirrored(given)
        sides = np.ones(3)
        sides["xyz".index(({*"xyz"} - {*axes}).pop())] = -1.0
        np.testing.assert_array_equal(other.landmarks, given.landmarks * sides)
        assert other.wrist is not None
        assert np.linalg.det(other.wrist[0]) == pytest.approx(1.0)
        assert other.upright == axes
        np.testing.assert_array_equal(mirrored(other).landmarks, given.landmarks)


def test_a_comparison_is_made_in_the_robots_world() -> None:
    given = reaching_hand(upright=HEADSET, wrist=np.tile(np.eye(4), (180, 1, 1)))
    turned = in_world_of(ARM, given)
    rotation = rotation_of("y-up")
    np.testing.assert_allclose(turned.landmarks, given.landmarks @ rotation.T)
    assert turned.wrist is not None
    np.testing.assert_array_equal(turned.wrist[0, :3, :3], rotation)
    assert turned.upright == "+z up, +x forward"
    assert in_world_of(BARE, given) is given
    assert in_world_of(ARM, reaching_hand()).upright == ""


def test_map_says_how_it_aligns(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "headset.npz"
    NpzFormat().write([reaching_hand(upright=HEADSET)], file)
    out = ["--out", str(tmp_path / "out.npz")]
    assert cli.main(["map", str(file), "--robot", "ur5_allegro", *out]) == 0
    lines = capsys.readouterr().out.splitlines()
    (line,) = (line for line in lines if "alignment" in line)
    assert "y-up" in line
    with np.load(tmp_path / "out.npz") as mapped:
        moved = mapped["targets"][59] - mapped["targets"][0]
    np.testing.assert_array_less(np.abs(moved - [0.3, 0.0, 0.0]), 0.03)


def test_a_user_may_state_the_axes_of_a_layout(tmp_path: Path) -> None:
    table = Path(tables.__file__).parent / "openxr26.yaml"
    own = tmp_path / "own.yaml"
    text = table.read_text().replace(HEADSET, "+z up, +y forward")
    own.write_text(text)
    assert load_layout(str(own)).upright == "+z up, +y forward"
    own.write_text(text.replace("+y forward", "-z forward"))
    with pytest.raises(InvalidInputError, match="upright"):
        load_layout(str(own))


def test_files_keep_the_axes(tmp_path: Path) -> None:
    given = reaching_hand(upright=HEADSET)
    file = tmp_path / "headset.npz"
    NpzFormat().write([given, mirrored(given)], file)
    for entry in NpzFormat().entries(file):
        assert NpzFormat().read(file, entry).upright == HEADSET
    assert replace(given, upright="").upright == ""
    assert preset_choice("paper").method.values["alignment"] == "world"
