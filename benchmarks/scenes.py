"""The motions that benchmarks map.

Recordings of real hands, as joint angles, and the robots that go with them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import msgspec
import numpy as np

from handmap_qp import Hand, HandSpec, load_hand, read_recording
from handmap_qp.hands.spec import Side
from handmap_qp.trackers.landmarks import fit_recording
from handmap_qp.trackers.recording import HumanMotion

ROBOTS = ("three_finger", "allegro")
"""Robots by family; `robot_for` finds the one for a side."""

# The three-fingered hand is its own mirror image, but for what its second and third finger stand
# for.
_SWAPPED = {"index": "middle", "middle": "index"}


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """A recording of a human hand, fitted.

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
        every: Keep every so-manieth sample, after fitting all.
        samples: Keep so many samples from the beginning; all if omitted.

    Returns:
        The scene.
    """
    recording = read_recording(file)
    if samples is not None:
        kept = slice(
            int(np.argmax(recording.valid)), int(np.argmax(recording.valid)) + samples * every
        )
        columns = {name: getattr(recording, name)[kept] for name in ("time", "landmarks", "valid")}
        recording = replace(recording, **columns)
    return Scene(recording.name, recording.side, thinned(fit_recording(recording), every))


def load_scenes(
    files: list[Path],
    every: int = 1,
    samples: int | None = None,
    done: Callable[[], None] = lambda: None,
) -> list[Scene]:
    """The same for several recordings; `done` is called after each."""
    scenes = []
    for file in files:
        scenes.append(load_scene(file, every, samples))
        done()
    return scenes


def thinned(motion: HumanMotion, every: int) -> HumanMotion:
    """Every so-manieth sample of a motion; the time from sample to sample grows accordingly."""
    if every == 1:
        return motion
    kept = {
        name: getattr(motion, name)[::every]
        for name in ("time", "q", "wrist", "valid", "fit_error")
    }
    steps = np.diff(kept["time"])
    first = np.median(steps) if len(steps) else motion.dt[0] * every
    return replace(motion, dt=np.concatenate([[first], steps]), **kept)


@cache
def robot_for(family: str, side: Side, points: str | None = None) -> Hand:
    """The robot of a family for a human hand of a side.

    Args:
        family: One of `ROBOTS`, or any name that `load_hand` knows.
        side: Side of the human hand.
        points: Set of reference points; the robot's own choice if omitted.

    Returns:
        The robot. The three-fingered one serves both sides, its fingers named for the side.
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
    """The three-fingered hand for the other side: index and middle finger change places."""
    points = tuple(
        msgspec.structs.replace(point, finger=_swap(point.finger), partner=_swap(point.partner))
        for point in spec.points
    )
    return msgspec.structs.replace(spec, side="left", points=points)


def _swap(name: str | None) -> str | None:
    """`index_tip` for `middle_tip` and so on."""
    if name is None:
        return None
    finger, mark, rest = name.partition("_")
    return _SWAPPED.get(finger, finger) + mark + rest
