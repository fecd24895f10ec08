"""Samples of a recording that show named poses: `find_poses`.

A pose is told by the raw landmarks alone, so that no fit and no mapping has a say in what the hand
showed.
"""

from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, Arrays, as_floats, lengths
from handmap_qp.hands import FINGERS
from handmap_qp.human import Recording, tip_gaps
from .hand_trace import angles_between

STRAIGHT = 60.0
"""A finger whose bones turn by less than this from wrist to tip is straight [deg]."""
CURLED = 150.0
"""A finger whose bones turn by more than this from wrist to tip is curled [deg]."""
PINCH_GAP = 0.025
"""Thumb and finger touch if their tips are nearer than this [m].

Where tips touch, gloves measure 1 to 5 mm between them, cameras up to 20.
"""
PINCH_LEAD = 0.010
"""In a pinch, every other fingertip is farther from the thumb's by at least this [m]."""
SPREAD = 35.0
"""Spread fingers: index and little finger diverge by more than this [deg]."""
SETTLING = 0.5
"""Samples this soon after the first valid one are not used, for mappings may still start up [s]."""
HOLD = 0.2
"""A pose counts as clear as it was at its least clear moment of this time before the sample [s]."""
Ranked = dict[str, tuple[int, float] | None]
"""Index of a sample and how clear its pose is, by the names of the poses; None for no sample."""


class Posture(NamedTuple):
    """What poses are told by, of every sample.

    Attributes:
        flexion: Sum of the angles between successive bones, from the metacarpal to the fingertip,
            of index, middle, ring and little finger [deg], shape (T, 4). 0 is straight, about 260
            a fist. Abduction at the knuckle counts too, some 10 to 20 deg.
        gaps: Distance between the tips of the thumb and of those fingers [m], shape (T, 4).
        spread: Angle between the proximal bones of index and little finger, both seen along the
            palm's normal; positive where they diverge [deg], shape (T,).
    """

    flexion: Array
    gaps: Array
    spread: Array


def measure_posture(landmarks: Array) -> Posture:
    """Flexion, gaps and spread of a right or left hand; NaN where landmarks are NaN or coincide.

    Landmarks are in metres, shape (T, 21, 3).

    Raises:
        InvalidInputError: On a wrong shape.
    """
    points = as_floats(landmarks, "landmarks", shape=("T", 21, 3))
    # Chains of wrist, MCP, PIP, DIP and tip.
    chains = [[0, *range(first, first + 4)] for first in (5, 9, 13, 17)]
    bones = np.diff(points[:, chains], axis=2)
    bones[np.isin(lengths(bones), (0.0, np.inf))] = np.nan
    flexion = angles_between(bones[:, :, 1:], bones[:, :, :-1]).sum(axis=2)
    # On both hands, the normal is such that the little finger's side is the positive one.
    normal = np.cross(bones[:, 0, 0], bones[:, 3, 0])
    index, little = np.cross(normal, bones[:, [0, 3], 1].swapaxes(0, 1))
    side = np.vecdot(np.cross(index, little), normal)
    spread = np.copysign(angles_between(index, little), side)
    return Posture(flexion, tip_gaps(points), spread)


POSES = (
    "open",
    "spread",
    "pointing",
    "fist",
    *(f"{finger} pinch" for finger in FINGERS[1:]),
)
"""Names of the poses, in the order of every result."""


def _scores(posture: Posture) -> Arrays:
    """Return how clearly every sample shows each of `POSES`, shape (T,); 0 where it does not."""
    flexion, gaps, spread = posture
    most = flexion.max(axis=1)
    least = flexion.min(axis=1)
    others = flexion[:, 1:].min(axis=1)
    is_open = most < STRAIGHT
    is_fist = least > CURLED
    is_pointing = (flexion[:, 0] < STRAIGHT) & (others > CURLED)
    found = {
        "open": (is_open, STRAIGHT - most),
        "spread": (is_open & (spread > SPREAD), spread),
        "pointing": (is_pointing, others - flexion[:, 0]),
        "fist": (is_fist, least),
    }
    for finger, gap in enumerate(gaps.T):
        apart = np.delete(gaps, finger, axis=1).min(axis=1) > gap + PINCH_LEAD
        is_pinch = (gap < PINCH_GAP) & apart & ~is_fist
        found[f"{FINGERS[1 + finger]} pinch"] = (is_pinch, PINCH_GAP - gap)
    return {name: np.where(*shown, 0.0) for name, shown in found.items()}


def find_poses(recording: Recording) -> dict[str, int | None]:
    """Find the sample that shows each pose most clearly.

    | pose | rule (angles are sums over a finger's joints) | the clearest has |
    | --- | --- | --- |
    | `open` | all four fingers bend less than 60 deg | the least bent worst finger |
    | `spread` | `open`, and index and little finger diverge by more than 35 deg | the most spread |
    | `pointing` | index less than 60 deg, the other three more than 150 | the largest difference |
    | `fist` | all four fingers bend more than 150 deg | the most bent least finger |
    | `index pinch` and so on | tips of thumb and that finger nearer than 25 mm, every other \
finger's 10 mm farther from the thumb, no `fist` | the smallest gap |

    A sample is as clear as the least clear sample of the 0.2 s before it. If some of those samples
    do not show the pose, it counts half. So a pose that is held wins over one in passing, which
    mappings with a low-pass filter cannot follow. The first 0.5 s are not used.

    Args:
        recording: Landmarks of a hand.

    Returns:
        For every name of `POSES`, the index of a sample, or None where no sample shows the pose.
    """
    return {name: found and found[0] for name, found in rank_poses(recording).items()}


def rank_poses(recording: Recording) -> Ranked:
    """Find the sample that shows each pose most clearly, and how clearly.

    Args:
        recording: Landmarks of a hand.

    Returns:
        For every name of `POSES`, the index of a sample as in `find_poses` and a number > 0 that
        is larger the clearer the pose is, to compare recordings by. None where no sample shows it.
    """
    posture = measure_posture(recording.landmarks)
    start = recording.time[np.argmax(recording.valid)] + SETTLING
    is_usable = recording.valid & (recording.time >= start)
    found: Ranked = {}
    for name, scores in _scores(posture).items():
        held = _held(np.where(is_usable, scores, 0.0), recording.time)
        best = int(np.argmax(held))
        found[name] = (best, held[best]) if held[best] > 0.0 else None
    return found


def _held(scores: Array, time: Array) -> Array:
    """Lower scores > 0 to the least one of the `HOLD` before them; a pose not held counts half."""
    held = scores.copy()
    first = np.searchsorted(time, time - HOLD)
    for i in np.flatnonzero(scores):
        before = scores[first[i] : i + 1]
        shown = before[before > 0.0]
        is_held = before.all() and time[i] - time[0] >= HOLD
        held[i] = shown.min() * (1.0 if is_held else 0.5)
    return held
