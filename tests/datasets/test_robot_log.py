"""Logs of robots become data sets, whose efforts are in newton metres and named by joint."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from handmap_qp.apps.datasets.robot_log import (
    RobotLog,
    is_robot_log,
    read_robot_log,
    save_robot_log,
    write_robot_logs,
)
from handmap_qp.cli import main
from handmap_qp.errors import RecordingError
from handmap_qp.trackers import read_recording
from handmap_qp.trackers.formats.mcap import _joint_states

h5py = pytest.importorskip("h5py")
parquet = pytest.importorskip("pyarrow.parquet")
rosbags = pytest.importorskip("rosbags.rosbag2")

NAMES = ("thumb", "index", "slide")
RATE = 50.0
COUNT = 101
TIME = np.arange(COUNT) / RATE
Q = np.column_stack([np.sin(TIME), np.cos(TIME), 0.01 * TIME])
TOLD = Q + 0.05
# Linear in time, so that interpolation is exact.
EFFORT = np.column_stack([0.1 * TIME, -0.2 * TIME, 5.0 - TIME])

LANDMARKS = read_recording(Path("demo"), "left").landmarks[0]


def log(**changes: Any) -> RobotLog:
    columns: dict[str, Any] = {
        "name": "take",
        "time": 7.0 + TIME,
        "joint_names": NAMES,
        "q": Q,
        "action": TOLD,
        "effort": EFFORT,
        "episode": np.zeros(COUNT),
        "task": "lift a cup",
        "robot": "leap",
    }
    return RobotLog(**(columns | changes))


def archive(path: Path, **changes: Any) -> Path:
    """Write an archive as a program of others may."""
    arrays: dict[str, Any] = {
        "time": TIME,
        "joint_names": np.array(NAMES),
        "q": Q,
        "action": TOLD,
    }
    arrays |= changes
    kept = {name: each for name, each in arrays.items() if each is not None}
    np.savez(path, **kept)
    return path


def frames_of(root: Path) -> dict[str, np.ndarray]:
    """Return the columns of a data set of LeRobot."""
    table = parquet.read_table(root / "data")
    return {name: np.array(table[name].to_pylist()) for name in table.column_names}


def features_of(root: Path) -> dict[str, Any]:
    return json.loads((root / "meta" / "info.json").read_text())["features"]


def test_a_log_is_read_as_it_was_written(tmp_path: Path) -> None:
    given = log(effort=np.where([True, False, True], EFFORT, np.nan))
    file = tmp_path / "take.npz"
    save_robot_log(file, given)
    assert is_robot_log(file)
    found = read_robot_log(file)
    assert (found.name, found.joint_names) == (given.name, given.joint_names)
    assert (found.task, found.robot) == ("lift a cup", "leap")
    for name in ("time", "q", "action", "effort", "episode"):
        np.testing.assert_array_equal(getattr(found, name), getattr(given, name))


def test_a_set_of_lerobot_has_efforts_by_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    file = tmp_path / "take.npz"
    save_robot_log(file, log())
    root = tmp_path / "cups"
    assert main(["convert", str(file), str(root), "--fps", "25"]) == 0
    assert "1 logs, 101 samples\nnothing was lost" in capsys.readouterr().out
    features = features_of(root)
    assert features["observation.effort"]["names"] == [*NAMES]
    assert features["observation.state"]["names"] == [*NAMES]
    assert "observation.valid" not in features
    frames = frames_of(root)
    instants = np.arange(51) / 25.0
    np.testing.assert_allclose(frames["timestamp"], instants, atol=1e-6)
    expected = np.column_stack([0.1 * instants, -0.2 * instants, 5.0 - instants])
    np.testing.assert_allclose(frames["observation.effort"], expected, atol=1e-6)
    np.testing.assert_allclose(frames["observation.state"], Q[::2], atol=1e-6)
    np.testing.assert_allclose(frames["action"], TOLD[::2], atol=1e-6)
    stats = json.loads((root / "meta" / "stats.json").read_text())
    assert stats["observation.effort"]["max"] == pytest.approx([0.2, 0.0, 5.0])
    (task,) = parquet.read_table(root / "meta" / "tasks.parquet")["task"].to_pylist()
    assert task == "lift a cup"


def test_a_file_of_robomimic_has_efforts_by_joint(tmp_path: Path) -> None:
    file = tmp_path / "take.npz"
    save_robot_log(file, log())
    out = tmp_path / "cups.hdf5"
    assert main(["convert", str(file), str(out)]) == 0
    with h5py.File(out) as data:
        env = json.loads(data["data"].attrs["env_args"])
        assert env["env_name"] == "leap"
        assert env["env_kwargs"]["effort_names"] == [*NAMES]
        demo = data["data/demo_0"]
        # At the log's own rate, frames are its rows.
        np.testing.assert_allclose(demo["obs/effort"][:], EFFORT, atol=1e-9)
        np.testing.assert_allclose(demo["next_obs/effort"][:-1], EFFORT[1:], atol=1e-9)
        np.testing.assert_allclose(demo["actions"][:], TOLD, atol=1e-9)


def test_currents_become_torques_where_the_constant_is_known(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    constants = np.array([0.5, np.nan, 2.0])
    current = np.column_stack([TIME, TIME, 1.0 - TIME])
    file = archive(tmp_path / "a.npz", current=current, torque_constant=constants)
    root = tmp_path / "set"
    assert main(["convert", str(file), str(root)]) == 0
    assert "lost: efforts of index, not known" in capsys.readouterr().out
    assert features_of(root)["observation.effort"]["names"] == ["thumb", "slide"]
    found = frames_of(root)["observation.effort"]
    expected = np.column_stack([0.5 * TIME, 2.0 - 2.0 * TIME])
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_without_efforts_a_set_has_no_such_column(tmp_path: Path) -> None:
    root = tmp_path / "set"
    assert main(["convert", str(archive(tmp_path / "a.npz")), str(root)]) == 0
    assert "observation.effort" not in features_of(root)


def test_only_efforts_that_all_logs_have_are_kept(tmp_path: Path) -> None:
    lost = log(name="other", effort=np.where(np.arange(3) == 0, np.nan, EFFORT))
    assert write_robot_logs([log(), lost], tmp_path / "set", "lerobot") == ("thumb",)
    assert features_of(tmp_path / "set")["observation.effort"]["names"] == [*NAMES[1:]]


def test_each_episode_of_a_log_is_one_of_the_set(tmp_path: Path) -> None:
    # The key was let go for 2 s, and the last press has one sample.
    number = np.repeat([0, 1, 2], [40, COUNT - 41, 1])
    parted = log(episode=number, time=TIME + 2.0 * number)
    write_robot_logs([parted], tmp_path / "set", "lerobot")
    frames = frames_of(tmp_path / "set")
    lengths = np.bincount(frames["episode_index"])
    assert lengths.tolist() == [40, COUNT - 41]
    # Nothing was interpolated across the pause.
    steps = np.abs(np.diff(frames["observation.state"], axis=0))
    assert steps.max() < 1.5 / RATE


def test_whole_numbers_are_positions_too(tmp_path: Path) -> None:
    found = read_robot_log(archive(tmp_path / "a.npz", q=np.zeros((COUNT, 3), int)))
    assert not found.q.any()
    assert not found.known_efforts.any()


def write_bag(
    path: Path,
    effort: bool = True,
    commands: bool = True,
    landmarks: bool = False,
) -> Path:
    """Write a bag as `ros2 bag record` does beside `handmap ros2`; return its file."""
    write_bag_folder(path.parent / "bag", effort, commands, landmarks)
    (file,) = (path.parent / "bag").glob("*.mcap")
    return file.rename(path)


def write_bag_folder(
    folder: Path, effort: bool = True, commands: bool = True, landmarks: bool = False
) -> None:
    """Write the folder of such a bag."""
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"
    types = store.types
    with rosbags.Writer(
        folder, version=9, storage_plugin=rosbags.StoragePlugin.MCAP
    ) as writer:
        topics = ["/lab/joint_states", "/lab/joint_commands"][: 1 + commands]
        states, *told = (
            writer.add_connection(topic, kind, typestore=store) for topic in topics
        )
        hand = writer.add_connection(
            "/left_hand/landmarks", "geometry_msgs/msg/PoseArray", typestore=store
        )
        for i, time in enumerate(TIME):
            stamp = round(1e9 * (time + 1.0))
            header = types["std_msgs/msg/Header"](
                types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9)), "base"
            )

            def put(connection: Any, names: Any, *columns: Any) -> None:
                values = (np.array(column, dtype=float) for column in columns)
                message = types[kind](header, [*names], *values)  # noqa: B023
                content = store.serialize_cdr(message, kind)
                writer.write(connection, stamp, content)  # noqa: B023

            # Another order, and a joint of the arm.
            torque = [9.0, *EFFORT[i, ::-1]] if effort else []
            put(states, ("arm", *NAMES[::-1]), [0.3, *Q[i, ::-1]], [], torque)
            # Commands begin later, at half the rate.
            if i >= 10 and i % 2 == 0:
                for connection in told:
                    put(connection, NAMES, TOLD[i], [], [])
            if landmarks:
                put_hand(store, writer, hand, header)


def put_hand(store: Any, writer: Any, connection: Any, header: Any) -> None:
    """Write the landmarks of the demo's first sample."""
    kind = "geometry_msgs/msg/PoseArray"
    types = store.types
    upright = types["geometry_msgs/msg/Quaternion"](0.0, 0.0, 0.0, 1.0)
    points = [types["geometry_msgs/msg/Point"](*point) for point in LANDMARKS.tolist()]
    poses = [types["geometry_msgs/msg/Pose"](point, upright) for point in points]
    message = types[kind](header, poses)
    stamp = header.stamp.sec * 10**9 + header.stamp.nanosec
    writer.write(connection, stamp, store.serialize_cdr(message, kind))


