"""How well a robot does what the hand meant: one number a question (`METRICS`), for any mapping.

Everything is measured against the tracker's raw landmarks, never against a fit of our own. Samples
in the first half second do not count, nor those in which the hand was not seen. The first sample
that counts is the reference of all metrics that need one.

The eight metrics of mimic_retargeter_lab are computed on the same traces. Their definitions are
those of https://github.com/mimicrobotics/mimic_retargeter_lab (`dexworld/metrics`): the human's
landmarks are laid on the robot's by a similarity (Umeyama 1991) in every sample; key vectors and
displacements are then compared.
"""

from functools import lru_cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from handmap_core.errors import expect
from handmap_core.se3 import (
    Array,
    inverse_pose,
    lengths,
    rigid_fit,
    transform_points,
    unit,
)
from handmap_qp.apps.tables import rows_of
from handmap_qp.hands import THUMB, Hand, PalmKinematics, Values, find_fingers
from handmap_qp.mapping import MotionEstimator
from handmap_qp.reference import estimate, polar
from .hand_trace import (
    KNUCKLE,
    MIDDLE,
    TIP,
    ByFinger,
    HandTrace,
    angles_between,
)
from .metrics import mean_values
from .surface_gaps import GapMeter
from .trajectory import RobotMotion, rms_derivative

SETTLING = 0.5
"""Time at the start that does not count [s]."""
PINCH = 0.015
"""A thumb and a finger of the human pinch below this distance of their tips [m]."""
OPEN = 0.030
"""They do not pinch above this distance [m]."""
CLOSED = 0.003
"""A robot's pinch is closed below this gap of its surfaces [m]."""
TOUCHING = 0.001
"""Surfaces touch below this gap, and penetrate each other beyond this depth [m]."""
NEAR = 0.080
"""Tip distances below this are compared by their order [m]."""
OBJECT_RIDGE = 0.1
"""Ridge of the T that describes the motion of a held object."""
WORKSPACE_RADIUS = 0.005
"""A reachable point was used if the fingertip came this near [m]."""

_LIMIT_TOLERANCE = 1e-6  # A joint is outside its limits beyond this [rad or m].
_STILL = 1e-6  # A coordinate of a fingertip that moves less stands still [m].
_MOST_LAG = 0.3  # Lags are looked for up to here [s].
_LEAST = 1e-8


class Fidelity(NamedTuple):
    """What `assess_fidelity` finds. NaN where the question does not arise.

    Attributes:
        values: Every metric of `METRICS` by its key.
        fingers: By finger that both hands have, its `extension_correlation` (0 if either finger
            stands still), `extension_rms` and `extension_range` (the human's, from the 2nd to the
            98th percentile) [reach], `direction_deg` (knuckle to tip), `wrist_direction_deg`,
            `tip_error_mm` and `tip_error_knuckles_mm`.
        pinch_samples: Samples of thumb-finger pairs in which the human pinches.
    """

    values: Values
    fingers: dict[str, Values]
    pinch_samples: int


def assess_fidelity(
    human: HandTrace,
    robot: HandTrace,
    time: Array,
    valid: Array,
    motion: RobotMotion | None = None,
    human_q: Array | None = None,
    shapes: Hand | None = None,
) -> Fidelity:
    """Measure how well a robot's motion does what a human's meant.

    Args:
        human: The human's motion (`trace_human`).
        robot: The robot's, of the same samples (`trace_robot`).
        time: Instants, increasing [s], shape (T,).
        valid: Samples in which the hand was seen, shape (T,).
        motion: The same with its joints and step times, for surfaces, limits and workspace.
        human_q: The fitted human's joint angles [rad], shape (T, m), for the jerk ratio only.
        shapes: The robot by another description, whose shapes surfaces are measured with.

    Raises:
        InvalidInputError: If the numbers of samples differ, no sample counts, or the hands have no
            finger in common.
    """
    shared = [name for name in human.names if name in robot.names]
    wanted = f"{len(time)} samples as in time"
    sized = {"human": human.palm, "robot": robot.palm, "valid": valid}
    for name, rows in sized.items():
        expect(len(rows) == len(time), name, wanted, value=len(rows))
    expect(shared, "robot", "a finger that the human has too", got="none")
    counts = valid & (time >= time[0] + SETTLING)
    expect(
        counts.any(), "time", "valid samples after the first half second", got="none"
    )
    h = human.part(counts, shared)
    r = robot.part(counts, shared)
    fingers = finger_metrics(h, r)
    values = mean_values([]) | _over_fingers(shared, fingers)
    for compare in object_metrics, palm_metrics, key_vector_metrics:
        values |= compare(h, r)
    values["latency_ms"] = latency(h, r, time[counts])
    pinch_samples = 0
    if motion:
        hand = motion.robot
        pinch_samples, found = gap_metrics(h, GapMeter(hand, shapes), motion.q[counts])
        values |= found | joint_metrics(hand, motion.q, time, counts, human_q)
        values["pinch_order"] = pinch_order(h, r)
        values["workspace"] = workspace_share(r, sample_workspace(hand))
        values["step_time_ms"] = 1e3 * motion.step_cpu[counts].mean()
    by_finger = dict(zip(shared, rows_of(fingers), strict=True))
    return Fidelity(values, by_finger, pinch_samples)


