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

from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.hands import Hand, Names, Side
from handmap_qp.human import Recording, fit_recording, measure_hand
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
"""Seed of what a reader has seen; no performance should have it."""
_REPEATS = 20
_POSES = Path(__file__).parent / "poses"


class Source(msgspec.Struct, frozen=True):
    """Where poses are from; see `poses/sources.yaml`."""

    name: str
    file: str
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
        names: Their names, all different.
        labels: What they show; a left and a right hand's are the same.
        q: Joint angles [rad], shape (n, 20).
        rest: What the fit leaves over of each landmark, in wrist axes [m], shape (n, 21, 3).
    """

    human: Hand
    names: Names
    labels: Names
    q: Array
    rest: Array

    def show(self, order: Array, rng: np.random.Generator) -> Array:
        """Return joint angles of gestures by index, never twice the same, shape (k, 20)."""
        return self.q[order] + rng.normal(0.0, JOINT_NOISE, (len(order), 20))

    def seen(self, q: Array, rest: Array, rng: np.random.Generator) -> Array:
        """Return landmarks as a tracker would see them [m], shape (T, 21, 3)."""
        exact = np.array([*map(self.human.points, q)]) + rest
        return exact + rng.normal(0.0, TRACKER_NOISE, exact.shape)


class Performance(NamedTuple):
    """Gestures after one another.

    Attributes:
        take: The motion, of a hand of the robot's side.
        shown: Index of each gesture in the order shown, without pauses at rest.
        samples: Last sample in which each is held.
    """

    take: Take
    shown: Array
    samples: Array


@cache
def read_gestures(source: Source) -> Gestures:
    """Read the poses of a source, and fit a human hand to each of them."""
    with np.load(_POSES / source.file) as arrays:
        raw = arrays["names"].tolist()
        points = arrays["landmarks"].astype(float)
    points[[name.startswith("LEFT") for name in raw]] *= (-1.0, 1.0, 1.0)
    lengths = measure_hand(_recorded(source.name, points))
    # One by one: each sample's fit would start from the one before.
    fits = [
        fit_recording(_recorded(source.name, one[None]), lengths=lengths)
        for one in points
    ]
    human = fits[0].human
    q = np.array([fit.q[0] for fit in fits])
    wrists = np.array([fit.wrist[0] for fit in fits])
    local = transform_points(inverse_pose(wrists), points)
    rest = local - np.array([*map(human.points, q)])
    names, labels = zip(*map(_named, raw), strict=True)
    return Gestures(human, names, labels, q, rest)


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
    count = len(gestures.names)
    pauses = np.arange(0, count, 2)
    start = gestures.names.index(source.start)
    order = np.insert(rng.permutation(count), pauses, start)
    is_shown = np.insert(np.ones(count, dtype=bool), pauses, False)
    moves = rng.uniform(*MOVES, len(order))
    ends = np.cumsum(moves + rng.uniform(*HOLDS, len(order)))
    # The first gesture is the start, where the person is already.
    ends += START - ends[0]
    time = np.arange(int(ends[-1] * rate)) / rate
    now = np.searchsorted(ends, time, side="right")
    before = np.maximum(now - 1, 0)
    share = np.clip((time - ends[before]) / moves[now], 0.0, 1.0)
    ease = share**3 * (10.0 + share * (6.0 * share - 15.0))
    q, rest = (
        ((1.0 - ease) * goals[before].T + ease * goals[now].T).T
        for goals in (gestures.show(order, rng), gestures.rest[order])
    )
    landmarks = gestures.seen(q, rest, rng)
    recording = _recorded(f"{source.name}, seed {seed}", landmarks, rate)
    last = np.searchsorted(now, np.arange(len(order)), side="right") - 1
    return Performance(prepare_take(recording, side), order[is_shown], last[is_shown])


@cache
def people(source: Source, side: Side) -> Take:
    """Return a person who shows every gesture in turn, and then all of them again, 20 times."""
    gestures = read_gestures(source)
    rng = np.random.default_rng(READERS_SEED)
    order = np.tile(np.arange(len(gestures.names)), _REPEATS)
    landmarks = gestures.seen(gestures.show(order, rng), gestures.rest[order], rng)
    return prepare_take(_recorded(source.name, landmarks), side)


def _recorded(name: str, landmarks: Array, rate: float = 30.0) -> Recording:
    """Return landmarks (T, 21, 3) of a right hand as a recording."""
    count = len(landmarks)
    seen = np.ones(count, dtype=bool)
    return Recording(name, np.arange(count) / rate, landmarks, seen, "right")


def _named(raw: str) -> tuple[str, str]:
    """Return the name of a pose and its label, of the name in its file."""
    side, _, words = raw.partition("_HAND_")
    label = words.replace("_", " ").lower()
    name = " / ".join(filter(str.isascii, raw.split("/")))
    return (f"{label} ({side.lower()})", label) if words else (name, name)
