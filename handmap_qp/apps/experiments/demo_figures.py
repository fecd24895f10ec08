"""The demo's pictures: both hands, errors over time, and joints within their limits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.apps.drawing.hands import (
    HUMAN_COLOUR,
    ROBOT_COLOUR,
    draw_hands,
    load_shape,
    spheres,
    tube,
)
from handmap_qp.apps.drawing.raster import Camera, Triangles, merged
from handmap_qp.apps.experiments.style import (
    COLOURS,
    INK,
    PALE,
    new_figure,
    styled,
    words,
)
from handmap_qp.apps.offline.trajectory import Trajectory
from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import HumanMotion

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@styled
def hands_figure(motion: HumanMotion, trajectory: Trajectory) -> Figure:
    """Draw both hands at start, middle and end, with their reference points and the points' paths.

    One camera shows both, each in its own world.

    Args:
        motion: The human motion.
        trajectory: The robot's trajectory.

    Returns:
        The picture, 1600 x 672 pixels.
    """
    figure = new_figure(figsize=(10.0, 4.2))
    size = (800, 672)
    instants = [0, len(motion.time) // 2, len(motion.time) - 1]
    human, robot = motion.human, trajectory.robot
    hands = [
        _placed(human, motion.q, motion.wrist, instants),
        _placed(robot, trajectory.q, trajectory.wrist, instants),
    ]
    corners = merged(hands).vertices.reshape(-1, 3)
    # Include the floor below the hands, which shows their shadows.
    floor = corners * [1.0, 1.0, 0.0]
    camera = Camera.framing(
        np.concatenate([corners, floor]),
        size,
        azimuth=-83.0,
        elevation=27.0,
        margin=0.03,
    )
    # Move the scene down to make room for the titles.
    x, y = camera.centre
    camera = replace(camera, centre=(x, y + 34.0))
    below = min(float(camera.project(floor)[:, 1].max()) + 26.0, size[1] - 16.0)
    driven = f"{len(human.joint_names)} joints, driven along the first synergy"
    mapped = f"{len(robot.joint_names)} joints, mapped by T and the QP"
    panels = (
        ("Human hand", driven, HUMAN_COLOUR, human_points(motion)),
        ("Three-fingered robot hand", mapped, ROBOT_COLOUR, trajectory.points),
    )
    labels = {
        f"{word}, {motion.time[i]:.0f} s": motion.wrist[i, :3, 3] * [1.0, 1.0, 0.0]
        for word, i in zip(("start", "middle", "end"), instants, strict=True)
    }
    for column, (title, subtitle, colour, path) in enumerate(panels):
        axes = figure.add_axes((0.5 * column, 0.0, 0.5, 1.0))
        marks = [spheres(path[instants].reshape(-1, 3), 0.0065, colour)]
        marks += [tube(way, 0.0011, colour) for way in path.swapaxes(0, 1)]
        draw_hands(
            axes,
            hands[column],
            camera,
            marks=merged(marks),
            ground=0.0,
            supersampling=3,
        )
        axes.text(36, 50, title, fontsize=13, fontweight="bold")
        axes.text(36, 79, subtitle, fontsize=9, color=PALE)
        for label, place in labels.items():
            x = camera.project(place)[0]
            axes.text(x, below, label, fontsize=8, color=PALE, ha="center")
    return figure


def human_points(motion: HumanMotion) -> np.ndarray:
    """Reference points of the human in its world [m], shape (T, m, 3)."""
    samples = zip(motion.q, motion.wrist, strict=True)
    return np.array([motion.human.points(*sample) for sample in samples])


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


def _placed(
    hand: Hand, q: np.ndarray, wrist: np.ndarray, instants: list[int]
) -> Triangles:
    """Triangles of a hand at several instants."""
    shape = load_shape(hand)
    return merged([shape.triangles(q[i], wrist[i]) for i in instants])
