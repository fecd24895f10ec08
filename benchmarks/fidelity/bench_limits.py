"""Compare limit handling: the QP, and eq. (8) without limits, clipped, and damped with clipping.

Each method maps the same recordings to the same robots. Limits that are ignored are violated;
limits that are applied after the step change the motion of all fingers. A QP takes them into
account while it solves. The last two columns are over samples in which some fingers have a joint at
a position limit and others have none: point errors of the former and of the latter.

    python benchmarks bench_limits --picture limits.png --json limits.json
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import common
import numpy as np
import scenes
from joint_motion import map_motion
from pseudoinverse import PseudoinverseIk

from handmap_qp import HandMapper, IkOptions, MappingOptions
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.hands import moved_by
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.qp import PointIk

WAYS: dict[str, Callable[[Hand, IkOptions], Any]] = {
    "QP": PointIk,
    "eq. (8), no limits": PseudoinverseIk,
    "eq. (8), clipped": lambda hand, options: PseudoinverseIk(
        hand, options, limits="clip"
    ),
    "damped, clipped": lambda hand, options: PseudoinverseIk(
        hand, options, limits="clip", damping=1.0
    ),
}
_TOLERANCE = 1e-9


def measure(trajectories: Sequence[Trajectory]) -> dict[str, float]:
    """Errors, violations and jerk over the trajectories of one method.

    Args:
        trajectories: One trajectory per recording.

    Returns:
        Numbers by column of the table; the name holds the unit.
    """
    point, wrist, jerk, others, saturated = [], [], [], [], []
    violations, largest, at_limit, fastest, samples = 0, 0.0, 0, 0.0, 0
    for trajectory in trajectories:
        robot, dt = trajectory.robot, np.diff(trajectory.time)
        seen = trajectory.valid
        outside = np.maximum(
            robot.lower_limits - trajectory.q, trajectory.q - robot.upper_limits
        ).max(axis=1)
        violations += int((outside > _TOLERANCE).sum())
        largest = max(largest, float(outside.max()))
        at_limit += int(trajectory.at_limit.any(axis=1).sum())
        samples += len(seen)
        speed = np.diff(trajectory.q, axis=0) / dt[:, None]
        fastest = max(fastest, float((np.abs(speed) / robot.velocity_limits).max()))
        rate = 1.0 / np.median(dt)
        jerk.append(np.diff(trajectory.q, n=3, axis=0).ravel() * rate**3)
        point.append(trajectory.point_error[seen].ravel())
        wrist.append(trajectory.wrist_error[seen])
        held, free = split_by_saturation(trajectory)
        saturated.append(held)
        others.append(free)
    errors = 1e3 * np.concatenate(point)
    return {
        "point_mm": float(errors.mean()),
        "p95_mm": float(np.percentile(errors, 95)),
        "wrist_mm": 1e3 * float(np.concatenate(wrist).mean()),
        "violations_%": 100.0 * violations / samples,
        "violation_rad": max(0.0, largest),
        "speed/limit": fastest,
        "at_limit_%": 100.0 * at_limit / samples,
        "rms_jerk": float(np.sqrt(np.mean(np.concatenate(jerk) ** 2))),
        "saturated_mm": 1e3 * _mean(saturated),
        "others_mm": 1e3 * _mean(others),
    }


def split_by_saturation(trajectory: Trajectory) -> tuple[np.ndarray, np.ndarray]:
    """Split point errors where some fingers have a joint at a limit and others have none.

    Args:
        trajectory: The trajectory.

    Returns:
        Errors of the saturated fingers and of the others [m].
    """
    robot = trajectory.robot
    joints = [frame.parentJoint for frame in robot.point_frames]
    moves = moved_by(robot.model, joints)[:, robot.v_indices] > 0.0
    is_saturated = (trajectory.at_limit @ moves.T) & trajectory.valid[:, None]
    is_mixed = is_saturated.any(axis=1) & ~is_saturated.all(axis=1)
    errors, held = trajectory.point_error[is_mixed], is_saturated[is_mixed]
    return errors[held], errors[~held]


def _mean(parts: list[np.ndarray]) -> float:
    values = np.concatenate(parts)
    return float(values.mean()) if len(values) else float("nan")


def draw(results: dict[str, list[dict[str, Any]]]) -> Any:
    """Draw error, violation and jerk of each method, a row of panels per robot."""
    from matplotlib.figure import Figure

    panels = {
        "point_mm": "point error [mm]",
        "violations_%": "samples outside limits [%]",
        "rms_jerk": "RMS jerk [rad/s$^3$]",
        "others_mm": "free fingers' error [mm]",
    }
    figure = Figure(figsize=(12.0, 2.3 * len(results)), layout="constrained")
    grid = figure.subplots(len(results), len(panels), squeeze=False)
    for row, (robot, rows) in zip(grid, results.items(), strict=True):
        names = [entry["way"] for entry in rows]
        for axes, (key, title) in zip(row, panels.items(), strict=True):
            axes.barh(
                names,
                [entry[key] for entry in rows],
                color=[common.PALETTE[0], *[common.PALETTE[1]] * (len(rows) - 1)],
            )
            for i, entry in enumerate(rows):
                axes.annotate(
                    f" {entry[key]:.3g}", (entry[key], i), va="center", size=7.5
                )
            axes.set_title(title, size=8.5)
            if key == "rms_jerk":
                axes.set_xscale("log")
            axes.margins(x=0.22)
            axes.invert_yaxis()
            axes.grid(axis="y", visible=False)
            if axes is not row[0]:
                axes.set_yticklabels([])
        row[0].set_ylabel(robot)
    return figure


def main(words: Sequence[str] | None = None) -> None:
    """Run the benchmark."""
    parser = common.make_parser(
        "Limit handling: the QP, and eq. (8) without limits, clipped, and damped with clipping."
    )
    arguments = common.parse_arguments(parser, words)
    files = common.find_recordings(arguments.recordings)[
        : 1 if arguments.quick else None
    ]
    with common.progress("reading recordings", len(files)) as advance:
        found = scenes.load_scenes(
            files, samples=40 if arguments.quick else None, done=advance
        )
    results: dict[str, list[dict[str, Any]]] = {}
    with common.progress(
        "mapping", len(scenes.ROBOTS) * len(WAYS) * len(found)
    ) as advance:
        for family in scenes.ROBOTS:
            results[family] = []
            for way, make in WAYS.items():
                trajectories = []
                for scene in found:
                    mapper = HandMapper(
                        scene.motion.human.with_points(None),
                        scenes.robot_for(family, scene.side),
                        MappingOptions(),
                    )
                    ik = make(mapper.robot, IkOptions())
                    mapper.moving_robot.replace_solver(ik)
                    trajectories.append(map_motion(mapper, scene.motion))
                    advance()
                results[family].append({"way": way, **measure(trajectories)})
    for family, rows in results.items():
        common.print_table(
            f"{family}, {len(found)} recordings", rows, to_stderr=arguments.json == "-"
        )
    common.write_json(arguments.json, "bench_limits", results)
    common.save_picture(arguments.picture, lambda: draw(results))


if __name__ == "__main__":
    main()
