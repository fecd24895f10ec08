"""What a whole recording shows of its time, its wrist and the size of its hand.

`check_recording` refuses what cannot be a hand. Some mistakes leave every single sample a possible
one: time at another rate, wrist poses that were never measured, a hand that slowly grows. This
module measures what a file can show of them. `hints` names what is unusual, which is a reason to
look and never one to refuse: people may move slowly on purpose.

**Time.** People's fingers move at 1 to 3 Hz: half of the power of their speed lies below that
frequency. Instants that run k times as slowly divide it by k. A factor of 10 is outside of what
people do, and a factor of 2 is inside: see `benchmarks/fidelity/bench_lies.py`.

**Wrist.** A tracker that measures a wrist never repeats it exactly while the palm moves.

**Size.** The bones of a person keep their lengths, so the hand must have one size in all parts of
the recording.
"""

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, affine, lengths, nearest_rotation
from handmap_core.trackers.hand_geometry import BONES, log_size
from handmap_core.trackers.wrist_axes import palm_axes
from handmap_qp.human import ChosenRows, Recording, by_parts

# -- limits of what is usual

USUAL_FREQUENCY = (0.4, 6.5)
"""Usual frequencies of fingers [Hz], see `RecordingFacts.frequency`.

Six recordings of people have 1.4 to 2.9 Hz. The upper limit is that of people who tap as fast as
they can. A person who moves from posture to posture every second has 0.7 Hz.
"""
USUAL_RATE = (12.0, 250.0)
"""Usual rates of trackers [samples/s]."""
CENTRAL_FREQUENCY = (1.0, 4.0)
"""Frequencies [Hz] beyond which an unusual rate is named: two weak signs that agree."""
USUAL_GROWTH = 1.16
"""Usual change of the hand's size, as a ratio (`RecordingFacts.growth`).

At most 1.11 in recordings of 4 s and more: video takes the hand for larger or smaller for a second.
"""
COARSE_STEP = 0.05
"""Rounding of instants, in usual steps, from which speeds suffer."""
STILL_TURN = math.radians(3.0)
"""A palm that turns by more proves that a wrist that never turns is not measured [rad]."""
STILL_TRAVEL = 0.005
"""A wrist landmark that travels farther proves the same of a wrist that never moves [m]."""

# -- how it is measured

_LONGEST_WINDOW = 512  # samples of one spectrum
_SHORTEST_WINDOW = 32
_SPECTRUM = 2048  # points of the transform: zeros are appended
_BREAK = 2.5  # usual steps without a sample, after which a new stretch begins
_NOISE = 2.0  # what is taken for noise, over the floor of the spectrum of positions
_LEAST_SIGNAL = 0.2  # of the power of speed; below it, fingers hardly move
_LOOSE = 0.01  # by which a bone may differ from its usual length, and half of that [m]
_LEAST_SIZED = 120  # samples of which a change of size can be told: 4 s of video
_MOST_PARTS = 10  # parts of a recording of which sizes are compared
_LEAST_PART = 48  # samples of such a part
_BLOCK = 8  # samples over which directions and sizes are averaged, so that noise is no change
_LEAST_REPEATS = 16  # samples that must be the same before that says anything
_AT_ONCE = 10_000  # samples whose sizes are measured at once
_MOST = 95.0  # percentile of turns and travels, so that outliers do not count


class RecordingFacts(NamedTuple):
    """What a recording shows.

    Attributes:
        time_source: Where its instants are from; empty for the stamps of its tracker.
        rate: Samples in a second, by the median step [1/s]; NaN of a single sample.
        steps: Short and long steps, the 5th and 95th percentile [s]; NaN of a single sample.
        rounding: What instants were rounded to by single or half precision [s]; 0 if they were not.
        frequency: Frequency below which half of the power of the fingertips' speed in the palm lies
            [Hz]; NaN where they hardly move, or in less than 32 samples without a gap.
        palm_turn: How far the palm turns from its first direction [rad].
        palm_travel: How far the wrist's landmark travels from its first place [m].
        has_wrist: Whether the tracker gave wrist poses.
        wrist_turn: How far they turn [rad]; 0 if there are none.
        wrist_travel: How far they travel [m]; 0 if there are none.
        is_turn_constant: Whether all wrist poses have exactly one orientation.
        is_place_constant: Whether all wrist poses have exactly one position.
        growth: Largest over smallest size of the hand, of up to ten parts of the recording or of
            `trend`; NaN of less than 120 samples.
        trend: Size at the end over that at the start, by a straight line through the logarithms;
            NaN likewise.
    """

    time_source: str
    rate: float
    steps: tuple[float, float]
    rounding: float
    frequency: float
    palm_turn: float
    palm_travel: float
    has_wrist: bool
    wrist_turn: float
    wrist_travel: float
    is_turn_constant: bool
    is_place_constant: bool
    growth: float
    trend: float


