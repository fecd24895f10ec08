"""The node with the parameters of `config/handmap.yaml`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return what is started."""
    share = Path(get_package_share_directory("handmap_ros2"))
    parameters = [str(share / "config" / "handmap.yaml")]
    node = Node(
        package="handmap_ros2",
        executable="handmap_ros2_node",
        namespace="handmap",
        parameters=parameters,
        output="screen",
    )
    return LaunchDescription([node])
