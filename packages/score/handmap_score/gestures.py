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
from scipy.stats import norm, qmc

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
HOLD = 0.45
"""Time in which every gesture is held [s]: all of them count the same."""
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
        human: The human hand, scaled to them; its reference points are the landmarks.
        names: Their names, all different; the side of a hand in brackets where there are both.
        landmarks: As the source has them, those of left hands mirrored [m], shape (n, 21, 3).
        poses: Joint angles [rad], and what the fit leaves over of each landmark, in wrist axes [m],
            shape (n, 20 + 63).
    """

    human: Hand
    names: Names
    landmarks: Array
    poses: Array

    def show(self, order: Array, rng: np.random.Generator) -> Array:
        """Return poses of gestures by index, never twice the same, shape (k, 83).

        Each joint's noise is spread evenly: it is a little in each of k equally likely ranges.
        """
        shown = self.poses[order]
        evenly = qmc.LatinHypercube(_JOINTS, seed=rng).random(len(order))
        shown[:, :_JOINTS] += JOINT_NOISE * norm.ppf(evenly)
        return shown

    def seen(self, poses: Array, rng: np.random.Generator) -> Array:
        """Return landmarks of poses, shape (T, 83), as a tracker would see them, (T, 21, 3)."""
        q, rest = np.split(poses, [_JOINTS], axis=1)
        exact = _points(self.human, q) + rest.reshape(len(q), -1, 3)
        return exact + rng.normal(0.0, TRACKER_NOISE, exact.shape)


class Performance(NamedTuple):
    """Gestures after one another.

    Attributes:
        source: Where the n gestures are from.
        take: The motion, of a hand of the robot's side.
        shown: Their names, in the order of showing.
        samples: Last sample in which each is held, shape (n,).
    """

    source: Source
    take: Take
    shown: Names
    samples: Array

    def sheet(self, motions: list[Array]) -> list[SheetRow]:
        """Return the end of every gesture, with the joints of motions of shape (T, k) each."""
        ends = sorted(zip(self.shown, self.samples.tolist(), strict=True))
        rows = sheet_rows(self.take.recording, dict(ends), motions)
        note = f"{self.source.name}, {self.source.licence}"
        return [row._replace(note=note) for row in rows]


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
    return Gestures(human, tuple(map(_name, raw)), points, poses)


@cache
def perform(source: Source, seed: int, rate: float, side: Side) -> Performance:
    """Show every gesture once, in pairs after a pause at rest.

    So every second motion is from rest, and the others are between random pairs. The seed chooses
    the order, how long motions take and how joints differ from the poses, both evenly, and the
    tracker's noise.

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
    evenly = qmc.LatinHypercube(1, seed=rng).random(len(order))
    times = np.insert(qmc.scale(evenly, *MOVES), 1, HOLD, axis=1)
    # The person is at the start already.
    times[0] = 0.0, START
    knots = times.cumsum()
    # Of least jerk is the quintic between poses in which the hand is still: a pose is held from one
    # knot to the next.
    held = gestures.show(order, rng).repeat(2, axis=0)
    still = np.zeros_like(held)
    motion = BPoly.from_derivatives(knots, np.stack([held, still, still], axis=1))
    time = np.arange(int(knots[-1] * rate)) / rate
    landmarks = gestures.seen(motion(time), rng)
    recording = _recorded(f"{source.name}, seed {seed}", landmarks, rate)
    ends = np.searchsorted(time, knots[1::2]) - 1
    # A pause and two gestures take turns.
    is_gesture = np.arange(len(order)) % 3 > 0
    names = tuple(gestures.names[k] for k in shown)
    return Performance(source, prepare_take(recording, side), names, ends[is_gesture])


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
