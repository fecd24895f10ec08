"""The node of `packages/ros2`, on the message types of rosbags and a stand-in for rclpy."""

from __future__ import annotations

import ast
import importlib
import sys
import types
import xml.etree.ElementTree as ET
from collections.abc import Callable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import yaml
from handmap_ros2 import bridge
from patience import PATIENCE, wait_until
from ros2_cases import COMMAND, PACKAGE
from service_tools import address_of, client_of, human_q, serving

import handmap_qp.client
from handmap_qp.client import Client

rosbags = pytest.importorskip("rosbags.typesys")
STORE = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
TYPES = STORE.types
NODE = PACKAGE / "handmap_ros2" / "node.py"
# Names of basic types as rclpy has them, where they differ.
_NAMES = {"float64": "double", "byte": "octet"}


def named(node: Any, about: Any) -> str:
    """Return how rclpy names the type of a field."""
    if node.name == "SEQUENCE":
        return f"sequence<{named(*about[0])}>"
    return (
        _NAMES.get(about[0], about[0])
        if node.name == "BASE"
        else about.replace("/msg/", "/")
    )


def message_class(name: str) -> Any:
    """Return a class of a message as rclpy's are: by keywords, and knowing its fields."""

    class Made(TYPES[name]):
        @staticmethod
        def get_fields_and_field_types() -> dict[str, str]:
            return {field: named(*about) for field, about in STORE.fielddefs[name][1]}

    return Made


