"""What mappings command over time, and when the human pinches: `map_pinch`, `find_pinch`."""

import math
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.arguments import InputArguments, MappingArguments
from handmap_qp.apps.offline.comparison import (
    LOOK_AHEAD,
    ComparedMethod,
    Take,
    base_name,
    outside_methods,
    own_method,
    own_methods,
    prepare_take,
)
from handmap_qp.apps.offline.look_ahead import look_ahead
from handmap_qp.apps.offline.trajectory import RobotMotion, map_hands, stretches
from handmap_qp.errors import expect
from handmap_qp.hands import Hand, Names, Side, joined
from handmap_qp.human import PALM, Recording, tip_gaps
from handmap_qp.se3 import rigid_fit
from handmap_qp.stream import measure_person
from handmap_qp.trackers import read_hands, read_recording

# The human pinches while thumb and index landmarks are nearer than the first, with interruptions
# below the second [m].
_CLOSED, _OPEN = 0.022, 0.035
# Shortest pinch that counts, and how long before it the hand may have been open [s].
_SHORTEST, _BEFORE = 0.5, 1.0
# A hand is open from this gap on [m], and its palm turns less than that while it closes [deg].
_WIDE, _TURN = 0.065, 25.0


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

    Raises:
        InvalidInputError: If there is no such mapping.
    """
    outside = outside_methods(peers, robot) if peers else {}
    names = names or own_methods()[:1]
    return [outside.get(name) or own_method(name) for name in names]


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
    return [method.map_take(take, robot) for method in methods], window


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


def find_pinch(*recordings: Recording) -> PinchWindow:
    """Find the longest pinch of thumb and index finger, in samples of the longest recording.

    Raises:
        InvalidInputError: If there is no pinch of half a second, or the longest is no pick: within
            a second before it, thumb and index finger are over 65 mm apart, and from then until
            they close, the palm turns by less than 25 degrees.
    """
    pinches = [(0.0, 0, 0, np.zeros(0), recordings[0])]
    for recording in recordings:
        time = recording.time
        gap = tip_gaps(recording.landmarks)[:, 0]
        # Samples without landmarks interrupt nothing.
        for run in stretches(~(gap > _OPEN)):
            shut = run.start + np.flatnonzero(gap[run] < _CLOSED)
            if len(shut):
                closed, end = shut[[0, -1]]
                length = time[min(run.stop, len(time) - 1)] - time[closed]
                pinches.append((length, closed, end, gap, recording))
    length, closed, end, gap, recording = max(pinches, key=itemgetter(0))
    name = ", ".join(recording.name for recording in recordings)
    wanted = f"a pinch of thumb and index finger of {_SHORTEST:g} s"
    expect(length >= _SHORTEST, name, wanted, got=f"{length:.2f} s")
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
    instants = max(recordings, key=len).time[:-1]
    ends = time[[start, closed, end, opened]]
    start, closed, end, opened = np.searchsorted(instants, ends).tolist()
    return PinchWindow(start, closed, end, recording.side, opened)
