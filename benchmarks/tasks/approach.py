"""How the pads of thumb and finger come together, without physics.

    python benchmarks approach
    python benchmarks approach --methods teleoperation benchmarks/peers/live.py:dexpilot
    python benchmarks approach --robots leap_right --held-back

A closing is a motion of a person in which thumb and one finger come together from an open hand: in
recordings, and from still poses to pinches by least jerk. Only fingers move: the palm is laid at
the origin. Each closing is mapped, and the last 30 mm of it are measured in the palm's frame: of
the robot and of the person by the gap between the balls of their pads.

    turn        of the line from the thumb's pad to the finger's [deg]
    beyond      that turn less the person's, as an absolute value [deg]
    middle      travel of the middle between the surfaces [mm], and the person's
    retreat     of that, toward the palm's origin [mm]
    thumb       its share of the closing along the final line; .5 means that both arrive together
    sideways    motion of the finger's pad across that line [mm]
    gap         between the surfaces at the end [mm]

Closings of `TUNED` may be looked at while a mapping is changed; the others are held back.
"""

from __future__ import annotations

import common  # first: it sets the number of threads before numpy is loaded

# isort: split
import argparse
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from handmap_score.gestures import SOURCES, read_gestures
from handmap_score.tasks.mapping import Mapping, make_mapping
from handmap_score.tasks.operator import HumanHand
from handmap_score.tasks.task import Scene

from handmap_core.human.recording import mirrored
from handmap_qp import Hand, load_hand
from handmap_qp.apps.offline.hand_trace import trace_human
from handmap_qp.apps.offline.trajectory import held_samples
from handmap_qp.hands import PadPair
from handmap_qp.hands.fingers import PalmKinematics
from handmap_qp.human import Recording, measure_hand, tip_gaps
from handmap_qp.mapping import robot_fingers
from handmap_qp.se3 import Array, inverse_pose, transform_points, unit
from handmap_qp.trackers.formats import read_recording

RATE = 60.0
"""Samples per second of closings between still poses."""
LAST = 0.03
"""Length of the part of a closing that is measured [m]."""
TUNED = (
    "pinch",
    "leap_pinch_move_right",
    "quest3_webxr_right",
    "handy: rest",
    "handy: flat",
)
"""Sources whose closings may be looked at while a mapping is changed."""
FINGERS = ("index", "middle", "ring", "little")
# A closing ends below this distance of tips, and begins this much above its end [m].
_SHUT, _OPENING = 0.026, 0.05
# It takes this long at most, and is mapped from this long before it to after its end [s].
_LONGEST, _BEFORE, _AFTER = 4.0, 0.5, 0.15
# The measured part ends where the gap is this far above its least [m]: lines of touching points
# have no direction.
_ARRIVED = 0.002
# Pinches of the poses, by the finger, and the time to get there from an open hand [s].
_PINCHES = {"pinch": 0, "asl f": 0, "asl 9": 0, "asl 8": 1, "asl 7": 2, "asl 6": 3}
_TAKES = 0.6
# Quicker closings are slowed down to this time, so that no speed limit of a robot shapes them [s].
_LEAST_TIME = 1.5
# A finger whose line to the thumb turns by more passes by it, and does not close on it [deg].
_STRAIGHT = 30.0
# Open hands that the poses begin with.
_OPEN = ("rest", "flat", "asl 5", "flare")
_TIPS = (8, 12, 16, 20)
# How far the middle of a person's pad is behind the tip, toward the last joint [m].
_BEHIND_TIP = 0.008


@dataclass(frozen=True, slots=True)
class Closing:
    """A person who closes thumb and finger.

    Attributes:
        source: Where it is from.
        finger: Index of the finger in `FINGERS`.
        time: Instants [s], shape (T,).
        landmarks: Landmarks in the palm's frame [m], shape (T, 21, 3).
        person: What the person is measured in.
    """

    source: str
    finger: int
    time: Array
    landmarks: Array
    person: Recording

    @property
    def duration(self) -> float:
        """Time from the widest pads to the closest ones [s]."""
        gaps = np.linalg.norm(self.pads[:, 1] - self.pads[:, 0], axis=1)
        end = int(gaps.argmin())
        return float(self.time[end] - self.time[gaps[: end + 1].argmax()])

    @property
    def is_held_back(self) -> bool:
        """Whether it may not be looked at while a mapping is changed."""
        return self.source not in TUNED

    @property
    def pads(self) -> Array:
        """Pads of the person's thumb and finger [m], shape (T, 2, 3)."""
        joints = np.array([4, _TIPS[self.finger]])
        tips = self.landmarks[:, joints]
        # Tips alone have no line where they touch: their distance is that of the skin's thickness.
        return tips + _BEHIND_TIP * unit(self.landmarks[:, joints - 1] - tips)