def _over_fingers(names: list[str], fingers: ByFinger) -> Values:
    """Return metrics of the whole hand: correlations weighted by the human's range, and means."""
    correlations = fingers["extension_correlation"]
    weights = fingers["extension_range"]
    means = "wrist_direction_deg", "tip_error_mm", "tip_error_knuckles_mm"
    found: Values = {key: fingers[key].mean() for key in means} | {
        "extension_rms": _rms(fingers["extension_rms"]),
        "finger_direction_deg": fingers["direction_deg"].mean(),
    }
    if weights.any():
        found["extension_correlation"] = np.average(correlations, weights=weights)
    if THUMB in names:
        found["thumb_extension_correlation"] = correlations[names.index(THUMB)]
    return found


def finger_metrics(human: HandTrace, robot: HandTrace) -> ByFinger:
    """Compare extension, direction and tip of each finger; see `Fidelity.fingers`.

    Tips are in palm frames. `tip_error_mm` scales the robot's by the ratio of hand sizes;
    `tip_error_knuckles_mm` takes each hand's tips relative to the centre of its knuckles and scales
    by the mean ratio of reaches. So it does not depend on the origin of the palm frame, which is a
    convention of each robot's description. Both are in mm of the human's hand.
    """
    one, other = both = np.array([human.extension, robot.extension])
    is_still = np.ptp(both, axis=1).min(axis=0) < _STILL
    correlations = _cosines(*(both - both.mean(axis=1, keepdims=True)).mT)
    low, high = np.percentile(one, (2.0, 98.0), axis=0)
    # Points of a finger are its knuckle, middle joint and tip.
    knuckles, _, tips = np.moveaxis(np.array([human.local, robot.local]), 3, 0)
    ratio = (robot.reach / human.reach).mean()
    # The thumb's knuckle does not count if there are others.
    others = [i for i, name in enumerate(human.names) if name != THUMB] or [0]
    h, r = tips - knuckles[:, :, others].mean(axis=2, keepdims=True)
    return {
        "extension_correlation": np.where(is_still, 0.0, correlations),
        "extension_rms": _rms(one - other),
        "extension_range": high - low,
        "direction_deg": angles_between(*(tips - knuckles)).mean(axis=0),
        "wrist_direction_deg": angles_between(*tips).mean(axis=0),
        "tip_error_mm": _distance_mm(tips[1] * (human.size / robot.size), tips[0]),
        "tip_error_knuckles_mm": _distance_mm(r / ratio, h),
    }


def object_metrics(human: HandTrace, robot: HandTrace) -> Values:
    """Compare the motions that both hands impose on an object between their fingers.

    T (eqs. 5-6, ridge 0.1) is estimated from each hand's tips and middle joints, from the first
    sample to every other. Both are expressed in the hand's own palm axes at the first sample. Means
    are of the angle between the rotations [deg], the Frobenius norm of the difference of the
    log-stretches, and the distance between the centroids' displacements [mm].
    """
    r1, s1, c1 = _object_motion(human)
    r2, s2, c2 = _object_motion(robot)
    return {
        "object_rotation_deg": _turns_deg(r1.mT @ r2).mean(),
        "object_stretch": np.linalg.norm(s1 - s2, axis=(1, 2)).mean(),
        "object_translation_mm": _distance_mm(c1, c2),
    }


def palm_metrics(human: HandTrace, robot: HandTrace) -> Values:
    """Compare the palms' motions since the first sample, each in its own axes there, as RMS."""
    one, other = (inverse_pose(hand.palm[0]) @ hand.palm for hand in (human, robot))
    apart = inverse_pose(one) @ other
    return {
        "palm_deg": _rms(_turns_deg(apart[:, :3, :3])),
        "palm_mm": 1e3 * _rms(lengths(apart[:, :3, 3])),
    }


def pinch_gaps(hand: HandTrace) -> ByFinger:
    """Distances from the thumb's tip to the other fingertips [m], shape (T,) each."""
    tips = _tips_by_finger(hand)
    thumb = tips.pop(THUMB, None)
    return {f: lengths(tip - thumb) for f, tip in tips.items() if thumb is not None}


