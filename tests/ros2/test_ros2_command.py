# ruff: noqa: E402 (imports follow the test of whether the packages are there)
"""A session in ROS 2: messages as rosbags has them, and `handmap ros2` as a process of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
from patience import PATIENCE, kept_going, wait_until
from ros2_cases import COMMAND, PACKAGE, WRIST
from service_tools import HERE, address_of, client_of, human_q, serving

pytest.importorskip("cyclonedds")
rosbags = pytest.importorskip("rosbags.typesys")

from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from handmap_ros2 import bridge, dds
from handmap_ros2.cli import Ros2

from handmap_qp import InvalidInputError
from handmap_qp.client import Client, Command, ServiceTimeoutError

STORE = rosbags.get_typestore(rosbags.Stores.ROS2_JAZZY)
# As `handmap ros2` where the package is installed: here its folder is only on the path.
RUN = f"""
import sys
import tyro
sys.path.insert(0, {str(PACKAGE)!r})
from handmap_qp.apps import connection
from handmap_ros2.cli import Ros2
# The service answers late on a busy machine.
connection.TIMEOUT = {PATIENCE}
tyro.cli(Ros2).run()
"""
# No other program has it, nor another run of the suite.
DOMAIN = 100 + os.getpid() % 100


def as_rosbags(message: Any) -> Any:
    """Return a message of DDS as one of rosbags."""
    if isinstance(message, list):
        is_number = all(isinstance(item, float) for item in message)
        return np.array(message) if is_number else [*map(as_rosbags, message)]
    if not hasattr(message, "__idl_typename__"):
        return message
    package, _, short = message.__idl_typename__.replace("::dds_", "").split("::")
    kind = STORE.types[f"{package}/msg/{short.removesuffix('_')}"]
    return kind(**{name: as_rosbags(value) for name, value in vars(message).items()})


def test_messages_are_those_of_rosbags_byte_for_byte() -> None:
    made = bridge.messages_of(COMMAND, "hand_controller")
    assert list(made) == [
        "joint_commands",
        "/hand_controller/joint_trajectory",
        "/hand_controller/commands",
        "/diagnostics",
        "wrist_command",
    ]
    for kind, fields in made.values():
        message = dds.filled(kind, fields)
        package, _, short = kind.split("/")
        assert message.__idl_typename__ == f"{package}::msg::dds_::{short}_"
        theirs = bytes(STORE.serialize_cdr(as_rosbags(message), kind))
        # The header of XCDR 1 says nothing of padding at the end.
        assert bytes(message.serialize())[:2] == theirs[:2] == b"\x00\x01"
        assert bytes(message.serialize())[4:] == theirs[4:]


def trajectory_time(last: Command | None, command: Command) -> float:
    """Return the time from start that the trajectory has [s]."""
    made = bridge.messages_of(command, "hand", last)["/hand/joint_trajectory"]
    (point,) = dds.filled(*made).points
    return point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec


def test_a_trajectory_takes_the_time_since_the_command_before() -> None:
    """Commands that were skipped count, whatever their speed limits were granted."""
    at = COMMAND.server_time
    for passed in (0.004, 0.05, 3.0):
        later = msgspec.structs.replace(COMMAND, server_time=at + passed)
        assert trajectory_time(COMMAND, later) == pytest.approx(passed, abs=1e-6)
    # Nothing before it, another epoch, or a clock that went back: what was granted.
    other = msgspec.structs.replace(
        COMMAND, epoch=COMMAND.epoch + 1, server_time=at + 1
    )
    earlier = msgspec.structs.replace(COMMAND, server_time=at - 1.0)
    for last, command in ((None, COMMAND), (COMMAND, other), (COMMAND, earlier)):
        assert trajectory_time(last, command) == pytest.approx(COMMAND.dt, abs=1e-9)


def test_a_bridge_counts_from_the_command_that_it_published() -> None:
    published: list[Any] = []
    node = SimpleNamespace(
        serve=lambda *_: None,
        publish=lambda topic, message: published.append((topic, message)),
    )
    later = msgspec.structs.replace(COMMAND, server_time=COMMAND.server_time + 0.048)
    commands = [COMMAND, later]
    client = SimpleNamespace(latest=lambda _: commands.pop(0))
    made = bridge.Bridge(cast(bridge.Node, node), cast(Client, client), "hand")
    made.spin_once()
    made.spin_once()
    _, second = (
        dds.filled(*message)
        for topic, message in published
        if topic == "/hand/joint_trajectory"
    )
    assert second.points[0].time_from_start.nanosec == pytest.approx(48e6, abs=1e3)


def test_messages_say_all_of_a_command() -> None:
    made = {
        topic: dds.filled(*message)
        for topic, message in bridge.messages_of(COMMAND, "left/hand").items()
    }
    state = made["joint_commands"]
    assert state.name == [*COMMAND.joint_names]
    assert state.position == [*COMMAND.q]
    assert state.effort == [*COMMAND.effort]
    (point,) = made["/left/hand/joint_trajectory"].points
    assert point.positions == state.position
    assert (point.time_from_start.sec, point.time_from_start.nanosec) == (0, 16_000_000)
    assert made["/left/hand/commands"].data == state.position
    pose = made["wrist_command"].pose
    assert vars(pose.position) == dict(zip("xyz", WRIST.position, strict=True))
    assert vars(pose.orientation) == dict(zip("xyzw", WRIST.quat_xyzw, strict=True))
    (status,) = made["/diagnostics"].status
    assert (status.level, status.message) == (0, "limited")
    about = {pair.key: pair.value for pair in status.values}
    assert about == {
        "session": "lab",
        "epoch": "7",
        "rule": "",
        "flags": "at_limit gripped",
    }
    stamps = [
        message.header.stamp for message in made.values() if hasattr(message, "header")
    ]
    assert all(stamp == stamps[0] for stamp in stamps)
    held = msgspec.structs.replace(COMMAND, status="held", wrist=None)
    report = bridge.messages_of(held, "hand")
    assert "wrist_command" not in report
    assert dds.filled(*report["/diagnostics"]).status[0].level == 1


@pytest.mark.parametrize(
    ("seconds", "stamp"),
    [(0.0, (0, 0)), (1.9999999999, (2, 0)), (2.25, (2, 250_000_000))],
)
def test_stamps_carry_over(seconds: float, stamp: tuple[int, int]) -> None:
    assert bridge.stamp_of(seconds) == stamp


class _Ros:
    """Another program in the same domain, named as ROS's middleware names things."""

    def __init__(self) -> None:
        self.participant = DomainParticipant(DOMAIN)

    def reader(self, topic: str, kind: str) -> Any:
        place = Topic(self.participant, f"rt/{topic}", dds.struct(kind), dds.QOS)
        return DataReader(self.participant, place, dds.QOS)

    def call(self, name: str) -> Any:
        """Call a service of type Trigger; return its reply."""
        asked, told = dds.trigger_types()
        ends: list[Any] = []
        for kind, topic, message in (
            (DataWriter, f"rq/handmap/{name}Request", asked),
            (DataReader, f"rr/handmap/{name}Reply", told),
        ):
            place = Topic(self.participant, topic, message, dds.QOS)
            ends.append(kind(self.participant, place, dds.QOS))
        writer, reader = ends
        wait_until(writer.get_matched_subscriptions)
        wait_until(reader.get_matched_publications)
        writer.write(asked(11, 22, 0))
        (reply,) = wait_until(
            lambda: [reply for reply in reader.take(10) if isinstance(reply, told)]
        )
        assert (reply.guid, reply.seq) == (11, 22)
        return reply


