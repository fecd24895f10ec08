"""Labelled poses of people, each after every other: how a robot shows them, and who is caught.

Poses are those of `handmap score`. Every pose of a right hand follows every other one, half a
second between them (minimum jerk) and half a second each. The palm stays.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from handmap_score.gestures import SOURCES, Source, read_gestures

from handmap_qp import Hand, HandMapper, Recording
from handmap_qp.apps.offline.fidelity import angles_between
from handmap_qp.apps.offline.hand_trace import (
    KNUCKLE,
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


def stream(poses: Sequence[Pose], order: Sequence[int]) -> Iterator[np.ndarray]:
    """Return landmarks of all samples: to each pose by minimum jerk, and still there."""
    share = np.linspace(0.0, 1.0, _MOVE + 1)[1:]
    ease = share**3 * (10.0 + share * (6.0 * share - 15.0))
    before = poses[order[0]].landmarks
    for k in order:
        now = poses[k].landmarks
        for x in ease:
            yield before + x * (now - before)
        for _ in range(_HOLD):
            yield now
        before = now


def map_tour(
    robot: Hand, poses: Sequence[Pose], order: Sequence[int], preset: str
) -> tuple[Hand, np.ndarray, np.ndarray, int]:
    """Map the poses after one another.

    Returns:
        The robot, joints and wrist at each pose's end, and the number of samples in which the robot
        stood still while the person moved.
    """
    every = np.array([pose.landmarks for pose in poses])
    whole = Recording(
        "poses", np.arange(len(every)) / RATE, every, np.ones(len(every), bool), "right"
    )
    human = scaled_human(whole, points="landmarks")
    mapper = HandMapper(human, robot, preset, dt=1.0 / RATE)
    q, wrist, still, last = [], [], 0, None
    for i, landmarks in enumerate(stream(poses, order)):
        step = mapper.map_landmarks(landmarks)
        # The ease in and out at both ends of a way is slow.
        if last is not None and 5 <= i % (_MOVE + _HOLD) < _MOVE - 5:
            is_other = order[i // (_MOVE + _HOLD)] != order[i // (_MOVE + _HOLD) - 1]
            still += is_other and np.abs(step.command.q - last).max() < 1e-9
        last = step.command.q
        if (i + 1) % (_MOVE + _HOLD) == 0:
            q.append(step.command.q)
            wrist.append(step.command.wrist)
    return mapper.robot, np.array(q), np.array(wrist), int(still)


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

    def bends(points: np.ndarray) -> np.ndarray:
        first = points[:, :, MIDDLE] - points[:, :, KNUCKLE]
        return angles_between(first, points[:, :, TIP] - points[:, :, MIDDLE])

    return Errors(
        names,
        angles_between(
            a[:, :, TIP] - a[:, :, KNUCKLE], b[:, :, TIP] - b[:, :, KNUCKLE]
        ),
        angles_between(a[:, :, TIP] - a[:, :, MIDDLE], b[:, :, TIP] - b[:, :, MIDDLE]),
        bends(b) - bends(a),
    )
