"""Measures of 21 landmarks that tell a hand in the right order from anything else.

All of them are ratios or angles, so that they hold for every hand and in every unit of length:

- the distances between neighbouring landmarks, which bones and palm keep (`own_distances`,
  `misfit`),
- the side of the palm's plane on which thumb and bent fingers lie (`palmar_evidence`), which is
  opposite on a left hand, in a mirrored world and where fingers bend backwards.

`noise_of` tells how noisy points are, which the limits of `stream.guard`, the smoothing of
`stream.follower` and `plausibility` ask for. A hand hardly changes its velocity between samples,
and white noise does: the median change over all points is noise, whatever one of them does.
"""

import json
import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_qp.human import finger_chains
from handmap_qp.se3 import Array, lengths, unit

BONES = [(0 if k % 4 == 1 else k - 1, k) for k in range(1, 21)]
"""Landmarks at both ends of each bone, and from the wrist to each finger's first joint."""
NEIGHBOURS = [(5, 9), (9, 13), (13, 17)]
"""Neighbouring MCP joints."""
_PAIRS = np.array(BONES + NEIGHBOURS + [(1, 5), (1, 17), (5, 17)])
# Centre and half width of log(distance / median distance) over the hands that were measured.
_FILE = Path(__file__).with_name("proportions.json")
_PROPORTIONS = json.loads(_FILE.read_bytes())
_CENTRES = np.array(_PROPORTIONS["centres"])
_WIDTHS = np.array(_PROPORTIONS["half_widths"])
_LARGEST_DEVIATION = 5.0  # widths; one pair far off counts no more than this
# A tracker's bones change by up to 18 % from sample to sample (MediaPipe); the distance between
# landmarks of two fingers changes by far more.
_RIGID_SPREAD = 0.2
_LEAST_TREMBLING = 2e-4  # of a squared bone: 3 um of 30 mm
_STUCK = (
    0.01  # of the usual trembling; rounded to 1 mm, and at rest, bones keep 0.1 of it
)
# A finger that the palm carries as it is: over some seconds, rounding to float32 moves it by 1 um,
# and none of ours stays within 1 mm (Leap hands with rigid bones, 128 samples). A joint at its
# limit, most often straight, may rest; quantised sensors repeat in all fingers.
_CARRIED, _STEP = 5e-6, 2e-6  # m
_OTHERS_CHANGE = 0.8  # of the steps between samples, in the middle finger by that share
_INSIDE = np.cos(np.radians([75.0, 2.0]))  # cosines of bends that are no limits
_QUARTILES_APART = 1.349  # standard deviations, of a normal distribution
_NORMAL = 1.538  # median length of vectors of three standard normal numbers
_SHARE = 0.1  # of a sample in the running estimate of noise
# A sample counts as no more than this many times the estimate, so that a fault hardly counts; an
# estimate below the least rises as one of that size [m], so that noise is soon learnt.
_MOST, _LEAST = 3.0, 3e-4

HYPEREXTENSION = (0.75, 0.20)
"""Farthest that people's MCP and PIP joints bend backwards, as the mean sine of four fingers.

49 and 12 degrees. MCPs reach 45 degrees by themselves (e-hand.com, normal range of motion).
"""
# Sizes of the features of `palmar_evidence`, at which they are taken as certain.
_FEATURE_SIZES = np.array([[0.10], [0.05], [0.20], [HYPEREXTENSION[1]], [0.10]])


class PalmarEvidence(NamedTuple):
    """Tells for each sample how surely the hand is a right one; of a left hand, all are negative.

    Attributes:
        total: From the thumb's base, the arch of the knuckles, the thumb's MCP joint and the
            fingers, from -5 to 5, shape (T,).
        fingers: From the bends of the fingers, from -2 to 2, shape (T,). PIP joints count in full
            at the limit of people's hyperextension, MCP joints from 0 there to full at 58 degrees.
    """

    total: Array
    fingers: Array


class Distances(NamedTuple):
    """Distances that bones and palm keep, over some samples.

    Attributes:
        medians: Logarithms of the median distances [log m], shape (..., 26).
        spreads: Interquartile ranges of the logarithms, as standard deviations; same shape.
    """

    medians: Array
    spreads: Array

    @property
    def hand_length(self) -> float:
        """Length from the wrist to the tip of the middle finger along the bones [m]."""
        return float(np.exp(self.medians[8:12]).sum())