def pinch_order(human: HandTrace, robot: HandTrace) -> float:
    """Whether nearer tips of the human are nearer tips of the robot: Spearman's correlation.

    It is taken over all samples and thumb-finger pairs in which the human's tips are less than
    80 mm apart; NaN with fewer than three.
    """
    pairs = np.array([np.ravel([*pinch_gaps(h).values()]) for h in (human, robot)])
    pairs = pairs[:, pairs[0] < NEAR]
    if pairs.shape[1] < 3 or not np.ptp(pairs, axis=1).all():
        return np.nan
    return float(np.corrcoef([_ranks(each) for each in pairs])[0, 1])


def _ranks(values: Array) -> Array:
    """Return the ranks of values, shape (n,); equal ones share the mean of theirs.

    Spearman's coefficient is the correlation of ranks. `scipy.stats` takes .6 s to import.
    """
    _, places, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - 0.5 * (counts - 1))[places]


def gap_metrics(human: HandTrace, gaps: GapMeter, q: Array) -> tuple[int, Values]:
    """Return how many samples of pairs the human pinches, and metrics of the robot's surfaces."""
    wanted = pinch_gaps(human)
    pinches = gaps.pinches(q)
    shared = [name for name in wanted if name in pinches]
    h, r = np.array([[gap[name] for name in shared] for gap in (wanted, pinches)])
    pinched = r[h < PINCH]
    apart = r[h > OPEN]
    nearest = gaps.nearest(q)
    found: Values = {
        "self_penetration": (nearest < -TOUCHING).mean(),
        "colliding": (nearest < 0.0).mean(),
        "pinch_closed": _mean(pinched < CLOSED),
        "pinch_false": _mean(apart < TOUCHING),
    }
    if len(pinched):
        deep, middle, wide = 1e3 * np.percentile(pinched, (5, 50, 95))
        found |= {"pinch_gap_mm": middle, "pinch_gap_p95_mm": wide}
        # Surfaces that never come near cannot penetrate.
        if found["pinch_closed"]:
            found["pinch_depth_mm"] = max(0.0, -deep)
    return len(pinched), found


def joint_metrics(
    hand: Hand, q: Array, time: Array, counts: Array, human_q: Array | None
) -> Values:
    """Compare joints with their limits, and their jerk with the fitted human's."""
    outside = np.abs(q - np.clip(q, *hand.limits)).max(axis=1)
    speed = np.abs(np.diff(q, axis=0)) / np.diff(time)[:, None] / hand.velocity_limits
    moving = counts[1:] & counts[:-1]
    found: Values = {"outside_limits": (outside > _LIMIT_TOLERANCE)[counts].mean()}
    if moving.any():
        found["speed_ratio"] = speed[moving].max()
    if human_q is not None:
        human_jerk, jerk = (
            rms_derivative(angles, time, counts, order=3) for angles in (human_q, q)
        )
        found["jerk_ratio"] = jerk / human_jerk if human_jerk > 0.0 else np.nan
    return found


