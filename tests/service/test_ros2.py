"""The ROS 2 bridge of `ros2.md`, run on the message types of rosbags and a stand-in for rclpy."""

from __future__ import annotations

import ast
import re
import sys
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from patience import wait_until
from service_tools import address_of, client_of, human_q, serving

import handmap_qp.apps.service
import handmap_qp.client
from handmap_qp.client import Client, Command
from handmap_qp.client.messages import Pose
from handmap_qp.se3 import pose_from_xyz_quat

rosbags = pytest.importorskip("rosbags.typesys")
STORE = rosbags.get_typestore(rosbags.Stores.ROS2_HUMBLE)
TYPES = STORE.types
STAMP = TYPES["builtin_interfaces/msg/Time"](sec=12, nanosec=500_000_000)


class Node:
    """The part of an rclpy node that the bridge uses.

    Publishers keep what they publish; callbacks are kept by topic.
    """

    def __init__(self, name: str) -> None:
        self.published: dict[str, list[Any]] = {}
        self.callbacks: dict[str, Callable[..., None]] = {}

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        self.published[topic] = []
        return types.SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(
        self, kind: Any, topic: str, callback: Callable[..., None], depth: int
    ) -> None:
        self.callbacks[topic] = callback

    def create_timer(self, period: float, callback: Callable[..., None]) -> None:
        self.callbacks["timer"] = callback

    def get_clock(self) -> Any:
        return types.SimpleNamespace(
            now=lambda: types.SimpleNamespace(to_msg=lambda: STAMP)
        )

    def get_logger(self) -> Any:
        lines = self.published.setdefault("log", [])
        return types.SimpleNamespace(
            warning=lambda line, throttle_duration_sec: lines.append(line)
        )


DEFAULTS = {"JointState": {"velocity": [], "effort": []}, "Header": {"frame_id": ""}}
"""Fields that ROS's classes leave empty by default, and those of rosbags do not."""


@pytest.fixture
def code() -> str:
    """Return the code of the bridge."""
    text = (Path(str(handmap_qp.apps.service.__file__)).parent / "ros2.md").read_text(
        encoding="utf-8"
    )
    (found,) = re.findall(r"```python\n(.*?)```", text, flags=re.DOTALL)
    return found