@pytest.fixture
def chain() -> Iterator[tuple[Any, Client, Any]]:
    """A service, a client that leads a session of it, and a process that has it in ROS."""
    with serving() as server, client_of(server) as tracker:
        tracker.open("three_finger", name="lab", preset="paper", is_shared=True)
        words = ["lab", "--from", address_of(server), "--domain", str(DOMAIN)]
        # As in the background of a shell.
        before = signal.signal(signal.SIGINT, signal.SIG_IGN)
        process = subprocess.Popen(
            [sys.executable, "-c", RUN, *words],
            stdout=subprocess.PIPE,
            text=True,
        )
        signal.signal(signal.SIGINT, before)
        try:
            assert process.stdout is not None
            assert "ROS domain" in process.stdout.readline()
            yield server, tracker, process
        finally:
            process.send_signal(signal.SIGINT)
            process.communicate(timeout=PATIENCE)
            assert process.returncode == 0


@pytest.mark.slow
def test_another_process_hears_commands_and_stops_the_robot(
    chain: tuple[Any, Client, Any],
) -> None:
    server, tracker, _ = chain
    ros = _Ros()
    state = ros.reader("handmap/joint_commands", "sensor_msgs/msg/JointState")
    report = ros.reader("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    phase = 0.0

    def lead() -> None:
        nonlocal phase
        phase += 0.02
        tracker.step(q=human_q(phase), wrist=HERE)

    with kept_going(lead, 0.02), client_of(server) as watcher:
        watcher.watch("lab")
        heard = wait_until(lambda: state.take(10))
        assert tracker.opened is not None
        assert heard[-1].name == [*tracker.opened.joint_names]
        assert ros.call("stop").success
        assert watcher.status().stop
        wait_until(
            lambda: [
                True
                for array in report.take(10)
                if array.status[0].message == "stopped"
            ]
        )
        assert ros.call("clear").success
        assert not watcher.status().stop
        refused = ros.call("clear")
        assert not refused.success
        assert refused.message
        assert ros.call("clutch").success


@pytest.mark.slow
def test_a_silent_service_is_said(chain: tuple[Any, Client, Any]) -> None:
    ros = _Ros()
    report = ros.reader("diagnostics", "diagnostic_msgs/msg/DiagnosticArray")
    # The session has sent nothing yet.
    (status,) = wait_until(lambda: report.take(10))[0].status
    assert (status.level, status.message) == (2, "the service is silent")


def test_what_a_service_cannot_do_is_its_answer() -> None:
    acts: dict[str, Any] = {}

    class Node:
        def publish(self, topic: str, message: bridge.Message) -> None: ...
        def serve(self, name: str, act: Any) -> None:
            acts[name] = act

    class Lost:
        def stop(self) -> None:
            raise ServiceTimeoutError("no answer")

    bridge.Bridge(Node(), Lost(), "hand")  # ty: ignore[invalid-argument-type]
    assert tuple(acts) == bridge.SERVICES
    assert acts["stop"]() == "no answer"


@pytest.mark.parametrize(
    ("option", "value"),
    [
        ("domain", "-1"),
        ("domain", "233"),
        ("domain", "seven"),
        ("namespace", ""),
        ("namespace", "/hand"),
        ("namespace", "7"),
        ("controller", "my hand"),
    ],
)
def test_names_that_ros_refuses_are_refused(option: str, value: str) -> None:
    with pytest.raises(InvalidInputError, match=f"--{option}"):
        Ros2("lab", **{option: value}).run()  # ty: ignore[invalid-argument-type]


def test_the_domain_of_the_environment_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ROS_DOMAIN_ID", "none")
    with pytest.raises(InvalidInputError, match=r"--domain.*none"):
        Ros2("lab").run()
    with pytest.raises(InvalidInputError, match="no service answers"):
        Ros2("lab", source="127.0.0.1:9", domain="0").run()
