"""Recordings as ROS 2 bags in MCAP: joint states, and landmarks as poses."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import HandmapError, InvalidInputError, RecordingError
from handmap_qp.hands.human import HUMAN_JOINTS
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.fit import fit_recording
from handmap_qp.human.landmarks import human_name
from handmap_qp.human.recording import Recording
from handmap_qp.human.sample import LANDMARK_COUNT
from handmap_qp.output_files import replaced_path
from handmap_qp.se3 import poses_from_quats, quat_wxyz_from_rotation
from handmap_qp.trackers.formats.archive import DAMAGES
from handmap_qp.trackers.formats.base import (
    SIDES,
    Entry,
    check_one_per_hand,
    entry_stem,
    reading,
    require,
)
from handmap_qp.trackers.formats.columns import finite_samples

_POSES, _STATE = "geometry_msgs/msg/PoseArray", "sensor_msgs/msg/JointState"
_POSE, _NUMBER = "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Float64"
_FRAME = "tracker"


@dataclass(frozen=True, slots=True)
class _Topics:
    """The topics of one hand, with their number of messages."""

    landmarks: str | None
    joints: str | None
    wrist: str | None
    confidence: str | None
    count: int

    @property
    def names(self) -> tuple[str | None, ...]:
        return (self.landmarks, self.joints, self.wrist, self.confidence)


class McapFormat:
    """A bag with topics below a namespace that has `left` or `right` in its name.

    Read are `.../landmarks` (geometry_msgs/PoseArray of 21 poses, MediaPipe's order) or, without
    them, `.../joint_states` (sensor_msgs/JointState with the 20 joints of `handmap hands human`, in
    radians; the hand then has the model's size); and `.../wrist` (geometry_msgs/PoseStamped) and
    `.../confidence` (std_msgs/Float64) of the same instants. Instants are those of the headers.

    Written are all of them; the joint states are fitted to the landmarks.
    """

    name = "mcap"
    suffixes = (".mcap",)
    about = "a ROS 2 bag: sensor_msgs/JointState, and landmarks as geometry_msgs/PoseArray"

    def recognises(self, path: Path) -> bool:
        """Tell whether it is a file, or the folder of a bag."""
        return path.is_file() or (path / "metadata.yaml").is_file()

    def entries(self, path: Path) -> tuple[Entry, ...]:
        """List the hands that have landmarks or joint states."""
        with _opened(path) as bag:
            hands = _hands(path, bag)
            return tuple(Entry(side, side, topics.count) for side, topics in hands.items())

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand."""
        with _opened(path) as bag:
            topics = _hands(path, bag)[entry.side]
            reader = _Reader(bag)
            name = topics.landmarks or topics.joints or ""
            times, messages = reader.stamped(name)
            wrist = _wrist_poses(reader, topics.wrist, times)
            if topics.landmarks is not None:
                landmarks = _landmarks(path, name, messages)
            else:
                landmarks = _forward(path, name, messages, entry.side, wrist)
            confidence = None
            if topics.confidence is not None:
                found = reader.logged(topics.confidence)
                confidence = np.array([found.get(stamp, np.nan) for stamp in reader.logs])
        valid = finite_samples(landmarks)
        if wrist is not None and not np.isfinite(wrist[valid]).all():
            wrist = None
        with reading(path, f"{name}: "):
            return Recording(
                name=entry_stem(path, entry),
                time=np.array(times),
                landmarks=landmarks,
                valid=valid,
                side=entry.side,
                source=f"ROS 2 bag, {name}",
                wrist=wrist,
                confidence=confidence,
            )

    def unread(self, path: Path) -> tuple[str, ...]:
        """Name the topics that a recording cannot hold."""
        with _opened(path) as bag:
            used = {topic for topics in _hands(path, bag).values() for topic in topics.names}
            return tuple(f"topic {topic}" for topic in sorted(set(bag.topics) - used))

    def losses(self, recordings: Sequence[Recording]) -> tuple[str, ...]:
        """Name what messages cannot hold."""
        lost = ["instants beyond whole nanoseconds", "the words about the source"]
        if any(not recording.valid.all() for recording in recordings):
            lost.append("landmarks of samples without a hand")
        if any(recording.wrist is not None for recording in recordings):
            lost.append("the last digit of the wrist's rotation, as a quaternion")
        return tuple(lost)

    def write(self, recordings: Sequence[Recording], path: Path) -> None:
        """Write one hand or both; a bag of one file, without the folder around it."""
        check_one_per_hand(recordings, self.name)
        bags = require("rosbags.rosbag2")
        for recording in recordings:
            if recording.time[0] < 0.0 or recording.time[-1] > 2.0**31:
                expected = "instants from 0 to 2^31 s, as ROS 2 has them"
                got = f"{recording.time[0]:g} to {recording.time[-1]:g}"
                raise InvalidInputError(argument="time", expected=expected, got=got)
        with (
            replaced_path(path, "path") as temporary,
            tempfile.TemporaryDirectory(prefix=f".{path.stem}-", dir=path.parent) as folder,
        ):
            bag = Path(folder) / path.stem
            with bags.Writer(bag, version=9, storage_plugin=bags.StoragePlugin.MCAP) as writer:
                _Writer(writer).write(recordings)
            (file,) = bag.glob("*.mcap")
            file.replace(temporary)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag, and turn what rosbags raises inside the block into `RecordingError`."""
    bags, serde = require("rosbags.rosbag2"), require("rosbags.serde")
    try:
        with bags.Reader(path) as bag:
            yield bag
    except HandmapError:
        raise
    # rosbags asserts on damaged records.
    except (bags.ReaderError, serde.SerdeError, AssertionError, *DAMAGES) as error:
        text = " ".join(str(error).split())
        raise RecordingError(f"cannot be read as MCAP: {text[:160]}", file=path) from error


def _store() -> Any:
    typesys = require("rosbags.typesys")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _hands(path: Path, bag: Any) -> dict[Side, _Topics]:
    """Find the topics of each hand by their types and names."""
    found: dict[Side, _Topics] = {}
    for side in SIDES:
        own = {name: info for name, info in bag.topics.items() if side in name.lower()}

        def pick(kind: str, word: str = "", own: dict[str, Any] = own) -> str | None:
            names = [n for n, info in own.items() if info.msgtype == kind and word in n]
            return names[0] if names else None

        landmarks, joints = pick(_POSES), pick(_STATE)
        main = landmarks or joints
        if main is not None:
            count = own[main].msgcount
            found[side] = _Topics(
                landmarks, joints, pick(_POSE, "wrist"), pick(_NUMBER, "confidence"), count
            )
    if not found:
        names = ", ".join(sorted(bag.topics)) or "none"
        problem = f"has no {_POSES} or {_STATE} with left or right in the topic's name; topics are "
        raise RecordingError(problem + names, file=path)
    return found


class _Reader:
    """Reads the messages of topics."""

    def __init__(self, bag: Any) -> None:
        self._bag, self._store = bag, _store()
        self.logs: list[int] = []

    def stamped(self, topic: str) -> tuple[list[float], list[Any]]:
        """Return the instants of the headers [s] and the messages; `logs` has the logged times."""
        times, messages = [], []
        for log, message in self._messages(topic):
            stamp = message.header.stamp
            times.append(stamp.sec + 1e-9 * stamp.nanosec)
            messages.append(message)
            self.logs.append(log)
        return times, messages

    def logged(self, topic: str) -> dict[int, float]:
        """Return the values of a topic of numbers by the logged times."""
        return {log: message.data for log, message in self._messages(topic)}

    def poses(self, topic: str) -> dict[float, tuple[float, ...]]:
        """Return seven numbers, position and quaternion wxyz, by instants."""
        found = {}
        for _, message in self._messages(topic):
            stamp, pose = message.header.stamp, message.pose
            p, q = pose.position, pose.orientation
            found[stamp.sec + 1e-9 * stamp.nanosec] = (p.x, p.y, p.z, q.w, q.x, q.y, q.z)
        return found

    def _messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        connections = [c for c in self._bag.connections if c.topic == topic]
        for connection, log, raw in self._bag.messages(connections=connections):
            yield log, self._store.deserialize_cdr(raw, connection.msgtype)


def _wrist_poses(reader: _Reader, topic: str | None, times: list[float]) -> np.ndarray | None:
    """Return the wrist's poses at the instants, NaN where there is none, shape (T, 4, 4)."""
    if topic is None:
        return None
    found, none = reader.poses(topic), (np.nan,) * 7
    rows = np.array([found.get(time, none) for time in times])
    is_given = np.isfinite(rows).all(axis=1)
    poses = np.full((len(rows), 4, 4), np.nan)
    if is_given.any():
        poses[is_given] = poses_from_quats(rows[is_given, :3], rows[is_given, 3:], topic)
    return poses


def _landmarks(path: Path, topic: str, messages: list[Any]) -> np.ndarray:
    rows = []
    for i, message in enumerate(messages):
        if len(message.poses) != LANDMARK_COUNT:
            problem = f"expected {LANDMARK_COUNT} poses, got {len(message.poses)} in message {i}"
            raise RecordingError(problem, file=path, array=topic)
        rows.append([(p.position.x, p.position.y, p.position.z) for p in message.poses])
    return np.array(rows).reshape(len(rows), LANDMARK_COUNT, 3)


def _forward(
    path: Path, topic: str, messages: list[Any], side: Side, wrist: np.ndarray | None
) -> np.ndarray:
    """Return the landmarks of joint states, by the model's own lengths."""
    human = load_hand(human_name(side), points="landmarks")
    rows = np.full((len(messages), LANDMARK_COUNT, 3), np.nan)
    for i, message in enumerate(messages):
        names = [name.removeprefix(f"{side}_") for name in message.name]
        missing = [name for name in HUMAN_JOINTS if name not in names]
        if missing or len(message.position) != len(names):
            problem = (
                f"message {i} has no position of joint {missing[0]!r}"
                if missing
                else (f"message {i} has {len(names)} names and {len(message.position)} positions")
            )
            raise RecordingError(problem, file=path, array=topic)
        q = message.position[[names.index(name) for name in HUMAN_JOINTS]]
        pose = np.eye(4) if wrist is None else wrist[i]
        if np.isfinite(q).all() and np.isfinite(pose).all():
            rows[i] = human.points(q, pose)
    return rows


class _Writer:
    """Writes the messages of recordings."""

    def __init__(self, writer: Any) -> None:
        self._writer, self._store = writer, _store()
        self._types = self._store.types

    def write(self, recordings: Sequence[Recording]) -> None:
        """Write all topics of each recording."""
        for recording in recordings:
            self._write_hand(recording)

    def _write_hand(self, recording: Recording) -> None:
        base, motion = f"/{recording.side}_hand", fit_recording(recording)
        landmarks = self._topic(f"{base}/landmarks", _POSES)
        joints = self._topic(f"{base}/joint_states", _STATE)
        wrist = None if recording.wrist is None else self._topic(f"{base}/wrist", _POSE)
        confidence = (
            None if recording.confidence is None else self._topic(f"{base}/confidence", _NUMBER)
        )
        names, none = list(motion.human.joint_names), np.zeros(0)
        for i, time in enumerate(recording.time.tolist()):
            stamp = round(1e9 * time)
            header = self._header(stamp)
            points = recording.landmarks[i] if recording.valid[i] else np.full((21, 3), np.nan)
            poses = [self._pose(point, (1.0, 0.0, 0.0, 0.0)) for point in points.tolist()]
            self._send(landmarks, stamp, _POSES, header, poses)
            if motion.valid[i]:
                self._send(joints, stamp, _STATE, header, names, motion.q[i], none, none)
            if wrist is not None and recording.wrist is not None and recording.valid[i]:
                pose = recording.wrist[i]
                turn = quat_wxyz_from_rotation(pose[:3, :3]).tolist()
                self._send(wrist, stamp, _POSE, header, self._pose(pose[:3, 3].tolist(), turn))
            if confidence is not None and recording.confidence is not None:
                self._send(confidence, stamp, _NUMBER, float(recording.confidence[i]))

    def _topic(self, name: str, kind: str) -> Any:
        return self._writer.add_connection(name, kind, typestore=self._store)

    def _send(self, topic: Any, stamp: int, kind: str, *values: Any) -> None:
        message = self._types[kind](*values)
        self._writer.write(topic, stamp, self._store.serialize_cdr(message, kind))

    def _header(self, stamp: int) -> Any:
        time = self._types["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9)
        return self._types["std_msgs/msg/Header"](time, _FRAME)

    def _pose(self, position: Sequence[float], quat_wxyz: Sequence[float]) -> Any:
        w, x, y, z = quat_wxyz
        return self._types["geometry_msgs/msg/Pose"](
            self._types["geometry_msgs/msg/Point"](*position),
            self._types["geometry_msgs/msg/Quaternion"](x, y, z, w),
        )
