"""File formats: every recording survives every format, and every damage is one line."""

from __future__ import annotations

import errno
import json
import os
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from lerobot_tables import columns_of, episodes_of
from mano_model import write_mano_model

from handmap_qp import (
    InvalidInputError,
    Recording,
    RecordingError,
    load_hand,
    read_recording,
)
from handmap_qp.errors import DiskFullError, MissingExtraError
from handmap_qp.hands import Side
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.se3 import rotation_from_rpy
from handmap_qp.trackers.formats import (
    FORMATS,
    Source,
    format_to_write,
    lerobot,
    list_sources,
    write_recordings,
)
from handmap_qp.trackers.formats.base import RecordingFormat
from handmap_qp.trackers.formats.hdf5 import joint_names
from handmap_qp.trackers.formats.mano import FROM_MANO

h5py = pytest.importorskip("h5py")
pq = pytest.importorskip("pyarrow.parquet")
pytest.importorskip("rosbags")

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow

LOSSLESS = ("npz", "robomimic")
ONE_WAY = ("lerobot", "npy", "dexycb", "arctic", "grab", "hot3d")
READ = [form for form in FORMATS.own.values() if form.name not in ONE_WAY]


def hand(
    side: Side = "right", count: int = 6, seed: int = 0, **changes: Any
) -> Recording:
    """A moving human hand, with a gap, wrist poses and confidences."""
    rng = np.random.default_rng(seed)
    human = load_hand("human" if side == "right" else "human_left", points="landmarks")
    landmarks, wrist = [], []
    for i in range(count):
        pose = np.eye(4)
        pose[:3, :3] = rotation_from_rpy([0.1 * i, 0.2, -0.1 * i])
        pose[:3, 3] = rng.normal(size=3)
        wrist.append(pose)
        landmarks.append(
            human.points(0.9 * human.rest, pose) + rng.normal(0, 1e-4, (21, 3))
        )
    values: dict = {
        "name": "take",
        "time": 3.0 + np.cumsum(rng.uniform(0.01, 0.04, count)),
        "landmarks": np.array(landmarks),
        "valid": np.arange(count) != 2,
        "side": side,
        "source": "a test",
        "task": "wave",
        "wrist": np.array(wrist),
        "confidence": rng.uniform(0.1, 1.0, count),
        **changes,
    }
    return Recording(**values)


def path_of(folder: Path, form: RecordingFormat, name: str = "take") -> Path:
    return folder / f"{name}{form.suffixes[0] if form.suffixes else ''}"


def assert_same(found: Recording, given: Recording) -> None:
    """What every format keeps; exact where the format says that it loses nothing."""
    assert found.side == given.side
    np.testing.assert_array_equal(found.valid, given.valid)
    np.testing.assert_array_equal(
        found.landmarks[given.valid], given.landmarks[given.valid], strict=True
    )


@pytest.mark.parametrize("form", READ, ids=lambda form: form.name)
@pytest.mark.parametrize("is_plain", [False, True], ids=["all", "plain"])
def test_a_hand_survives(form: RecordingFormat, is_plain: bool, tmp_path: Path) -> None:
    without: dict[str, Any] = {"wrist": None, "confidence": None, "source": ""}
    given = hand(**(without if is_plain else {}))
    path = path_of(tmp_path, form)
    losses = write_recordings([given], path, form)
    found = read_recording(path)
    assert_same(found, given)
    np.testing.assert_allclose(found.time, given.time, atol=6e-10, rtol=0)
    # The compiled core takes floats of this machine's byte order alone.
    assert {found.time.data.format, found.landmarks.data.format} == {"d"}
    lost = " ".join(losses)
    if form.name in LOSSLESS:
        assert not losses
        assert (found.source, found.task) == (given.source, given.task)
    if "instants" not in lost:
        np.testing.assert_array_equal(found.time, given.time, strict=True)
    if "wrist" not in lost:
        if given.wrist is None:
            assert found.wrist is None
        else:
            assert found.wrist is not None
            np.testing.assert_array_equal(
                found.wrist[given.valid], given.wrist[given.valid]
            )
    if "confidence" not in lost:
        assert (found.confidence is None) == (given.confidence is None)
    if given.confidence is not None and found.confidence is not None:
        np.testing.assert_allclose(
            found.confidence[given.valid], given.confidence[given.valid], rtol=1e-15
        )
    assert sorted(path.parent.iterdir()) == [path], "nothing else is written"


