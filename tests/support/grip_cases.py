"""A pick, a hand that an object blocks, and a follower that grips: for tests of grips."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from types import MappingProxyType
from typing import Any

import numpy as np
from picks import made_pick

from handmap_core.human.recording import sample_columns
from handmap_core.human.sample import HumanSample
from handmap_core.mapping.step import MapStep
from handmap_core.stream.hand_grip import GripOptions
from handmap_qp import Hand, HandMapper, Recording, load_hand
from handmap_qp.hands import Side
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.se3 import transform_points
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.grip import GripFollower

HUMAN = load_hand("human", points="landmarks")
WIDTH = 0.03


# Workspaces, whose users place them anew.
_configuration = lru_cache(maxsize=8)(Hand.configuration)


@lru_cache
def pick(opens: bool = False) -> Recording:
    """A hand closes at .8 s; then it may open as it has closed."""
    recording = made_pick("right")
    if not opens:
        return recording
    back = np.arange(110)[::-1]
    order = np.append(np.arange(110), back)
    time = np.arange(len(order)) / 60.0
    valid = np.ones(len(order), dtype=bool)
    return Recording("pick", time, recording.landmarks[order], valid, "right")


def samples(opens: bool = False) -> Iterator[HumanSample]:
    recording = pick(opens)
    columns = sample_columns(recording)
    yield from map(columns.sample, range(len(recording.time)))


def gap_of(hand: Hand, q: np.ndarray) -> float:
    """Distance of the pads of thumb and index [m], by the poses of their links."""
    placed = _configuration(hand)
    wrist = np.eye(4) if hand.is_floating else None
    placed.place(hand.configuration_vector(q, wrist))
    pads = [robot_fingers(hand).pads[name] for name in ("thumb", "index")]
    places = [
        transform_points(placed.data.oMi[pad.joint].homogeneous, pad.offset)
        for pad in pads
    ]
    apart = np.linalg.norm(places[1] - places[0])
    return float(apart - pads[0].radius - pads[1].radius)


def grip_follower(hand: Hand, **options: Any) -> GripFollower:
    follower = Follower(HandMapper(HUMAN, hand, "teleoperation"), smoothing=None)
    return GripFollower(follower, GripOptions(**options))


class Blocked:
    """A hand whose pads cannot come nearer than an object is wide: its joints then stay."""

    def __init__(self, hand: Hand, width: float = WIDTH) -> None:
        self.hand = hand
        self.width = width
        self.q = hand.rest.copy()

    def follow(self, q: np.ndarray) -> None:
        if gap_of(self.hand, q) >= self.width:
            self.q = q.copy()


def run(
    grip: GripFollower,
    width: float = WIDTH,
    opens: bool = False,
    centre: np.ndarray | None = None,
    deviation: float = 0.0,
) -> Iterator[tuple[MapStep, np.ndarray]]:
    """Yield each step, and the joints that had been measured."""
    plant = Blocked(grip.follower.mapper.robot, width)
    for sample in samples(opens):
        measured = plant.q
        step = grip.map_sample(sample, measured, centre, deviation)
        plant.follow(step.command.q)
        yield step, measured


class BlockedHands:
    """A robot each of whose hands is `Blocked`; joints of the arms go where they are told."""

    def __init__(self, robot: Hand, widths: dict[str, float]) -> None:
        self.robot = robot
        self.q = robot.rest.copy()
        self.widths = widths

    def follow(self, q: np.ndarray) -> None:
        robot = self.robot
        moved = q.copy()
        for (side, hand), own in zip(
            robot.by_side.items(), robot.finger_joints, strict=True
        ):
            if gap_of(hand, q) < self.widths[side]:
                moved[own] = self.q[own]
        self.q = moved


@lru_cache
def both_hands(opens: bool = False) -> Sequence[Mapping[Side, HumanSample]]:
    """A pick by both hands at once."""
    sides: tuple[Side, ...] = "left", "right"
    landmarks = {side: made_pick(side).landmarks for side in sides}
    order = [*range(110)] + [*range(109, -1, -1)] * opens
    return tuple(
        MappingProxyType(
            {side: HumanSample(k / 60.0, side, landmarks[side][i]) for side in sides}
        )
        for k, i in enumerate(order)
    )