class Wearer(NamedTuple):
    """The operator whose hand is mapped: only measured here."""

    recording: Recording
    name: str = "wearer"

    @property
    def has_finished(self) -> bool:
        """Whether the operator will do nothing more: nobody waits for this one."""
        return False

    def calibrate(self, seed: int) -> Recording:
        """Return the recording that the person is measured in."""
        del seed
        return self.recording

    def reset(self, seed: int) -> None:
        """Do nothing: there is no state."""

    def see(self, scene: Scene) -> HumanHand:
        """Return the first hand of the recording."""
        del scene
        return HumanHand(self.recording.landmarks[0], np.eye(4))


class Approach(NamedTuple):
    """The last part of a closing, by its first and last instant.

    Attributes:
        line: Unit vectors from thumb to finger, shape (2, 3).
        middle: Middle between the surfaces [m], shape (2, 3).
        pads: Places of thumb and finger [m], shape (2, 2, 3).
        gap: Between the surfaces [m], shape (2,).
    """

    line: Array
    middle: Array
    pads: Array
    gap: Array

    @property
    def turn(self) -> float:
        """Turn of the line [deg]."""
        return float(
            np.degrees(np.arccos(np.clip(self.line[0] @ self.line[1], -1.0, 1.0)))
        )

    @property
    def travel(self) -> float:
        """Travel of the middle [mm]."""
        return 1e3 * float(np.linalg.norm(self.middle[1] - self.middle[0]))

    @property
    def retreat(self) -> float:
        """Travel of the middle toward the palm's origin, along y [mm]."""
        return 1e3 * float(self.middle[0, 1] - self.middle[1, 1])

    @property
    def thumb_share(self) -> float:
        """The thumb's share of the closing, along the last line."""
        thumb, finger = (self.pads[1] - self.pads[0]) @ self.line[1]
        return float(thumb / (thumb - finger))

    @property
    def sideways(self) -> float:
        """Motion of the finger's pad across the last line [mm]."""
        moved = self.pads[1, 1] - self.pads[0, 1]
        return 1e3 * float(
            np.linalg.norm(moved - (moved @ self.line[1]) * self.line[1])
        )


def last_part(pads: Array, radii: tuple[float, float] = (0.0, 0.0)) -> Approach:
    """Return the last part of a closing.

    Args:
        pads: Places of thumb and finger [m], shape (T, 2, 3).
        radii: How far their surfaces are from there [m].
    """
    vectors = pads[:, 1] - pads[:, 0]
    gaps = np.linalg.norm(vectors, axis=1) - sum(radii)
    last = int(np.argmax(gaps <= gaps.min() + _ARRIVED))
    is_wide = gaps[: last + 1] >= gaps[last] + LAST
    first = (
        int(np.flatnonzero(is_wide)[-1])
        if is_wide.any()
        else int(gaps[: last + 1].argmax())
    )
    both = [first, last]
    lines = unit(vectors[both])
    thumb, finger = radii
    middles = (pads[both].sum(axis=1) + (thumb - finger) * lines) / 2.0
    return Approach(lines, middles, pads[both], gaps[[first, len(gaps) - 1]])


def closings(files: Sequence[Path]) -> list[Closing]:
    """Return the closings of recordings, the package's own among them, and of the poses."""
    recordings = [read_recording(Path("pinch"), "right"), *map(read_recording, files)]
    found = [one for each in recordings for one in _of_recording(each)]
    return [
        one for one in (*found, *_of_poses()) if last_part(one.pads).turn < _STRAIGHT
    ]


def _of_recording(recording: Recording) -> Iterator[Closing]:
    if recording.side == "left":
        recording = mirrored(recording)
    time = recording.time
    seen = recording.landmarks[held_samples(recording.valid)]
    palms = trace_human(seen, measure_hand(recording)).palm
    landmarks = transform_points(inverse_pose(palms), seen)
    gaps = np.where(recording.valid[:, None], tip_gaps(recording.landmarks), np.inf)
    for finger in range(len(FINGERS)):
        own = np.where(gaps.argmin(axis=1) == finger, gaps[:, finger], np.inf)
        for end in _local_ends(own):
            opened = np.flatnonzero(gaps[:end, finger] > own[end] + _OPENING)
            if not len(opened) or time[end] - time[opened[-1]] > _LONGEST:
                continue
            begin = np.searchsorted(time, time[opened[-1]] - _BEFORE)
            until = np.searchsorted(time, time[end] + _AFTER)
            used = np.arange(begin, until)
            used = used[recording.valid[used]]
            yield Closing(
                recording.name, finger, time[used], landmarks[used], recording
            )


def _local_ends(gaps: Array) -> Iterator[int]:
    """Yield the closest sample of each stretch in which tips touch."""
    shut = np.flatnonzero(gaps < _SHUT)
    for stretch in np.split(shut, np.flatnonzero(np.diff(shut) > 10) + 1):
        if len(stretch):
            yield int(stretch[gaps[stretch].argmin()])