def test_readings_that_repeat_and_efforts_of_other_joints_are_left_out() -> None:
    """Drivers may send a reading twice, and some send efforts of the motors alone."""

    def message(time: float, position: float, effort: list[float]) -> SimpleNamespace:
        stamp = SimpleNamespace(sec=0, nanosec=round(1e9 * time))
        return SimpleNamespace(
            header=SimpleNamespace(stamp=stamp),
            name=["a", "b"],
            position=np.full(2, position),
            effort=np.array(effort),
        )

    messages = [
        message(0.1, 1.0, [0.5, 0.6]),
        message(0.1, 2.0, [0.7, 0.8]),
        message(0.05, 3.0, []),
        message(0.2, 4.0, [0.9]),
    ]
    found = _joint_states(Path("take"), "/lab/joint_states", messages)
    np.testing.assert_allclose(found.time, [0.1, 0.2])
    np.testing.assert_array_equal(found.position, [[1.0, 1.0], [4.0, 4.0]])
    np.testing.assert_array_equal(found.effort, [[0.5, 0.6], [np.nan, np.nan]])


def test_the_folder_of_a_bag_is_a_log(
    tmp_path: Path, capsys: pytest.CaptureFixture
) -> None:
    """`ros2 bag record` writes a folder."""
    folder = tmp_path / "take"
    write_bag_folder(folder)
    assert is_robot_log(folder)
    assert read_robot_log(folder).name == "take"
    out = tmp_path / "set"
    assert main(["convert", str(folder), str(out)]) == 0
    assert "nothing was lost" in capsys.readouterr().out
    assert features_of(out)["observation.effort"]["names"] == [*NAMES]


