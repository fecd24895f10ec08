"""A node of rclpy that carries a session: `HandmapNode`.

What is said is decided by `bridge`, as in `handmap ros2`. With the parameter
`robot` the node also opens the session, and leads it by the joint angles of a human hand.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import rclpy
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from rosidl_runtime_py.utilities import get_message
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from handmap_qp.client import Client, ServiceError, ServiceTimeoutError
from .bridge import Bridge, Message


class HandmapNode(Node):
    """Publishes the commands of a session, and offers stop, clear, engage and disengage."""

    def __init__(self) -> None:
        super().__init__("handmap")
        for name, default in (
            ("session", "ros"),
            ("address", "tcp://127.0.0.1:5570"),
            ("robot", ""),
            ("controller", "hand_controller"),
        ):
            self.declare_parameter(name, default)
        self._ends: dict[str, Any] = {}
        self._wrist: list[float] | None = None
        self.client = Client(self._given("address"))
        self._bridge: Bridge | None = None
        if self._given("robot"):
            self.create_subscription(PoseStamped, "human/wrist", self.on_wrist, 1)
            self.create_subscription(
                JointState, "human/joint_states", self.on_joints, 1
            )
        self.create_timer(0.005, self.spin_once)

    def publish(self, topic: str, message: Message) -> None:
        """Publish a message, as in `bridge.Node`."""
        kind = get_message(message[0])
        if topic not in self._ends:
            self._ends[topic] = self.create_publisher(kind, topic, 10)
        self._ends[topic].publish(filled(kind, message[1]))

    def serve(self, name: str, act: Callable[[], str]) -> None:
        """Offer a service, as in `bridge.Node`."""

        def answer(_: Any, response: Any) -> Any:
            response.message = act()
            response.success = not response.message
            return response

        self.create_service(Trigger, name, answer)

    def spin_once(self) -> None:
        """Publish what has come; join the session first."""
        self._attempt(lambda bridge: bridge.spin_once())

    def on_wrist(self, stamped: Any) -> None:
        """Keep the wrist's pose for the joints that follow."""
        place, turn = stamped.pose.position, stamped.pose.orientation
        self._wrist = [place.x, place.y, place.z, turn.x, turn.y, turn.z, turn.w]

    def on_joints(self, joints: Any) -> None:
        """Lead the session by a sample: joint angles by name, in any order."""
        self._attempt(lambda _: self._lead(joints))

    def _lead(self, joints: Any) -> None:
        opened = self.client.opened
        if opened is None or self._wrist is None:
            return
        angles = dict(zip(joints.name, joints.position, strict=True))
        stamp = joints.header.stamp
        self.client.send(
            q=[angles[name] for name in opened.human_joint_names],
            wrist=self._wrist,
            time=stamp.sec + 1e-9 * stamp.nanosec,
        )

    def _attempt(self, act: Callable[[Bridge], None]) -> None:
        """Act in the session, and log what goes wrong, every two seconds at most."""
        try:
            if self._bridge is None:
                self._bridge = self._join()
            act(self._bridge)
        except (KeyError, ValueError, ServiceError, ServiceTimeoutError) as error:
            self.get_logger().warning(repr(error), throttle_duration_sec=2.0)

    def _join(self) -> Bridge:
        """Open the session or watch it; services that act on it are offered then."""
        session, robot = self._given("session"), self._given("robot")
        if robot:
            self.client.open(robot, name=session)
        else:
            self.client.watch(session)
        return Bridge(self, self.client, self._given("controller"))

    def _given(self, parameter: str) -> str:
        return self.get_parameter(parameter).value


def filled(kind: Any, fields: Any) -> Any:
    """Return a message of ROS of its fields in order, with other messages inside as tuples."""
    types = kind.get_fields_and_field_types()
    values = [_value(*pair) for pair in zip(types.values(), fields, strict=True)]
    return kind(**dict(zip(types, values, strict=True)))


def _value(kind: str, given: Any) -> Any:
    if kind == "octet":
        return bytes([given])
    if kind.startswith("sequence<"):
        return [_value(kind[len("sequence<") : -1], item) for item in given]
    if "/" in kind:
        return filled(get_message(kind.replace("/", "/msg/")), given)
    return given


def main() -> None:
    """Run the node until Ctrl-C."""
    rclpy.init()
    with suppress(KeyboardInterrupt):
        rclpy.spin(HandmapNode())


if __name__ == "__main__":
    main()