def own_distances(landmarks: Array) -> Distances:
    """Measure the distances that bones and palm keep, in our order.

    Args:
        landmarks: Finite landmarks in any unit, shape (T, ..., 21, 3).
    """
    apart = np.diff(landmarks[..., _PAIRS, :], axis=-2)[..., 0, :]
    squares = np.vecdot(apart, apart)
    squares.sort(axis=0)
    count = len(squares)
    rows = squares[[count // 4, count // 2, count - 1 - count // 4]]
    low, middle, high = 0.5 * np.log(np.maximum(rows, 1e-24))
    return Distances(middle, (high - low) / _QUARTILES_APART)


def log_sizes(distances: Distances) -> Array:
    """Return the logarithms of hands' sizes, the upper medians over all pairs, shape (...)."""
    return np.sort(distances.medians - _CENTRES, axis=-1)[..., len(_CENTRES) // 2]


def misfit(distances: Distances) -> Array:
    """Tell how badly landmarks fit a hand in our order, shape (...).

    Returns:
        Root mean square deviation from the proportions of hands [half widths of their range], and
        from rigidity. Below 1.3 for hands, above 1.5 for orders that are wrong in more than the
        exchange of two similar fingers. Noise makes bones look soft; without spreads, proportions
        alone count.
    """
    middles = log_sizes(distances)[..., None]
    deviations = (distances.medians - _CENTRES - middles) / _WIDTHS
    squares = deviations**2 + (distances.spreads / _RIGID_SPREAD) ** 2
    return np.sqrt(np.minimum(squares, _LARGEST_DEVIATION**2).mean(axis=-1))


def stuck_fingers(landmarks: Array) -> Array:
    """Tell which fingers repeat to rounding while the landmarks of most others tremble.

    A finger that is held still trembles too. Of a tracker with rigid bones nothing can be told.

    Args:
        landmarks: Some samples [m], shape (T, 21, 3).

    Returns:
        True or False for each finger, shape (5,).
    """
    chains = finger_chains(landmarks)
    bones = lengths(np.diff(chains[:, :, 1:], axis=2)) ** 2
    trembling = (np.ptp(bones, axis=0) / bones.mean(axis=0)).max(axis=1)
    usual = median(trembling)
    # Rounded landmarks of a hand at rest repeat in the tracker's world too.
    is_carried = np.ptp(chains[:, :, 3], axis=0).any(axis=1)
    return (trembling < _STUCK * usual) & is_carried & (usual > _LEAST_TREMBLING)


def carried_fingers(landmarks: Array) -> Array:
    """Tell which bent fingers the palm carries as they are while the other fingers move.

    This finds them where bones are rigid, and takes some seconds.

    Args:
        landmarks: Samples of some seconds [m], shape (T, 21, 3).

    Returns:
        True or False for each finger, shape (5,).
    """
    chains = finger_chains(landmarks)
    away = lengths(chains[:, :, 1:, None] - landmarks[:, None, None, [0, 5, 17]])
    ranges = np.ptp(away, axis=0).max(axis=(1, 2))
    steps = np.abs(np.diff(away, axis=0))
    changing = (steps > _STEP).any(axis=(2, 3)).mean(axis=0)
    bones = unit(np.diff(chains[-1], axis=1))
    bends = np.vecdot(bones[:, 1:], bones[:, :-1])
    is_inside = (bends == np.clip(bends, *_INSIDE)).any(axis=1)
    return (ranges < _CARRIED) & is_inside & (median(changing) > _OTHERS_CHANGE)


def palmar_evidence(landmarks: Array) -> PalmarEvidence:
    """Tell a right hand from a left one.

    On every hand, the thumb's base and the bent fingers lie on the palmar side of the plane through
    wrist, index and little MCP joints, and the middle and ring MCP joints on its dorsal side.

    Args:
        landmarks: Finite landmarks in our order and any unit, shape (T, 21, 3).

    Returns:
        The evidence for a right hand, sample by sample; about 0 for a flat hand of a tracker
        without an arched palm.
    """
    offsets = landmarks - landmarks[:, :1]
    along = offsets[:, 9]
    palmar = unit(np.cross(offsets[:, 5], offsets[:, 17]))[:, None]
    sizes = np.maximum(lengths(along), 1e-12)
    heights = np.vecdot(offsets, palmar) / sizes[:, None]
    joints = finger_chains(landmarks)[:, 1:, :3]
    bones = unit(np.diff(joints, axis=2))
    turns = np.cross(bones[:, :, 0], bones[:, :, 1])
    bends = np.vecdot(turns, np.cross(unit(along)[:, None], palmar))
    # Up to people's hyperextension, an MCP joint may be bent to either side.
    bent = np.vecdot(bones[:, :, 0], palmar).mean(axis=1)
    limit = HYPEREXTENSION[0]
    features = np.array(
        [
            heights[:, 1],
            -0.5 * (heights[:, 9] + heights[:, 13]),
            heights[:, 2],
            bends.mean(axis=1),
            bent - np.clip(bent, -limit, limit),
        ]
    )
    evidence = np.clip(features / _FEATURE_SIZES, -1.0, 1.0)
    return PalmarEvidence(evidence.sum(axis=0), evidence[3:].sum(axis=0))


def change_rate(dt: float, former: float) -> float:
    """Return the change of velocity over the noise that makes it, from the last steps [1/s]."""
    return math.hypot(1.0 / dt, 1.0 / former, 1.0 / dt + 1.0 / former)


def noise_of(changes: Array, rate: float) -> float:
    """Return the noise of points [m], of sizes (n,) of the changes of their velocities [m/s]."""
    return median(changes) / (_NORMAL * rate)


def learnt_noise(noise: float, seen: float) -> float:
    """Return the running estimate of noise after a sample, from that before [m]."""
    return noise + _SHARE * (min(seen, _MOST * max(noise, _LEAST)) - noise)


def median(values: Array) -> float:
    """Return the (upper) median, without the overhead of `np.median` on small arrays."""
    return float(np.sort(values)[len(values) // 2])
