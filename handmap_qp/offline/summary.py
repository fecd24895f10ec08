"""Summary numbers of a mapped motion, printed by `handmap map`."""

from __future__ import annotations

from typing import Any

import numpy as np

from handmap_qp.offline.trajectory import Trajectory


def summarise(trajectory: Trajectory) -> dict[str, Any]:
    """Summarise a mapped motion.

    Args:
        trajectory: The robot's trajectory.

    Returns:
        Numbers by name, with the unit in the name. Errors and times are taken over the valid
        samples, `samples_at_limit` over all.
    """
    seen = trajectory.valid
    points = 1e3 * trajectory.point_error[seen]
    step = 1e6 * trajectory.step_cpu[seen]
    return {
        "robot": trajectory.robot.name,
        "samples": len(trajectory.time),
        "held": int((~seen).sum()),
        "step_cpu_us_median": float(np.median(step)),
        "step_cpu_us_p99": float(np.percentile(step, 99)),
        "point_error_mm_mean": float(points.mean()),
        "point_error_mm_p95": float(np.percentile(points, 95)),
        "point_error_mm_max": float(points.max()),
        "wrist_error_mm_mean": 1e3 * float(trajectory.wrist_error[seen].mean()),
        "samples_at_limit": int(trajectory.at_limit.any(axis=1).sum()),
        "limit_violation_max": trajectory.limit_violation,
    }


def table_rows(summary: dict[str, Any]) -> dict[str, str]:
    """Format a summary as table rows.

    Args:
        summary: Result of `summarise`.

    Returns:
        Formatted values, with their units, by label.
    """
    number = summary
    return {
        "samples": f"{number['samples']}, {number['held']} without a hand (robot held still)",
        "step, CPU time": (
            f"{number['step_cpu_us_median']:.0f} us median, {number['step_cpu_us_p99']:.0f} us p99"
        ),
        "point error": (
            f"{number['point_error_mm_mean']:.2f} mm mean, "
            f"{number['point_error_mm_p95']:.2f} mm p95, {number['point_error_mm_max']:.2f} mm max"
        ),
        "wrist error": f"{number['wrist_error_mm_mean']:.2f} mm mean",
        "samples at a limit": f"{number['samples_at_limit']}",
        "largest limit violation": f"{number['limit_violation_max']:.1e} rad",
    }
