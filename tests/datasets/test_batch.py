"""`handmap batch`: every recording once, whatever is killed, with the same bytes each time."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Iterator
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from batch_cases import (
    OPTIONS,
    KillingFormat,
    batch,
    die_at_once,
    episodes,
    list_or_die,
    piece,
    with_format,
    write_pieces,
)
from lerobot_tables import columns_of, episodes_of, feature_names
from msgspec import structs
from patience import wait_until

from handmap_qp import InvalidInputError, load_hand
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.datasets import engines, sources, workers
from handmap_qp.apps.datasets.assemble import WRIST_NAMES, assemble
from handmap_qp.apps.datasets.batch import plan_batch, run_batch
from handmap_qp.apps.datasets.engines import (
    SERIAL,
    Engine,
    Submit,
    _next_group,
    pool_engine,
)
from handmap_qp.apps.datasets.episodes import MEASURES
from handmap_qp.apps.datasets.manifest import (
    MOST_KILLS,
    Line,
    open_manifest,
    read_manifests,
)
from handmap_qp.apps.datasets.report import _worst_sample
from handmap_qp.apps.datasets.sources import Job, JobOptions, find_files, list_jobs
from handmap_qp.apps.offline.fidelity import SETTLING
from handmap_qp.apps.offline.trajectory import map_hands
from handmap_qp.cli import main
from handmap_qp.hands.robot import load_robot
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import write_recordings
from handmap_qp.trackers.formats.hdf5 import RobomimicFormat

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

LONG = 240.0
"""Timeout for batches in processes of their own on a busy machine [s]."""


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    write_pieces(folder / "a", 2)
    write_recordings([piece(60, 14)], folder / "b.csv")
    return folder


@pytest.fixture(scope="module")
def serial(inputs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The serial run that all others must equal."""
    out = tmp_path_factory.mktemp("serial") / "out"
    tally = batch(inputs, out)
    assert [len(tally.done), len(tally.failed)] == [3, 0]
    return out


def test_an_episode_has_what_a_reader_needs(serial: Path) -> None:
    with np.load(serial / "episodes/a/take0.npz.npz") as columns:
        robot = load_hand("three_finger")
        assert columns["q"].shape == (12, len(robot.joint_names))
        assert list(columns["joint_names"]) == list(robot.joint_names)
        assert (columns["q"] >= robot.lower_limits).all()
        assert (columns["q"] <= robot.upper_limits).all()
        assert str(columns["side"]) == "right"
    lines = read_manifests(serial)
    assert set(lines) == {f"a/take{i}.npz::" for i in range(2)} | {"b.csv::"}
    line = lines["a/take1.npz::"]
    assert (line.status, line.frames, line.robot) == ("done", 13, "three_finger")
    assert line.cpu_s > 0.0
    assert line.metrics["valid"] == 1.0


