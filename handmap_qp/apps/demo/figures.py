"""The demo's plots, errors over time and joints within their limits, and their style."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from handmap_qp.apps.drawing.hands import require_matplotlib
from handmap_qp.apps.offline.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.figure import Figure

INK, PALE = "#222831", "#8a929c"
COLOURS = ("#c8452f", "#2f7d6b", "#3f6fb5", "#c48a1d", "#7a56a6")
STYLE: dict[str, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": PALE,
    "axes.linewidth": 0.8,
    "axes.titlesize": 9.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "grid.color": "#e4e7eb",
    "grid.linewidth": 0.8,
    "axes.axisbelow": True,
    "xtick.color": PALE,
    "ytick.color": PALE,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "lines.linewidth": 1.8,
    "legend.frameon": False,
    "figure.dpi": 160,
    "savefig.dpi": 160,
    "figure.facecolor": "white",
    # A fixed salt: the same numbers must give the same file.
    "svg.hashsalt": "handmap",
}

_Arguments = ParamSpec("_Arguments")


def styled(draw: Callable[_Arguments, Figure]) -> Callable[_Arguments, Figure]:
    """Decorate a drawing function to use `STYLE`, without changing matplotlib's settings."""

    @wraps(draw)
    def drawn(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> Figure:
        with require_matplotlib().rc_context(STYLE):
            return draw(*arguments, **named)

    return drawn


def new_figure(**settings: Any) -> Figure:
    """Return an empty figure; settings as of `matplotlib.figure.Figure`."""
    from matplotlib.figure import Figure

    return Figure(**settings)


def words(name: str) -> str:
    """Replace the underscores of a name by spaces."""
    return name.replace("_", " ")


@styled
def errors_figure(trajectory: Trajectory) -> Figure:
    """Draw the errors of points and wrist, and the CPU time of each step, over time."""
    figure = new_figure(figsize=(7.5, 5.6), layout="constrained")
    points, wrist, step = figure.subplots(
        3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0)
    )
    time = trajectory.time
    cpu = 1e6 * trajectory.step_cpu
    specs = zip(trajectory.robot.reference_points, COLOURS, strict=False)
    for point, (spec, colour) in enumerate(specs):
        error = 1e3 * trajectory.point_error[:, point]
        points.plot(time, error, color=colour, label=words(spec.name))
    points.legend(loc="upper right", bbox_to_anchor=(1.0, 0.98))
    points.set(title="Reference points: distance from their targets", ylabel="mm")
    wrist.plot(time, 1e3 * trajectory.wrist_error, color=INK)
    wrist.set(title="Wrist: distance from its target", ylabel="mm")
    for axes in (points, wrist):
        axes.set_ylim(bottom=0.0)
    step.plot(time, cpu, color=PALE, linewidth=1.0)
    step.set(title="CPU time of a step", ylabel="µs", xlabel="time [s]")
    step.set_ylim(0.0, 2.0 * float(np.nanpercentile(cpu, 95)))
    step.set_xlim(time[0], time[-1])
    return figure


@styled
def joints_figure(trajectory: Trajectory) -> Figure:
    """Draw each joint of the robot over time, with its limits."""
    robot, time = trajectory.robot, trajectory.time
    rows = -(-len(robot.joint_names) // 4)
    figure = new_figure(figsize=(9.5, 2.1 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 4, sharex=True, squeeze=False)
    limits = np.degrees([robot.lower_limits, robot.upper_limits]).T
    for axes, name, q, (lower, upper) in zip(
        grid.flat, robot.joint_names, np.degrees(trajectory.q).T, limits, strict=False
    ):
        room = 0.08 * (upper - lower)
        for start in (lower - room, upper):
            axes.axhspan(start, start + room, color="#f3d9d4", linewidth=0.0)
        axes.plot(time, q, color=COLOURS[2])
        axes.set(
            xlim=(time[0], time[-1]),
            ylim=(lower - room, upper + room),
            title=words(name),
        )
    for axes in grid.flat[len(robot.joint_names) :]:
        axes.set_axis_off()
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    for axes in grid[:, 0]:
        axes.set_ylabel("deg")
    return figure
