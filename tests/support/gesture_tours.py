"""Labelled poses of people, each after every other: how a robot shows them, and who is caught.

Poses are those of `handmap score`. Every pose of a right hand follows every other one, half a
second between them (minimum jerk) and half a second each, or as long as the robot needs (`PACES`).
The palm stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from arrivals import shapes_of
from handmap_score.gestures import SOURCES, Source, read_gestures

from handmap_qp import Hand, HandMapper, Recording
from handmap_qp.apps.offline.fidelity import angles_between
from handmap_qp.apps.offline.hand_trace import (
    MIDDLE,
    TIP,
    HandTrace,
    trace_human,
)
from handmap_qp.hands import THUMB, find_fingers
from handmap_qp.hands.human import HumanLengths
from handmap_qp.human.measure import scaled_human
from handmap_qp.mapping.hand_pair import points_in_palm

RATE = 60.0
"""Samples per second."""
_MOVE, _HOLD = 30, 30
"""Samples of a motion, and of the shortest hold."""
LONGEST_HOLD = 8.0
"""Time after which a person who waits for the robot goes on [s]."""
RESTING = 0.05
"""Speed below which a joint rests [rad/s]."""
HELD_BACK = Path(__file__).parents[1] / "data" / "held_back" / "handy-work.npz"
"""Poses that no mapping was tuned on; see the README beside them."""
CAUGHT = 60.0
"""A finger that is farther off than this is caught [deg]."""


class Pose(NamedTuple):
    """A labelled pose: its landmarks with the palm at the origin, shape (21, 3).

    What is held back has no source that a reader knows.
    """

    source: Source | None
    name: str
    landmarks: np.ndarray


def read_poses() -> list[Pose]:
    """Read the labelled poses of right hands, scaled to one length of the palm."""
    found = []
    for source in SOURCES:
        gestures = read_gestures(source)
        for name, points in zip(gestures.names, gestures.landmarks, strict=True):
            if not name.endswith("(left)"):
                found.append(Pose(source, name, points))
    return _with_one_palm(found)


def read_held_back() -> list[Pose]:
    """Read poses that no mapping was tuned on: other people's, and left hands, mirrored."""
    with np.load(HELD_BACK) as arrays:
        names = arrays["names"].tolist()
        landmarks = arrays["landmarks"]
    found = []
    for name, points in zip(names, landmarks, strict=True):
        mirror = (-1.0, 1.0, 1.0) if name.startswith("LEFT") else (1.0, 1.0, 1.0)
        found.append(Pose(None, name, points * mirror))
    for source in SOURCES:
        gestures = read_gestures(source)
        for name, points in zip(gestures.names, gestures.landmarks, strict=True):
            if name.endswith("(left)"):
                found.append(Pose(None, name, points))
    return _with_one_palm(found)


def _with_one_palm(poses: list[Pose]) -> list[Pose]:
    """Lay the palms on each other, so that only fingers move from pose to pose."""
    lengths = HumanLengths.from_hand_length(0.19)
    whole = trace_human(np.array([pose.landmarks for pose in poses]), lengths)
    local = [
        (pose.landmarks - palm[:3, 3]) @ palm[:3, :3]
        for pose, palm in zip(poses, whole.palm, strict=True)
    ]
    size = np.median([np.linalg.norm(points[9] - points[0]) for points in local])
    return [
        pose._replace(landmarks=points * size / np.linalg.norm(points[9] - points[0]))
        for pose, points in zip(poses, local, strict=True)
    ]


def tour(count: int) -> list[int]:
    """Return an order in which every pose follows every other one once, and some themselves."""
    order = [0]
    for step in range(1, count):
        # Rounds of one step size; each pose of a round follows the one `step` before it.
        seen = set()
        for start in range(count):
            k = start
            while k not in seen:
                seen.add(k)
                order += [k] if order[-1] != k else []
                k = (k + step) % count
                order.append(k)
    return order


def random_tour(count: int, transitions: int, seed: int) -> list[int]:
    """Return an order of random poses, none of which follows itself.

    Args:
        count: How many poses there are, at least 2.
        transitions: How many poses follow the first one.
        seed: Of the generator.
    """
    rng = np.random.default_rng(seed)
    steps = rng.integers(1, count, transitions)
    return (np.cumsum([rng.integers(count), *steps]) % count).tolist()


