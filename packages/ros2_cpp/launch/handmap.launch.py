"""The node with the parameters of `config/handmap.yaml`, and a hand: `robot:=FILE.hand`."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    """Return what is started."""
    share = Path(get_package_share_directory("handmap_ros2_cpp"))
    robot = DeclareLaunchArgument("robot", description="file of the saved hand")
    node = Node(
        package="handmap_ros2_cpp",
        executable="hand_node",
        namespace="handmap",
        parameters=[
            str(share / "config" / "handmap.yaml"),
            {"robot": LaunchConfiguration("robot")},
        ],
        output="screen",
    )
    return LaunchDescription([robot, node])
