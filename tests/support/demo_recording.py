"""The recordings `demo` and `pinch` of the package: made from the human model, not of a person.

Both hands go through the gestures of `GESTURES` while their wrists move and turn; in `pinch`, each
picks something up, carries it and puts it down, as `PICK` says. Landmarks get the noise, the
jitter, the dropped frames and the loss of a headset's tracker. The files are the same byte for byte
each time: numbers are rounded to what a file keeps (0.1 mm, 0.1 ms), and they are not compressed.

    python tests/support/demo_recording.py handmap_qp/trackers/demo.npz
    python tests/support/demo_recording.py handmap_qp/trackers/pinch.npz --pinch
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_core.human.sample import human_name
from handmap_qp.hands import Side
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import affine, quat_wxyz_from_rotation, rotation_from_rpy

RATE = 30.0
"""Frames per second of the tracker."""
HAND_LENGTH = 0.186
"""Length of the person's hand [m]."""
SOURCE = (
    "demo_recording.py: the package's human model through a documented motion with a "
    "headset's noise; no person was recorded"
)
_REACH, _HOLD = 0.45, 0.40  # s to get from gesture to gesture, and to stay there
_NOISE, _DRIFT, _DRIFT_TIME = 0.0005, 0.0010, 0.25  # m, m, s
_JITTER = 0.0015  # s
_TIPS = [4, 8, 12, 16, 20]


class Gesture(NamedTuple):
    """A posture to reach.

    Attributes:
        name: What it is.
        fingers: Joint angles, four for each finger from thumb to little [rad].
        turn: Roll, pitch and yaw of the wrist from its usual orientation [rad].
        shift: Displacement of the wrist from its usual place [m].
    """

    name: str
    fingers: tuple[tuple[float, float, float, float], ...]
    turn: tuple[float, float, float] = (0.0, 0.0, 0.0)
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)


_THUMB_OPEN, _THUMB_REST = (0.75, 0.25, 0.05, 0.05), (0.5, 0.6, 0.35, -0.25)
_STRAIGHT = (
    (0.06, 0.05, 0.05, 0.02),
    (0.0, 0.03, 0.05, 0.02),
    (-0.05, 0.05, 0.05, 0.02),
)
_OPEN = (_THUMB_OPEN, *_STRAIGHT, (-0.14, 0.08, 0.06, 0.02))
_SPREAD = (
    (1.25, 0.15, 0.0, 0.0),
    (0.30, 0.0, 0.03, 0.0),
    (0.02, 0.0, 0.03, 0.0),
    (-0.26, 0.0, 0.03, 0.0),
    (-0.55, 0.02, 0.03, 0.0),
)
_CURLED = (
    (0.0, 1.45, 1.60, 0.95),
    (-0.02, 1.48, 1.62, 0.95),
    (-0.05, 1.48, 1.60, 0.95),
)
# The thumb lies on the middle finger.
_FIST_THUMB = (-0.76, 0.32, 1.1, 0.97)
_FIST = (_FIST_THUMB, (0.02, 1.40, 1.55, 0.90), *_CURLED)
_POINT = (_FIST_THUMB, _STRAIGHT[0], *_CURLED)
_LOOSE = ((0.08, 0.35, 0.45, 0.25), (0.0, 0.40, 0.50, 0.30), (-0.06, 0.45, 0.5, 0.3))
_LITTLE = (-0.16, 0.50, 0.50, 0.30)
_REST = (_THUMB_REST, *_LOOSE, _LITTLE)

# Thumb and finger 13 mm apart at their tips, which is skin on skin: found once by least squares,
# with the other fingers loose.
_PINCHES: dict[
    int, tuple[tuple[float, float, float, float], tuple[float, float, float, float]]
] = {
    1: ((0.10, 0.69, 0.30, 0.00), (0.05, 0.88, 1.00, 0.50)),
    2: ((-0.13, 0.75, 0.31, -0.01), (0.00, 0.96, 1.00, 0.50)),
    3: ((-0.43, 0.74, 0.31, -0.02), (-0.05, 1.04, 0.94, 0.49)),
    4: ((-0.72, 0.59, 0.28, -0.02), (-0.20, 1.03, 0.87, 0.48)),
}


