"""The demo's pictures: both hands, errors over time, and joints within their limits."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.drawing.hands import (
    HUMAN_COLOUR,
    ROBOT_COLOUR,
    draw_hands,
    load_shape,
    spheres,
    tube,
)
from handmap_qp.drawing.raster import Camera, Triangles, merged
from handmap_qp.experiments.style import COLOURS, INK, PALE, styled, words
from handmap_qp.hands.hand import Hand
from handmap_qp.human.recording import HumanMotion
from handmap_qp.offline.trajectory import Trajectory

if TYPE_CHECKING:
    from matplotlib.axes import Axes
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
    human_way = np.array(
        [human.points(q, wrist) for q, wrist in zip(motion.q, motion.wrist, strict=True)]
    )
    hands = [
        _placed(human, motion.q, motion.wrist, instants),
        _placed(robot, trajectory.q, trajectory.wrist, instants),
    ]
    corners = np.concatenate([hand.vertices.reshape(-1, 3) for hand in hands])
    # Include the floor below the hands, which shows their shadows.
    floor = corners * [1.0, 1.0, 0.0]
    camera = Camera.framing(
        np.concatenate([corners, floor]), size, azimuth=-83.0, elevation=27.0, margin=0.03
    )
    # Move the scene down to make room for the titles.
    camera = replace(camera, centre=(camera.centre[0], camera.centre[1] + 34.0))
    titles = (
        (
            "Human hand",
            f"{len(human.joint_names)} joints, driven along the first synergy",
            HUMAN_COLOUR,
            human_way,
        ),
        (
            "Three-fingered robot hand",
            f"{len(robot.joint_names)} joints, mapped by T and the QP",
            ROBOT_COLOUR,
            trajectory.points,
        ),
    )
    below = min(float(camera.project(floor)[:, 1].max()) + 26.0, size[1] - 16.0)
    for column, (hand, (title, subtitle, colour, way)) in enumerate(
        zip(hands, titles, strict=True)
    ):
        axes = figure.add_axes((0.5 * column, 0.0, 0.5, 1.0))
        balls = spheres(way[instants].reshape(-1, 3), 0.0065, colour)
        paths = [tube(way[:, point], 0.0011, colour) for point in range(way.shape[1])]
        draw_hands(axes, hand, camera, marks=merged([balls, *paths]), ground=0.0, supersampling=3)
        axes.text(36, 50, title, fontsize=13, fontweight="bold")
        axes.text(36, 79, subtitle, fontsize=9, color=PALE)
        for instant, word in zip(instants, ("start", "middle", "end"), strict=True):
            x = camera.project(motion.wrist[instant, :3, 3] * [1.0, 1.0, 0.0])[0]
            axes.text(
                x,
                below,
                f"{word}, {motion.time[instant]:.0f} s",
                fontsize=8,
                color=PALE,
                ha="center",
            )
    return figure


@styled
def errors_figure(trajectory: Trajectory) -> Figure:
    """Draw the errors of points and wrist, and the CPU time of each step, over time."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.5, 5.6), layout="constrained")
    axes = figure.subplots(3, 1, sharex=True, height_ratios=(2.0, 1.0, 1.0))
    time = trajectory.time
    for point, (spec, colour) in enumerate(
        zip(trajectory.robot.reference_points, COLOURS, strict=False)
    ):
        axes[0].plot(
            time, 1e3 * trajectory.point_error[:, point], color=colour, label=words(spec.name)
        )
    axes[0].set_title("Reference points: distance from their targets")
    axes[0].set_ylabel("mm")
    axes[0].legend(loc="upper right", bbox_to_anchor=(1.0, 0.98))
    axes[1].plot(time, 1e3 * trajectory.wrist_error, color=INK)
    axes[1].set_title("Wrist: distance from its target")
    axes[1].set_ylabel("mm")
    axes[2].plot(time, 1e6 * trajectory.step_cpu, color=PALE, linewidth=1.0)
    axes[2].set_title("CPU time of a step")
    axes[2].set_ylabel("µs")
    axes[2].set_ylim(0.0, 2.0 * float(np.nanpercentile(1e6 * trajectory.step_cpu, 95)))
    axes[2].set_xlabel("time [s]")
    for one in axes[:2]:
        one.set_ylim(bottom=0.0)
    axes[2].set_xlim(time[0], time[-1])
    return figure


@styled
def joints_figure(trajectory: Trajectory) -> Figure:
    """Draw each joint of the robot over time, with its limits."""
    from matplotlib.figure import Figure

    robot = trajectory.robot
    columns = 4
    rows = -(-len(robot.joint_names) // columns)
    figure = Figure(figsize=(9.5, 2.1 * rows + 0.4), layout="constrained")
    grid = figure.subplots(rows, columns, sharex=True, squeeze=False)
    for joint, axes in enumerate(grid.flat):
        if joint >= len(robot.joint_names):
            axes.set_axis_off()
            continue
        _joint_axes(axes, trajectory, joint)
    for axes in grid[-1]:
        axes.set_xlabel("time [s]")
    for row in grid:
        row[0].set_ylabel("deg")
    return figure


def _joint_axes(axes: Axes, trajectory: Trajectory, joint: int) -> None:
    robot = trajectory.robot
    lower, upper = np.degrees([robot.lower_limits[joint], robot.upper_limits[joint]])
    room = 0.08 * (upper - lower)
    axes.axhspan(lower - room, lower, color="#f3d9d4", linewidth=0.0)
    axes.axhspan(upper, upper + room, color="#f3d9d4", linewidth=0.0)
    axes.plot(trajectory.time, np.degrees(trajectory.q[:, joint]), color=COLOURS[2])
    axes.set_ylim(lower - room, upper + room)
    axes.set_xlim(trajectory.time[0], trajectory.time[-1])
    axes.set_title(words(robot.joint_names[joint]))


def _placed(hand: Hand, q: np.ndarray, wrist: np.ndarray, instants: list[int]) -> Triangles:
    """Triangles of a hand at several instants."""
    shape = load_shape(hand)
    return merged([shape.triangles(q[i], wrist[i]) for i in instants])