def recording_facts(recording: Recording) -> RecordingFacts:
    """Measure what a recording shows of its time, its wrist and the size of its hand.

    Args:
        recording: The recording; samples that are not valid do not count, nor do those in which a
            bone has another length than usual, because the guard holds the robot in them.
    """
    seen = np.flatnonzero(recording.valid)
    is_usual = _has_usual_bones(ChosenRows(recording.landmarks, seen))
    # Where nothing keeps its length, no sample is better than another.
    seen = seen[is_usual | ~is_usual.any()]
    time = recording.time[seen]
    landmarks = ChosenRows(recording.landmarks, seen)
    sign = 1.0 if recording.side == "right" else -1.0
    palms = by_parts(lambda part: palm_axes(part, sign), landmarks)
    has_wrist = recording.wrist is not None
    turns, travels, repeats = _motion_of_poses(recording, seen, palms)
    rate, steps = _rate(recording.time)
    growth, trend = _sizes(landmarks)
    return RecordingFacts(
        time_source=recording.time_source,
        rate=rate,
        steps=steps,
        rounding=_rounding(recording.time),
        frequency=_finger_frequency(time, landmarks, palms),
        palm_turn=turns[0],
        palm_travel=travels[0],
        has_wrist=has_wrist,
        wrist_turn=turns[1] if has_wrist else 0.0,
        wrist_travel=travels[1] if has_wrist else 0.0,
        is_turn_constant=repeats[0],
        is_place_constant=repeats[1],
        growth=growth,
        trend=trend,
    )


def hints(facts: RecordingFacts) -> list[str]:
    """Return a line for each thing that is unusual, with what to check; none if nothing is."""
    found = [
        _unusual_time(facts),
        _rounded_time(facts),
        _unmeasured_wrist(facts),
        _changed_size(facts),
    ]
    return [line for line in found if line]


def _has_usual_bones(landmarks: ChosenRows) -> Array:
    """Tell which samples (T, 21, 3) have bones of about the usual lengths, shape (T,)."""
    starts, ends = np.transpose(BONES)
    # One landmark that overflows must not become a warning.
    with np.errstate(over="ignore", invalid="ignore"):
        bones = by_parts(
            lambda part: lengths(part[:, ends] - part[:, starts]), landmarks
        )
        usual = np.median(bones, axis=0)
        most = 0.5 * usual + _LOOSE
        return by_parts(
            lambda part: (np.abs(part - usual) < most).all(axis=1),
            bones,
        )


# -- time


def _rate(time: Array) -> tuple[float, tuple[float, float]]:
    """Return samples a second, and short and long steps [s]; see `RecordingFacts`."""
    steps = np.diff(time)
    if not len(steps):
        return math.nan, (math.nan, math.nan)
    short, usual, long = np.percentile(steps, [5.0, 50.0, 95.0]).tolist()
    return 1.0 / usual, (short, long)


def _rounding(time: Array) -> float:
    """Return what instants were rounded to [s] by a type of few digits; 0 if they were not."""
    for kind in (np.float16, np.float32):
        with np.errstate(over="ignore"):
            short = time.astype(kind)
        if not (short == time).all():
            continue
        rounding = float(np.spacing(np.abs(short).max()))
        # Whole multiples of a coarser step, such as 0.25 s, are no sign of rounding.
        is_coarser = bool((np.mod(time, 2.0 * rounding) == 0.0).all())
        return 0.0 if is_coarser else rounding
    return 0.0


