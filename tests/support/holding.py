"""A person who turns and moves an object between three fingers, made from the human model: `hold`.

No person was recorded: the fingertips of the human model go to places of the surface that are known
exactly, stay there while the object moves in the hand, and the hand is lifted meanwhile. So it is
known where a robot's fingers belong, and how much of the object's motion they carry.

The recording `held` of the package is one of these:

    python tests/support/holding.py handmap_qp/trackers/held.npz
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
import trimesh
from scipy.optimize import least_squares

from handmap_qp import Recording, load_hand
from handmap_qp.human import TIPS
from handmap_qp.mapping.objects import nearest, parse_object
from handmap_qp.se3 import affine, rotation_from_rpy, smoothstep, transform_points, unit
from handmap_qp.trackers.formats import write_recordings

OBJECTS = {
    "cube": "box:0.04",
    "ball": "sphere:0.044",
    "can": "cylinder:0.04x0.08",
    "box": "box:0.03x0.06x0.05",
    "bar": "box:0.025x0.025x0.1",
}
"""Shapes that are held, as of `parse_object`: their x goes from the thumb to the fingers."""
CAP = "cylinder:0.04x0.02"
"""The cap of a bottle, whose axis is z."""
MOUSE = np.array((0.031, 0.055, 0.036))
"""Half the width, half the length and the height of a mouse [m]."""
MOTIONS = {
    f"{kind} {sign:+d}{axis}": sign * size * np.eye(6)[3 * (kind == "turn") + k]
    for kind, size in (("move", 0.01), ("turn", math.radians(15.0)))
    for k, axis in enumerate("xyz")
    for sign in (1, -1)
}
"""Motions in the hand: 10 mm along, or 15 degrees about an axis of the object, (6,) [m, rad]."""
FINGERS = ("thumb", "index", "middle")
RATE = 60.0
"""Samples per second."""
SKIN = 0.008
"""Distance of a fingertip's landmark from the surface that its skin touches [m]."""
NOISE = 2e-4
"""Standard deviation of the tracker's noise [m]."""
_TIPS = [4, 8, 12]
# Samples that it takes to close, to rest, and to move the object; how far fingers open [m].
_CLOSING, _RESTING, _MOVING = 50, 20, 80
_OPEN = 0.04
_LIFT = 0.05
# Distance of the fingers' places from each other [m].
_APART = 0.03
# Weights of the rest posture and of the last one, against fingertips [1/rad, 1/m].
_TO_REST, _TO_LAST, _TO_PLACE = 0.03, 0.01, 100.0
# The palm looks sideways, in a world with y up.
_PALM = affine(rotation_from_rpy((-np.pi / 2.0, 0.0, 0.0)), (0.0, 0.3, 0.0))


class Hold(NamedTuple):
    """A person who holds an object.

    Attributes:
        recording: The recording, with the object.
        places: Where the f fingers touch it, in its frame [m], shape (f, 3): those of `FINGERS`, or
            all five.
        normals: Outward normals there, shape (f, 3).
        closed: Index of the sample from which on they touch.
        error: How far a fingertip of the model is off its place, at most, from then on [m].
    """

    recording: Recording
    places: np.ndarray
    normals: np.ndarray
    closed: int
    error: float


