"""Public poses of people's hands, and performances of them: `read_gestures`, `perform`.

Poses are labelled and still. A motion between them is ours: joint angles of the fitted human hand
follow a minimum jerk, and what the fit leaves over is blended alike. So bones keep their lengths,
and landmarks at a pose are the source's own but for noise.
"""

from functools import cache
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from scipy.interpolate import BPoly

from handmap_qp.apps.drawing.contact_sheet import SheetRow, sheet_rows
from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.apps.offline.hand_trace import HandTrace
from handmap_qp.hands import Hand, Names, Side
from handmap_qp.human import Recording, measure_hand, scaled_human
from handmap_qp.human.fit import LandmarkFitter
from handmap_qp.se3 import Array, inverse_pose, transform_points

JOINT_NOISE = np.radians(3.0)
"""Standard deviation of a joint from one showing of a gesture to the next [rad]."""
TRACKER_NOISE = 0.0003
"""Standard deviation of every coordinate of a landmark in every sample [m]."""
MOVES = 0.3, 0.8
"""Shortest and longest motion between two gestures [s]."""
HOLDS = 0.3, 0.6
"""Shortest and longest time in which a gesture is held [s]."""
START = 0.7
"""Time at rest before the first motion [s]; the first half second is not measured."""
READERS_SEED = 2**32
"""Seed of what a reader has seen."""
_REPEATS = 20
_JOINTS = 20
_POSES = Path(__file__).parent / "poses"


class Source(msgspec.Struct, frozen=True):
    """Where poses are from; see `poses/sources.yaml`."""

    name: str
    start: str
    licence: str
    credit: str


SOURCES = msgspec.yaml.decode(
    (_POSES / "sources.yaml").read_bytes(), type=tuple[Source, ...]
)
"""All sources that are shipped."""


class Gestures(NamedTuple):
    """The n poses of a source, as those of one right hand.

    Attributes:
        source: The source.
        human: The human hand, scaled to them; its reference points are the landmarks.
        names: Their names, all different; the side of a hand in brackets where there are both.
        poses: Joint angles [rad], and what the fit leaves over of each landmark, in wrist axes [m],
            shape (n, 20 + 63).
    """

    source: Source
    human: Hand
    names: Names
    poses: Array

    def show(self, order: Array, rng: np.random.Generator) -> Array:
        """Return poses of gestures by index, never twice the same, shape (k, 83)."""
        shown = self.poses[order]
        shown[:, :_JOINTS] += rng.normal(0.0, JOINT_NOISE, (len(order), _JOINTS))
        return shown

    def seen(self, poses: Array, rng: np.random.Generator) -> Array:
        """Return landmarks of poses, shape (T, 83), as a tracker would see them, (T, 21, 3)."""
        q, rest = np.split(poses, [_JOINTS], axis=1)
        exact = _points(self.human, q) + rest.reshape(len(q), -1, 3)
        return exact + rng.normal(0.0, TRACKER_NOISE, exact.shape)


class Performance(NamedTuple):
    """Gestures after one another.

    Attributes:
        gestures: The n gestures.
        take: The motion, of a hand of the robot's side.
        samples: Last sample in which each gesture is held, shape (n,).
    """

    gestures: Gestures
    take: Take
    samples: Array

    def sheet(self, motions: list[Array]) -> list[SheetRow]:
        """Return the end of every gesture, with the joints of motions of shape (T, k) each."""
        source = self.gestures.source
        ends = zip(self.gestures.names, self.samples.tolist(), strict=True)
        rows = sheet_rows(self.take.recording, dict(ends), motions)
        return [row._replace(note=f"{source.name}, {source.licence}") for row in rows]


@cache
def read_gestures(source: Source) -> Gestures:
    """Read the poses of a source, and fit a human hand to each of them."""
    with np.load(_POSES / f"{source.name}.npz") as arrays:
        raw = arrays["names"].tolist()
        points = arrays["landmarks"].astype(float)
    points[[name.startswith("LEFT") for name in raw]] *= (-1.0, 1.0, 1.0)
    recording = _recorded(source.name, points)
    lengths = measure_hand(recording)
    human = scaled_human(recording, points="landmarks", lengths=lengths)
    # Each by its own: a fitter would start from the one before.
    fits = [LandmarkFitter("right", lengths).fit(one) for one in points]
    q, wrists = map(np.array, zip(*fits, strict=True))
    local = transform_points(inverse_pose(wrists), points)
    rest = local - _points(human, q)
    poses = np.hstack([q, rest.reshape(len(q), -1)])
    return Gestures(source, human, tuple(map(_name, raw)), poses)


@cache
def perform(source: Source, seed: int, rate: float, side: Side) -> Performance:
    """Show every gesture once, in pairs after a pause at rest.

    So every second motion is from rest, and the others are between random pairs. The seed chooses
    order and durations, how joints differ from the poses, and the tracker's noise.

    Args:
        source: Source of the gestures.
        seed: Of all that is random.
        rate: Samples per second.
        side: Which hand; a left one is the mirror image.
    """
    gestures = read_gestures(source)
    rng = np.random.default_rng(seed)
    shown = rng.permutation(len(gestures.names))
    pauses = np.arange(0, len(shown), 2)
    order = np.insert(shown, pauses, gestures.names.index(source.start))
    moves = rng.uniform(*MOVES, len(order))
    holds = rng.uniform(*HOLDS, len(order))
    # The person is at the start already.
    moves[0], holds[0] = 0.0, START
    knots = np.column_stack([moves, holds]).cumsum()
    # Of least jerk is the quintic between poses in which the hand is still: a pose is held from one
    # knot to the next.
    held = gestures.show(order, rng).repeat(2, axis=0)
    still = np.zeros_like(held)
    motion = BPoly.from_derivatives(knots, np.stack([held, still, still], axis=1))
    time = np.arange(int(knots[-1] * rate)) / rate
    name = f"{source.name}, seed {seed}"
    recording = _recorded(name, gestures.seen(motion(time), rng), rate)
    # Gestures in their own order; there is a pause before every second one that is shown.
    turn = np.argsort(shown)
    ends = knots[1::2][turn + turn // 2 + 1]
    samples = np.searchsorted(time, ends) - 1
    return Performance(gestures, prepare_take(recording, side), samples)


@cache
def people(source: Source, side: Side) -> HandTrace:
    """Return a person who shows every gesture in turn, and then all of them again, 20 times."""
    gestures = read_gestures(source)
    rng = np.random.default_rng(READERS_SEED)
    order = np.tile(np.arange(len(gestures.names)), _REPEATS)
    landmarks = gestures.seen(gestures.show(order, rng), rng)
    return prepare_take(_recorded(source.name, landmarks), side).trace


def _points(human: Hand, q: Array) -> Array:
    """Return the landmarks of the model at joint angles (T, 20) [m], shape (T, 21, 3)."""
    return np.array([human.points(each) for each in q])


def _recorded(name: str, landmarks: Array, rate: float = 30.0) -> Recording:
    """Return landmarks (T, 21, 3) of a right hand as a recording."""
    time = np.arange(len(landmarks)) / rate
    return Recording(name, time, landmarks, np.isfinite(time), "right")


def _name(raw: str) -> str:
    """Return the name of a pose, of that in its file."""
    side, _, words = raw.lower().partition("_hand_")
    if words:
        return f"{words.replace('_', ' ')} ({side})"
    return " / ".join(filter(str.isascii, raw.split("/")))
