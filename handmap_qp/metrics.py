"""Numbers that sum up a mapped motion: what `handmap map` prints and the benchmarks compare."""

from __future__ import annotations

from typing import Any

import numpy as np

from handmap_qp.trackers.landmarks import TIPS, HumanMotion
from handmap_qp.trajectory import Trajectory


def summarise(motion: HumanMotion, trajectory: Trajectory) -> dict[str, Any]:
    """Sum up a mapped motion.

    Args:
        motion: The human's motion.
        trajectory: The robot's.

    Returns:
        Numbers by name; the name bears the unit. Point and fit errors are over valid samples, steps at a limit over all.
    """
    seen = trajectory.valid
    points = 1e3 * trajectory.point_error[seen]
    fit = 1e3 * motion.fit_error[seen]
    step = 1e6 * trajectory.step_cpu[seen]
    jacobian = 1e6 * float(np.median(trajectory.jacobian_cpu))
    return {
        "robot": trajectory.robot.name,
        "samples": len(trajectory.time),
        "held": int((~seen).sum()),
        "step_cpu_us_median": float(np.median(step)),
        "step_cpu_us_p99": float(np.percentile(step, 99)),
        "jacobian_cpu_us_median": jacobian,
        "point_error_mm_mean": float(points.mean()),
        "point_error_mm_p95": float(np.percentile(points, 95)),
        "point_error_mm_max": float(points.max()),
        "wrist_error_mm_mean": 1e3 * float(trajectory.wrist_error[seen].mean()),
        "samples_at_limit": int(trajectory.at_limit.any(axis=1).sum()),
        "limit_violation_max": trajectory.limit_violation,
        "fit_error_mm_mean": float(fit.mean()),
        "fit_error_tips_mm_mean": float(fit[:, TIPS].mean()),
        "fit_error_mm_per_landmark": dict(
            zip([point.name for point in motion.human.reference_points], fit.mean(axis=0).round(3).tolist(), strict=True)
        ),
    }