class _Person:
    """The human model, whose fingertips go to places of an object.

    Args:
        tips: Landmarks of the f fingertips.
        places: Their places in the object's frame [m], shape (f, 3).
        normals: Outward normals there, shape (f, 3).
    """

    def __init__(
        self, tips: Sequence[int], places: np.ndarray, normals: np.ndarray
    ) -> None:
        self.hand = human = load_hand("human", points="landmarks")
        self._fingers, self._places, self._normals = [*tips], places, normals
        low, high = human.lower_limits, human.upper_limits
        self._limits = low, high
        span = 0.1 * (high - low)
        self.rest = self.grasp = np.clip(human.rest, low + span, high - span)

    def tips(self, q: np.ndarray) -> np.ndarray:
        """Return the fingertips of a hand whose wrist is the origin [m], shape (f, 3)."""
        return self.hand.points(q, np.eye(4))[self._fingers]

    def off(self, q: np.ndarray, pose: np.ndarray, away: float = 0.0) -> np.ndarray:
        """Return how far fingertips are off their places, away from the surface [m], (f, 3)."""
        aims = self._places + (SKIN + away) * self._normals
        return self.tips(q) - transform_points(pose, aims)

    def grasps(self, axes: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Grasp an object that is near such axes and centre, and return its pose, (4, 4)."""
        low, high = self._limits

        def placed(way: np.ndarray) -> np.ndarray:
            return affine(axes @ pin.exp3(way[3:]), centre + way[:3])

        def cost(values: np.ndarray) -> np.ndarray:
            way, q = values[:6], values[6:]
            off = _TO_PLACE * self.off(q, placed(way)).ravel()
            return np.concatenate([off, _TO_REST * (q - self.rest), 0.1 * way[3:]])

        free = np.full(6, 2.0)
        margin = 0.05 * (high - low)
        bounds = np.append(-free, low + margin), np.append(free, high - margin)
        start = np.append(np.zeros(6), self.rest)
        found = least_squares(cost, start, bounds=bounds).x
        self.grasp = found[6:]
        return placed(found[:6])

    def posture(self, pose: np.ndarray, away: float, last: np.ndarray) -> np.ndarray:
        """Return the posture for an object there, away from it [m], near the last one."""
        low, high = self._limits

        def cost(q: np.ndarray) -> np.ndarray:
            off = _TO_PLACE * self.off(q, pose, away).ravel()
            to_rest, to_last = _TO_REST * (q - self.grasp), _TO_LAST * (q - last)
            return np.concatenate([off, to_rest, to_last])

        def slopes(q: np.ndarray) -> np.ndarray:
            points = self.hand.point_jacobian(q, np.eye(4)).reshape(-1, 3, len(q))
            own = _TO_PLACE * points[self._fingers].reshape(-1, len(q))
            one = np.eye(len(q))
            return np.concatenate([own, _TO_REST * one, _TO_LAST * one])

        start = np.clip(last, low + 1e-6, high - 1e-6)
        return least_squares(cost, start, slopes, (low, high), xtol=1e-7).x


def add_choices(parser: argparse.ArgumentParser, motions: Sequence[str]) -> None:
    """Let users choose robots, objects, motions, such as these if omitted, and a seed."""
    add = parser.add_argument
    add("--robots", nargs="+", default=list(common.ROBOTS))
    add("--objects", nargs="+", choices=list(OBJECTS), default=list(OBJECTS))
    add("--motions", nargs="+", choices=list(MOTIONS), default=list(motions))
    add("--seed", type=int, default=0)


@lru_cache(maxsize=4)
def hold(what: str, motion: str, seed: int = 0, wrist: float = 0.0) -> Hold:
    """Make a person who grasps an object and moves it in the hand.

    Args:
        what: One of `OBJECTS`, or `cap`.
        motion: One of `MOTIONS`.
        seed: Seed of the tracker's noise.
        wrist: Angle by which the wrist turns meanwhile, about the object's z [rad].
    """
    text = CAP if what == "cap" else OBJECTS[what]
    shape = parse_object(text)
    sides = [[-0.2, 0.0, 0.0], [0.2, 0.5 * _APART, 0.0], [0.2, -0.5 * _APART, 0.0]]
    # Far to the sides, places of a round object would be one.
    sides = np.array(sides) * (0.15, 1.0, 1.0)
    places, normals, _ = nearest(shape, sides)
    person = _Person(_TIPS, places, normals)
    # The object is where the hand grasps it most easily.
    at_rest = person.tips(person.rest)
    x = unit(at_rest[1:].mean(axis=0) - at_rest[0])
    z = unit(np.cross(x, at_rest[1] - at_rest[2]))
    axes = np.column_stack([x, np.cross(z, x), z])
    pose = person.grasps(axes, at_rest.mean(axis=0))
    made = _moved(person, pose, MOTIONS[motion], wrist, seed)
    recording = replace(made.recording, name=f"{what}, {motion}", object_shape=text)
    return made._replace(recording=recording, places=places, normals=normals)


def hold_mouse(folder: Path, seed: int = 0) -> Hold:
    """Make a person whose five fingertips go to a mouse, half an ellipsoid, and lift it.

    Args:
        folder: Folder for the file of its mesh.
        seed: Seed of the tracker's noise.
    """
    points = trimesh.creation.icosphere(subdivisions=3).vertices * MOUSE
    file = folder / "mouse.stl"
    points[:, 2] = np.maximum(points[:, 2], 0.0)
    trimesh.Trimesh(points).convex_hull.export(file)
    sides = np.array(
        [(-2, 0, 0.7), (-0.4, 1, 1), (0.3, 1, 1), (1, 0.7, 1), (2, 0, 0.7)]
    )
    places, normals, _ = nearest(parse_object(str(file)), sides * MOUSE)
    person = _Person(TIPS.tolist(), places, normals)
    landmarks = person.hand.points(person.rest, np.eye(4))
    # To the right, from the index knuckle to the little one, and forward.
    x = unit(landmarks[17] - landmarks[5])
    z = unit(np.cross(x, landmarks[9] - landmarks[0]))
    axes = np.column_stack([x, np.cross(z, x), z])
    centre = person.tips(person.rest).mean(axis=0) - axes @ (0.0, 0.02, 0.02)
    pose = person.grasps(axes, centre)
    made = _moved(person, pose, np.zeros(6), 0.0, seed)
    recording = replace(made.recording, name="mouse", object_shape=str(file))
    return made._replace(recording=recording, places=places, normals=normals)


def _moved(
    person: _Person, pose: np.ndarray, amount: np.ndarray, wrist: float, seed: int
) -> Hold:
    """Let a person close on an object at a pose, lift it and move it in the hand."""
    q = person.grasp
    closed = _CLOSING
    count = _CLOSING + _RESTING + _MOVING + _RESTING
    landmarks, poses, worst = np.empty((count, 21, 3)), np.empty((count, 4, 4)), 0.0
    for i in range(count):
        share = smoothstep((i - closed - _RESTING) / _MOVING)
        own = affine(pin.exp3(share * amount[3:]), share * amount[:3])
        away = _OPEN * (1.0 - smoothstep(i / closed))
        q = person.posture(pose @ own, away, q)
        if i >= closed:
            off = person.off(q, pose @ own)
            worst = max(worst, np.linalg.norm(off, axis=1).max())
        palm = _PALM.copy()
        palm[1, 3] += _LIFT * smoothstep((i - closed) / _MOVING)
        if wrist:
            there = palm @ pose
            turn = affine(pin.exp3(np.array((0.0, 0.0, share * wrist))))
            palm = there @ turn @ np.linalg.inv(there) @ palm
        landmarks[i] = person.hand.points(q, palm)
        poses[i] = palm @ pose @ own
    landmarks += np.random.default_rng(seed).normal(0.0, NOISE, landmarks.shape)
    recording = Recording(
        "held",
        np.arange(count) / RATE,
        landmarks,
        np.ones(count, dtype=bool),
        "right",
        source="made from the human model",
        object_pose=poses,
    )
    nothing = np.empty((0, 3))
    return Hold(recording, nothing, nothing, closed, worst)


def write_held(out: Path) -> None:
    """Write the package's recording of a hand with an object."""
    made = hold("box", "turn +1z", seed=1).recording
    kept = replace(
        made,
        name="held",
        upright="+y up, -z forward",
        landmarks=made.landmarks.round(5),
    )
    write_recordings([kept], out)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="file to write, .npz")
    write_held(parser.parse_args().out)