@pytest.fixture
def bridge(code: str, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Run the code of the bridge; return the names that it defines."""
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": Node},
        "client": dict(vars(handmap_qp.client)),
    }
    for package, names in {
        "geometry_msgs": ("Point", "Pose", "PoseStamped", "Quaternion"),
        "sensor_msgs": ("JointState",),
        "std_msgs": ("Header",),
    }.items():
        modules[f"{package}.msg"] = {
            name: partial(TYPES[f"{package}/msg/{name}"], **DEFAULTS.get(name, {}))
            for name in names
        }
    for name, content in modules.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    # What the import of a real submodule does by itself.
    vars(sys.modules["rclpy"])["node"] = sys.modules["rclpy.node"]
    namespace: dict[str, Any] = {"__name__": "bridge"}
    exec(compile(code, "ros2.md", "exec"), namespace)
    return namespace


def over_the_wire(message: Any) -> Any:
    """Serialise a message as CDR and read it, as another ROS node would."""
    name = message.__msgtype__
    for field in ("position", "velocity", "effort"):
        # rclpy takes lists; rosbags needs arrays.
        if name == "sensor_msgs/msg/JointState":
            setattr(message, field, np.array(getattr(message, field), dtype=float))
    return STORE.deserialize_cdr(STORE.serialize_cdr(message, name), name)


def header(frame: str = "") -> Any:
    return TYPES["std_msgs/msg/Header"](stamp=STAMP, frame_id=frame)


def joint_state(names: list[str], angles: np.ndarray) -> Any:
    empty = np.zeros(0)
    return TYPES["sensor_msgs/msg/JointState"](
        header=header(), name=names, position=angles, velocity=empty, effort=empty
    )


def pose_stamped(position: list[float], quat_xyzw: list[float]) -> Any:
    point = TYPES["geometry_msgs/msg/Point"](*position)
    pose = TYPES["geometry_msgs/msg/Pose"](
        position=point, orientation=TYPES["geometry_msgs/msg/Quaternion"](*quat_xyzw)
    )
    return TYPES["geometry_msgs/msg/PoseStamped"](header=header("map"), pose=pose)


def command(**changes: Any) -> Command:
    pose = Pose((0.1, 0.2, 0.3), (0.0, 0.0, 0.6, 0.8))
    fields: dict[str, Any] = {
        "name": "s",
        "time": 0.0,
        "server_time": 0.0,
        "joint_names": ("b", "a"),
        "q": (0.25, -0.5),
        "status": "converged",
        "wrist": pose,
    }
    return Command(**{**fields, **changes})


def test_it_is_as_short_as_the_readme_says_and_runs_on_the_python_of_ros(
    code: str,
) -> None:
    assert len([line for line in code.splitlines() if line.strip()]) <= 40
    files = Path(handmap_qp.client.__file__).parent.glob("*.py")
    for source in (code, *(file.read_text(encoding="utf-8") for file in files)):
        ast.parse(source, feature_version=(3, 10))


def test_a_sample_is_ordered_by_name_and_keeps_pose_and_time(
    bridge: dict[str, Any],
) -> None:
    joints = over_the_wire(joint_state(["c", "a", "b"], np.array([3.0, 1.0, 2.0])))
    wrist = over_the_wire(pose_stamped([0.1, 0.2, 0.3], [0.0, 0.0, 0.6, 0.8]))
    sample = bridge["to_sample"](joints, wrist, ("a", "b", "c"))
    assert sample["q"] == [1.0, 2.0, 3.0]
    assert sample["time"] == 12.5
    assert np.allclose(
        Pose.of(sample["wrist"]).matrix,
        pose_from_xyz_quat([0.1, 0.2, 0.3, 0.0, 0.0, 0.6, 0.8], "xyzw"),
    )


def test_a_command_becomes_a_joint_state_by_name(bridge: dict[str, Any]) -> None:
    message = over_the_wire(bridge["to_joint_state"](command(), STAMP))
    assert dict(zip(message.name, message.position, strict=True)) == {
        "b": 0.25,
        "a": -0.5,
    }
    assert message.header.stamp.sec == 12


def test_a_command_becomes_a_pose_with_its_scalar_last(bridge: dict[str, Any]) -> None:
    message = over_the_wire(bridge["to_pose_stamped"](command(), STAMP))
    orientation = message.pose.orientation
    assert (orientation.x, orientation.y, orientation.z, orientation.w) == (
        0.0,
        0.0,
        0.6,
        0.8,
    )
    assert (message.pose.position.x, message.pose.position.z) == (0.1, 0.3)
    assert message.header.frame_id == "handmap"


def test_the_node_carries_samples_in_and_commands_out(bridge: dict[str, Any]) -> None:
    with (
        serving() as server,
        client_of(server) as client,
        Client(address_of(server)) as watching,
    ):
        node = bridge["Bridge"](client, "three_finger")
        node.callbacks["timer"]()
        assert client.opened is not None
        # A simulated robot follows the session by the name that the page gives.
        watching.watch("ros")
        names = list(client.opened.human_joint_names)
        node.callbacks["human/joint_states"](joint_state(names, human_q()))
        assert not node.published["robot/joint_commands"], (
            "nothing goes out before the wrist is known"
        )
        node.callbacks["human/wrist"](
            pose_stamped([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        )
        node.callbacks["human/joint_states"](joint_state(names, human_q()))
        wait_until(
            lambda: node.callbacks["timer"]() or node.published["robot/joint_commands"]
        )
        state = node.published["robot/joint_commands"][0]
        assert tuple(state.name) == server_joints(client)
        assert node.published["robot/wrist_command"]
        seen = watching.latest(5.0)
        assert seen is not None
        assert tuple(seen.joint_names) == server_joints(client)


def test_an_unusable_sample_is_logged_and_the_node_continues(
    bridge: dict[str, Any],
) -> None:
    with serving() as server, client_of(server) as client:
        node = bridge["Bridge"](client, "three_finger")
        node.callbacks["human/wrist"](
            pose_stamped([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        )
        node.callbacks["human/joint_states"](joint_state(["elbow"], np.zeros(1)))
        assert "KeyError" in node.published["log"][0]
        node.callbacks["timer"]()


def test_a_node_that_was_started_first_waits_for_the_server(
    bridge: dict[str, Any], free_port: int
) -> None:
    with Client(f"tcp://127.0.0.1:{free_port}", timeout=0.05) as client:
        node = bridge["Bridge"](client, "three_finger")
        node.callbacks["timer"]()
        node.callbacks["human/wrist"](
            pose_stamped([0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0])
        )
        node.callbacks["human/joint_states"](joint_state([], np.zeros(0)))
        assert ["ServiceTimeoutError" in line for line in node.published["log"]] == [
            True,
            True,
        ]
        client.timeout = 20.0
        with serving(port=free_port):
            node.callbacks["timer"]()
            assert len(server_joints(client)) == 8
            client.close()


def server_joints(client: Client) -> tuple[str, ...]:
    assert client.opened is not None
    return client.opened.joint_names