@pytest.mark.parametrize("form", READ, ids=lambda form: form.name)
def test_two_hands_in_one_file(form: RecordingFormat, tmp_path: Path) -> None:
    right = hand("right")
    left = hand("left", seed=1, time=right.time)
    path = path_of(tmp_path, form)
    if form.name == "mano":
        with pytest.raises(InvalidInputError, match="recordings"):
            write_recordings([left, right], path, form)
        return
    write_recordings([left, right], path, form)
    found = {
        recording.side: recording for recording in map(Source.read, list_sources(path))
    }
    assert_same(found["left"], left)
    assert_same(found["right"], right)
    assert_same(read_recording(path, "left"), left)
    with pytest.raises(RecordingError, match="it has 2 recordings"):
        read_recording(path)
    (source,) = [s for s in list_sources(path) if s.entry.side == "right"]
    assert_same(read_recording(f"{path}::{source.entry.name}"), right)
    with pytest.raises(RecordingError, match="has no recording 'absent'"):
        read_recording(f"{path}::absent")


PLAIN: tuple[dict[str, Any], ...] = ({}, {"wrist": None})


def test_many_recordings_in_one_set(tmp_path: Path) -> None:
    form, path = FORMATS["robomimic"], tmp_path / "set.hdf5"
    given = [
        hand(count=3 + i, seed=i, name=f"take{i}", **PLAIN[i % 2]) for i in range(12)
    ]
    write_recordings(given, path, form)
    sources = list_sources(path)
    assert [source.entry.samples for source in sources] == [3 + i for i in range(12)]
    for source, recording in zip(sources, given, strict=True):
        found = source.read()
        assert found.name == recording.name
        assert_same(found, recording)
        assert (found.wrist is None) == (recording.wrist is None)


@settings(max_examples=20)
@given(
    landmarks=hnp.arrays(float, (3, 21, 3), elements=st.floats(-1e6, 1e6)),
    times=st.lists(st.floats(-1e6, 1e6), min_size=3, max_size=3, unique=True),
    valid=st.lists(st.booleans(), min_size=3, max_size=3).filter(any),
)
@pytest.mark.parametrize("name", ["npz", "csv"])
def test_every_number_survives(
    name: str,
    tmp_path_factory: pytest.TempPathFactory,
    landmarks: np.ndarray,
    times: list[float],
    valid: list[bool],
) -> None:
    given = Recording("r", np.sort(times), landmarks, np.array(valid), "left")
    path = path_of(tmp_path_factory.mktemp("numbers"), FORMATS[name])
    write_recordings([given], path)
    found = read_recording(path)
    np.testing.assert_array_equal(found.landmarks, given.landmarks)
    np.testing.assert_array_equal(found.time, given.time)
    np.testing.assert_array_equal(found.valid, given.valid)


