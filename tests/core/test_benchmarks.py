"""The benchmarks run, and their shared functions are correct."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from marks import rotated
from section_four.experiment import HandMotion

from handmap_qp.apps.offline.comparison import own_method
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.hands.library import load_hand
from handmap_qp.human import HumanMotion
from handmap_qp.mapping.objects import Box

FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"
SCRIPTS = sorted(FOLDER.glob("*/bench_*.py"))


def run(script: str, *words: str | Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, str(FOLDER), script, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)


@pytest.fixture(scope="module")
def shared(benchmark: Callable[[str], Any]) -> dict[str, Any]:
    """The modules that the scripts share."""
    return {name: benchmark(name) for name in ("common", "scenes")}


@pytest.mark.slow
@pytest.mark.parametrize("script", rotated(SCRIPTS, 16), ids=lambda script: script.stem)
def test_every_benchmark_runs_and_writes_its_numbers(
    script: Path,
    benchmark: Callable[[str], Any],
    request: pytest.FixtureRequest,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
) -> None:
    text = script.read_text(encoding="utf-8")
    assert text.endswith('\nif __name__ == "__main__":\n    main()\n')
    if "find_recordings" in text:
        request.getfixturevalue("recordings")
    if "build_library" in text and shutil.which("c++") is None:
        pytest.skip("needs a C++ compiler")
    results, drawing = tmp_path / "results.json", tmp_path / "results.png"
    # In this process, because most of a quick run would be imports.
    words = [script, "--quick", "--json", results, "--picture", drawing]
    monkeypatch.setattr(sys, "argv", [str(word) for word in words])
    module, pyplot = benchmark(script.stem), pytest.importorskip("matplotlib.pyplot")
    try:
        with patch.dict(os.environ):
            module.main()
    finally:
        pyplot.close("all")
    document = json.loads(results.read_text(encoding="utf-8"))
    assert document["benchmark"] in script.stem
    assert document["facts"]["versions"]["handmap-qp"]
    assert drawing.read_bytes().startswith(b"\x89PNG")


def test_the_page_of_figures_has_a_row_an_aim(
    benchmark: Callable[[str], Any], tmp_path: Path
) -> None:
    page, results = tmp_path / "page.md", tmp_path / "figures.json"
    words = ["--quick", "--only", "size", "--markdown", page, "--json", results]
    benchmark("figures").main([str(word) for word in words])
    rows = json.loads(results.read_text(encoding="utf-8"))["rows"]
    assert page.read_text(encoding="utf-8").count("\n") == 2 + len(rows)
    assert all(row["met"] == "yes" for row in rows)


@pytest.mark.slow
def test_json_may_go_to_stdout_alone(recordings: Path) -> None:
    done = run(
        "bench_accuracy",
        "--quick",
        "--json",
        "-",
        "--recordings",
        recordings,
    )
    assert done.returncode == 0, done.stderr
    rows = json.loads(done.stdout)["rows"]
    assert {row["robot"] for row in rows} == {"three_finger", "allegro"}
    assert all(
        -1.0 <= row["correlation"] <= 1.0 and row["jerk_over_human"] > 0.0
        for row in rows
    )
    assert "Effect of the options" in done.stderr


@pytest.mark.slow
def test_without_recordings_a_benchmark_says_so_in_one_line(
    benchmark: Callable[[str], Any],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(sys, "argv", ["accuracy", "--recordings", str(tmp_path)])
    with pytest.raises(SystemExit) as stopped:
        benchmark("bench_accuracy").main()
    assert stopped.value.code == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.splitlines()
    assert "--recordings DIR or HANDMAP_RECORDINGS" in line


def test_a_file_that_cannot_be_written_is_refused_before_any_work(
    shared: dict[str, Any], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    common = shared["common"]
    with pytest.raises(SystemExit) as stopped:
        common.parse_arguments(
            common.make_parser("test"),
            ["--json", str(tmp_path / "missing" / "out.json")],
        )
    assert stopped.value.code == 2
    assert "the folder does not exist" in capsys.readouterr().err


def test_json_holds_plain_numbers(shared: dict[str, Any], tmp_path: Path) -> None:
    file = tmp_path / "out.json"
    shared["common"].write_json(
        str(file),
        "test",
        {"a": np.float64(1.5), "b": [float("nan"), np.arange(2)], 3: {"c": True}},
    )
    document = json.loads(file.read_text(encoding="utf-8"))
    assert (document["a"], document["b"], document["3"]) == (
        1.5,
        [None, [0, 1]],
        {"c": True},
    )


def test_tables_are_never_cut(
    shared: dict[str, Any], capsys: pytest.CaptureFixture[str]
) -> None:
    columns = {f"a long column {i}": f"{i} and words" for i in range(30)}
    shared["common"].print_table("Title", [columns, {}, columns])
    printed = capsys.readouterr().out
    assert all(text in printed for pair in columns.items() for text in pair)


def test_cpu_time_is_that_of_the_call(shared: dict[str, Any]) -> None:
    common, seen = shared["common"], []
    times = common.cpu_times(seen.append, 5)
    assert seen == [0, 1, 2, 3, 4]
    assert (times >= 0.0).all()
    assert common.mean_cpu_time(lambda: sum(range(2000)), 20) > common.mean_cpu_time(
        lambda: None, 20
    )


def test_every_other_sample_takes_twice_the_time(
    shared: dict[str, Any], recordings: Path
) -> None:
    scene = shared["scenes"].load_scene(
        recordings / "leap_pinch_move_right.npz", samples=30
    )
    motion: HumanMotion = scene.motion
    thinned: HumanMotion = shared["scenes"].thinned(motion, 2)
    np.testing.assert_array_equal(thinned.q, motion.q[::2])
    np.testing.assert_allclose(thinned.dt[1:], motion.time[2::2] - motion.time[:-2:2])
    assert shared["scenes"].thinned(motion, 1) is motion


def test_robots_are_found_for_either_side(shared: dict[str, Any]) -> None:
    robot_for = shared["scenes"].robot_for
    assert [robot_for("allegro", side).side for side in ("left", "right")] == [
        "left",
        "right",
    ]
    right, left = (
        robot_for("three_finger", side).reference_points for side in ("right", "left")
    )
    assert [point.finger for point in right] == ["thumb", "middle", "index"]
    assert [point.finger for point in left] == ["thumb", "index", "middle"]
    assert [point.partner for point in left] == ["thumb_tip", "index_tip", "middle_tip"]
    assert [point.link for point in left] == [point.link for point in right]


@pytest.mark.slow
def test_a_mapped_grasp_starts_as_planned_and_does_what_the_human_does(
    benchmark: Callable[[str], Any],
) -> None:
    """The human bends his index finger and moves his wrist, which does not turn."""
    grasps = benchmark("mapped_grasps")
    scene = grasps.with_equal_palms(
        benchmark("arc").planned_scene(
            load_hand("allegro_right"), Box((0.05, 0.05, 0.05)), samples=4
        )
    )
    palms = [
        (grasp.wrist_pose @ grasp.hand.wrist_to_palm)[:3, :3]
        for grasp in (scene.human, scene.robot)
        if grasp.wrist_pose is not None
    ]
    np.testing.assert_allclose(palms[0], palms[1], atol=1e-12)
    human, grasp = scene.human, scene.robot
    assert human.wrist_pose is not None
    assert grasp.wrist_pose is not None
    q, wrist = np.tile(human.q, (3, 1)), np.tile(human.wrist_pose, (3, 1, 1))
    is_bent = [
        name in ("index_MCP_flexion", "index_PIP_flexion") for name in HUMAN_JOINTS
    ]
    q[:, is_bent] += np.array([[0.0], [0.15], [0.3]])
    wrist[:, 1, 3] += (0.0, 0.02, 0.04)
    motion = grasps.map_grasp(
        own_method("finger-vectors"), scene, HandMotion(q, wrist, wrist), 0.3
    )
    np.testing.assert_array_equal(motion.q[0], grasp.q)
    moved = motion.wrist - grasp.wrist_pose
    np.testing.assert_allclose(moved[-1, :3, 3], [0.0, 0.04, 0.0], atol=2e-3)
    np.testing.assert_allclose(moved[:, :3, :3], 0.0, atol=0.02)
    # The index finger's joints come first; the little finger has none.
    bent = np.abs(motion.q[-1] - motion.q[0])
    assert bent[1:4].sum() > 0.2
    assert bent[4:].max() < 0.1 * bent[1:4].sum()


@pytest.mark.slow
def test_runs_beyond_the_paper_are_tables_and_files(
    benchmark: Callable[[str], Any],
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    beyond = benchmark("beyond_the_paper")
    monkeypatch.setattr(beyond, "STEPS", 2)
    monkeypatch.setattr(beyond, "DISTANCES", (0.1,))
    monkeypatch.setattr(beyond, "MARGINS", (0.0, 4.0))
    names = ["limits", "placement", "origin"]
    monkeypatch.setattr(
        sys, "argv", ["beyond", "--studies", *names, "--out", str(tmp_path)]
    )
    beyond.main()
    assert {file.name for file in tmp_path.iterdir()} == {
        f"{name}.{kind}" for name in names for kind in ("csv", "png")
    }
    printed = capsys.readouterr().out
    assert "limit_excess_deg" in printed
    rows = list(beyond.limits())
    assert len(rows) == 2 * 3 * 4
    worst = {
        row["fingers"]: row["limit_excess_deg"]
        for row in rows
        if row["margin_deg"] == 0.0
    }
    assert worst["pseudoinverse"] > 0.1 > worst["qp"]
