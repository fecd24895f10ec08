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
from typing import Literal, NamedTuple

import numpy as np

from handmap_core.se3 import Array, Arrays, unit
from handmap_qp.apps.offline.look_ahead import continuous_quats
from handmap_qp.hands import Hand, Names
from handmap_qp.trackers import SIDES, pieces_of
from .episodes import StoredEpisode, open_episode
from .manifest import Line
from .sources import BOTH
from .training_sets import (
    Columns,
    Episode,
    Frames,
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
        RecordingError: If an episode is damaged, see `open_episode`.
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
        pairs = [(line, open_episode(folder, line)) for line in group]
        (_, first), (_, last) = pairs[0], pairs[-1]
        is_both = sorted(line.side for line, _ in pairs) == [*SIDES]
        is_both = is_both and np.array_equal(first.time, last.time)
        for episode in [pairs] if is_both else [[pair] for pair in pairs]:
            yield _episode(episode, fps, hands)


def _episode(
    pairs: Sequence[tuple[Line, StoredEpisode]], fps: float, hands: Robots
) -> Episode:
    """Put the hands of one recording side by side, at a fixed rate."""
    (line, stored), *_ = pairs
    time = stored.time
    count = int((time[-1] - time[0]) * fps + 1e-6) + 1
    instants = np.minimum(time[0] + np.arange(count) / fps, time[-1])
    folder = Path(line.place[0]).parent.name
    by_side = {line.side: stored for line, stored in pairs}
    return Episode(
        sources=", ".join(line.key for line, _ in pairs),
        task=line.task or folder.replace("_", " ") or "human hand motion",
        count=count,
        parts=_with_actions(_states(by_side, instants, hands)),
    )


def _states(
    by_side: Mapping[str, StoredEpisode], instants: Array, hands: Robots
) -> Iterator[tuple[Array, Array]]:
    """Yield the states of consecutive frames, and whether the hands are valid in them.

    Args:
        by_side: Episodes of the same instants.
        instants: Instants of all frames [s], shape (N,).
        hands: Robot hands by side, in the order of the state.
    """
    resampled = [_resampled(stored, instants) for stored in by_side.values()]
    for parts in zip(*resampled, strict=True):
        found = dict(zip(by_side, parts, strict=True))
        count = len(parts[0][0])
        states = []
        valid = []
        for side, hand in hands.items():
            state = np.tile([*hand.rest, *_NO_WRIST], (count, 1))
            seen = np.zeros((count, 1), dtype=bool)
            if side in found:
                state, seen = found[side]
            states.append(_as_float32(state, hand))
            valid.append(seen)
        yield np.hstack(states), np.hstack(valid)


def _with_actions(states: Iterator[tuple[Array, Array]]) -> Iterator[Frames]:
    """Yield frames whose action is the state of the next one; the last frame repeats."""
    waiting: tuple[Array, Array] | None = None
    for state, valid in states:
        if waiting:
            before, seen = waiting
            action = np.concatenate([before[1:], state[:1]])
            yield _without_effort(before, action, seen)
        waiting = state, valid
    if waiting:
        before, seen = waiting
        yield _without_effort(before, next_frames(before), seen)


def _without_effort(state: Array, action: Array, valid: Array) -> Frames:
    """Return frames of a mapped recording, which have no efforts: nobody measured a robot."""
    return Frames(state, action, valid, effort=np.zeros((len(state), 0)))


def _resampled(
    episode: StoredEpisode, instants: Array
) -> Iterator[tuple[Array, Array]]:
    """Interpolate joints and wrists; a frame is valid between two valid samples.

    Args:
        episode: The episode.
        instants: Instants of all frames [s], shape (N,), within those of the episode.

    Yields:
        Rows of consecutive frames, a few thousand at once.
    """
    last: _Samples | None = None
    done = read = 0
    for columns in episode.pieces():
        samples = _samples(columns, last)
        read += len(columns["time"])
        is_last = read == len(episode.time)
        # A frame at the last sample of a piece is one of the next piece, which has it too.
        side = "right" if is_last else "left"
        stop = int(np.searchsorted(instants, samples.time[-1], side))
        for piece in pieces_of(stop - done):
            yield _interpolated(samples, instants[done:stop][piece])
        done = stop
        last = _Samples(samples.time[-1:], [rows[-1:] for rows in samples.columns])


class _Samples(NamedTuple):
    """Consecutive samples of an episode.

    Attributes:
        time: Their instants [s], shape (T,).
        columns: Joint positions, positions and quaternions of each wrist in turn, and whether
            samples are valid; each of shape (T, n).
    """

    time: Array
    columns: list[Array]


def _samples(columns: Arrays, last: _Samples | None) -> _Samples:
    """Return a piece of an episode, behind the last sample of the piece before.

    Args:
        columns: The piece.
        last: The last sample; None if it is the first piece.
    """
    count = len(columns["time"])
    found = [columns["q"]]
    for wrist in columns["wrist"].reshape(count, -1, 4, 4).swapaxes(0, 1):
        found += [wrist[:, :3, 3], continuous_quats(wrist[:, :3, :3])]
    found.append(columns["valid"].reshape(count, -1))
    if last is None:
        return _Samples(columns["time"], found)
    for before, quats in zip(last.columns[2:-1:2], found[2:-1:2], strict=True):
        # Quaternions go on without a jump of sign.
        if np.vecdot(before[0], quats[0]) < 0.0:
            quats *= -1.0
    return _Samples(
        np.concatenate([last.time, columns["time"]]),
        [np.concatenate(rows) for rows in zip(last.columns, found, strict=True)],
    )


def _interpolated(samples: _Samples, instants: Array) -> tuple[Array, Array]:
    """Return state and flags at instants."""

    def resample(rows: Array) -> Array:
        return np.transpose(
            [np.interp(instants, samples.time, column) for column in rows.T]
        )

    joints, *wrists, valid = map(resample, samples.columns)
    wrists[1::2] = map(unit, wrists[1::2])
    return np.hstack([joints, *wrists]), valid == 1.0


def _as_float32(state: Array, hand: Hand) -> Array:
    """Round a state to float32 without leaving the joints' limits."""
    rounded = state.astype(np.float32)
    joints = rounded[:, : len(hand.joint_names)]
    middle = np.mean(hand.limits, axis=0, dtype=np.float32)
    is_outside = joints != np.clip(joints, *hand.limits)
    np.nextafter(joints, middle, out=joints, where=is_outside)
    return rounded
