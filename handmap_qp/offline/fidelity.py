"""How well a robot does what the hand meant: one number a question, for any mapping.

Everything is measured against the tracker's raw landmarks, never against a fit of our own. Samples
in the first half second do not count, nor those in which the hand was not seen. The first sample
that counts is the reference of all metrics that need one.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import rankdata

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import THUMB
from handmap_qp.mapping.decomposition import polar
from handmap_qp.mapping.estimation import MotionEstimator
from handmap_qp.offline.finger_traces import FingerTrace, HandTrace
from handmap_qp.offline.key_vectors import KeyVectors, compare_key_vectors
from handmap_qp.offline.surface_gaps import SurfaceGaps

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

_LIMIT_TOLERANCE = 1e-6  # A joint is outside its limits beyond this [rad or m].
_STILL = 1e-6  # A coordinate of a fingertip that moves less stands still [m].
_MOST_LAG = 0.3  # Lags are looked for up to here [s].


@dataclass(frozen=True, slots=True, eq=False)
class JointMotion:
    """A robot's joints over time.

    Attributes:
        q: Positions [rad or m], shape (T, n).
        lower: Lower position limits, shape (n,).
        upper: Upper position limits, shape (n,).
        speed: Speed limits [rad/s or m/s], shape (n,).
    """

    q: np.ndarray
    lower: np.ndarray
    upper: np.ndarray
    speed: np.ndarray


@dataclass(frozen=True, slots=True)
class FingerFidelity:
    """How one finger follows the human's.

    Attributes:
        extension_correlation: Pearson's correlation of both extensions (tip to knuckle over reach);
            0 if either finger stands still.
        extension_rms: RMS difference of both extensions [reach].
        extension_range: The human's extension from the 2nd to the 98th percentile [reach].
        direction_deg: Mean angle between both vectors from knuckle to tip, each in its own palm
            frame [deg].
        wrist_direction_deg: The same from the palm's origin to the tip [deg].
        tip_error_mm: Mean distance of the robot's tip, scaled by the ratio of hand sizes, from the
            human's, both in palm frames [mm of the human's hand].
        tip_error_knuckles_mm: The same with each hand's tips relative to the centre of its
            knuckles, scaled by the mean ratio of reaches. It does not depend on the origin of the
            palm frame, which is a convention of each robot's description.
    """

    extension_correlation: float
    extension_rms: float
    extension_range: float
    direction_deg: float
    wrist_direction_deg: float
    tip_error_mm: float
    tip_error_knuckles_mm: float


@dataclass(frozen=True, slots=True)
class Fidelity:
    """What `assess_fidelity` finds. NaN where the question does not arise.

    Attributes:
        fingers: One entry for every finger that both hands have.
        extension_correlation: Mean over the fingers, weighted by the human's range.
        extension_rms: RMS over fingers and samples [reach].
        finger_direction_deg: Mean over fingers and samples, from knuckle to tip [deg].
        wrist_direction_deg: The same from the palm's origin to the tip [deg].
        tip_error_mm: Mean over fingers and samples [mm of the human's hand].
        tip_error_knuckles_mm: The same from the centre of the knuckles, scaled by the mean ratio of
            reaches [mm of the human's hand].
        object_rotation_deg: Mean angle between the rotations of both hands' T, which is estimated
            on tips and middle joints in the world with ridge 0.1 [deg].
        object_stretch: Mean Frobenius norm of the difference of both log-stretches.
        object_translation_mm: Mean distance between the displacements of both hands' centroids of
            tips and middle joints [mm].
        palm_deg: RMS angle between both palms' rotations since the reference [deg].
        palm_mm: RMS distance between both palms' displacements since the reference [mm].
        pinch_samples: Samples of thumb-finger pairs in which the human pinches.
        pinch_closed: Share of those in which the robot's surfaces are less than 3 mm apart.
        pinch_gap_mm: Median of the robot's gap then [mm].
        pinch_gap_p95_mm: 95th percentile of it [mm].
        pinch_depth_mm: 95th percentile of the penetration then [mm]; 0 where there is none.
        pinch_false: Share of the samples of pairs more than 30 mm apart in which the robot's
            surfaces are within 1 mm.
        pinch_order: Spearman's correlation of the tip distances of all thumb-finger pairs, where
            the human's is below 80 mm.
        jerk_ratio: RMS joint jerk of the robot over the fitted human's.
        speed_ratio: Largest joint speed over its limit.
        outside_limits: Share of samples with a joint outside its position limits.
        latency_ms: Lag of the robot's fingertips at the best cross-correlation with the human's
            [ms].
        self_penetration: Share of samples with a self-penetration above 1 mm.
        key_vectors: The eight metrics of mimic_retargeter_lab.
    """

    fingers: dict[str, FingerFidelity]
    extension_correlation: float
    extension_rms: float
    finger_direction_deg: float
    wrist_direction_deg: float
    tip_error_mm: float
    tip_error_knuckles_mm: float
    object_rotation_deg: float
    object_stretch: float
    object_translation_mm: float
    palm_deg: float
    palm_mm: float
    pinch_samples: int = 0
    pinch_closed: float = float("nan")
    pinch_gap_mm: float = float("nan")
    pinch_gap_p95_mm: float = float("nan")
    pinch_depth_mm: float = float("nan")
    pinch_false: float = float("nan")
    pinch_order: float = float("nan")
    jerk_ratio: float = float("nan")
    speed_ratio: float = float("nan")
    outside_limits: float = float("nan")
    latency_ms: float = float("nan")
    self_penetration: float = float("nan")
    key_vectors: KeyVectors | None = field(default=None)


def assess_fidelity(
    human: HandTrace,
    robot: HandTrace,
    time: np.ndarray,
    *,
    valid: np.ndarray | None = None,
    gaps: SurfaceGaps | None = None,
    joints: JointMotion | None = None,
    human_q: np.ndarray | None = None,
    workspace: dict[str, np.ndarray] | None = None,
    step_time: np.ndarray | None = None,
) -> Fidelity:
    """Measure how well a robot's motion does what a human's meant.

    Args:
        human: The human's motion (`trace_human`).
        robot: The robot's, of the same samples (`trace_robot`).
        time: Instants, increasing [s], shape (T,).
        valid: Samples in which the hand was seen, shape (T,); all if omitted.
        gaps: The robot's surface gaps (`measure_gaps`), for pinches and self-penetration.
        joints: The robot's joints, for jerk and limits.
        human_q: The fitted human's joint angles [rad], shape (T, m), for the jerk ratio only.
        workspace: Points that each fingertip can reach, in the palm frame [m], shape (N, 3) each
            (`sample_workspace`).
        step_time: Time that the mapping took for every sample [s], shape (T,).

    Returns:
        The metrics.

    Raises:
        InvalidInputError: If the numbers of samples differ, no sample counts, or the hands have no
            finger in common.
    """
    seen = np.ones(len(time), dtype=bool) if valid is None else np.asarray(valid, dtype=bool)
    shared = [name for name in human.fingers if name in robot.fingers]
    counts = _counting(time, seen)
    _check(human, robot, time, seen, shared, counts)
    h, r = human.at(counts), robot.at(counts)
    fingers = {name: _finger_fidelity(h, r, name, shared) for name in shared}
    weights = np.array([f.extension_range for f in fingers.values()])
    correlations = np.array([f.extension_correlation for f in fingers.values()])
    rotation, stretch, translation = object_motion_error(h, r, shared)
    palm_deg, palm_mm = palm_error(h.palm, r.palm)
    results: dict[str, Any] = {}
    if gaps is not None:
        results |= _gap_metrics(h, gaps, counts)
        results["pinch_order"] = pinch_order(h, r)
    if joints is not None:
        results |= _joint_metrics(joints, time, seen, counts, human_q)
    return Fidelity(
        fingers,
        _weighted(correlations, weights),
        float(np.sqrt(np.mean([f.extension_rms**2 for f in fingers.values()]))),
        float(np.mean([f.direction_deg for f in fingers.values()])),
        float(np.mean([f.wrist_direction_deg for f in fingers.values()])),
        float(np.mean([f.tip_error_mm for f in fingers.values()])),
        float(np.mean([f.tip_error_knuckles_mm for f in fingers.values()])),
        rotation,
        stretch,
        translation,
        palm_deg,
        palm_mm,
        latency_ms=latency(h, r, time[counts]),
        key_vectors=compare_key_vectors(
            h,
            r,
            None if gaps is None else gaps.nearest[counts],
            workspace,
            None if step_time is None else np.asarray(step_time)[counts],
        ),
        **results,
    )


def extension_match(human: FingerTrace, robot: FingerTrace) -> tuple[float, float, float]:
    """Compare how far a finger is stretched.

    Args:
        human: The human's finger.
        robot: The robot's, of the same samples.

    Returns:
        Correlation in [-1, 1], RMS difference [reach], the human's range [reach].
    """
    one, other = human.extension, robot.extension
    low, high = np.percentile(one, (2.0, 98.0))
    still = min(np.ptp(one), np.ptp(other)) < 1e-6
    correlation = 0.0 if still else float(np.corrcoef(one, other)[0, 1])
    return correlation, float(np.sqrt(np.mean((one - other) ** 2))), float(high - low)


def angles_between(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Angles between vectors.

    Args:
        a: Shape (T, 3).
        b: Shape (T, 3).

    Returns:
        Angles [deg], shape (T,).
    """
    sine = np.linalg.norm(np.cross(a, b), axis=1)
    return np.degrees(np.arctan2(sine, np.einsum("ti,ti->t", a, b)))


def object_motion_error(
    human: HandTrace, robot: HandTrace, fingers: list[str]
) -> tuple[float, float, float]:
    """Compare the motions that both hands impose on an object between their fingers.

    T (eqs. 5-6, ridge 0.1) is estimated from each hand's tips and middle joints, from the first
    sample to every other. Both are expressed in the hand's own palm axes at the first sample.

    Args:
        human: The human's motion.
        robot: The robot's.
        fingers: Fingers whose points are used.

    Returns:
        Mean angle between the rotations [deg], mean Frobenius norm of the difference of the
        log-stretches, mean distance between the centroids' displacements [mm].
    """
    motions = [_object_motion(hand, fingers) for hand in (human, robot)]
    (r1, s1, c1), (r2, s2, c2) = motions
    angle = Rotation.from_matrix(r1.transpose(0, 2, 1) @ r2).magnitude()
    stretch = np.linalg.norm(s1 - s2, axis=(1, 2))
    distance = np.linalg.norm(c1 - c2, axis=1)
    return (
        float(np.degrees(angle.mean())),
        float(stretch.mean()),
        float(1e3 * distance.mean()),
    )


def palm_error(human: np.ndarray, robot: np.ndarray) -> tuple[float, float]:
    """Compare the palms' motions since the first sample, each in its own axes there.

    Args:
        human: Palm poses, shape (T, 4, 4).
        robot: Palm poses, shape (T, 4, 4).

    Returns:
        RMS angle [deg], RMS distance [mm].
    """
    one, other = np.linalg.inv(human[0]) @ human, np.linalg.inv(robot[0]) @ robot
    turn = one[:, :3, :3].transpose(0, 2, 1) @ other[:, :3, :3]
    angle = Rotation.from_matrix(turn).magnitude()
    distance = np.linalg.norm(one[:, :3, 3] - other[:, :3, 3], axis=1)
    return float(np.degrees(_rms(angle))), float(1e3 * _rms(distance))


def pinch_gaps(hand: HandTrace) -> dict[str, np.ndarray]:
    """Distances from the thumb's tip to the other fingertips [m], shape (T,) each."""
    if THUMB not in hand.fingers:
        return {}
    thumb = hand.fingers[THUMB].tip
    return {
        name: np.linalg.norm(finger.tip - thumb, axis=1)
        for name, finger in hand.fingers.items()
        if name != THUMB
    }


def pinch_order(human: HandTrace, robot: HandTrace) -> float:
    """Whether nearer tips of the human are nearer tips of the robot.

    Args:
        human: The human's motion.
        robot: The robot's.

    Returns:
        Spearman's correlation over all samples and thumb-finger pairs in which the human's tips are
        less than 80 mm apart; NaN with fewer than three.
    """
    one, other = pinch_gaps(human), pinch_gaps(robot)
    shared = [name for name in one if name in other]
    a = np.concatenate([one[name] for name in shared] or [np.empty(0)])
    b = np.concatenate([other[name] for name in shared] or [np.empty(0)])
    near = a < NEAR
    if near.sum() < 3 or np.ptp(a[near]) == 0.0 or np.ptp(b[near]) == 0.0:
        return float("nan")
    return float(np.corrcoef(rankdata(a[near]), rankdata(b[near]))[0, 1])


def latency(human: HandTrace, robot: HandTrace, time: np.ndarray) -> float:
    """Lag of the robot's fingertips behind the human's, both in palm frames.

    The cross-correlation of all coordinates together, over all lags up to 0.3 s, is refined by a
    parabola through its largest value.

    Args:
        human: The human's motion.
        robot: The robot's.
        time: Instants [s], shape (T,).

    Returns:
        Lag [ms]; negative if the robot is ahead; NaN if either stands still or with fewer than
        eight samples.
    """
    shared = [name for name in human.fingers if name in robot.fingers]
    if len(time) < 8:
        return float("nan")
    grid = np.arange(time[0], time[-1], float(np.median(np.diff(time))))
    signals = [
        np.hstack([_resampled(hand.in_palm(hand.fingers[n].tip), time, grid) for n in shared])
        for hand in (human, robot)
    ]
    a, b = (signal - signal.mean(axis=0) for signal in signals)
    step = grid[1] - grid[0]
    most = min(int(np.ceil(_MOST_LAG / step)), len(grid) // 2)
    lags = np.arange(-most, most + 1)
    values = np.array([_lagged_correlation(a, b, int(lag)) for lag in lags])
    if min(np.ptp(a, axis=0).max(), np.ptp(b, axis=0).max()) < _STILL:
        return float("nan")
    best = int(np.argmax(values))
    shift = 0.0
    if 0 < best < len(lags) - 1:
        before, here, after = values[best - 1 : best + 2]
        curvature = before - 2.0 * here + after
        shift = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
    return float(1e3 * step * (lags[best] + shift))


def rms_jerk(q: np.ndarray, time: np.ndarray, usable: np.ndarray) -> float:
    """RMS third derivative by divided differences, for uneven instants.

    Args:
        q: Columns over time, shape (T, n).
        time: Instants [s], shape (T,).
        usable: Samples that count, shape (T,); a difference needs four in a row.

    Returns:
        RMS over columns and instants [unit/s^3]; NaN without four usable samples in a row.
    """
    values, good = q, usable
    for k in (1, 2, 3):
        values = k * np.diff(values, axis=0) / (time[k:] - time[:-k])[:, None]
        good = good[1:] & good[:-1]
    return _rms(values[good]) if good.any() else float("nan")


def knuckle_centre(hand: HandTrace, fingers: list[str]) -> np.ndarray:
    """Centre of the knuckles in the palm frame, without the thumb's if there are others.

    Args:
        hand: The hand.
        fingers: Fingers that count.

    Returns:
        The centre in every sample [m], shape (T, 3).
    """
    others = [name for name in fingers if name != THUMB] or fingers
    return np.mean([hand.in_palm(hand.fingers[name].knuckle) for name in others], axis=0)


def _finger_fidelity(
    human: HandTrace, robot: HandTrace, name: str, shared: list[str]
) -> FingerFidelity:
    one, other = human.fingers[name], robot.fingers[name]
    correlation, rms, spread = extension_match(one, other)
    tip_h, tip_r = human.in_palm(one.tip), robot.in_palm(other.tip)
    from_knuckle = angles_between(
        tip_h - human.in_palm(one.knuckle), tip_r - robot.in_palm(other.knuckle)
    )
    scaled = tip_r * (human.size / robot.size)
    ratio = float(np.mean([robot.fingers[f].reach / human.fingers[f].reach for f in shared]))
    from_centre = (tip_r - knuckle_centre(robot, shared)) / ratio
    wanted = tip_h - knuckle_centre(human, shared)
    return FingerFidelity(
        correlation,
        rms,
        spread,
        float(from_knuckle.mean()),
        float(angles_between(tip_h, tip_r).mean()),
        float(1e3 * np.linalg.norm(scaled - tip_h, axis=1).mean()),
        float(1e3 * np.linalg.norm(from_centre - wanted, axis=1).mean()),
    )


def _object_motion(
    hand: HandTrace, fingers: list[str]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rotations (T, 3, 3), log-stretches (T, 3, 3) and centroid displacements (T, 3)."""
    points = np.stack(
        [getattr(hand.fingers[name], part) for name in fingers for part in ("tip", "middle")],
        axis=1,
    )
    axes = hand.palm[0, :3, :3]
    points = points @ axes
    estimator = MotionEstimator(points[0], ridge=OBJECT_RIDGE)
    rotations, stretches = np.empty((2, len(points), 3, 3))
    for t, sample in enumerate(points):
        factors = polar(estimator.estimate(sample).motion[:3, :3])
        rotations[t] = factors.rotation
        stretches[t] = factors.stretch(np.log(np.maximum(factors.stretches, 1e-6)))
    centroids = points.mean(axis=1)
    return rotations, stretches, centroids - centroids[0]


def _gap_metrics(human: HandTrace, gaps: SurfaceGaps, counts: np.ndarray) -> dict[str, Any]:
    wanted = pinch_gaps(human)
    shared = [name for name in wanted if name in gaps.pinches]
    h = np.concatenate([wanted[name] for name in shared] or [np.empty(0)])
    r = np.concatenate([gaps.pinches[name][counts] for name in shared] or [np.empty(0)])
    pinched, apart = r[h < PINCH], r[h > OPEN]
    results: dict[str, Any] = {"pinch_samples": len(pinched)}
    results["self_penetration"] = float((gaps.nearest[counts] < -TOUCHING).mean())
    if len(pinched):
        results |= {
            "pinch_closed": float((pinched < CLOSED).mean()),
            "pinch_gap_mm": 1e3 * float(np.median(pinched)),
            "pinch_gap_p95_mm": 1e3 * float(np.percentile(pinched, 95)),
            "pinch_depth_mm": 1e3 * max(0.0, -float(np.percentile(pinched, 5))),
        }
    if len(apart):
        results["pinch_false"] = float((apart < TOUCHING).mean())
    return results


def _joint_metrics(
    joints: JointMotion,
    time: np.ndarray,
    seen: np.ndarray,
    counts: np.ndarray,
    human_q: np.ndarray | None,
) -> dict[str, float]:
    q = joints.q
    outside = np.maximum(joints.lower - q, q - joints.upper).max(axis=1) > _LIMIT_TOLERANCE
    speed = np.abs(np.diff(q, axis=0)) / np.diff(time)[:, None] / joints.speed
    moving = counts[1:] & counts[:-1]
    results = {
        "outside_limits": float(outside[counts].mean()),
        "speed_ratio": float(speed[moving].max()) if moving.any() else float("nan"),
    }
    if human_q is not None:
        human_jerk = rms_jerk(human_q, time, counts)
        results["jerk_ratio"] = (
            rms_jerk(q, time, counts) / human_jerk if human_jerk > 0.0 else float("nan")
        )
    return results


def _counting(time: np.ndarray, seen: np.ndarray) -> np.ndarray:
    return seen & (time >= time[0] + SETTLING)


def _check(
    human: HandTrace,
    robot: HandTrace,
    time: np.ndarray,
    seen: np.ndarray,
    shared: list[str],
    counts: np.ndarray,
) -> None:
    sizes = {"human": len(human.palm), "robot": len(robot.palm), "valid": len(seen)}
    for name, size in sizes.items():
        if size != len(time):
            raise InvalidInputError(
                argument=name, expected=f"{len(time)} samples as in time", got=str(size)
            )
    if not shared:
        raise InvalidInputError(
            argument="robot",
            expected="a finger that the human has too",
            got=", ".join(robot.fingers) or "no named fingers",
        )
    if not counts.any():
        raise InvalidInputError(
            argument="time", expected="valid samples after the first half second", got="none"
        )


def _lagged_correlation(a: np.ndarray, b: np.ndarray, lag: int) -> float:
    """Correlation of a(t) with b(t + lag), all columns together."""
    count = len(a) - abs(lag)
    one, other = a[max(0, -lag) :][:count], b[max(0, lag) :][:count]
    norm = float(np.sqrt((one**2).sum() * (other**2).sum()))
    return float((one * other).sum()) / norm if norm > 0.0 else float("nan")


def _resampled(values: np.ndarray, time: np.ndarray, grid: np.ndarray) -> np.ndarray:
    return np.column_stack([np.interp(grid, time, column) for column in values.T])


def _weighted(values: np.ndarray, weights: np.ndarray) -> float:
    return float(values @ weights / weights.sum()) if weights.sum() > 0.0 else float("nan")


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
