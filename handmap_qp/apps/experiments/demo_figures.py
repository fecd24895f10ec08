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
from handmap_qp.apps.experiments.style import COLOURS, INK, PALE, styled, words
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
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 4.2))
    size = (800, 672)
    instants = [0, len(motion.time) // 2, len(motion.time) - 1]
    human, robot = motion.human, trajectory.robot
    samples = zip(motion.q, motion.wrist, strict=True)
    human_path = np.array([human.points(*sample) for sample in samples])
    hands = [
        _placed(human, motion.q, motion.wrist, instants),
        _placed(robot, trajectory.q, trajectory.wrist, instants),
    ]
    corners = np.concatenate([hand.vertices.reshape(-1, 3) for hand in hands])
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
    camera = replace(camera, centre=(camera.centre[0], camera.centre[1] + 34.0))
    below = min(float(camera.project(floor)[:, 1].max()) + 26.0, size[1] - 16.0)
    panels = (
        (
            "Human hand",
            human,
            "driven along the first synergy",
            HUMAN_COLOUR,
            human_path,
        ),
        (
            "Three-fingered robot hand",
            robot,
            "mapped by T and the QP",
            ROBOT_COLOUR,
            trajectory.points,
        ),
    )
    for column, (title, model, how, colour, path) in enumerate(panels):
        axes = figure.add_axes((0.5 * column, 0.0, 0.5, 1.0))
        marks = [spheres(path[instants].reshape(-1, 3), 0.0065, colour)]
        marks += [
            tube(path[:, point], 0.0011, colour) for point in range(path.shape[1])
        ]
        draw_hands(
            axes,
            hands[column],
            camera,
            marks=merged(marks),
            ground=0.0,
            supersampling=3,
        )
        axes.text(36, 50, title, fontsize=13, fontweight="bold")
        axes.text(
            36, 79, f"{len(model.joint_names)} joints, {how}", fontsize=9, color=PALE
        )
        for instant, word in zip(instants, ("start", "middle", "end"), strict=True):
            x = camera.project(motion.wrist[instant, :3, 3] * [1.0, 1.0, 0.0])[0]
            label = f"{word}, {motion.time[instant]:.0f} s"
            axes.text(x, below, label, fontsize=8, color=PALE, ha="center")
    return figure


@styled
def errors_figure(trajectory: Trajectory) -> Figure:
    """Draw the errors of points and wrist, and the CPU time of each step, over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.6), layout="constrained")
    points, wrist, step = figure.subplots(
        3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0)
    )
    time, cpu = trajectory.time, 1e6 * trajectory.step_cpu
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
    from matplotlib.figure import Figure

    robot, time = trajectory.robot, trajectory.time
    rows = -(-len(robot.joint_names) // 4)
    figure = Figure(figsize=(9.5, 2.1 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, 4, sharex=True, squeeze=False)
    limits = np.degrees([robot.lower_limits, robot.upper_limits]).T
    for axes, name, q, (lower, upper) in zip(
        grid.flat, robot.joint_names, np.degrees(trajectory.q).T, limits, strict=False
    ):
        room = 0.08 * (upper - lower)
        axes.axhspan(lower - room, lower, color="#f3d9d4", linewidth=0.0)
        axes.axhspan(upper, upper + room, color="#f3d9d4", linewidth=0.0)
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