def test_a_lerobot_set_is_read_by_pyarrow_alone(tmp_path: Path) -> None:
    given = [hand(count=4), hand("left", count=7, seed=2, task="")]
    write_recordings(given, tmp_path / "set")
    info = json.loads((tmp_path / "set/meta/info.json").read_text())
    assert info["codebase_version"] == "v3.0"
    assert (info["total_episodes"], info["total_frames"]) == (2, 11)
    table = pq.read_table(tmp_path / "set/data/chunk-000/file-000.parquet")
    assert set(table.column_names) == set(info["features"])
    for name, feature in info["features"].items():
        size = len(feature["names"]) if feature["names"] else 1
        assert feature["shape"] == [size], name
    np.testing.assert_array_equal(table["index"].to_numpy(), np.arange(11))
    np.testing.assert_array_equal(
        table["frame_index"].to_numpy(), [*range(4), *range(7)]
    )
    np.testing.assert_allclose(
        table["timestamp"].to_numpy(),
        table["frame_index"].to_numpy() / info["fps"],
        rtol=1e-6,
    )
    episodes = pq.read_table(
        tmp_path / "set/meta/episodes/chunk-000/file-000.parquet"
    ).to_pylist()
    assert [e["length"] for e in episodes] == [4, 7]
    assert [(e["dataset_from_index"], e["dataset_to_index"]) for e in episodes] == [
        (0, 4),
        (4, 11),
    ]
    stats = json.loads((tmp_path / "set/meta/stats.json").read_text())
    times = np.concatenate([recording.time for recording in given])
    assert stats["observation.time"]["mean"][0] == pytest.approx(times.mean())
    assert stats["observation.time"]["std"][0] == pytest.approx(times.std())
    assert stats["observation.time"]["count"] == [11]
    tasks = pq.read_table(tmp_path / "set/meta/tasks.parquet").to_pydict()
    assert tasks == {
        "task_index": [0, 1],
        "task": ["wave", "left human hand"],
    }
    with pytest.raises(InvalidInputError, match="exists already"):
        write_recordings(given, tmp_path / "set")
    for i, recording in enumerate(given):
        columns, episode = (
            columns_of(tmp_path / "set", i),
            episodes_of(tmp_path / "set")[i],
        )
        assert (episode["name"], episode["side"]) == (recording.name, recording.side)
        np.testing.assert_array_equal(columns["observation.time"], recording.time)
        np.testing.assert_array_equal(
            columns["observation.landmarks"], recording.landmarks.reshape(-1, 63)
        )
        np.testing.assert_array_equal(columns["observation.valid"], recording.valid)
        assert recording.wrist is not None
        np.testing.assert_array_equal(
            columns["observation.wrist"], recording.wrist[:, :3].reshape(-1, 12)
        )


