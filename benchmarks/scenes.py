"""Recordings of human hands, fitted to joint angles, and the robots to map them to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from handmap_qp import Hand, HandSpec, load_hand, read_recording
from handmap_qp.hands import Side
from handmap_qp.human import HumanMotion
from handmap_qp.human.fit import fit_recording

ROBOTS = ("three_finger", "allegro")
"""Robots by family; `robot_for` returns the one for a side."""

# The three-fingered hand is symmetric, so a left one differs only in the names of two fingers.
_SWAPPED = {"index": "middle", "middle": "index"}


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A fitted recording of a human hand.

    Attributes:
        name: Name of the recording.
        side: `right` or `left`.
        motion: Joint angles and wrist poses.
    """

    name: str
    side: Side
    motion: HumanMotion


@cache
def load_scene(file: Path, every: int = 1, samples: int | None = None) -> Scene:
    """Read and fit a recording, once per process.

    Args:
        file: The recording.
        every: Keep every n-th sample, after fitting all.
        samples: Number of samples to keep, from the first valid one; all if omitted.

    Returns:
        The scene.
    """
    recording = read_recording(file)
    if samples is not None:
        kept = slice(
            int(np.argmax(recording.valid)),
            int(np.argmax(recording.valid)) + samples * every,
        )
        columns = {
            name: getattr(recording, name)[kept]
            for name in ("time", "landmarks", "valid")
        }
        recording = replace(recording, **columns, wrist=None, confidence=None)
    return Scene(
        recording.name, recording.side, thinned(fit_recording(recording), every)
    )


def load_scenes(
    files: list[Path],
    every: int = 1,
    samples: int | None = None,
    done: Callable[[], None] = lambda: None,
) -> list[Scene]:
    """Read and fit several recordings; `done` is called after each."""
    scenes = []
    for file in files:
        scenes.append(load_scene(file, every, samples))
        done()
    return scenes


def thinned(motion: HumanMotion, every: int) -> HumanMotion:
    """Keep every n-th sample of a motion; `dt` grows accordingly."""
    if every == 1:
        return motion
    kept = {
        name: getattr(motion, name)[::every] for name in ("time", "q", "wrist", "valid")
    }
    steps = np.diff(kept["time"])
    first = np.median(steps) if len(steps) else motion.dt[0] * every
    return replace(motion, dt=np.concatenate([[first], steps]), **kept)


@cache
def robot_for(family: str, side: Side, points: str | None = None) -> Hand:
    """Return the robot of a family for a human hand of a side.

    Args:
        family: One of `ROBOTS`, or any name that `load_hand` accepts.
        side: Side of the human hand.
        points: Set of reference points; the robot's default if omitted.

    Returns:
        The robot. The three-fingered hand serves both sides, with its fingers named for the side.
    """
    if family == "allegro":
        return load_hand(f"allegro_{side}", points=points)
    hand = load_hand(family, points=points)
    return (
        load_hand(_other_side(hand.spec), points=points)
        if family == "three_finger" and side == "left"
        else hand
    )


def _other_side(spec: HandSpec) -> HandSpec:
    """Return the three-fingered hand for the other side: swap index and middle finger."""
    points = tuple(
        msgspec.structs.replace(
            point, finger=_swap(point.finger), partner=_swap(point.partner)
        )
        for point in spec.points
    )
    return msgspec.structs.replace(spec, side="left", points=points)


def _swap(name: str | None) -> str | None:
    """Swap the finger in a point's name: `index_tip` becomes `middle_tip`."""
    if name is None:
        return None
    finger, mark, rest = name.partition("_")
    return _SWAPPED.get(finger, finger) + mark + rest