def _pinch(finger: int) -> tuple[tuple[float, float, float, float], ...]:
    posture = list(_REST)
    posture[0], posture[finger] = _PINCHES[finger]
    return tuple(posture)


GESTURES: tuple[Gesture, ...] = (
    Gesture("rest", _REST),
    Gesture("open", _OPEN),
    Gesture("fist", _FIST, shift=(0.0, 0.05, 0.0)),
    Gesture("open", _OPEN, shift=(0.05, 0.08, 0.03)),
    Gesture("point", _POINT, turn=(0.0, 0.0, 0.25), shift=(0.08, 0.10, 0.05)),
    Gesture("pinch index", _pinch(1), turn=(0.0, 0.0, 0.25), shift=(0.08, 0.05, 0.10)),
    Gesture("spread", _SPREAD, shift=(0.02, 0.04, 0.14)),
    Gesture("pinch middle", _pinch(2), turn=(0.2, 0.0, 0.0), shift=(0.0, 0.02, 0.12)),
    Gesture("rest", _REST, turn=(0.5, 0.1, 0.0), shift=(-0.04, 0.0, 0.08)),
    Gesture("pinch ring", _pinch(3), turn=(0.7, 0.0, 0.0), shift=(-0.06, 0.0, 0.06)),
    Gesture("open", _OPEN, turn=(0.3, -0.2, -0.2), shift=(-0.06, 0.05, 0.04)),
    Gesture("pinch little", _pinch(4), turn=(0.6, 0.0, 0.0), shift=(-0.04, 0.04, 0.02)),
    Gesture(
        "thumb across", ((-0.9, 0.55, 0.75, 0.5), *_OPEN[1:]), turn=(0.4, 0.0, 0.0)
    ),
    Gesture("wrist up", _OPEN, turn=(0.0, 0.6, 0.0), shift=(0.0, 0.02, 0.05)),
    Gesture("wrist down", _OPEN, turn=(0.0, -0.6, 0.0), shift=(0.0, 0.04, 0.0)),
    Gesture("palm up", _REST, turn=(1.4, 0.0, 0.0), shift=(-0.05, 0.0, 0.0)),
    Gesture("rest", _REST),
)
"""What the right hand does, in order; the left hand begins in the middle."""
_AJAR = ((0.0, 0.9, 0.1, -0.1), (0.05, 0.3, 0.3, 0.15), *_REST[2:])
PICK: tuple[Gesture, ...] = (
    Gesture("around it", _AJAR),
    Gesture("pinch index", _pinch(1)),
    Gesture("lift", _pinch(1), shift=(0.0, 0.0, 0.10)),
    Gesture("carry", _pinch(1), shift=(0.08, 0.05, 0.10)),
    Gesture("put down", _pinch(1), shift=(0.08, 0.05, 0.0)),
    Gesture("let go", _AJAR, shift=(0.08, 0.05, 0.0)),
)
"""What both hands do in `pinch`: thumb and index finger are 10 cm apart before and after."""


def demo_arrays(gestures: tuple[Gesture, ...] = GESTURES) -> dict[str, np.ndarray]:
    """Return the arrays of a file, as `NpzFormat` reads them."""
    rng = np.random.default_rng(20140531)
    duration = len(gestures) * (_REACH + _HOLD)
    frames = np.arange(int(duration * RATE))
    # Two frames are dropped, and the instants jitter.
    frames = frames[~np.isin(frames, [151, 304])]
    time = frames / RATE + np.clip(rng.normal(0.0, _JITTER, len(frames)), -0.01, 0.01)
    time = np.round(time - time[0], 4)
    arrays: dict[str, np.ndarray] = {}
    first = len(GESTURES) // 2 if gestures is GESTURES else 0
    starts: dict[Side, int] = {"left": first, "right": 0}
    for side, start in starts.items():
        own = _hand_arrays(side, time, [*gestures[start:], *gestures[:start]], rng)
        arrays |= {f"{side}_{name}": array for name, array in own.items()}
    return arrays


