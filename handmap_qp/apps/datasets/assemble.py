"""Put the episodes of a batch together into one data set for training.

An episode has the robot's state (joint positions, then the wrist's position and quaternion wxyz)
and the action, which is the state of the next frame; the last frame repeats. That of a robot with
two hands has all its joints once, then both wrists. Episodes are interpolated to a fixed rate,
between two samples of a motion that is inside its limits, so that it stays inside them. Where a
file has both hands at the same instants, they are one episode. In a data set of both robots, a hand
that an episode lacks is at rest, and not valid.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from operator import attrgetter
from pathlib import Path
from typing import Literal

import numpy as np

from handmap_core.se3 import Array, Arrays, unit
from handmap_qp.apps.offline.look_ahead import continuous_quats
from handmap_qp.hands import Hand, Names
from handmap_qp.trackers import SIDES
from .episodes import read_episode
from .manifest import Line
from .sources import BOTH
from .training_sets import (
    Columns,
    Episode,
    next_frames,
    write_lerobot,
    write_robomimic,
)

WRIST_NAMES = (
    "wrist_x",
    "wrist_y",
    "wrist_z",
    "wrist_qw",
    "wrist_qx",
    "wrist_qy",
    "wrist_qz",
)
"""Names of the wrist's position [m] and quaternion in the state."""
_NO_WRIST = np.eye(7)[3]
Robots = Mapping[str, Hand]
"""Robot hands by side, or a robot with two hands by `BOTH`."""


def assemble(
    lines: Sequence[Line],
    folder: Path,
    form: Literal["lerobot", "robomimic"],
    fps: float,
    robots: Robots,
) -> Path:
    """Write the data set of a batch, and return its folder or file; an earlier one is replaced.

    Args:
        lines: Lines of the episodes.
        folder: Folder of the batch.
        form: LeRobot v3, as the folder `lerobot`; or robomimic, as the file `episodes.hdf5`.
        fps: Frames per second.
        robots: Robot hands by side.

    Raises:
        InvalidInputError: If it cannot be written.
        RecordingError: If an episode is damaged, see `read_episode`.
        MissingExtraError: If the package of the format is not installed.
    """
    hands = dict(sorted(robots.items()))
    episodes = _episodes(lines, folder, fps, hands)
    columns = Columns(state_names(hands), SIDES if BOTH in hands else tuple(hands))
    robot = " and ".join(hand.name for hand in hands.values())
    if form == "robomimic":
        file = folder / "episodes.hdf5"
        write_robomimic(episodes, file, columns, robot=robot, argument="--out")
        return file
    root = folder / "lerobot"
    write_lerobot(
        episodes,
        root,
        columns,
        fps=fps,
        robot=robot,
        argument="--out",
        overwrite=True,
    )
    return root


def state_names(hands: Robots) -> Names:
    """Return the names of the numbers of a state; with both hands, their side is in front."""
    names = []
    for side, hand in hands.items():
        before = f"{side}_" if len(hands) > 1 else ""
        names += [before + name for name in hand.joint_names]
        for part in hand.hands:
            before = f"{part.side}_" if hand.parts else before
            names += [before + name for name in WRIST_NAMES]
    return tuple(names)


def _episodes(
    lines: Sequence[Line], folder: Path, fps: float, hands: Robots
) -> Iterator[Episode]:
    """Read the episodes one after the other, by the names of their files."""
    known = sorted(
        (line for line in lines if line.side in hands), key=attrgetter("key")
    )
    for _, group in groupby(known, key=lambda line: line.place[0]):
        pairs = [(line, read_episode(folder, line)) for line in group]
        (_, first), (_, last) = pairs[0], pairs[-1]
        is_both = sorted(line.side for line, _ in pairs) == [*SIDES]
        is_both = is_both and np.array_equal(first["time"], last["time"])
        for episode in [pairs] if is_both else [[pair] for pair in pairs]:
            yield _episode(episode, fps, hands)


def _episode(
    pairs: Sequence[tuple[Line, Arrays]], fps: float, hands: Robots
) -> Episode:
    """Put the hands of one recording side by side, at a fixed rate."""
    by_side = {line.side: columns for line, columns in pairs}
    (line, columns), *_ = pairs
    time = columns["time"]
    count = int((time[-1] - time[0]) * fps + 1e-6) + 1
    instants = np.minimum(time[0] + np.arange(count) / fps, time[-1])
    states = []
    valid = []
    for side, hand in hands.items():
        state = np.tile([*hand.rest, *_NO_WRIST], (count, 1))
        seen = np.zeros((count, 1), dtype=bool)
        if side in by_side:
            state, seen = _resampled(by_side[side], instants)
        states.append(_as_float32(state, hand))
        valid.append(seen)
    whole = np.hstack(states)
    folder = Path(line.place[0]).parent.name
    return Episode(
        sources=", ".join(line.key for line, _ in pairs),
        task=line.task or folder.replace("_", " ") or "human hand motion",
        state=whole,
        action=next_frames(whole),
        valid=np.hstack(valid),
        # A mapped recording has none: nobody has measured a robot.
        effort=np.zeros((count, 0)),
    )


def _resampled(columns: Arrays, instants: Array) -> tuple[Array, Array]:
    """Interpolate joints and wrists; a frame is valid between two valid samples."""
    time = columns["time"]

    def resample(values: Array) -> Array:
        rows = values.reshape(len(time), -1).T
        return np.transpose([np.interp(instants, time, column) for column in rows])

    state = [resample(columns["q"])]
    for wrist in columns["wrist"].reshape(len(time), -1, 4, 4).swapaxes(0, 1):
        quats = resample(continuous_quats(wrist[:, :3, :3]))
        state += [resample(wrist[:, :3, 3]), unit(quats)]
    return np.hstack(state), resample(columns["valid"]) == 1.0


def _as_float32(state: Array, hand: Hand) -> Array:
    """Round a state to float32 without leaving the joints' limits."""
    rounded = state.astype(np.float32)
    joints = rounded[:, : len(hand.joint_names)]
    middle = np.mean(hand.limits, axis=0, dtype=np.float32)
    is_outside = joints != np.clip(joints, *hand.limits)
    np.nextafter(joints, middle, out=joints, where=is_outside)
    return rounded
