"""What mappings command over time, and when the human pinches: `map_pinch`, `find_pinch`."""

import math
import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_core.errors import InvalidInputError, expect
from handmap_core.se3 import Array, rigid_fit, unit
from handmap_qp.apps.arguments import InputArguments, MappingArguments
from handmap_qp.apps.offline.comparison import (
    LOOK_AHEAD,
    ComparedMethod,
    Take,
    base_name,
    is_peer,
    outside_methods,
    own_method,
    own_methods,
    peers_program,
    prepare_take,
    with_limited,
)
from handmap_qp.apps.offline.look_ahead import look_ahead
from handmap_qp.apps.offline.trajectory import RobotMotion, map_hands, stretches
from handmap_qp.apps.tables import progress
from handmap_qp.hands import Hand, Names, Side, joined
from handmap_qp.human import (
    PALM,
    Recording,
    fit_recording,
    measure_hand,
    scaled_human,
    tip_gaps,
)
from handmap_qp.stream import measure_person
from handmap_qp.trackers import read_hands, read_recording

# The human pinches while thumb and index landmarks are nearer than the first, with interruptions
# below the second [m].
_CLOSED, _OPEN = 0.022, 0.035
# Shortest pinch that counts, and how long before it the hand may have been open [s].
_SHORTEST, _BEFORE = 0.5, 1.0
# A hand is open from this gap on [m], and its palm turns less than that while it closes [deg].
_WIDE, _TURN = 0.065, 25.0
# Thumb and index finger of a pick face each other by more than this, as in `pads_facing`.
_FACING = -0.2
# Samples of a closed hand that are looked at.
_LOOKS = 9
# Last joint and landmark of the tip of thumb and index finger, and the other's tip.
_LAST_JOINTS = ((3, 4, 8), (7, 8, 4))
# A joint that bends by so much shows where its tip goes [rad].
_BEND = 1e-4

_GRIP = re.compile(r"(?P<preset>.+)\+grip(?P<place>\+place(?P<millimetres>\d*))?")


class GripName(NamedTuple):
    """What the name of a mapping with a grip says.

    `PRESET+grip` knows the robot's measured joints alone. `PRESET+grip+place` knows the object's
    place too, exactly. `PRESET+grip+place5` knows it with an error, whose standard deviation along
    each axis is 5 mm, or any other number of millimetres.

    Attributes:
        preset: Name of the preset.
        deviation: Standard deviation of the known place along each axis [m]; None if no place is
            known.
    """

    preset: str
    deviation: float | None

    @property
    def sees(self) -> bool:
        """Whether the object's place is known."""
        return self.deviation is not None

    @classmethod
    def parse(cls, name: str) -> "GripName | None":
        """Return what a name says; None if it is not the name of a mapping with a grip."""
        match = _GRIP.fullmatch(name)
        if match is None:
            return None
        if match["place"] is None:
            return cls(match["preset"], None)
        return cls(match["preset"], 1e-3 * float(match["millimetres"] or 0))


class PinchWindow(NamedTuple):
    """When the human pinches thumb and index finger.

    Attributes:
        start: Index of the last sample at which the hand is open, before it closes.
        closed: Index of the sample at which the pinch has closed.
        end: Index of the last sample at which it is closed.
        side: The hand.
        opened: Index of the first sample from which the hand is open until `start`, at most a
            second before that.
    """

    start: int
    closed: int
    end: int
    side: Side = "right"
    opened: int = 0


def chosen_methods(
    names: Names, peers: Path | None, robot: str
) -> list[ComparedMethod]:
    """Return mappings by name, of this package and of an outside program; one preset if none.

    Args:
        names: Their names.
        peers: Folder of the outside program; that of the peers if omitted, where one is named.
        robot: The robot hand, by name or path.

    Raises:
        InvalidInputError: If there is no such mapping.
        OutsideError: If the outside program cannot run.
    """
    outside = {}
    if peers or any(map(is_peer, names)):
        outside = with_limited(outside_methods(peers or peers_program(), robot))
    names = names or own_methods()[:1]
    return [outside.get(name) or own_method(name, tuple(outside)) for name in names]