def test_what_is_unusual_is_mapped_and_written_down(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for name, factor in (("usual", 1.0), ("slow", 10.0)):
        recording = piece(0, 90)
        slowed = replace(recording, time=factor * recording.time)
        write_recordings([slowed], tmp_path / f"{name}.npz")
    out = tmp_path / "out"
    files = [str(tmp_path / f"{name}.npz") for name in ("usual", "slow")]
    robot = ["--robot", "three_finger", "--workers", "0"]
    main(["batch", *files, *robot, "--out", str(out)])
    lines = read_manifests(out)
    assert {line.status for line in lines.values()} == {"done"}
    assert lines["usual.npz::"].hints == ()
    (hint,) = lines["slow.npz::"].hints
    assert "check its unit" in hint
    assert f"unusual: slow.npz: {hint}" in capsys.readouterr().out


def test_jobs_come_longest_first_and_shards_share_nothing(inputs: Path) -> None:
    files = find_files([inputs])[0]

    def lines(part: int, parts: int) -> list[Line]:
        jobs = list_jobs(files, inputs, OPTIONS, shard=(part, parts))
        return [job.line for job in jobs]

    whole = lines(1, 1)
    assert [line.frames for line in whole] == [14, 13, 12]
    parts = [line.key for part in (1, 2, 3) for line in lines(part, 3)]
    assert sorted(parts) == sorted(line.key for line in whole)


def test_the_order_of_the_work_changes_no_byte(
    inputs: Path, serial: Path, tmp_path: Path
) -> None:
    plan = plan_batch([inputs], tmp_path, OPTIONS)
    run_batch(replace(plan, jobs=plan.jobs[::-1]), tmp_path, SERIAL)
    assert episodes(tmp_path) == episodes(serial)


def test_a_second_run_does_only_what_is_left(tmp_path: Path) -> None:
    files = write_pieces(tmp_path / "in", 3)
    files[1].write_bytes(b"torn")
    out = tmp_path / "out"
    first = batch(tmp_path / "in", out)
    assert [line.key for line in first.failed] == ["take1.npz::"]
    assert "take1.npz: is not an .npz file" in first.failed[0].error
    before = episodes(out)
    write_recordings([piece(30, 13)], files[1])
    os.utime(files[2], (1, 1))
    second = batch(tmp_path / "in", out)
    assert sorted(line.key for line in second.done) == ["take1.npz::", "take2.npz::"]
    after = episodes(out)
    assert after.items() >= before.items(), "the same recording gives the same bytes"
    assert not batch(tmp_path / "in", out).lines
    (out / "episodes/take0.npz.npz").unlink()
    assert [line.key for line in batch(tmp_path / "in", out).done] == ["take0.npz::"]
    calm = replace(OPTIONS, arguments=MappingArguments(smooth=True))
    for options in (calm, replace(calm, look_ahead=True)):
        assert len(batch(tmp_path / "in", out, options).done) == 3


def test_options_and_hands_are_compared_by_their_content(tmp_path: Path) -> None:
    file = tmp_path / "options.yaml"
    options = replace(OPTIONS, arguments=MappingArguments(options=file))
    digests = []
    for text in ("preset: object\n", "preset: paper\n", "preset: object\n"):
        file.write_text(text)
        digests.append(options.digest)
    assert digests[0] == digests[2] != digests[1] != OPTIONS.digest


def test_a_torn_last_line_is_done_again(tmp_path: Path) -> None:
    write_pieces(tmp_path / "in", 2)
    out = tmp_path / "out"
    batch(tmp_path / "in", out)
    file = out / "manifest.jsonl"
    good = file.read_bytes()
    for cut in (1, 60):
        file.write_bytes(good[:-cut])
        tally = batch(tmp_path / "in", out)
        assert len(tally.done) == 1
        assert all(json.loads(line) for line in file.read_bytes().splitlines())
        assert len(read_manifests(out)) == 2


def test_two_batches_do_not_write_to_one_folder(tmp_path: Path) -> None:
    with (
        open_manifest(tmp_path),
        pytest.raises(InvalidInputError, match="another handmap batch"),
    ):
        open_manifest(tmp_path).__enter__()
    with open_manifest(tmp_path, (1, 2)), open_manifest(tmp_path, (2, 2)):
        pass


@pytest.mark.slow
def test_a_pool_writes_the_same_bytes_and_gives_up_what_kills(
    inputs: Path, serial: Path, tmp_path: Path
) -> None:
    plan = plan_batch([inputs], tmp_path, OPTIONS)
    poison = plan.jobs[1].line.key
    jobs = [
        with_format(job, KillingFormat()) if job.line.key == poison else job
        for job in plan.jobs
    ]
    seen: list[Line] = []
    tally = run_batch(
        replace(plan, jobs=tuple(jobs)), tmp_path, pool_engine(2), progress=seen.append
    )
    assert [line.key for line in tally.failed] == [poison]
    assert tally.failed[0].kills == MOST_KILLS
    assert len(tally.done) == 2
    expected = {
        name: data for name, data in episodes(serial).items() if poison[:-2] not in name
    }
    assert episodes(tmp_path) == expected
    assert {line.status for line in seen if line.key == poison} == {"killed", "failed"}
    # It is left alone from now on, until its file changes.
    again = plan_batch([inputs], tmp_path, OPTIONS)
    assert not again.jobs
    assert [line.key for line in again.left_alone] == [poison]


def test_a_worker_may_die_before_the_next_recording_is_given_to_it(
    inputs: Path, serial: Path, tmp_path: Path
) -> None:
    given: list[Job] = []

    @contextmanager
    def start(_: int) -> Iterator[Submit]:
        with SERIAL.start(1) as begin:

            def submit(jobs: tuple[Job, ...]) -> Any:
                given.extend(jobs)
                if len(given) == 2:
                    raise BrokenProcessPool
                return begin(jobs)

            yield submit

    tally = batch(inputs, tmp_path, engine=Engine(start, 2))
    # The second one is tried alone then, and is not to blame.
    assert [len(tally.done), len(tally.failed)] == [3, 0]
    assert len(given) == 4
    assert episodes(tmp_path) == episodes(serial)


def test_short_recordings_go_to_a_worker_together(tmp_path: Path) -> None:
    write_pieces(tmp_path / "in", 9, frames=12)
    jobs = list(plan_batch([tmp_path / "in"], tmp_path / "out", OPTIONS).jobs)

    def of_frames(count: int) -> list[Job]:
        return [
            replace(job, line=structs.replace(job.line, frames=count)) for job in jobs
        ]

    # At most a quarter of what is left, and at least one.
    for count in (len(jobs), 3):
        waiting = deque(jobs[:count])
        group = _next_group(waiting, 2)
        assert group == tuple(jobs[: max(1, count // 4)])
        assert [*group, *waiting] == jobs[:count]
    assert len(_next_group(deque(of_frames(engines.GROUP_FRAMES)), 2)) == 1
    assert (
        len(_next_group(deque(of_frames(100) * 20), 2)) == engines.GROUP_FRAMES // 100
    )


@pytest.mark.slow
def test_workers_that_never_start_end_the_batch_with_one_line(
    inputs: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture,
) -> None:
    monkeypatch.setattr(workers, "start_worker", die_at_once)
    monkeypatch.setattr(workers, "MOST_STARTS", 2)
    command = [
        "batch",
        str(inputs),
        "--robot",
        "three_finger",
        "--out",
        str(tmp_path / "out"),
    ]
    assert main([*command, "--workers", "1"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(
        "handmap: --workers: expected processes that start, got 2 in a row"
    )
    assert error.count("\n") == 1
    monkeypatch.undo()
    # No recording is blamed, nothing is lost.
    jobs = plan_batch([inputs], tmp_path / "out", OPTIONS).jobs
    assert not any(job.line.kills for job in jobs)


def test_what_a_killed_batch_leaves_is_taken_away(inputs: Path, tmp_path: Path) -> None:
    job = plan_batch([inputs], tmp_path, OPTIONS).jobs[0]
    file = tmp_path / job.out
    file.parent.mkdir(parents=True, exist_ok=True)
    torn = [file.with_name(f".{file.name}.{name * 8}.part") for name in ("a", "b")]
    for each in torn:
        each.write_bytes(b"torn")
    # It was alone when everything died, so that it counts as the one to blame.
    with open_manifest(tmp_path) as append:
        append(structs.replace(job.line, status="killed", kills=1))
    plan_batch([inputs], tmp_path, OPTIONS, (1, 2))
    assert all(each.exists() for each in torn), "another shard may be writing them"
    plan = plan_batch([inputs], tmp_path, OPTIONS)
    kills = {each.line.key: each.line.kills for each in plan.jobs}
    assert {key for key, count in kills.items() if count} == {job.line.key}
    assert kills[job.line.key] == 1
    assert not any(each.exists() for each in torn)


def test_a_file_that_crashes_or_holds_its_reader_holds_no_listing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("h5py")
    for name in ("1.hdf5", "crash.hdf5", "hold.hdf5", "3.hdf5"):
        write_recordings([piece(0, 12)], tmp_path / name, RobomimicFormat())
    monkeypatch.setattr(sources, "_listing", list_or_die)
    jobs = list_jobs(find_files([tmp_path])[0], tmp_path, OPTIONS)
    lines = [job.line for job in jobs]
    assert [line.frames for line in lines] == [12, 12, 0, 0]
    assert [line.key for line in lines[2:]] == ["crash.hdf5::", "hold.hdf5::"]
    assert all("crashed, or took 30 s" in line.error for line in lines[2:])


def start(inputs: Path, out: Path) -> subprocess.Popen[str]:
    command = [
        sys.executable,
        "-m",
        "handmap_qp.cli",
        "batch",
        str(inputs),
        "--out",
        str(out),
    ]
    return subprocess.Popen(
        [*command, "--robot", "three_finger", "--workers", "1"],
        text=True,
        stderr=subprocess.PIPE,
    )


def children(pid: int) -> list[int]:
    """Return the processes that a process has started, and those that these have."""
    listing = subprocess.run(
        ["ps", "-o", "pid=", "--ppid", str(pid)],
        capture_output=True,
        text=True,
        check=False,
    ).stdout.split()
    return [found for child in map(int, listing) for found in (child, *children(child))]


def is_alive(pid: int) -> bool:
    try:
        state = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"


@pytest.mark.slow
def test_workers_end_with_a_parent_that_is_killed_and_the_next_run_goes_on(
    tmp_path: Path,
) -> None:
    count = len(write_pieces(tmp_path / "in", 48, frames=30))
    out, manifest = tmp_path / "out", tmp_path / "out" / "manifest.jsonl"
    process = start(tmp_path / "in", out)
    wait_until(
        lambda: manifest.exists() and manifest.read_bytes().count(b"\n"), "begins", LONG
    )
    started = children(process.pid)
    assert started
    process.kill()
    process.communicate()
    wait_until(
        lambda: not any(map(is_alive, started)), "workers end with their parent", LONG
    )
    done = manifest.read_bytes().count(b"\n")
    assert done < count
    # Interrupted by Ctrl-C, it finishes what is under way, and says how to go on.
    process = start(tmp_path / "in", out)
    wait_until(lambda: manifest.read_bytes().count(b"\n") > done, "goes on", LONG)
    process.send_signal(signal.SIGINT)
    _, error = process.communicate(timeout=LONG)
    if process.returncode:
        assert process.returncode == 130
        assert "run the same command to go on" in error
    batch(tmp_path / "in", out)
    assert len(batch(tmp_path / "in", tmp_path / "whole").done) == count
    assert episodes(out) == episodes(tmp_path / "whole")


@pytest.mark.slow
def test_ray_writes_the_same_bytes(inputs: Path, serial: Path, tmp_path: Path) -> None:
    pytest.importorskip("ray")
    # A process of its own, because Ray starts others and changes signals.
    code = (
        "import sys; from handmap_qp.cli import main; sys.exit(main(sys.argv[1:]))",
        *(
            "batch",
            str(inputs),
            "--robot",
            "three_finger",
            "--out",
            str(tmp_path / "out"),
        ),
        *("--engine", "ray", "--workers", "1"),
    )
    done = subprocess.run(
        [sys.executable, "-c", *code], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert episodes(tmp_path / "out") == episodes(serial)


@pytest.fixture(scope="module")
def pairs(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A command for recordings of both hands; its second call finds the episodes of the first."""
    root = tmp_path_factory.mktemp("pairs")
    folder = root / "in" / "pour_water"
    folder.mkdir(parents=True)
    right = piece(0, 20, "right")
    # Three samples in which the right hand was not seen.
    valid, landmarks = right.valid.copy(), right.landmarks.copy()
    valid[8:11], landmarks[8:11] = False, np.nan
    right = replace(right, valid=valid, landmarks=landmarks)
    write_recordings([piece(0, 20, "left"), right], folder / "0.npz")
    told = replace(piece(40, 20, "left"), task="fill the cup")
    write_recordings([told], folder / "1.npz")
    command = ["batch", str(root / "in"), "--robot", "allegro_left", "allegro_right"]
    return [*command, "--workers", "0", "--fps", "50", "--out", str(root / "out")]


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_the_data_set_keeps_limits_and_pairs_hands(form: str, pairs: list[str]) -> None:
    pytest.importorskip("pyarrow")
    h5py = pytest.importorskip("h5py")
    assert main([*pairs, "--format", form]) == 0
    out = Path(pairs[-1])
    left, right = load_hand("allegro_left"), load_hand("allegro_right")
    count = len(left.joint_names) + 7
    if form == "lerobot":
        root = out / "lerobot"
        assert (
            feature_names(root, "observation.state")[0] == f"left_{left.joint_names[0]}"
        )
        assert [episode["tasks"] for episode in episodes_of(root)] == [
            ["pour water"],
            ["fill the cup"],
        ]
        found = [columns_of(root, i) for i in range(2)]
        episodes_ = [
            (f["observation.state"], f["action"], f["observation.valid"]) for f in found
        ]
    else:
        with h5py.File(out / "episodes.hdf5") as file:
            demos = [file[f"data/demo_{i}"] for i in range(2)]
            assert file["data"].attrs["total"] == sum(
                d.attrs["num_samples"] for d in demos
            )
            episodes_ = [
                (d["obs/state"][()], d["actions"][()], d["obs/valid"][()])
                for d in demos
            ]
    assert len(episodes_) == 2
    for state, action, valid in episodes_:
        assert state.shape[1] == 2 * count
        np.testing.assert_array_equal(action[:-1], state[1:])
        for hand, first in ((left, 0), (right, count)):
            q = state[:, first : first + count - 7].astype(float)
            assert (q >= hand.lower_limits).all()
            assert (q <= hand.upper_limits).all()
            speed = np.abs(np.diff(q, axis=0)) * 50.0
            assert (speed <= hand.velocity_limits + 1e-4).all()
            quats = state[:, first + count - 4 : first + count]
            np.testing.assert_allclose(np.linalg.norm(quats, axis=1), 1.0, atol=1e-6)
        assert valid[:, 0].any()
    assert [bool(valid[:, 1].any()) for _, _, valid in episodes_] == [True, False]
    # At least those between the samples around the three that were not seen; none at the ends.
    seen = episodes_[0][2][:, 1]
    gap = float(np.ptp(piece(0, 20, "right").time[[7, 11]]))
    assert (~seen).sum() >= 50.0 * gap - 1.0
    assert seen[0]
    assert seen[-1]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[str], str]:
    """A command for a robot with two hands, and what it prints; one of two files has one hand."""
    folder = tmp_path_factory.mktemp("whole") / "pour"
    folder.mkdir()
    both = [piece(0, 20, "left"), piece(0, 20, "right")]
    write_recordings(both, folder / "0.npz")
    write_recordings(both[1:], folder / "1.npz")
    words = ["--robot", "g1", "--workers", "0", "--fps", "50", "--out"]
    return ["batch", str(folder.parent), *words, str(folder.parent / "out")], "both"


def test_an_episode_of_a_robot_is_what_map_hands_maps(
    whole: tuple[list[str], str], capsys: pytest.CaptureFixture
) -> None:
    command, side = whole
    out = Path(command[-1])
    with pytest.raises(SystemExit, match="1"):
        main(command)
    assert "pour/1.npz" in capsys.readouterr().err
    lines = read_manifests(out)
    assert "got right" in lines["pour/1.npz::"].error
    done = lines["pour/0.npz::"]
    assert (done.status, done.side, done.robot, done.frames) == ("done", side, "g1", 20)
    hands = [piece(0, 20, "left"), piece(0, 20, "right")]
    robot, arguments = load_robot("g1"), MappingArguments()
    motion, _, followed = map_hands(hands, robot, measure_person(*hands), arguments)
    with np.load(out / done.out) as columns:
        np.testing.assert_array_equal(columns["q"], motion.q)
        np.testing.assert_array_equal(columns["valid"], followed)
        own = [hand.frame_pose("wrist", motion.q[9]) for hand in robot.by_side.values()]
        np.testing.assert_array_equal(columns["wrist"][9], own)
        assert list(columns["joint_names"]) == list(robot.by_side["left"].joint_names)
    # The next run only tries again what failed, and the same bytes come again.
    options = JobOptions({side: "g1"})
    before = episodes(out)
    assert len(batch(Path(command[1]), out, options).done) == 0
    (out / done.out).write_bytes(b"torn")
    assert [line.key for line in batch(Path(command[1]), out, options).done] == [
        done.key
    ]
    assert episodes(out) == before
    calm = JobOptions(options.robots, MappingArguments(smooth=True), look_ahead=True)
    smooth = batch(Path(command[1]), out, calm)
    jerks = [line.metrics["jerk"] or 0.0 for line in (smooth.done[0], done)]
    assert 0.0 < jerks[0] < jerks[1]
    assert main(["report", str(out)]) == 0
    assert (out / "report/worst_g1.png").exists()


@pytest.mark.parametrize("form", ["lerobot", "robomimic"])
def test_a_data_set_of_a_robot_has_its_joints_once(
    form: str, whole: tuple[list[str], str]
) -> None:
    pytest.importorskip("pyarrow")
    h5py = pytest.importorskip("h5py")
    command, _ = whole
    with pytest.raises(SystemExit, match="1"):
        main([*command, "--format", form])
    hand = load_robot("g1").by_side["left"]
    wrists = [f"{side}_{name}" for side in ("left", "right") for name in WRIST_NAMES]
    names = [*hand.joint_names, *wrists]
    root = Path(command[-1]) / "lerobot"
    if form == "lerobot":
        assert list(feature_names(root, "observation.state")) == names
        assert list(feature_names(root, "observation.valid")) == ["left", "right"]
        assert json.loads((root / "meta/info.json").read_text())["robot_type"] == "g1"
        columns = columns_of(root, 0)
        state, valid = columns["observation.state"], columns["observation.valid"]
    else:
        with h5py.File(root.with_name("episodes.hdf5")) as file:
            env = json.loads(file["data"].attrs["env_args"])
            assert (env["env_name"], env["env_kwargs"]["state_names"]) == ("g1", names)
            state, valid = (
                file[f"data/demo_0/obs/{n}"][()] for n in ("state", "valid")
            )
    assert state.shape[1] == len(names)
    assert valid.shape == (len(state), 2)
    assert valid.all()
    q = state[0, : len(hand.joint_names)].astype(float)
    for part, first in ((hand, -14), (load_robot("g1").by_side["right"], -7)):
        place = part.frame_pose("wrist", q)[:3, 3]
        np.testing.assert_allclose(state[0, first:][:3], place, atol=1e-5)


def test_rounding_to_float32_stays_inside_the_limits(tmp_path: Path) -> None:
    pytest.importorskip("pyarrow")
    hand = load_hand("allegro_right")
    ends = np.stack([hand.lower_limits, hand.upper_limits])
    assert (ends.astype(np.float32) != ends).any(), "some limits are no float32"
    (tmp_path / "episodes").mkdir()
    wrist = np.tile(np.eye(4), (2, 1, 1))
    columns: dict[str, Any] = {"time": np.array([0.0, 0.1]), "wrist": wrist, "q": ends}
    np.savez(tmp_path / "episodes/a.npz", valid=np.ones(2, dtype=bool), **columns)
    about: dict[str, Any] = {"path": "a", "size": 1, "mtime_ns": 1, "options": ""}
    line = Line("a::", "done", side="right", frames=2, out="episodes/a.npz", **about)
    root = assemble([line], tmp_path, "lerobot", 10.0, {"right": hand})
    state = columns_of(root, 0)["observation.state"]
    q = state[:, : len(hand.joint_names)].astype(float)
    assert (q >= hand.lower_limits).all()
    assert (q <= hand.upper_limits).all()
    np.testing.assert_allclose(q, ends, atol=1e-6)


BAD: dict[tuple[str, ...], str] = {
    (
        "--robot",
        "three_finger",
        "allegro_right",
    ): "--robot: expected one robot for each side",
    (
        "--robot",
        "three_finger",
        "--shard",
        "5/4",
    ): "--shard: expected I/N with 1 <= I <= N",
    ("--robot", "three_finger", "--shard", "x"): "--shard: expected I/N",
    (
        "--robot",
        "three_finger",
        "--workers",
        "-1",
    ): "--workers: expected a number from 0",
    ("--robot", "three_finger", "--fps", "0"): "--fps: expected a rate",
    ("--robot", "absent_hand"): "absent_hand",
    ("--robot", "three_finger", "g1"): "--robot: expected no other robot beside",
    (
        "--robot",
        "three_finger",
        "--look-ahead",
        "--smooth",
    ): "--smooth: has no effect with",
}


@pytest.mark.parametrize("words", BAD, ids=" ".join)
def test_a_bad_call_is_one_line(
    words: tuple[str, ...], inputs: Path, tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    assert main(["batch", str(inputs), "--out", str(tmp_path / "out"), *words]) == 2
    error = capsys.readouterr().err
    assert BAD[words] in error
    assert error.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_inputs_without_recordings_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    (tmp_path / "empty").mkdir()
    for given, line in {
        "absent": "no such file or folder",
        "empty": "has no files of a known",
    }.items():
        command = ["batch", str(tmp_path / given), "--robot", "three_finger", "--out"]
        assert main([*command, str(tmp_path / "out")]) == 2
        assert line in capsys.readouterr().err


def test_the_report_finds_the_worst(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    files = write_pieces(tmp_path / "in", 6)
    rng = np.random.default_rng(0)
    good = piece(20, 16)
    noisy = good.landmarks + rng.normal(0.0, 0.006, good.landmarks.shape)
    write_recordings([replace(good, landmarks=noisy)], files[4])
    (tmp_path / "in" / "torn.npz").write_bytes(b"")
    out = tmp_path / "out"
    batch(tmp_path / "in", out)
    assert (
        main(["report", str(out), "--keep", "0.67", "--worst", "2", "--no-pictures"])
        == 0
    )
    printed = capsys.readouterr().out
    assert "6 episodes, 4 kept" in printed
    kept = (out / "report/keep.txt").read_text().split()
    # The noisy one is worst in jerk; another one may be worst in reach, and as bad.
    assert len(kept) == 4
    assert "episodes/take4.npz.npz" not in kept
    text = (out / "report/report.md").read_text()
    assert "| take4.npz |" in text
    assert "1 recording failed" in text
    assert "torn.npz" in text
    rows = (out / "report/episodes.csv").read_text().splitlines()
    assert any(row.startswith("take4.npz::,") for row in rows[1:3])
    assert len(rows) == 7
    assert main(["report", str(tmp_path)]) == 2
    assert "run handmap batch first" in capsys.readouterr().err
    assert main(["report", str(out), "--keep", "0"]) == 2


def test_the_picture_shows_what_an_episode_is_worst_in() -> None:
    recording = piece(0, 60)
    count, settled = (
        len(recording),
        int(np.argmax(recording.time - recording.time[0] >= SETTLING)),
    )
    columns = {
        "valid": np.ones(count, dtype=bool),
        "point_error": np.zeros((count, 2)),
        "at_limit": np.zeros((count, 3), dtype=bool),
        "at_speed_limit": np.zeros((count, 3), dtype=bool),
    }
    # The start does not count: the robot is still on its way to the hand.
    columns["point_error"][[0, settled + 4]] = 0.5, 0.2
    columns["at_limit"][settled + 7, :2] = True
    columns["at_speed_limit"][[settled + 2, settled + 9], 1] = True
    columns["point_error"][settled + 9, 1] = 0.01
    found = {
        measure.key: _worst_sample(recording, columns, measure) - settled
        for measure in MEASURES
    }
    assert found.pop("saturation") == 7
    assert found.pop("speed_limited") == 9
    assert set(found.values()) == {4}
    columns["valid"][settled:] = False
    assert _worst_sample(recording, columns, MEASURES[0]) == 0


def test_a_stop_finishes_what_is_under_way_and_writes_it_down(
    inputs: Path, tmp_path: Path
) -> None:
    plan = plan_batch([inputs], tmp_path, OPTIONS)
    seen: list[Line] = []
    tally = run_batch(
        plan,
        tmp_path,
        SERIAL,
        progress=seen.append,
        is_stopped=lambda: bool(seen),
    )
    assert not tally.is_complete
    assert (
        len(tally.done) == len(read_manifests(tmp_path)) == len(episodes(tmp_path)) == 1
    )
    assert len(batch(inputs, tmp_path).done) == 2
