"""What is said in ROS 2 of a session: `Bridge`, on any node that can publish and serve.

`messages_of` turns a command into messages: tuples of their fields, in the order of ROS's own
definitions. `dds.DdsNode` sends them without ROS, `node.HandmapNode` by rclpy.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from handmap_qp.client import Client, Command, ServiceError, ServiceTimeoutError

Fields = tuple[Any, ...]
Message = tuple[str, Fields]
"""Type, such as `sensor_msgs/msg/JointState`, and all its fields."""

SERVICES = ("stop", "clear", "engage", "disengage", "clutch", "release")
"""Services of type `std_srvs/srv/Trigger`; `Client` has methods of the same names.

`clutch` and `release` are former names of `engage` and `disengage`.
"""

# Levels of diagnostic_msgs/msg/DiagnosticStatus.
_OK, _WARN, _ERROR = 0, 1, 2
_FOLLOWING = ("converged", "limited", "unreachable", "unsettled")
# Longest wait for a command, before requests are served [s], and between reports of silence.
_WAIT, _SILENT = 0.02, 1.0


class Node(Protocol):
    """A node of ROS 2."""

    def publish(self, topic: str, message: Message) -> None:
        """Publish a message; a topic without a leading `/` is in the node's namespace."""

    def serve(self, name: str, act: Callable[[], str]) -> None:
        """Offer a service of type `std_srvs/srv/Trigger`.

        Args:
            name: Its name in the node's namespace.
            act: Called at a request; returns what went wrong, or nothing.
        """


class Bridge:
    """Publishes the commands of a session, and passes on what services ask for.

    Args:
        node: The node.
        client: A client that watches the session.
        controller: Name of the ros2_control controller that takes the joints.
    """

    def __init__(self, node: Node, client: Client, controller: str) -> None:
        self._node = node
        self._client = client
        self._controller = controller
        self._heard = time.monotonic()
        self._last: Command | None = None
        for name in SERVICES:
            node.serve(name, lambda name=name: self._act(name))

    def spin_once(self) -> None:
        """Wait for a command, for 20 ms at most, and publish it; say each second if none comes."""
        now = time.monotonic()
        if command := self._client.latest(_WAIT):
            self._heard = now
            made = messages_of(command, self._controller, self._last)
            self._last = command
            for topic, message in made.items():
                self._node.publish(topic, message)
        elif now - self._heard > _SILENT:
            self._heard = now
            header = stamp_of(time.time()), ""
            report = _report(_ERROR, "the service is silent", header, {})
            self._node.publish("/diagnostics", report)

    def _act(self, name: str) -> str:
        client = self._client
        try:
            if name == "clear":
                if not (stop := client.status().stop):
                    return "no stop is in force"
                client.clear(stop)
            else:
                getattr(client, name)()
        except (ServiceError, ServiceTimeoutError) as error:
            return str(error)
        return ""


def time_since(last: Command | None, command: Command) -> float:
    """Return the time that a controller has for a command: since the one published before [s].

    Commands in between may have been skipped, and the time that was granted to speed limits ends
    at a cap, so it is the difference of the server's instants. Without a command of the same epoch
    before, it is the time that was granted.
    """
    if last is None or last.epoch != command.epoch:
        return command.dt
    passed = command.server_time - last.server_time
    return passed if passed > 0.0 else command.dt


def messages_of(
    command: Command, controller: str, last: Command | None = None
) -> dict[str, Message]:
    """Return the messages of a command by topic, all with one stamp.

    Args:
        command: The command.
        controller: Name of the controller: `/NAME/commands` is read by ros2_control's forward
            controllers, `/NAME/joint_trajectory` by its joint_trajectory_controller.
        last: The command that was published before; None if there was none.
    """
    header = stamp_of(time.time()), "handmap"
    q, effort = command.q, command.effort
    point = q, (), (), effort, stamp_of(time_since(last, command))
    about = {
        "session": command.name,
        "epoch": command.epoch,
        "rule": command.rule,
        "flags": " ".join(command.flags),
    }
    level = _OK if command.status in _FOLLOWING else _WARN
    made = {
        "joint_commands": (
            "sensor_msgs/msg/JointState",
            (header, command.joint_names, q, (), effort),
        ),
        f"/{controller}/joint_trajectory": (
            "trajectory_msgs/msg/JointTrajectory",
            (header, command.joint_names, [point]),
        ),
        f"/{controller}/commands": ("std_msgs/msg/Float64MultiArray", (((), 0), q)),
        "/diagnostics": _report(level, command.status, header, about),
    }
    if wrist := command.wrist:
        pose = wrist.position, wrist.quat_xyzw
        made["wrist_command"] = "geometry_msgs/msg/PoseStamped", (header, pose)
    return made


def stamp_of(seconds: float) -> Fields:
    """Return a time, or a duration, as ROS has them."""
    sec, part = divmod(round(seconds * 1e9), 10**9)
    return sec, part


def _report(level: int, text: str, header: Fields, about: dict[str, Any]) -> Message:
    """Return what diagnostics say of the session."""
    values = [(key, str(value)) for key, value in about.items()]
    status = level, "handmap", text, "", values
    return "diagnostic_msgs/msg/DiagnosticArray", (header, [status])