def map_pinch(
    methods: Sequence[ComparedMethod],
    robot: Hand,
    files: Sequence[Path],
    inputs: InputArguments = InputArguments(),
) -> tuple[list[RobotMotion], PinchWindow]:
    """Return what each mapping commands, and when the human pinches.

    A robot with several hands needs a recording of each. Its first part then is what pinches.

    Raises:
        HandmapError: If a recording cannot be read or mapped, or shows no pick.
    """
    if robot.parts:
        hands = read_hands(files, fps=inputs.fps)
        window = find_pinch(*(hands[side] for side in robot.by_side))
        parts = sorted(robot.parts, key=lambda hand: hand.side != window.side)
        whole = joined(robot.name, *parts)
        used = [hands[side] for side in whole.by_side]
        return [_map_hands(method.name, whole, used) for method in methods], window
    take, window = read_pick(robot, files, inputs)
    return map_take(methods, take, robot), window


def map_take(
    methods: Sequence[ComparedMethod], take: Take, robot: Hand
) -> list[RobotMotion]:
    """Return what each mapping commands for a recording, with a progress bar.

    Raises:
        HandmapError: If a mapping cannot map it.
    """
    mapped = []
    with progress("mapping", len(methods)) as advance:
        for done, method in enumerate(methods):
            advance(done, method.name)
            mapped.append(method.map_take(take, robot))
    return mapped


def read_pick(
    robot: Hand, files: Sequence[Path], inputs: InputArguments = InputArguments()
) -> tuple[Take, PinchWindow]:
    """Read a recording for a hand, prepared, and find when the human pinches.

    Raises:
        HandmapError: If it cannot be read, or shows no pick.
    """
    expect(len(files) == 1, "RECORDING", "one recording of a hand", value=len(files))
    side = inputs.side or robot.side
    recording = read_recording(files[0], side, fps=inputs.fps)
    return prepare_take(recording, robot.side), find_pinch(recording)


def _map_hands(name: str, robot: Hand, recordings: Sequence[Recording]) -> RobotMotion:
    preset = base_name(name)
    options = MappingArguments(preset=preset, smooth=name != preset)
    person = measure_person(*recordings)
    if name.endswith(LOOK_AHEAD):
        recordings = list(map(look_ahead, recordings))
    return map_hands(recordings, robot, person, options)[0]


def find_pinch(*recordings: Recording, takes_fists: bool = False) -> PinchWindow:
    """Find the longest pick by thumb and index finger, in samples of the longest recording.

    Args:
        recordings: The recordings, one for each hand.
        takes_fists: Whether thumb and index finger may close without facing each other.

    Raises:
        InvalidInputError: If there is no pinch of half a second, or none of them is a pick: within
            a second before it, thumb and index finger are over 65 mm apart; from then until they
            close, the palm turns by less than 25 degrees; and closed, they face each other, as
            they do not in a fist. The message is about the longest pinch.
    """
    name = ", ".join(recording.name for recording in recordings)
    closings = sorted(
        (closing for recording in recordings for closing in _closings(recording)),
        key=lambda closing: closing.length,
        reverse=True,
    )
    longest = closings[0].length if closings else 0.0
    wanted = f"a pinch of thumb and index finger of {_SHORTEST:g} s"
    expect(longest >= _SHORTEST, name, wanted, got=f"{longest:.2f} s")
    instants = max(recordings, key=len).time[:-1]
    problems: list[InvalidInputError] = []
    for closing in closings:
        if closing.length < _SHORTEST:
            break
        try:
            return _pick(closing, name, instants, takes_fists)
        except InvalidInputError as error:
            problems.append(error)
    raise problems[0]


class _Closing(NamedTuple):
    """Thumb and index finger that close, and stay so.

    Attributes:
        recording: The recording.
        gap: Distance of thumb and index landmarks in all its samples [m], shape (T,).
        closed: Index of the first closed sample.
        end: Index of the last one.
        length: Time for which they stay closed [s].
    """

    recording: Recording
    gap: Array
    closed: int
    end: int
    length: float