def write_demo(file: Path, gestures: tuple[Gesture, ...] = GESTURES) -> None:
    """Write a recording.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    with replaced_file(file, "file") as stream:
        # Not compressed: the bytes would depend on the version of zlib, and a wheel is compressed.
        np.savez(stream, allow_pickle=False, **demo_arrays(gestures))


def _hand_arrays(
    side: Side, time: np.ndarray, gestures: list[Gesture], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return what the tracker says of one hand."""
    lengths = HumanLengths.from_hand_length(HAND_LENGTH)
    human = load_hand(human_name(side), points="landmarks", lengths=lengths)
    q, turn, shift = _motion(time, gestures)
    mirror = -1.0 if side == "left" else 1.0
    usual = np.array([0.16, 0.30, 1.05])
    landmarks, wrist = np.empty((len(time), 21, 3)), np.empty((len(time), 4, 4))
    for i in range(len(time)):
        # A mirrored hand turns the other way about y and z.
        roll, pitch, yaw = turn[i]
        rotation = rotation_from_rpy([pitch, mirror * roll, mirror * yaw])
        place = (usual + shift[i]) * (mirror, 1.0, 1.0)
        wrist[i] = affine(rotation, place)
        landmarks[i] = human.points(q[i], wrist[i])
    landmarks += _noise(time, rng)
    tremble = rng.normal(0.0, 0.004, (len(time), 3))
    poses = np.array(
        [_seven(pose, angles) for pose, angles in zip(wrist, tremble, strict=True)]
    )
    confidence = np.clip(0.95 - np.abs(rng.normal(0.0, 0.05, len(time))), 0.0, 1.0)
    valid = np.ones(len(time), dtype=bool)
    if side == "left":
        # A third of a second without tracking.
        valid[200:210] = False
        landmarks[~valid], poses[~valid], confidence[~valid] = np.nan, np.nan, 0.0
    return {
        "time": time,
        "landmarks": np.round(landmarks, 4).astype(np.float32),
        "valid": valid,
        "wrist_pose": np.round(poses, 4).astype(np.float32),
        "confidence": np.round(confidence, 3),
        "source": np.array(SOURCE),
        "upright": np.array("+z up, +y forward"),
    }


def _motion(
    time: np.ndarray, gestures: list[Gesture]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return joint angles (T, 20), turns (T, 3) and shifts (T, 3): minimum jerk between holds."""
    step = _REACH + _HOLD
    index = np.minimum((time / step).astype(int), len(gestures) - 1)
    share = np.clip((time - index * step) / _REACH, 0.0, 1.0)[:, None]
    blend = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
    rows = np.array([[*np.ravel(g.fingers), *g.turn, *g.shift] for g in gestures])
    before = rows[np.maximum(index - 1, 0)]
    values = before + blend * (rows[index] - before)
    return values[:, :20], values[:, 20:23], values[:, 23:]


def _noise(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return white noise and slow drift of every landmark, more at the tips [m], (T, 21, 3)."""
    shape = (len(time), 21, 3)
    white, push = rng.normal(0.0, _NOISE, shape), rng.normal(0.0, 1.0, shape)
    drift = np.empty(shape)
    drift[0] = push[0]
    for i in range(1, len(time)):
        kept = np.exp(-(time[i] - time[i - 1]) / _DRIFT_TIME)
        drift[i] = kept * drift[i - 1] + np.sqrt(1.0 - kept**2) * push[i]
    noise = white + _DRIFT * drift
    noise[:, _TIPS] *= 1.4
    return noise


def _seven(pose: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Return a trembling pose as position and quaternion wxyz, shape (7,)."""
    rotation = pose[:3, :3] @ rotation_from_rpy(angles)
    return np.concatenate([pose[:3, 3], quat_wxyz_from_rotation(rotation)])


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path, help="file to write, .npz")
    parser.add_argument("--pinch", action="store_true", help="write `pinch`")
    given = parser.parse_args()
    write_demo(given.out, PICK if given.pinch else GESTURES)