def _of_poses() -> Iterator[Closing]:
    for source in SOURCES:
        gestures = read_gestures(source)
        names = list(gestures.names)
        every = np.array(gestures.landmarks)
        person = Recording(
            source.name,
            np.arange(len(every)) / 30.0,
            every,
            np.ones(len(every), bool),
            "right",
        )
        pinches = _PINCHES | {"pinching (left)": 0, "pinching (right)": 0}
        for opened in (*_OPEN, "relaxed (left)", "relaxed (right)"):
            for shut, finger in pinches.items():
                if opened not in names or shut not in names:
                    continue
                first, last = (
                    gestures.poses[names.index(name)] for name in (opened, shut)
                )
                landmarks = gestures.seen(_moved(first, last), np.random.default_rng(0))
                time = np.arange(len(landmarks)) / RATE
                palms = trace_human(landmarks, measure_hand(person)).palm
                landmarks = transform_points(inverse_pose(palms), landmarks)
                name = f"{'handy' if 'andy' in source.name else 'xrblocks'}: {opened}"
                yield Closing(name, finger, time, landmarks, person)


def _moved(first: Array, last: Array) -> Array:
    """Return poses from one to another by least jerk, with a rest before and after."""
    x = np.arange(-_BEFORE, _TAKES + _AFTER, 1.0 / RATE) / _TAKES
    x = np.clip(x, 0.0, 1.0)[:, None]
    return first + x**3 * (10.0 + x * (6.0 * x - 15.0)) * (last - first)


def mapped(closing: Closing, mapping: Mapping, robot: Hand) -> Array:
    """Return the joints of the robot in a closing, shape (T, n)."""
    mapping.reset()
    slow = max(1.0, _LEAST_TIME / closing.duration)
    steps = slow * np.diff(closing.time, prepend=closing.time[0] - 1.0 / RATE)
    rows = []
    for landmarks, dt in zip(closing.landmarks, steps, strict=True):
        joints = mapping.map(HumanHand(landmarks, np.eye(4)), float(dt))
        rows.append([joints[name] for name in robot.joint_names])
    return np.array(rows)


def approaches(
    robot: Hand, method: str, chosen: Sequence[Closing]
) -> list[dict[str, float]]:
    """Return the figures of each closing with a finger that the robot has."""
    fingers = robot_fingers(robot)
    kinematics = PalmKinematics(robot)
    mappings: dict[str, Mapping] = {}
    found = []
    for closing in chosen:
        name = FINGERS[closing.finger]
        if name not in fingers.pads:
            continue
        person = closing.person.name
        if person not in mappings:
            mappings[person] = make_mapping(method, Wearer(closing.person), robot, 0)
        pair = PadPair(fingers.pads["thumb"], fingers.pads[name])
        q = mapped(closing, mappings[person], robot)
        places = kinematics.points(q, [pad.place for pad in pair])
        own = last_part(places, (pair.thumb.radius, pair.finger.radius))
        human = last_part(closing.pads)
        found.append(
            {
                "turn": own.turn,
                "person": human.turn,
                "beyond": abs(own.turn - human.turn),
                "middle": own.travel,
                "persons": human.travel,
                "retreat": own.retreat,
                "thumb": own.thumb_share,
                "sideways": own.sideways,
                "gap": 1e3 * own.gap[1],
            }
        )
    return found


_FORMATS = {"turn": ".1f", "person": ".1f", "beyond": ".1f", "middle": ".1f"}
_FORMATS |= {
    "persons": ".1f",
    "retreat": ".1f",
    "thumb": ".2f",
    "sideways": ".1f",
    "gap": ".1f",
}


def main() -> None:
    """Print the median of each figure, and the 90th percentile of the turn."""
    parser = common.make_parser(str(__doc__).partition("\n")[0], draws=False)
    parser.add_argument("--robots", nargs="+", default=[*common.ROBOTS])
    parser.add_argument(
        "--methods", nargs="+", default=["teleoperation", "finger-vectors"]
    )
    parser.add_argument(
        "--held-back",
        action=argparse.BooleanOptionalAction,
        help="only closings that are held back, or only the others (default: all)",
    )
    given = common.parse_arguments(parser)
    chosen = closings(common.find_recordings(given.recordings))
    if given.held_back is not None:
        chosen = [one for one in chosen if one.is_held_back == given.held_back]
    print(f"{len(chosen)} closings")
    head = "".join(f"{name:>10}" for name in (*_FORMATS, "turn p90", "gap p90"))
    print(f"{'':<34}{head}")
    for robot_name in given.robots:
        robot = load_hand(robot_name)
        for method in given.methods:
            found = approaches(robot, method, chosen)
            columns = {
                name: np.array([one[name] for one in found]) for name in _FORMATS
            }
            cells = [
                f"{np.median(columns[name]):>10{form}}"
                for name, form in _FORMATS.items()
            ]
            cells += [
                f"{np.percentile(columns[name], 90):>10.1f}" for name in ("turn", "gap")
            ]
            label = f"{robot_name} {method.rpartition('/')[2]}"
            print(f"{label:<34}{''.join(cells)}")


if __name__ == "__main__":
    main()