def _closings(recording: Recording) -> Iterator[_Closing]:
    """Yield every closing of thumb and index finger."""
    time = recording.time
    gap = tip_gaps(recording.landmarks)[:, 0]
    # Samples without landmarks interrupt nothing.
    for run in stretches(~(gap > _OPEN)):
        shut = run.start + np.flatnonzero(gap[run] < _CLOSED)
        if len(shut):
            closed, end = shut[[0, -1]].tolist()
            length = float(time[min(run.stop, len(time) - 1)] - time[closed])
            yield _Closing(recording, gap, closed, end, length)


def _pick(
    closing: _Closing, name: str, instants: Array, takes_fists: bool
) -> PinchWindow:
    """Return when a closing happens, by the index of instants [s].

    Raises:
        InvalidInputError: If it is no pick.
    """
    recording, gap, closed, end, _ = closing
    time = recording.time
    recent = np.searchsorted(time, time[closed] - _BEFORE)
    instant = f"in the second before it closes at {time[closed]:.2f} s"
    wanted = f"a hand open by {1e3 * _WIDE:g} mm {instant}"
    widest = np.fmax.reduce(gap[recent : closed + 1])
    expect(widest > _WIDE, name, wanted, got=f"at most {1e3 * widest:.0f} mm")
    open_hand = stretches(gap[:closed] > _WIDE)[-1]
    start = open_hand.stop - 1
    opened = max(open_hand.start, np.searchsorted(time, time[start] - _BEFORE))
    palms = rigid_fit(*recording.landmarks[[start, closed]][:, PALM])
    turn = math.degrees(Rotation.from_matrix(palms[:3, :3]).magnitude())
    wanted = f"a palm that turns by less than {_TURN:g} degrees {instant}"
    expect(turn < _TURN, name, wanted, got=f"{turn:.0f} degrees")
    if not takes_fists:
        facing = pads_facing(recording, slice(closed, end + 1))
        wanted = f"thumb and index finger that face each other at {time[closed]:.2f} s"
        got = "a fist, in which the thumb lies on the back of the finger"
        advice = "nothing can be held there, so it is no pick"
        expect(facing > _FACING, name, wanted, got=got, advice=advice)
    ends = time[[start, closed, end, opened]]
    start, closed, end, opened = np.searchsorted(instants, ends).tolist()
    return PinchWindow(start, closed, end, recording.side, opened)


def pads_facing(recording: Recording, samples: slice) -> float:
    """Return how far thumb and index finger face each other, as a cosine.

    A finger faces half-way between where its last segment points and where its tip goes as its
    last joint bends: there is the skin of its pad. The cosine is that of the angle from there to
    the other's tip, seen from the middle of the last segment, and the smaller one of both fingers.
    In pinches of people it is 0.1 to 0.6, in fists below -0.5: there the thumb lies on the back of
    the index finger.

    Args:
        recording: The recording.
        samples: Which samples; the median over some valid ones counts.

    Raises:
        InvalidInputError: If none of the samples is valid.
    """
    valid = np.arange(len(recording))[samples][recording.valid[samples]]
    expect(len(valid), recording.name, "valid samples of a closed hand", got="none")
    chosen = np.linspace(0, len(valid) - 1, min(_LOOKS, len(valid))).round().astype(int)
    part = recording.part(valid[chosen])
    lengths = measure_hand(recording)
    human = scaled_human(part, lengths=lengths).with_points("landmarks")
    cosines = [
        min(_faces(human, q, *last) for last in _LAST_JOINTS)
        for q in fit_recording(part, lengths=lengths).q
    ]
    return float(np.median(cosines))


def _faces(human: Hand, q: Array, joint: int, tip: int, other: int) -> float:
    """Return the cosine between where a finger faces, and the direction to another tip."""
    bent = q.copy()
    bent[joint] += _BEND
    points = human.points(q, np.eye(4))
    palmar = unit(human.points(bent, np.eye(4))[tip] - points[tip])
    distal = unit(points[tip] - points[tip - 1])
    middle = (points[tip - 1] + points[tip]) / 2.0
    return float(unit(palmar + distal) @ unit(points[other] - middle))