def latency(human: HandTrace, robot: HandTrace, time: Array) -> float:
    """Lag of the robot's fingertips behind the human's, both in palm frames.

    The cross-correlation of all coordinates together, over all lags up to 0.3 s, is refined by a
    parabola through its largest value.

    Args:
        human: The human's motion.
        robot: The robot's, with the same fingers.
        time: Instants [s], shape (T,).

    Returns:
        Lag [ms]; negative if the robot is ahead; NaN if either stands still or with fewer than
        eight samples.
    """
    if len(time) < 8:
        return np.nan
    step = np.median(np.diff(time))
    grid = np.arange(time[0], time[-1], step)
    tips = np.array([human.local, robot.local])[:, :, :, TIP]
    after = np.searchsorted(time, grid).clip(1)
    share = ((grid - time[after - 1]) / (time[after] - time[after - 1]))[:, None, None]
    tips = (1.0 - share) * tips[:, after - 1] + share * tips[:, after]
    if np.ptp(tips, axis=1).max(axis=(1, 2)).min() < _STILL:
        return np.nan
    a, b = tips - tips.mean(axis=1, keepdims=True)
    most = min(int(np.ceil(_MOST_LAG / step)), len(grid) // 2)
    # For every lag, a(t) and b(t + lag): ends that have no partner are cut off.
    values = [
        _cosines(
            a[max(0, -lag) : len(a) - max(0, lag)].ravel(),
            b[max(0, lag) : len(b) + min(0, lag)].ravel(),
        )
        for lag in range(-most, most + 1)
    ]
    best = np.argmax(values)
    shift = 0.0
    if 0 < best < 2 * most:
        before, here, after = values[best - 1 : best + 2]
        # The first of the largest values: that before it is smaller.
        shift = 0.5 * (before - after) / (before - 2.0 * here + after)
    return 1e3 * step * (best - most + shift)


def key_vector_metrics(human: HandTrace, robot: HandTrace) -> Values:
    """Compute those of mimic's metrics that need both hands; see the top of this module.

    Key vectors go from the palm's origin to each tip, and from the thumb's tip to each other tip.
    """
    other = _palm_points(robot)
    both = np.array([_laid_on(_palm_points(human), other), other])
    # The palm's origin comes first, then the tips; the first of them is the thumb's, if any.
    tips = both[:, :, 1 : 1 + len(human.names)]
    vectors = [tips - both[:, :, :1]]
    if THUMB in human.names:
        vectors.append(tips[:, :, 1:] - tips[:, :, :1])
    a, b = np.concatenate(vectors, axis=2)
    cosine = _cosines(a, b)
    steps = np.diff(tips, axis=1)
    bends = np.diff(steps[1], axis=0)
    return {
        "key_cosine": cosine.mean(),
        "key_angle_deg": np.degrees(np.arccos(cosine)).mean(),
        "key_scale": (lengths(b) / (lengths(a) + _LEAST)).mean(),
        "motion_preservation": _mean(_cosines(*steps)),
        "flatness_mm2": 1e6 * _mean(np.vecdot(bends, bends)),
    }


def workspace_share(robot: HandTrace, workspace: ByFinger) -> float:
    """Share of the reachable points that the fingertips came near, mean over the fingers."""
    distances = [
        KDTree(tips).query(workspace[name])[0]
        for name, tips in _tips_by_finger(robot).items()
    ]
    return _mean(np.array(distances) <= WORKSPACE_RADIUS)


@lru_cache(maxsize=1)
def sample_workspace(hand: Hand, *, count: int = 20_000) -> ByFinger:
    """Draw points that each fingertip can reach, joints uniform within their limits.

    They are in the palm frame, by finger [m], shape (count, 3) each.
    """
    q = np.random.default_rng(42).uniform(*hand.limits, (count, *hand.zero.shape))
    fingers = find_fingers(hand)
    places = [finger.tip for finger in fingers.values()]
    tips = PalmKinematics(hand).points(q, places)
    return dict(zip(fingers, tips.swapaxes(0, 1), strict=True))


def _tips_by_finger(hand: HandTrace) -> ByFinger:
    """Fingertips in the palm frame [m], shape (T, 3) each."""
    return dict(zip(hand.names, hand.local[:, :, TIP].swapaxes(0, 1), strict=True))


def _object_motion(hand: HandTrace) -> tuple[Array, Array, Array]:
    """Rotations (T, 3, 3), log-stretches (T, 3, 3) and centroid displacements (T, 3)."""
    points = hand.points[:, :, MIDDLE:].reshape(len(hand.points), -1, 3)
    points = points @ hand.palm[0, :3, :3]
    estimator = MotionEstimator(points[0], ridge=OBJECT_RIDGE)
    factors = polar(estimate(estimator, points).motion[:, :3, :3])
    stretches = factors.stretch(np.log(np.maximum(factors.stretches, 1e-6)))
    centroids = points.mean(axis=1)
    return factors.rotation, stretches, centroids - centroids[0]


def _palm_points(hand: HandTrace) -> Array:
    """Palm origin, tips and knuckles in the palm frame [m], shape (T, 1 + 2 k, 3)."""
    local = hand.local[:, :, [TIP, KNUCKLE]].swapaxes(1, 2)
    return np.insert(local.reshape(len(local), -1, 3), 0, 0.0, axis=1)


def _laid_on(points: Array, onto: Array) -> Array:
    """Points of every sample moved by the similarity that lays them best on others (Umeyama)."""
    turned = transform_points(rigid_fit(points, onto), points)
    centre = turned.mean(axis=1, keepdims=True)
    turned -= centre
    fit = (turned * (onto - centre)).sum(axis=(1, 2), keepdims=True)
    size = (turned**2).sum(axis=(1, 2), keepdims=True)
    return fit / np.maximum(size, _LEAST**2) * turned + centre


def _cosines(a: Array, b: Array) -> Array:
    """Cosines between vectors along the last axis; 0 where either is zero."""
    return np.clip(np.vecdot(unit(a), unit(b)), -1.0, 1.0)


def _turns_deg(rotations: Array) -> Array:
    """Angles of rotations of shape (T, 3, 3) [deg], shape (T,)."""
    return np.degrees(Rotation.from_matrix(rotations).magnitude())


def _distance_mm(a: Array, b: Array) -> Array:
    """Mean distance over samples [mm]."""
    return 1e3 * lengths(a - b).mean(axis=0)


def _mean(values: Array) -> float:
    return values.mean() if values.size else np.nan


def _rms(values: Array) -> Array:
    return np.sqrt(np.mean(np.square(values), axis=0))
