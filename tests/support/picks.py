"""Recordings that are picks, and objects of a household for them: `picks`, `HOUSEHOLD`.

Few recordings of people are picks. Others are made from them: slower or faster, of a person with
another hand, or a closing that is kept while the hand is lifted. The rest is made from the human
model. Names say which.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from demo_recording import GESTURES
from handmap_score.tasks import household

from handmap_core.human.recording import Recording
from handmap_core.human.sample import human_name
from handmap_qp import HumanLengths, load_hand
from handmap_qp.apps.simulation.pinch import PinchTrial
from handmap_qp.hands import Side
from handmap_qp.se3 import affine, rotation_from_rpy, smoothstep
from handmap_qp.trackers.formats import read_recording

RATE = 60.0
"""Samples per second of recordings that are made from the human model."""
HAND_LENGTH = 0.186
"""Length of the person's hand, if none is given [m]."""
# Time for which a made hand is open, and of the whole recording [s].
_OPEN_FOR, _WHOLE = 0.8, 3.2
# A hand is lifted so far [m], in such a time, so long after it has closed [s].
_LIFT, _LIFTING, _RESTING = 0.1, 1.0, 0.4
_POSTURES = {gesture.name: np.ravel(gesture.fingers) for gesture in GESTURES}


@cache
def made_pick(
    side: Side = "right",
    *,
    closing: float = 0.3,
    hand_length: float = HAND_LENGTH,
    pitch: float = 0.0,
    seed: int = 0,
) -> Recording:
    """Make a pick from the human model: an open hand closes thumb and index finger, and rises.

    The palm looks down, in a world with y up. No person was recorded.

    Args:
        side: The hand.
        closing: Time in which it closes [s].
        hand_length: Length of the hand [m].
        pitch: By how much the fingers point down [rad].
        seed: Seed of the tracker's noise, 0.3 mm of each landmark.

    Returns:
        The recording, the same one each time; its arrays cannot be written to.
    """
    lengths = HumanLengths.from_hand_length(hand_length)
    human = load_hand(human_name(side), points="landmarks", lengths=lengths)
    random = np.random.default_rng(seed)
    start, end = _POSTURES["open"], _POSTURES["pinch index"]
    turn = rotation_from_rpy((-np.pi / 2.0 - pitch, 0.0, 0.0))
    time = np.arange(0.0, _WHOLE, 1.0 / RATE)
    landmarks = np.empty((len(time), 21, 3))
    for i, instant in enumerate(time):
        share = smoothstep((instant - _OPEN_FOR) / closing)
        rise = smoothstep((instant - _OPEN_FOR - closing - _RESTING) / _LIFTING)
        pose = affine(turn, (0.0, 0.3 + _LIFT * rise, 0.0))
        landmarks[i] = human.points(start + share * (end - start), pose)
    landmarks += random.normal(0.0, 3e-4, landmarks.shape)
    valid = np.ones(len(time), dtype=bool)
    for array in (time, landmarks, valid):
        array.flags.writeable = False
    return Recording("made", time, landmarks, valid, side)


def slowed(recording: Recording, factor: float) -> Recording:
    """Return a recording that takes longer by a factor."""
    name = f"{recording.name} x{factor:g} as long"
    return replace(recording, name=name, time=recording.time * factor)


def resized(recording: Recording, scale: float) -> Recording:
    """Return a recording of a person whose hand is larger by a factor, at the same place."""
    wrist = recording.landmarks[:, :1]
    landmarks = wrist + scale * (recording.landmarks - wrist)
    name = f"{recording.name} hand x{scale:g}"
    return replace(recording, name=name, landmarks=landmarks, wrist=None)


def kept(recording: Recording, instant: float, up: Sequence[float]) -> Recording:
    """Return a recording that ends in a closing: its last hand is kept, and lifted.

    Args:
        recording: A recording.
        instant: When thumb and index finger are nearest [s].
        up: Direction in which it is lifted, shape (3,).

    Returns:
        What it shows in the 2 s before, then the same hand for 2 s more.
    """
    time = recording.time
    near = np.abs(time - instant) < 0.1
    thumb, index = recording.landmarks[:, 4], recording.landmarks[:, 8]
    gap = np.where(
        near & recording.valid, np.linalg.norm(thumb - index, axis=1), np.inf
    )
    last = int(gap.argmin())
    piece = recording.part(slice(np.searchsorted(time, time[last] - 2.0), last + 1))
    step = float(np.median(np.diff(time)))
    more = np.arange(step, 2.0, step)
    rise = _LIFT * smoothstep((more - _RESTING) / _LIFTING)
    hands = piece.landmarks[-1] + rise[:, None, None] * np.array(up)
    return replace(
        piece,
        name=f"{recording.name} kept at {instant:g} s",
        time=np.concatenate([piece.time, piece.time[-1] + more]),
        landmarks=np.concatenate([piece.landmarks, hands]),
        valid=np.concatenate([piece.valid, np.ones(len(more), dtype=bool)]),
        wrist=None,
        confidence=None,
    )


def picks(files: Sequence[Path]) -> Iterator[Recording]:
    """Yield a dozen recordings that are picks.

    Args:
        files: Recordings of people, of the shared folder.
    """
    real = {file.stem: read_recording(file) for file in files}
    move, hmd = real["leap_pinch_move_right"], real["leap_hmd_right"]
    video = real["rgb_mediapipe_right"]
    yield move
    yield slowed(move, 1.5)
    yield resized(move, 0.88)
    yield hmd
    yield slowed(hmd, 0.5)
    yield resized(slowed(hmd, 0.5), 1.1)
    for instant in (8.47, 20.2):
        yield kept(video, instant, (0.0, 1.0, 0.0))
    yield named(made_pick(), "made")
    yield named(made_pick(closing=0.8, seed=1), "made, closes slowly")
    yield named(made_pick(hand_length=0.17, pitch=0.5, seed=2), "made, small, pitched")
    yield named(made_pick(hand_length=0.2, closing=0.2, seed=3), "made, large, quick")


def named(recording: Recording, name: str) -> Recording:
    """Return a recording by another name."""
    return replace(recording, name=name)


HOUSEHOLD: dict[str, PinchTrial] = {
    name: PinchTrial(held.shape, held.mass, held.friction)
    for name, held in household.HOUSEHOLD.items()
}
"""Objects of the task `pick` of `handmap score --tasks`, held at the frame's origin."""
