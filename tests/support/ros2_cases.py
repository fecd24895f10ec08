"""The package of ROS 2, and a command that says everything."""

from pathlib import Path

from handmap_qp.client import Command
from handmap_qp.client.messages import Pose

PACKAGE = Path(__file__).parents[2] / "packages" / "ros2"
WRIST = Pose((0.1, 0.2, 0.3), (0.5, -0.5, 0.5, 0.5))
COMMAND = Command(
    seq=3,
    name="lab",
    time=1.5,
    server_time=2.5,
    joint_names=("index", "thumb_a", "thumb_b"),
    q=(0.25, -1.0, 0.125),
    wrist=WRIST,
    status="limited",
    flags=("at_limit", "gripped"),
    epoch=7,
    dt=0.016,
    rule="",
    effort=(0.5, 0.0, -0.25),
)
