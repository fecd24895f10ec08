"""A test motion for the view, as joint angles and as a file."""

from __future__ import annotations

import re
from copy import copy
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp import Recording, load_hand
from handmap_qp.apps.viewer.controls import SteeringControls
from handmap_qp.apps.viewer.replay import Replay
from handmap_qp.human import HumanMotion
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.se3 import affine, rotation_from_quat_wxyz

COUNT, GAP = 60, slice(20, 25)


def option_handles(steering: SteeringControls) -> dict[str, Any]:
    """Return viser's controls of the options by name."""
    return {
        name: control.handle
        for name, control in steering.controls.items()
        if name not in ("preset", "compare")
    }


@cache
def closing_motion(points: str | None = None) -> HumanMotion:
    """Return 2 s of a hand that closes, travels and rotates, and is not seen for five samples."""
    human = load_hand("human", points=points)
    share = np.linspace(0.0, 0.5, COUNT)
    q = human.rest + share[:, None] * (0.8 * human.upper_limits - human.rest)
    turns = [
        rotation_from_quat_wxyz((np.cos(0.4 * s), 0.0, np.sin(0.4 * s), 0.0))
        for s in share
    ]
    wrist = np.array(
        [
            affine(turn, np.array([0.3 * s, 1.0, -0.2 * s]))
            for turn, s in zip(turns, share, strict=True)
        ]
    )
    valid = np.ones(COUNT, dtype=bool)
    valid[GAP] = False
    return HumanMotion(
        human,
        np.arange(COUNT) / 30.0,
        np.full(COUNT, 1.0 / 30.0),
        q,
        wrist,
        valid,
    )


@cache
def closing_recording() -> Recording:
    """Return the landmarks of the motion."""
    motion = closing_motion("landmarks")
    landmarks = [
        motion.human.points(q, wrist)
        for q, wrist in zip(motion.q, motion.wrist, strict=True)
    ]
    return Recording("closing", motion.time, np.array(landmarks), motion.valid, "right")


def make_replay(
    robot: str = "three_finger", preset: str = "paper", **changes: Any
) -> Replay:
    """Map the motion to a robot, with options by name."""
    replay = copy(_mapped(robot, preset, tuple(sorted(changes.items()))))
    replay.switches = {}
    return replay


@cache
def _mapped(robot: str, preset: str, changes: tuple[tuple[str, Any], ...]) -> Replay:
    motion = closing_motion()
    choice = preset_choice(preset).with_changes(dict(changes))
    seen = closing_recording(), motion
    return Replay(motion.human, _robot(robot), choice, seen)


_robot = cache(load_hand)


def plotted(html: str, colour: str) -> np.ndarray:
    """Return times and values of a line of a plot, shape (2, n), to a tenth of a pixel."""
    top = max(map(float, re.findall(r'text-anchor="end">([^<]*)<', html)))
    times = [float(t) for t in re.findall(r'text-anchor="middle">([^<]*)<', html)]
    path = re.search(rf'd="([^"]*)" fill="none" stroke="{colour}"', html)
    assert path is not None
    pixels = re.findall(r"[ML]([-\d.]+) ([-\d.]+)", path[1])
    x, y = np.array(pixels, dtype=float).T
    start, end = min(times), max(times)
    return np.array([start + (end - start) * x / 228.0, top * (1.0 - y / 86.0)])


def press(button: Any) -> None:
    """Press a button as a browser does."""
    button.value = True


def write_recording(path: Path) -> Path:
    """Write the motion as a recording of landmarks."""
    recording = closing_recording()
    np.savez(
        path,
        time=recording.time,
        landmarks=recording.landmarks,
        valid=recording.valid,
        handedness=recording.side,
    )
    return path
