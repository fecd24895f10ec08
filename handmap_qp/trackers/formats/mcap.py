"""Recordings as ROS 2 bags in MCAP: joint states, and landmarks as poses."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from operator import attrgetter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_core.errors import InvalidInputError, RecordingError, expect, require
from handmap_core.se3 import Array, pose_from_xyz_quat, quat_wxyz_from_rotation
from handmap_qp.hands import HUMAN_JOINTS, Names, Side, load_hand
from handmap_qp.human import (
    LANDMARK_COUNT,
    LandmarkFitter,
    Recording,
    expect_fitted,
    finite_samples,
    human_name,
    measure_hand,
)
from handmap_qp.output_files import replaced_path
from .base import (
    SIDES,
    Entry,
    WrittenByPieces,
    build_recording,
    reading,
)
from .long import LongRecording

_POSES = "geometry_msgs/msg/PoseArray"
_STATE = "sensor_msgs/msg/JointState"
_POSE = "geometry_msgs/msg/PoseStamped"
_NUMBER = "std_msgs/msg/Float64"
# Message types of a hand's topics, and a word of the topic's name.
_KINDS = {
    "landmarks": (_POSES, ""),
    "joint_states": (_STATE, ""),
    "wrist": (_POSE, "wrist"),
    "confidence": (_NUMBER, "confidence"),
}
_FRAME = "tracker"
_NOWHERE = (np.nan,) * 7
_NUMBERS_OF = attrgetter(
    *(f"position.{name}" for name in "xyz"), *(f"orientation.{name}" for name in "wxyz")
)
"""Returns the numbers of a pose: position, then quaternion."""


Topics = dict[str, str]
"""Topics of a hand, by what they are of `_KINDS`."""


class McapFormat(WrittenByPieces):
    """A bag with topics below a namespace that has `left` or `right` in its name.

    Read are `.../landmarks` (geometry_msgs/PoseArray of 21 poses, MediaPipe's order) or, without
    them, `.../joint_states` (sensor_msgs/JointState with the 20 joints of `handmap hands human`, in
    radians; the hand then has the model's size); and `.../wrist` (geometry_msgs/PoseStamped) and
    `.../confidence` (std_msgs/Float64) of the same instants. Instants are those of the headers.

    Written are all of them; the joint states are fitted to the landmarks.
    """

    name = "mcap"
    suffixes = (".mcap",)
    lacks = (
        "digits of time",
        "source",
        "upright",
        "task",
        "time_source",
        "object_pose",
        "unseen",
        "digits of wrist",
    )

    def recognises(self, path: Path) -> bool:
        """Tell whether it is a file, or the folder of a bag."""
        return path.is_file() or is_bag_folder(path)

    def entries(self, path: Path) -> Sequence[Entry]:
        """List the hands that have landmarks or joint states."""
        with _opened(path) as bag:
            return [
                Entry(side, side, bag.topics[_main(topics)].msgcount)
                for side, topics in _hands(bag).items()
            ]

    def read(self, path: Path, entry: Entry) -> Recording:
        """Read one hand."""
        with _opened(path) as bag:
            topics = _hands(bag)[entry.side]
            name = _main(topics)
            logs, messages = zip(*_messages(bag, name), strict=True)
            times = [_instant(message) for message in messages]
            sevens = {
                _instant(message): _NUMBERS_OF(message.pose)
                for _, message in _messages(bag, topics.get("wrist"))
            }
            wrists = np.array([sevens.get(time, _NOWHERE) for time in times])
            shares = {
                log: message.data
                for log, message in _messages(bag, topics.get("confidence"))
            }
            with reading(path, array=name):
                if "landmarks" in topics:
                    landmarks = np.array([_points(m) for m in messages])
                else:
                    landmarks = _forward(messages, entry.side, wrists)
        return build_recording(
            path,
            entry,
            np.array(times),
            landmarks,
            prefix=f"{name}: ",
            source=f"ROS 2 bag, {name}",
            wrist_pose=wrists,
            confidence=[shares.get(log, np.nan) for log in logs],
        )

    def unread(self, path: Path) -> Names:
        """Name the topics that a recording cannot hold."""
        with _opened(path) as bag:
            rest = set(bag.topics).difference(*map(dict.values, _hands(bag).values()))
            return tuple(f"topic {topic}" for topic in sorted(rest))

    def write_long(self, recordings: Sequence[LongRecording], path: Path) -> None:
        """Write one hand or both; a bag of one file, without the folder around it."""
        self.check_one_per_hand(recordings)
        bags = require("rosbags.rosbag2", "files")
        for recording in recordings:
            start, end = recording.instants()[[0, -1]]
            expect(
                start >= 0.0 and end <= 2.0**31,
                "time",
                "instants from 0 to 2^31 s, as ROS 2 has them",
                got=f"{start:g} to {end:g}",
            )
        with (
            replaced_path(path, "path") as temporary,
            tempfile.TemporaryDirectory(
                prefix=f".{path.stem}-",
                dir=path.parent,
            ) as folder,
        ):
            bag = Path(folder) / path.stem
            with bags.Writer(
                bag,
                version=9,
                storage_plugin=bags.StoragePlugin.MCAP,
            ) as writer:
                for recording in recordings:
                    _write_hand(writer, recording)
            (file,) = bag.glob("*.mcap")
            file.replace(temporary)


class JointStates(NamedTuple):
    """The messages of a topic of joint states.

    Attributes:
        time: Instants of their headers [s], strictly increasing, shape (T,).
        names: Names of n joints.
        position: Their positions [rad or m], shape (T, n).
        effort: Their efforts [N m or N], shape (T, n); NaN where messages have none.
    """

    time: Array
    names: Names
    position: Array
    effort: Array


class BagTopics(NamedTuple):
    """Names of topics of a bag.

    Attributes:
        landmarks: Those of landmarks of a hand that have messages.
        joint_states: Those of joint states, of a hand or a robot.
    """

    landmarks: Names
    joint_states: Names


def is_bag_folder(path: Path) -> bool:
    """Return whether a path is a folder that `ros2 bag record` has written."""
    return (path / "metadata.yaml").is_file()


def bag_topics(path: Path) -> BagTopics:
    """Return the names of topics of a bag; errors as `read_joint_states`."""
    with _opened(path) as bag:
        landmarks = tuple(
            topic
            for topic, info in bag.topics.items()
            if info.msgtype == _POSES and info.msgcount
            if any(side in topic.lower() for side in SIDES)
        )
        return BagTopics(landmarks, _state_topics(bag))


def _state_topics(bag: Any) -> Names:
    topics = bag.topics.items()
    return tuple(topic for topic, info in topics if info.msgtype == _STATE)


def read_joint_states(path: Path) -> dict[str, JointStates]:
    """Read all topics of joint states of a bag, by the names of the topics.

    Messages that are not later than the one before are left out, and so are topics without any.

    Raises:
        RecordingError: If it cannot be read, or a message has other joints than the first one.
        MissingExtraError: If rosbags is not installed.
    """
    with _opened(path) as bag:
        found = {
            topic: [message for _, message in _messages(bag, topic)]
            for topic in _state_topics(bag)
        }
    return {
        topic: _joint_states(path, topic, messages)
        for topic, messages in found.items()
        if messages
    }


def _joint_states(path: Path, topic: str, messages: Sequence[Any]) -> JointStates:
    names = tuple(messages[0].name)
    count = len(names)
    rows = {}
    latest = -np.inf
    for message in messages:
        if tuple(message.name) != names or len(message.position) != count:
            problem = "has messages of different joints"
            raise RecordingError(problem, file=path, array=topic)
        # Drivers may repeat the same reading.
        if (time := _instant(message)) > latest:
            has_effort = len(message.effort) == count
            effort = message.effort if has_effort else np.full(count, np.nan)
            rows[time] = message.position, effort
            latest = time
    position, effort = map(np.array, zip(*rows.values(), strict=True))
    return JointStates(np.array([*rows]), names, position, effort)


@contextmanager
def _opened(path: Path) -> Iterator[Any]:
    """Open a bag, and turn what rosbags raises inside the block into `RecordingError`."""
    bags = require("rosbags.rosbag2", "files")
    with reading(path, "cannot be read as MCAP"), bags.Reader(path) as bag:
        yield bag


def _store() -> Any:
    typesys = require("rosbags.typesys", "files")
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


def _hands(bag: Any) -> dict[Side, Topics]:
    """Find the topics of each hand by their types and names: the first of each of `_KINDS`."""
    found: dict[Side, Topics] = {}
    for side in SIDES:
        topics = {
            what: topic
            for what, (kind, word) in _KINDS.items()
            for topic, info in reversed([*bag.topics.items()])
            if side in topic.lower() and info.msgtype == kind and word in topic
        }
        if topics.keys() & {"landmarks", "joint_states"}:
            found[side] = topics
    if not found:
        names = ", ".join(sorted(bag.topics)) or "none"
        problem = f"has no {_POSES} or {_STATE} with left or right in the topic's name; topics are "
        raise InvalidInputError(problem + names)
    return found


def _main(topics: Topics) -> str:
    """Return the topic that has the samples of a hand."""
    return topics.get("landmarks") or topics["joint_states"]


def _messages(bag: Any, topic: str | None) -> Iterator[tuple[int, Any]]:
    """Yield the messages of a topic with the times at which they were logged [ns]."""
    store = _store()
    for own in bag.connections:
        if own.topic != topic:
            continue
        for connection, log, raw in bag.messages(connections=[own]):
            yield log, store.deserialize_cdr(raw, connection.msgtype)


def _instant(message: Any) -> float:
    """Return the instant of a message's header [s]."""
    return message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec


def _points(message: Any) -> list[tuple[float, ...]]:
    """Return the landmarks of a message [m]."""
    count = len(message.poses)
    expect(
        count == LANDMARK_COUNT,
        "",
        f"{LANDMARK_COUNT} poses in every message",
        value=count,
    )
    return [_NUMBERS_OF(pose)[:3] for pose in message.poses]


def _forward(
    messages: Sequence[Any],
    side: Side,
    wrists: Array,
) -> Array:
    """Return the landmarks of joint states, by the model's own lengths."""
    human = load_hand(human_name(side), points="landmarks")
    rows = np.full((len(messages), LANDMARK_COUNT, 3), np.nan)
    has_pose = finite_samples(wrists)
    for i, message in enumerate(messages):
        pairs = zip(message.name, message.position, strict=False)
        angles = {name.removeprefix(f"{side}_"): angle for name, angle in pairs}
        for name in HUMAN_JOINTS:
            if name not in angles:
                raise InvalidInputError(f"a message has no position of joint {name!r}")
        q = [angles[name] for name in HUMAN_JOINTS]
        pose = pose_from_xyz_quat(wrists[i], "wxyz", "wrist") if has_pose[i] else None
        # Where the bag has wrists, a hand without one is nowhere.
        if np.isfinite(q).all() and has_pose[i] == has_pose.any():
            rows[i] = human.points(q, pose)
    return rows


def _write_hand(writer: Any, recording: LongRecording) -> None:
    """Write all topics of a recording."""
    store = _store()
    # The size of the hand is measured in the overview.
    measured = recording.with_overview().overview
    fitter = LandmarkFitter(measured.side, measure_hand(measured))
    # Landmarks and joint states are always there.
    topics = {
        kind: writer.add_connection(
            f"/{measured.side}_hand/{what}", kind, typestore=store
        )
        for what, (kind, _) in _KINDS.items()
        if getattr(measured, what, ()) is not None
    }
    del measured
    is_any_fitted = False
    for part in recording.parts():
        is_fitted = fitter.fitting(part)
        is_any_fitted |= bool(is_fitted.any())
        _write_part(writer, store, topics, part, fitter, is_fitted)
    expect_fitted(is_any=is_any_fitted)


def _write_part(
    writer: Any,
    store: Any,
    topics: dict[str, Any],
    recording: Recording,
    fitter: LandmarkFitter,
    is_fitted: Array,
) -> None:
    """Write the messages of consecutive samples.

    Args:
        writer: The bag.
        store: The types of messages.
        topics: The topics, by their types.
        recording: The samples.
        fitter: Fits joint angles, and goes on from part to part.
        is_fitted: Which samples it takes, shape (T,).
    """
    types = store.types

    def pose(position: Array, quat_wxyz: Sequence[float] = (1.0, 0.0, 0.0, 0.0)) -> Any:
        return types["geometry_msgs/msg/Pose"](
            types["geometry_msgs/msg/Point"](*position.tolist()),
            types["geometry_msgs/msg/Quaternion"](*quat_wxyz[1:], quat_wxyz[0]),
        )

    def put(stamp: int, kind: str, *values: Any) -> None:
        content = store.serialize_cdr(types[kind](*values), kind)
        writer.write(topics[kind], stamp, content)

    names = list(fitter.human.joint_names)
    none = np.zeros(0)
    landmarks = np.where(recording.valid[:, None, None], recording.landmarks, np.nan)
    for i, time in enumerate(recording.time.tolist()):
        stamp = round(1e9 * time)
        instant = types["builtin_interfaces/msg/Time"](*divmod(stamp, 10**9))
        header = types["std_msgs/msg/Header"](instant, _FRAME)
        put(stamp, _POSES, header, [pose(point) for point in landmarks[i]])
        if is_fitted[i]:
            q, _ = fitter.fit(recording.landmarks[i])
            put(stamp, _STATE, header, names, q, none, none)
        if recording.wrist is not None and recording.valid[i]:
            own = recording.wrist[i]
            quat = quat_wxyz_from_rotation(own[:3, :3]).tolist()
            put(stamp, _POSE, header, pose(own[:3, 3], quat))
        if recording.confidence is not None:
            put(stamp, _NUMBER, float(recording.confidence[i]))