class Node:
    """The part of an rclpy node that ours uses.

    Publishers keep what they publish; callbacks are kept by topic or service.
    """

    given: ClassVar[dict[str, str]] = {}

    def __init__(self, name: str) -> None:
        self.parameters: dict[str, Any] = {}
        self.published: dict[str, list[Any]] = {}
        self.callbacks: dict[str, Callable[..., Any]] = {}

    def declare_parameter(self, name: str, default: str) -> None:
        value = self.given.get(name, default)
        self.parameters[name] = types.SimpleNamespace(value=value)

    def get_parameter(self, name: str) -> Any:
        return self.parameters[name]

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        kept = self.published.setdefault(topic, [])
        return types.SimpleNamespace(publish=kept.append)

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[..., None], depth: int
    ) -> None:
        self.callbacks[topic] = callback

    def create_service(
        self, kind: Any, name: str, callback: Callable[..., Any]
    ) -> None:
        self.callbacks[name] = callback

    def create_timer(self, period: float, callback: Callable[..., None]) -> None:
        self.callbacks["timer"] = callback

    def get_logger(self) -> Any:
        lines = self.published.setdefault("log", [])
        return types.SimpleNamespace(
            warning=lambda line, throttle_duration_sec: lines.append(line)
        )


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the file of the node; return the names that it defines."""
    for name, content in {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "geometry_msgs.msg": {"PoseStamped": None},
        "sensor_msgs.msg": {"JointState": None},
        "std_srvs.srv": {"Trigger": None},
        "rosidl_runtime_py.utilities": {"get_message": message_class},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent = name.partition(".")[0]
        monkeypatch.setitem(sys.modules, parent, sys.modules.get(parent, module))
    monkeypatch.delitem(sys.modules, "handmap_ros2.node", raising=False)
    return vars(importlib.import_module("handmap_ros2.node"))


def joint_state(names: list[str], angles: np.ndarray) -> Any:
    stamp = TYPES["builtin_interfaces/msg/Time"](sec=12, nanosec=500_000_000)
    header = TYPES["std_msgs/msg/Header"](stamp=stamp, frame_id="")
    empty = np.zeros(0)
    return TYPES["sensor_msgs/msg/JointState"](
        header=header, name=names, position=angles, velocity=empty, effort=empty
    )


def pose_stamped(seven: list[float]) -> Any:
    point = TYPES["geometry_msgs/msg/Point"](*seven[:3])
    turn = TYPES["geometry_msgs/msg/Quaternion"](*seven[3:])
    pose = TYPES["geometry_msgs/msg/Pose"](position=point, orientation=turn)
    return types.SimpleNamespace(pose=pose)


def test_it_runs_on_the_python_of_ros() -> None:
    client = Path(handmap_qp.client.__file__).parent.glob("*.py")
    for file in (NODE, Path(bridge.__file__), *client):
        ast.parse(file.read_text(encoding="utf-8"), feature_version=(3, 10))


def test_the_package_says_what_it_needs_and_has() -> None:
    needed = {tag.text for tag in ET.parse(PACKAGE / "package.xml").iter("exec_depend")}
    imported = {
        node.module.partition(".")[0]
        for node in ast.walk(ast.parse(NODE.read_text(encoding="utf-8")))
        if isinstance(node, ast.ImportFrom) and node.module and not node.level
    }
    messages = {
        kind.partition("/")[0]
        for kind, _ in bridge.messages_of(COMMAND, "hand").values()
    }
    theirs = imported - {"handmap_qp"} - sys.stdlib_module_names
    assert theirs | messages <= needed
    parameters = yaml.safe_load((PACKAGE / "config/handmap.yaml").read_text())
    node = NODE.read_text(encoding="utf-8")
    for name in parameters["/**"]["ros__parameters"]:
        assert f'("{name}", ' in node


def test_messages_are_written_by_rclpys_types(made: dict[str, Any]) -> None:
    for kind, fields in bridge.messages_of(COMMAND, "hand").values():
        message = made["filled"](message_class(kind), fields)
        names = [name for name, _ in STORE.fielddefs[kind][1]]
        assert [name for name in vars(message) if name in names] == names
        if kind.endswith("DiagnosticArray"):
            assert message.status[0].level == b"\0"


def test_the_node_carries_samples_in_and_commands_out(
    made: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving() as server, client_of(server) as watching:
        given = {"robot": "three_finger", "address": address_of(server)}
        monkeypatch.setattr(Node, "given", given)
        node = made["HandmapNode"]()
        node.client.timeout = 20.0
        with node.client:
            node.callbacks["timer"]()
            watching.watch("ros")
            names = list(node.client.opened.human_joint_names)
            state = joint_state(names[::-1], human_q()[::-1])
            node.callbacks["human/joint_states"](state)
            node.callbacks["timer"]()
            # Nothing goes out before the wrist is known.
            assert not node.published.get("joint_commands")
            node.callbacks["human/wrist"](pose_stamped([0.0] * 6 + [1.0]))
            node.callbacks["human/joint_states"](state)
            wait_until(
                lambda: (
                    node.callbacks["timer"]() or node.published.get("joint_commands")
                )
            )
            assert node.published["wrist_command"]
            seen = watching.latest(PATIENCE)
            assert seen is not None
            assert seen.time == 12.5
            sent = node.published["joint_commands"][-1]
            assert tuple(sent.name) == tuple(seen.joint_names)
            response = node.callbacks["stop"](None, types.SimpleNamespace())
            assert response.success
            assert watching.status().stop
            node.callbacks["human/joint_states"](joint_state(["elbow"], np.zeros(1)))
            assert "KeyError" in node.published["log"][-1]


def test_a_node_that_was_started_first_waits_for_the_server(
    made: dict[str, Any], monkeypatch: pytest.MonkeyPatch, free_port: int
) -> None:
    given = {"address": f"tcp://127.0.0.1:{free_port}", "session": "lab"}
    monkeypatch.setattr(Node, "given", given)
    node = made["HandmapNode"]()
    assert "human/wrist" not in node.callbacks
    with node.client:
        node.client.timeout = 0.05
        node.callbacks["timer"]()
        assert "ServiceTimeoutError" in node.published["log"][-1]
        node.client.timeout = PATIENCE
        with (
            serving(port=free_port) as server,
            Client(address_of(server), timeout=PATIENCE) as tracker,
        ):
            tracker.open("three_finger", name="lab")
            node.callbacks["timer"]()
            assert len(node.published["log"]) == 1
            node.client.close()