class Pace(NamedTuple):
    """How fast the person is.

    Attributes:
        waits: Whether the person holds every pose until no joint has been faster than `RESTING`
            for half a second, or for `LONGEST_HOLD`.
        slows: Whether the person moves as slowly as the robot's joints need (`samples_of_move`).
    """

    waits: bool = False
    slows: bool = False


PACES = {
    "half-second": Pace(),
    "wait": Pace(waits=True),
    "own": Pace(waits=True, slows=True),
}
"""Half a second for everything; half a second for motions alone; and the robot hand's own pace."""


def samples_of_move(before: np.ndarray, now: np.ndarray, limits: np.ndarray) -> int:
    """Return how many samples a motion lasts in which no joint of the robot needs its limit.

    It is the longest travel of any joint over its speed limit, times 15/8: so much faster than its
    mean is a motion of minimum jerk in its middle. It is at least half a second.

    Args:
        before: Joints of the robot at rest in the pose before [rad], shape (n,).
        now: Those in the next pose.
        limits: Its speed limits [rad/s], shape (n,).
    """
    seconds = 15.0 / 8.0 * (np.abs(now - before) / limits).max()
    return max(_MOVE, int(np.ceil(RATE * seconds)))


def _has_rested(rows: Sequence[np.ndarray]) -> bool:
    """Return whether no joint moved faster than `RESTING`, on average, in the shortest hold."""
    if len(rows) <= _HOLD:
        return False
    travel = np.ptp(rows[-_HOLD - 1 :], axis=0).max()
    return bool(travel <= RESTING * _HOLD / RATE)


def moving(before: np.ndarray, now: np.ndarray, samples: int) -> np.ndarray:
    """Return landmarks from pose to pose by minimum jerk, shape (samples, 21, 3).

    The first sample is behind the pose before, and the last one is the pose.
    """
    share = np.linspace(0.0, 1.0, samples + 1)[1:]
    ease = share**3 * (10.0 + share * (6.0 * share - 15.0))
    return before + ease[:, None, None] * (now - before)


def stream(poses: Sequence[Pose], order: Sequence[int]) -> Iterator[np.ndarray]:
    """Return landmarks of all samples: to each pose by minimum jerk, and still there."""
    before = poses[order[0]].landmarks
    for k in order:
        now = poses[k].landmarks
        yield from moving(before, now, _MOVE)
        yield from [now] * _HOLD
        before = now


class TourMotion(NamedTuple):
    """A robot that follows poses.

    Attributes:
        robot: The robot.
        q: Its joints at the end of each of the m poses [rad], shape (m, n).
        wrist: Its wrist there, shape (m, 4, 4).
        held: Its joints from the person's last motion to the end of each pose, shape (T, n) each.
        still: Number of samples in which the robot stood still while the person moved.
    """

    robot: Hand
    q: np.ndarray
    wrist: np.ndarray
    held: list[np.ndarray]
    still: int


def scaled_to(poses: Sequence[Pose]) -> Hand:
    """Return the human hand, scaled to poses."""
    every = np.array([pose.landmarks for pose in poses])
    whole = Recording(
        "poses", np.arange(len(every)) / RATE, every, np.ones(len(every), bool), "right"
    )
    return scaled_human(whole, points="landmarks")


def settle(robot: Hand, poses: Sequence[Pose], preset: str) -> np.ndarray:
    """Return the robot's joints at rest in each pose, which it meets from its rest posture.

    Args:
        robot: The robot.
        poses: The m poses.
        preset: The mapping.

    Returns:
        Joints [rad], shape (m, n).
    """
    human = scaled_to(poses)
    found = []
    for pose in poses:
        mapper = HandMapper(human, robot, preset, dt=1.0 / RATE)
        rows = []
        while len(rows) < LONGEST_HOLD * RATE and not _has_rested(rows):
            rows.append(mapper.map_landmarks(pose.landmarks).command.q)
        found.append(rows[-1])
    return np.array(found)