def test_a_full_file_of_a_lerobot_set_is_followed_by_another(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lerobot, "DATA_FILE_SIZE", 1)
    monkeypatch.setattr(lerobot, "CHUNK_FILES", 2)
    write_recordings([hand(count=3 + i) for i in range(3)], tmp_path / "set")
    files = sorted((tmp_path / "set/data").rglob("*.parquet"))
    names = [file.relative_to(tmp_path / "set/data").as_posix() for file in files]
    folder = "chunk-00{}/file-00{}.parquet"
    assert names == [folder.format(i // 2, i % 2) for i in range(3)]
    assert [len(pq.read_table(file)) for file in files] == [3, 4, 5]
    episodes = episodes_of(tmp_path / "set")
    assert [e["data/chunk_index"] for e in episodes] == [0, 0, 1]
    assert [e["data/file_index"] for e in episodes] == [0, 1, 0]


@pytest.mark.parametrize("name", ["robomimic", "egodex"])
def test_room_for_hdf5_is_checked_before_it_is_written(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """libhdf5 crashes on a full disk, so room for all arrays must have been seen before."""
    pytest.importorskip("h5py")
    form, path = FORMATS[name], tmp_path / "take.hdf5"
    sizes: list[int] = []
    monkeypatch.setattr(os, "posix_fallocate", lambda *args: sizes.append(args[2]))
    form.write([hand()], path)
    before = path.read_bytes()
    assert sum(sizes) > len(before)

    def full(*args: int) -> None:
        raise OSError(errno.ENOSPC, "")

    monkeypatch.setattr(os, "posix_fallocate", full)
    with pytest.raises(DiskFullError, match="No space left"):
        form.write([hand()], path)
    assert path.read_bytes() == before
    assert [*tmp_path.iterdir()] == [path]


def test_a_lerobot_set_is_not_read(tmp_path: Path) -> None:
    write_recordings([hand()], tmp_path / "set")
    with pytest.raises(RecordingError, match="written and not read") as caught:
        read_recording(tmp_path / "set")
    assert caught.value.file == tmp_path / "set"


def test_egodex_is_read_as_documented(tmp_path: Path) -> None:
    rng, count = np.random.default_rng(0), 5
    poses = np.tile(np.eye(4), (count, 1, 1))
    with h5py.File(tmp_path / "0.hdf5", "w") as file:
        file["camera/intrinsic"] = np.eye(3)
        file.attrs["llm_description"] = "plug it in"
        file.attrs["llm_description2"] = "unplug it"
        for side in ("left", "right"):
            for name in (*joint_names(side), f"{side}IndexFingerMetacarpal"):
                poses[:, :3, 3] = rng.normal(size=(count, 3))
                file[f"transforms/{name}"] = poses.astype(np.float32)
                file[f"confidences/{name}"] = np.linspace(0.0, 1.0, count)
        expected = file["transforms/leftMiddleFingerIntermediateTip"][:, :3, 3]
    left = read_recording(tmp_path / "0.hdf5", "left")
    np.testing.assert_array_equal(left.landmarks[:, 11], expected)
    np.testing.assert_array_equal(left.time, np.arange(count) / 30.0)
    np.testing.assert_array_equal(left.valid, [False, True, True, True, True])
    assert left.confidence is not None
    np.testing.assert_allclose(left.confidence, np.linspace(0.0, 1.0, count))
    assert left.task == "plug it in"
    with h5py.File(tmp_path / "0.hdf5", "a") as file:
        file.attrs["which_llm_description"] = "2"
    assert read_recording(tmp_path / "0.hdf5", "left").task == "unplug it"
    (source, _) = list_sources(tmp_path / "0.hdf5")
    assert "2 other poses" in source.format.unread(source.path)


@pytest.mark.parametrize("has_wrist", [False, True])
def test_joint_states_of_ros_become_a_hand_by_the_model(
    has_wrist: bool, tmp_path: Path
) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store, kind = get_typestore(Stores.ROS2_HUMBLE), "sensor_msgs/msg/JointState"
    human = load_hand("human_left", points="landmarks")
    order = list(reversed(HUMAN_JOINTS))
    with Writer(
        tmp_path / "bag", version=9, storage_plugin=StoragePlugin.MCAP
    ) as writer:
        topic = writer.add_connection("/glove/left/joint_states", kind, typestore=store)
        for i in range(3):
            time = store.types["builtin_interfaces/msg/Time"](7, 10**7 * i)
            header = store.types["std_msgs/msg/Header"](time, "")
            values = dict(zip(human.joint_names, 0.5 * i * human.rest, strict=True))
            position = np.array([values[name] for name in order])
            names, none = [f"left_{name}" for name in order], np.zeros(0)
            message = store.types[kind](header, names, position, none, none)
            writer.write(topic, i, store.serialize_cdr(message, kind))
        if has_wrist:
            kind = "geometry_msgs/msg/PoseStamped"
            topic = writer.add_connection("/left/wrist", kind, typestore=store)
            for i in (0, 2):  # the second one was lost
                time = store.types["builtin_interfaces/msg/Time"](7, 10**7 * i)
                header = store.types["std_msgs/msg/Header"](time, "")
                place = store.types["geometry_msgs/msg/Point"](0.0, 0.0, 1.0)
                turn = store.types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
                pose = store.types["geometry_msgs/msg/Pose"](place, turn)
                message = store.types[kind](header, pose)
                writer.write(topic, i, store.serialize_cdr(message, kind))
    for path in (tmp_path / "bag", tmp_path / "bag" / "bag.mcap"):
        found = read_recording(path)
        assert found.side == "left"
        np.testing.assert_allclose(found.time, [7.0, 7.01, 7.02], rtol=0, atol=1e-12)
        np.testing.assert_array_equal(found.valid, [True, not has_wrist, True])
        for i in np.flatnonzero(found.valid):
            expected = human.points(0.5 * i * human.rest)
            expected[:, 2] += has_wrist
            np.testing.assert_allclose(found.landmarks[i], expected)


def test_mano_joints_are_put_in_order(tmp_path: Path) -> None:
    assert sorted(FROM_MANO) == list(range(21))
    right = hand()
    mano = np.empty((len(right), 21, 3))
    # MANO: index, middle, little, ring, thumb; then the tips from thumb to little.
    order = [0, 5, 6, 7, 9, 10, 11, 17, 18, 19, 13, 14, 15, 1, 2, 3, 4, 8, 12, 16, 20]
    mano[:] = right.landmarks[:, order]
    np.savez(tmp_path / "m.npz", joints=mano, side="right", fps=30.0, valid=right.valid)
    found = read_recording(tmp_path / "m.npz")
    assert_same(found, right)
    np.testing.assert_allclose(found.time, np.arange(6) / 30.0)


@pytest.mark.parametrize("suffix", [".pkl", ".npz"])
def test_mano_parameters_go_through_the_users_model(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    rng, path = np.random.default_rng(1), tmp_path / "p.npz"
    turns, shift = rng.normal(0.0, 0.3, (4, 45)), rng.normal(size=(4, 3))
    given: dict[str, Any] = {
        "side": "right",
        "fps": 30.0,
        "transl": shift,
        "betas": np.ones(10),
    }
    root = np.array(
        [[0.0, 0.0, 0.0], [0.0, 0.0, np.pi / 2], [0.3, 0.1, 0.2], [0.0, np.pi, 0.0]]
    )
    turns[1] = turns[0]
    given |= {"global_orient": root, "hand_pose": turns, "flat_hand_mean": True}
    np.savez(path, **given)
    monkeypatch.delenv("HANDMAP_MANO", raising=False)
    with pytest.raises(RecordingError, match="need the licensed model"):
        read_recording(path)
    model = tmp_path / f"MANO_RIGHT{suffix}"
    write_mano_model(model)
    monkeypatch.setenv("HANDMAP_MANO", str(tmp_path if suffix == ".pkl" else model))
    hands = read_recording(path).landmarks - shift[:, None]
    # The wrist stays where it is; the same fingers under another wrist are the same, turned.
    np.testing.assert_allclose(hands[:, 0], hands[:1, 0].repeat(4, axis=0), atol=1e-12)
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    still = hands[0] - hands[0, 0]
    np.testing.assert_allclose(hands[1] - hands[1, 0], still @ quarter.T, atol=1e-12)
    # Components of all 45 directions say the same as the angles that they span.
    components = (
        dict(np.load(model)) if suffix == ".npz" else pickle.loads(model.read_bytes())
    )
    basis, mean = components["hands_components"], components["hands_mean"]
    np.savez(
        path,
        **{**given, "hand_pose": (turns @ basis.T)[:, :44], "flat_hand_mean": True},
    )
    rest = turns - np.outer(turns @ basis[44], basis[44])
    found = read_recording(path).landmarks
    np.savez(path, **{**given, "hand_pose": rest - mean, "flat_hand_mean": False})
    np.testing.assert_allclose(read_recording(path).landmarks, found, atol=1e-12)


def test_a_model_that_runs_code_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    np.savez(
        tmp_path / "p.npz",
        side="right",
        fps=30.0,
        pose=np.zeros((3, 48)),
        flat_hand_mean=True,
    )
    monkeypatch.setenv("HANDMAP_MANO", str(tmp_path))
    (tmp_path / "MANO_RIGHT.pkl").write_bytes(pickle.dumps({"v_template": print}))
    with pytest.raises(
        RecordingError, match=r"holds builtins.print, which is not read"
    ):
        read_recording(tmp_path / "p.npz")


BROKEN: dict[str, tuple[str, Callable[[Path], object], str]] = {
    "csv column": ("csv", lambda p: p.write_text("side,time\n"), "line 1: has no column 'wrist_x'"),
    "csv field": (
        "csv",
        lambda p: edit_line(p, 4, lambda line: line.replace(",", ",oops", 1)),
        "line 4: time: expected a number, got 'oops",
    ),
    "csv short row": (
        "csv",
        lambda p: edit_line(p, 3, lambda line: line.rpartition(",")[0]),
        "line 3: expected 79 fields, got 78",
    ),
    "csv side": (
        "csv",
        lambda p: edit_line(p, 5, lambda line: line.replace("right", "up")),
        "line 5: side: expected right or left, got 'up'",
    ),
    "csv time": (
        "csv",
        lambda p: edit_line(p, 5, lambda line: "right,0.0," + line.split(",", 2)[2]),
        "time: expected strictly increasing instants, got 0.0 at sample 3",
    ),
    "hdf5 array": (
        "egodex",
        lambda p: edit_h5(p, "transforms/rightThumbTip"),
        "rightThumbTip: is missing",
    ),
    "hdf5 shape": (
        "robomimic",
        lambda p: edit_h5(p, "data/demo_0/obs/time", np.zeros(3)),
        "data/demo_0/obs/time: expected numbers of shape (6,), got float64 of shape (3,)",
    ),
    "hdf5 words": (
        "robomimic",
        lambda p: edit_h5(p, "data/demo_0/obs/valid", np.full(6, 2.0)),
        "data/demo_0/obs/valid: expected truth values, or 0 and 1",
    ),
    "mcap torn": (
        "mcap",
        lambda p: p.write_bytes(p.read_bytes()[:200]),
        "cannot be read as MCAP",
    ),
}  # fmt: skip


def edit_line(path: Path, number: int, change: Callable[[str], str]) -> None:
    lines = path.read_text().splitlines()
    lines[number - 1] = change(lines[number - 1])
    path.write_text("\n".join(lines))


def edit_h5(path: Path, name: str, value: np.ndarray | None = None) -> None:
    with h5py.File(path, "a") as file:
        del file[name]
        if value is not None:
            file[name] = value


@pytest.mark.parametrize(("name", "damage", "line"), BROKEN.values(), ids=BROKEN.keys())
def test_a_bad_file_is_one_line_with_its_place(
    tmp_path: Path, name: str, damage: Callable[[Path], object], line: str
) -> None:
    form, path = FORMATS[name], path_of(tmp_path, FORMATS[name])
    write_recordings([hand()], path, form)
    damage(path)
    with pytest.raises(RecordingError) as caught:
        read_recording(path)
    assert line in str(caught.value)
    assert "\n" not in str(caught.value)


def test_whatever_a_format_raises_is_an_error_of_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "take.npz"
    write_recordings([hand()], path)

    def fails(self: RecordingFormat, file: Path, entry: object = None) -> None:
        raise KeyError("absent\nhere")

    for method in ("read", "entries"):
        monkeypatch.setattr(type(FORMATS["npz"]), method, fails)
        with pytest.raises(RecordingError, match="absent") as caught:
            read_recording(path)
        assert caught.value.file == path
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("form", READ, ids=lambda form: form.name)
def test_files_of_noise_are_refused_in_one_line(
    form: RecordingFormat, tmp_path: Path
) -> None:
    rng = np.random.default_rng(5)
    path = path_of(tmp_path, form)
    write_recordings([hand()], path, form)
    file = max(
        (p for p in [path, *path.rglob("*")] if p.is_file()),
        key=lambda p: p.stat().st_size,
    )
    good = file.read_bytes()
    for _ in range(8):
        content = bytearray(good)
        for place in rng.integers(0, len(good), 5):
            content[place] = rng.integers(0, 256)
        file.write_bytes(bytes(content[: rng.integers(len(good) // 3, len(good))]))
        with pytest.raises(RecordingError) as caught:
            read_recording(path)
        assert "\n" not in str(caught.value)


def test_what_has_no_format_is_named(tmp_path: Path) -> None:
    (tmp_path / "a.txt").write_text("")
    for path, word in {
        tmp_path / "a.txt": "unknown suffix '.txt'; known are .npz",
        tmp_path: "is a folder of no known form",
        tmp_path / "absent.csv": "No such file",
    }.items():
        with pytest.raises(RecordingError, match=word):
            read_recording(path)
    with pytest.raises(
        InvalidInputError, match=r"OUT: expected a file that ends in one of .npz"
    ):
        format_to_write(tmp_path / "a.txt")
    with pytest.raises(InvalidInputError, match="--format: expected one of npz, csv"):
        format_to_write(tmp_path / "a", "zip")


def test_a_missing_package_names_its_extra(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, package in {
        "egodex": "h5py",
        "lerobot": "pyarrow",
        "mcap": "rosbags",
    }.items():
        with monkeypatch.context() as patch:
            patch.setitem(__import__("sys").modules, package, None)
            for part in ("pyarrow.parquet", "rosbags.rosbag2", "rosbags.typesys"):
                if part.startswith(package):
                    patch.setitem(__import__("sys").modules, part, None)
            with pytest.raises(
                MissingExtraError, match=r"pip install 'handmap-qp\[files\]'"
            ):
                write_recordings(
                    [hand()], path_of(tmp_path, FORMATS[name]), FORMATS[name]
                )
