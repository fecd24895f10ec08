"""Draw the README's picture of robots that both hands of a person lead.

Arguments are recordings of the left and the right hand, whose axes are those of WebXR, and the file
to write: `python docs/robots_picture.py left.npz right.npz docs/images/robots.png`.
"""

from __future__ import annotations

import sys
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
from PIL import Image

from handmap_qp import read_recording
from handmap_qp.apps.arguments import MappingArguments
from handmap_qp.apps.drawing.contact_sheet import FINGER_COLOURS
from handmap_qp.apps.drawing.hands import GREY, load_shape, spheres, tube
from handmap_qp.apps.drawing.raster import Camera, Triangles, merged, render
from handmap_qp.apps.offline.trajectory import map_hands
from handmap_qp.hands.robot import load_robot
from handmap_qp.stream.measurement import measure_person

ROBOTS = ("g1", "ur5_pair", "tiago_dual")
TIMES = (0.5, 2.2, 6.2, 6.8)
"""Instants that are drawn, from the first sample on [s]."""
CELL = (330, 300)
TURNED = 28.0
"""Direction of the camera from a robot's front [deg]."""


def main(left: Path, right: Path, out: Path) -> None:
    """Map the recordings, and draw a row of the person and of each robot."""
    hands = {
        recording.side: replace(recording, upright="+y up, -z forward")
        for recording in map(read_recording, (left, right))
    }
    person = measure_person(*hands.values())
    longest = max(hands.values(), key=len)
    rows = np.searchsorted(longest.time - longest.time[0], TIMES)
    turn = np.array([[0.0, 0.0, -1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    people = []
    for time in longest.time[rows]:
        seen = [
            each.landmarks[np.searchsorted(each.time, time)] for each in hands.values()
        ]
        people.append(merged([drawn_hand(points @ turn.T) for points in seen]))
    pictures = [row_of(people)]
    for name in ROBOTS:
        robot = load_robot(name)
        motion, *_ = map_hands([*hands.values()], robot, person, MappingArguments())
        shape = load_shape(next(iter(robot.by_side.values())))
        pictures.append(row_of([shape.triangles(q) for q in motion.q[rows]]))
        print(
            f"{name}: wrist off by {1e3 * motion.wrist_error[rows].max():.0f} mm at most"
        )
    picture = np.concatenate(pictures)
    image = Image.fromarray((255.0 * picture).round().astype(np.uint8))
    image.save(out, optimize=True)
    print(f"wrote {out}")


def drawn_hand(points: np.ndarray) -> Triangles:
    """Return a human hand as tubes between its landmarks (21, 3) [m], a colour for each finger."""
    parts = [spheres(points, 0.009, GREY)]
    for k, colour in enumerate(FINGER_COLOURS.values()):
        chain = points[[0, *range(4 * k + 1, 4 * k + 5)]]
        parts += [tube(pair, 0.007, colour) for pair in pairwise(chain)]
    return merged(parts)


def row_of(solids: list[Triangles]) -> np.ndarray:
    """Draw solids side by side, all by one camera, shape (height, width, 3)."""
    corners = np.concatenate([solid.vertices for solid in solids]).reshape(-1, 3)
    camera = Camera.framing(corners, CELL, azimuth=TURNED, elevation=12.0)
    images = np.concatenate([render(solid, camera) for solid in solids], axis=1)
    return 1.0 + images[..., 3:] * (images[..., :3] - 1.0)


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:4]))