def map_tour(
    robot: Hand,
    poses: Sequence[Pose],
    order: Sequence[int],
    preset: str,
    pace: Pace = PACES["half-second"],
    settled: np.ndarray | None = None,
) -> TourMotion:
    """Map the poses after one another.

    Args:
        robot: The robot.
        poses: The poses.
        order: Which poses follow each other.
        preset: The mapping.
        pace: How fast the person is.
        settled: Result of `settle`, for a pace that slows; computed if omitted.
    """
    mapper = HandMapper(scaled_to(poses), robot, preset, dt=1.0 / RATE)
    if pace.slows and settled is None:
        settled = settle(robot, poses, preset)
    longest = round(LONGEST_HOLD * RATE) if pace.waits else _HOLD
    ends, held, still = [], [], 0
    before = order[0]
    for k in order:
        count = _MOVE
        if pace.slows and settled is not None:
            count = samples_of_move(settled[before], settled[k], robot.velocity_limits)
        way = moving(poses[before].landmarks, poses[k].landmarks, count)
        moved = [mapper.map_landmarks(landmarks).command.q for landmarks in way]
        if k != before:
            # The ease in and out at both ends of a motion is slow.
            fast = np.diff(moved[max(0, count // 6 - 1) : count - count // 6], axis=0)
            still += int((np.abs(fast).max(axis=1) < 1e-9).sum())
        end = mapper.map_landmarks(poses[k].landmarks).command
        rows = [moved[-1], end.q]
        while len(rows) <= longest and not (pace.waits and _has_rested(rows)):
            end = mapper.map_landmarks(poses[k].landmarks).command
            rows.append(end.q)
        ends.append(end)
        held.append(np.array(rows))
        before = k
    q = np.array([end.q for end in ends])
    wrist = np.array([end.wrist for end in ends])
    return TourMotion(mapper.robot, q, wrist, held, still)


def thumb_away(landmarks: np.ndarray) -> np.ndarray:
    """Return the distance of the thumb's tip from the nearest bone of the other fingers [m].

    Args:
        landmarks: Shape (T, 21, 3).
    """
    tip = landmarks[:, 4:5]
    fingers = landmarks[:, 5:].reshape(len(landmarks), 4, 4, 3)
    starts, ends = fingers[:, :, :-1], fingers[:, :, 1:]
    starts, ends = (each.reshape(len(landmarks), -1, 3) for each in (starts, ends))
    bones = ends - starts
    share = np.vecdot(tip - starts, bones) / np.vecdot(bones, bones)
    nearest = starts + np.clip(share, 0.0, 1.0)[:, :, None] * bones
    return np.linalg.norm(tip - nearest, axis=2).min(axis=1)


def extensions(landmarks: np.ndarray) -> np.ndarray:
    """Return the distance from knuckle to tip of four fingers, over their bones, shape (T, 4).

    Args:
        landmarks: Shape (T, 21, 3).
    """
    fingers = landmarks[:, 5:].reshape(len(landmarks), 4, 4, 3)
    bones = np.linalg.norm(np.diff(fingers, axis=2), axis=3).sum(axis=2)
    return np.linalg.norm(fingers[:, :, 3] - fingers[:, :, 0], axis=2) / bones


def thumb_errors(robot: Hand, q: np.ndarray, landmarks: np.ndarray) -> np.ndarray:
    """Return the angle between the parts of both thumbs that people see [deg], shape (T,).

    It is the part from the MCP joint to the tip, in palm axes.

    Args:
        robot: The robot.
        q: Its joints at each pose, shape (T, n).
        landmarks: The person's, shape (T, 21, 3).
    """
    lengths = HumanLengths.from_hand_length(0.19)
    axes = trace_human(landmarks, lengths).palm[:, None, :3, :3].swapaxes(2, 3)
    thumb = find_fingers(robot)[THUMB]
    places = [thumb.between or thumb.knuckle, thumb.tip]
    robots = np.diff(points_in_palm(robot, q, places), axis=1)[:, 0]
    persons = (axes @ (landmarks[:, 4] - landmarks[:, 2])[:, None, :, None])[:, 0, :, 0]
    return angles_between(persons, robots)


class Errors(NamedTuple):
    """Degrees between human and robot, shape (T, k) of k fingers.

    Attributes:
        names: The fingers.
        direction: From knuckle to tip, in palm axes.
        last: From the middle joint to the tip, in palm axes.
        bend: At the middle joint, robot's minus human's.
    """

    names: list[str]
    direction: np.ndarray
    last: np.ndarray
    bend: np.ndarray


def compare(human: HandTrace, robot: HandTrace) -> Errors:
    """Compare the shapes of the fingers that both hands have."""
    names = [name for name in human.names if name in robot.names]
    every = np.arange(len(human.palm))
    a, b = (trace.part(every, names).local for trace in (human, robot))
    meant, shown = shapes_of(a), shapes_of(b)
    last = angles_between(
        a[:, :, TIP] - a[:, :, MIDDLE], b[:, :, TIP] - b[:, :, MIDDLE]
    )
    return Errors(
        names, angles_between(meant.aim, shown.aim), last, shown.bend - meant.bend
    )