def test_a_bag_with_landmarks_is_a_recording_beside_commands(tmp_path: Path) -> None:
    """Who records all topics of a session has both, and landmarks are what was converted before."""
    file = write_bag(tmp_path / "take.mcap", landmarks=True)
    assert not is_robot_log(file)
    out = tmp_path / "hand.npz"
    assert main(["convert", str(file), str(out)]) == 0
    with np.load(out) as found:
        assert found["landmarks"].shape == (COUNT, 21, 3)


def test_a_bag_with_states_and_commands_is_a_log(tmp_path: Path) -> None:
    file = write_bag(tmp_path / "take.mcap")
    assert is_robot_log(file)
    found = read_robot_log(file)
    assert found.joint_names == NAMES
    np.testing.assert_allclose(found.time, 1.0 + TIME[10:], atol=1e-9)
    np.testing.assert_allclose(found.q, Q[10:])
    np.testing.assert_allclose(found.effort, EFFORT[10:])
    # The newest command at each instant.
    np.testing.assert_allclose(found.action, TOLD[10 + np.arange(91) // 2 * 2])


def test_a_bag_without_efforts_has_none(tmp_path: Path) -> None:
    found = read_robot_log(write_bag(tmp_path / "take.mcap", effort=False))
    assert not found.known_efforts.any()


def test_a_bag_without_commands_is_no_log(tmp_path: Path) -> None:
    assert not is_robot_log(write_bag(tmp_path / "take.mcap", commands=False))


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"q": Q[:-1]}, "q: expected finite numbers of shape"),
        ({"q": np.where(Q > 0.9, np.nan, Q)}, "q: expected finite"),
        ({"time": TIME[::-1]}, "time: expected strictly increasing"),
        ({"effort": EFFORT[:, :2]}, "effort: expected numbers of shape"),
        ({"current": EFFORT}, "torque_constant"),
        ({"current": EFFORT, "torque_constant": np.ones(2)}, "a.npz"),
        ({"joint_names": np.array(3)}, "a.npz"),
        ({"task": np.array(["a", "b"])}, "a.npz"),
        ({"episode": -np.arange(COUNT)}, "episode: expected numbers that do not fall"),
        ({"joint_names": np.array(["a", "b", "a"])}, "joint_names: .* got a twice"),
    ],
)
def test_what_cannot_be_used_is_said(
    tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    file = archive(tmp_path / "a.npz", **changes)
    with pytest.raises(RecordingError, match=said):
        read_robot_log(file)


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["LOG", "out.csv"], "a data set for logs of a robot"),
        (["LOG", "demo", "out"], "logs of a robot alone"),
        (["LOG", "OTHER", "out"], "logs of one robot"),
        (["LOG", "out", "--fps", "0"], "--fps: expected frames a second"),
        (["LOG", "out", "--fps", "1e9"], "--fps: expected frames a second"),
        (["LOG", "out", "--side", "left"], "--side: expected not for logs"),
        (["LOG", "out", "--mano", "model"], "--mano: expected not for logs"),
        (["INSTANTS", "out"], "IN: expected an episode of two instants"),
        (["INSTANTS", "out.hdf5"], "IN: expected an episode of two instants"),
    ],
)
def test_convert_refuses_what_is_no_set_of_one_robot(
    tmp_path: Path, words: list[str], said: str, capsys: pytest.CaptureFixture
) -> None:
    files = {
        "LOG": archive(tmp_path / "a.npz"),
        "OTHER": archive(tmp_path / "b.npz", joint_names=np.array(["a", "b", "c"])),
        "INSTANTS": archive(tmp_path / "c.npz", episode=np.arange(COUNT)),
    }
    given = [str(files.get(word, word)) for word in words]
    given = [str(tmp_path / word) if word.startswith("out") else word for word in given]
    assert main(["convert", *given]) == 2
    assert said in capsys.readouterr().err
    assert not [*tmp_path.glob("out*")]
