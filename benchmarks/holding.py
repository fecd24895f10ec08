"""A person who turns and moves an object between three fingers, made from the human model: `hold`.

No person was recorded: the fingertips of the human model go to places of the surface that are known
exactly, stay there while the object moves in the hand, and the hand is lifted meanwhile. So it is
known where a robot's fingers belong, and how much of the object's motion they carry.

The recording `held` of the package is one of these:

    python benchmarks/holding.py handmap_qp/trackers/held.npz
"""

from __future__ import annotations

import argparse
import math
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from scipy.optimize import least_squares

from handmap_qp import Recording, load_hand
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
        places: Where `FINGERS` touch it, in its frame [m], shape (3, 3).
        normals: Outward normals there, shape (3, 3).
        closed: Index of the sample from which on they touch.
        error: How far a fingertip of the model is off its place, at most, from then on [m].
    """

    recording: Recording
    places: np.ndarray
    normals: np.ndarray
    closed: int
    error: float


def hold(what: str, motion: str, seed: int = 0) -> Hold:
    """Make a person who grasps an object and moves it in the hand.

    Args:
        what: One of `OBJECTS`.
        motion: One of `MOTIONS`.
        seed: Seed of the tracker's noise.
    """
    human = load_hand("human", points="landmarks")
    shape = parse_object(OBJECTS[what])
    sides = [[-0.2, 0.0, 0.0], [0.2, 0.5 * _APART, 0.0], [0.2, -0.5 * _APART, 0.0]]
    # Far to the sides, places of a round object would be one.
    sides = np.array(sides) * (0.15, 1.0, 1.0)
    places, normals, _ = nearest(shape, sides)
    low, high = human.lower_limits, human.upper_limits
    rest = np.clip(human.rest, low + 0.1 * (high - low), high - 0.1 * (high - low))

    def tips(q: np.ndarray) -> np.ndarray:
        return human.points(q, np.eye(4))[_TIPS]

    def aims(pose: np.ndarray, away: float = 0.0) -> np.ndarray:
        return transform_points(pose, places + (SKIN + away) * normals)

    def posture(pose: np.ndarray, away: float, last: np.ndarray) -> np.ndarray:
        def cost(q: np.ndarray) -> np.ndarray:
            off = _TO_PLACE * (tips(q) - aims(pose, away)).ravel()
            return np.concatenate([off, _TO_REST * (q - grasp), _TO_LAST * (q - last)])

        start = np.clip(last, low + 1e-6, high - 1e-6)
        return least_squares(cost, start, bounds=(low, high), xtol=1e-7).x

    # The object is where the hand grasps it most easily.
    at_rest = tips(rest)
    x = unit(at_rest[1:].mean(axis=0) - at_rest[0])
    z = unit(np.cross(x, at_rest[1] - at_rest[2]))
    axes = np.column_stack([x, np.cross(z, x), z])
    centre = at_rest.mean(axis=0)

    def placed(way: np.ndarray) -> np.ndarray:
        return affine(axes @ pin.exp3(way[3:]), centre + way[:3])

    def grasping(values: np.ndarray) -> np.ndarray:
        way, q = values[:6], values[6:]
        off = _TO_PLACE * (tips(q) - aims(placed(way))).ravel()
        return np.concatenate([off, _TO_REST * (q - rest), 0.1 * way[3:]])

    free = np.full(6, 2.0)
    margin = 0.05 * (high - low)
    bounds = np.append(-free, low + margin), np.append(free, high - margin)
    found = least_squares(grasping, np.append(np.zeros(6), rest), bounds=bounds).x
    pose, q = placed(found[:6]), found[6:]
    grasp = q
    amount = MOTIONS[motion]
    closed = _CLOSING
    count = _CLOSING + _RESTING + _MOVING + _RESTING
    landmarks, poses, worst = np.empty((count, 21, 3)), np.empty((count, 4, 4)), 0.0
    for i in range(count):
        share = smoothstep((i - closed - _RESTING) / _MOVING)
        own = affine(pin.exp3(share * amount[3:]), share * amount[:3])
        away = _OPEN * (1.0 - smoothstep(i / closed))
        q = posture(pose @ own, away, q)
        if i >= closed:
            off = tips(q) - aims(pose @ own)
            worst = max(worst, np.linalg.norm(off, axis=1).max())
        palm = _PALM.copy()
        palm[1, 3] += _LIFT * smoothstep((i - closed) / _MOVING)
        landmarks[i] = human.points(q, palm)
        poses[i] = palm @ pose @ own
    landmarks += np.random.default_rng(seed).normal(0.0, NOISE, landmarks.shape)
    recording = Recording(
        f"{what}, {motion}",
        np.arange(count) / RATE,
        landmarks,
        np.ones(count, dtype=bool),
        "right",
        source="made from the human model",
        object_pose=poses,
        object_shape=OBJECTS[what],
    )
    return Hold(recording, places, normals, closed, worst)


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