def _finger_frequency(time: Array, landmarks: ChosenRows, palms: Array) -> float:
    """Measure `RecordingFacts.frequency`.

    All is counted in samples, and divided by the step at last. So a recording whose time runs at
    another rate has exactly as many times the frequency.
    """
    if len(time) < _SHORTEST_WINDOW:
        return math.nan
    steps = np.diff(time)
    usual = np.median(steps)
    is_break = steps > _BREAK * usual
    # In the palm's axes.
    local = by_parts(lambda part: part[:, 4::4] - part[:, :1], landmarks) @ palms
    tips = local.reshape(len(time), -1)
    stretches = np.split(tips, np.flatnonzero(is_break) + 1)
    # Cycles per sample, without a constant speed.
    frequencies = np.arange(1, _SPECTRUM // 2 + 1) / _SPECTRUM
    power = np.zeros(len(frequencies))
    for stretch in stretches:
        if len(stretch) >= _SHORTEST_WINDOW:
            power += _speed_power(np.diff(stretch, axis=0))
    if not power.any():
        return math.nan
    # Noise of positions is the same at all frequencies; that of their differences is not.
    gain = np.square(2.0 * np.sin(np.pi * frequencies))
    positions = power / gain
    floor = np.median(positions[3 * len(positions) // 4 :])
    signal = np.maximum(power - _NOISE * floor * gain, 0.0)
    if signal.sum() < _LEAST_SIGNAL * power.sum():
        return math.nan
    share = np.cumsum(signal) / signal.sum()
    return float(np.interp(0.5, share, frequencies) / steps[~is_break].mean())


def _speed_power(speeds: Array) -> Array:
    """Return the power of speeds (n, m) by frequency, but for 0, summed over half-open windows."""
    size = min(len(speeds), _LONGEST_WINDOW)
    count = 1 + math.ceil((len(speeds) - size) / (size / 2))
    taper = np.hanning(size)[:, None]
    power = np.zeros(_SPECTRUM // 2)
    for start in np.linspace(0, len(speeds) - size, count).astype(int):
        window = speeds[start : start + size] * taper
        spectrum = np.fft.rfft(window, _SPECTRUM, axis=0)[1:]
        power += np.square(np.abs(spectrum)).sum(axis=1)
    return power / np.square(taper).sum()


def _unusual_time(facts: RecordingFacts) -> str:
    """Name fingers that are too slow or too quick for people."""
    slowest, quickest = USUAL_FREQUENCY
    rarest, densest = USUAL_RATE
    slow, quick = CENTRAL_FREQUENCY
    frequency = facts.frequency
    is_slow = frequency < slowest or (facts.rate < rarest and frequency < slow)
    is_quick = frequency > quickest or (facts.rate > densest and frequency > quick)
    if not (is_slow or is_quick):
        return ""
    word = "slowly" if is_slow else "quickly"
    return (
        f"the fingers move at {frequency:.2g} Hz, at {facts.rate:.3g} samples a second, and those "
        f"of people at 1 to 3 Hz: unless the person moved so {word}, the time of the recording is "
        "not in seconds; check its unit, or give the rate by --fps"
    )


def _rounded_time(facts: RecordingFacts) -> str:
    """Name instants that a type of few digits has rounded."""
    if not facts.rounding * facts.rate > COARSE_STEP:
        return ""
    return (
        f"instants are rounded to {1e3 * facts.rounding:.2g} ms, because they were stored "
        "in a type of few digits: store them in double precision, or from the first sample on"
    )


# -- wrist


def _motion_of_poses(
    recording: Recording, seen: Array, palms: Array
) -> tuple[list[float], list[float], tuple[bool, bool]]:
    """Measure the motion of the palm of the landmarks, and of the tracker's wrist if it gives one.

    Args:
        recording: The recording.
        seen: Indices of the samples that count, shape (n,).
        palms: Rotations of the palm in them, shape (n, 3, 3).

    Returns:
        How far they turn [rad] and travel [m], the palm first; and whether all orientations and all
        positions of the wrist are exactly the same.
    """
    poses = [affine(palms, recording.landmarks[seen, 0])]
    if recording.wrist is not None:
        poses.append(recording.wrist[seen])
    moving = np.stack(poses, axis=1)
    may_repeat = len(poses) > 1 and len(seen) >= _LEAST_REPEATS
    repeats = (
        may_repeat and _repeats(moving[:, 1, :3, :3]),
        may_repeat and _repeats(moving[:, 1, :3, 3]),
    )
    return _turns(moving[..., :3, :3]), _travels(moving[..., :3, 3]), repeats


def _turns(rotations: Array) -> list[float]:
    """Return how far each of k rotations turns from its first ones [rad], shape (T, k, 3, 3)."""
    groups = _equal_parts(rotations, max(1, len(rotations) // _BLOCK))
    sums = np.concatenate([parts.sum(axis=1) for parts in groups])
    means = nearest_rotation(sums)
    cosines = (np.einsum("tkij,kij->tk", means, means[0]) - 1.0) / 2.0
    angles = np.arccos(np.clip(cosines, -1.0, 1.0))
    return np.percentile(angles, _MOST, axis=0).tolist()


def _repeats(rows: Array) -> bool:
    """Tell whether all rows are exactly the same."""
    return bool((rows == rows[0]).all())


def _travels(places: Array) -> list[float]:
    """Return how far each of k places is from its first one [m], shape (T, k, 3)."""
    return np.percentile(lengths(places - places[0]), _MOST, axis=0).tolist()


def _unmeasured_wrist(facts: RecordingFacts) -> str:
    """Name wrist poses that no tracker measured: those repeat exactly while the hand moves."""
    # A pose of which one half moves was measured, and its other half would tremble too.
    does_not_turn = facts.is_turn_constant and (
        not facts.is_place_constant or facts.palm_turn > STILL_TURN
    )
    does_not_travel = facts.is_place_constant and (
        not facts.is_turn_constant or facts.palm_travel > STILL_TRAVEL
    )
    if not (does_not_turn or does_not_travel):
        return ""
    palm = (
        f"turns by {math.degrees(facts.palm_turn):.0f} degrees"
        if does_not_turn
        else f"travels {1e3 * facts.palm_travel:.0f} mm"
    )
    return (
        f"the wrist poses never {'turn' if does_not_turn else 'travel'}, and the palm of the "
        f"landmarks {palm}, so no tracker measured them: leave them out of the file, or write the "
        "tracker's own"
    )


# -- size


def _equal_parts(rows: Array, count: int) -> tuple[Array, Array]:
    """Cut the rows of an array into parts whose lengths differ by at most one.

    They are the parts of `np.array_split`, but parts of one length make one array, so that numpy
    measures all of them at once.

    Args:
        rows: Shape (T, ...).
        count: Number of parts, at most T.

    Returns:
        The longer parts, which come first, and the shorter ones; each has shape (parts, length of
        a part, ...), and no part of the longer ones if all are equally long.
    """
    length, longer = divmod(len(rows), count)
    cut = longer * (length + 1)
    return (
        rows[:cut].reshape(longer, length + 1, *rows.shape[1:]),
        rows[cut:].reshape(count - longer, length, *rows.shape[1:]),
    )


def _sizes(landmarks: ChosenRows) -> tuple[float, float]:
    """Return `RecordingFacts.growth` and `RecordingFacts.trend`."""
    count = len(landmarks)
    if count < _LEAST_SIZED:
        return math.nan, math.nan
    parts = _log_sizes(landmarks, min(_MOST_PARTS, count // _LEAST_PART))
    steps = _log_sizes(landmarks, count // _BLOCK)
    # The slope of the least-squares line, from places around their middle.
    places = (np.arange(len(steps)) + 0.5) / len(steps) - 0.5
    trend = float(places @ steps / (places @ places))
    return math.exp(max(np.ptp(parts), abs(trend))), math.exp(trend)


def _log_sizes(landmarks: ChosenRows, count: int) -> Array:
    """Return the logarithm of the hand's size in so many parts of a recording (`_equal_parts`)."""
    length, longer = divmod(len(landmarks), count)
    ends = [i * length + min(i, longer) for i in range(count + 1)]
    at_once = max(1, _AT_ONCE // (length + 1))
    sizes = []
    for first in range(0, count, at_once):
        own = ends[first : first + at_once + 1]
        rows = landmarks[own[0] : own[-1]]
        sizes += [log_size(rows[i - own[0] : j - own[0]]) for i, j in pairwise(own)]
    return np.array(sizes)


def _changed_size(facts: RecordingFacts) -> str:
    """Name a hand that has not one size."""
    if not facts.growth > USUAL_GROWTH:
        return ""
    return (
        f"the size of the hand changes by {100.0 * (facts.growth - 1.0):.0f} % within the "
        "recording, and bones keep their lengths: check the tracker's scale, or record each person "
        "apart"
    )
