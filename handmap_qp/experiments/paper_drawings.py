"""Drawing functions of the paper's figures 4 to 7; `paper_figures` computes their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from handmap_qp.experiments.figure_record import Row
from handmap_qp.experiments.held_object import InHandStep, object_poses
from handmap_qp.experiments.section_four import Run, Scene
from handmap_qp.experiments.style import (
    COLOURS,
    INK,
    PALE,
    blank_axes,
    box_triangles,
    draw_arrow,
    draw_box_edges,
    styled,
)
from handmap_qp.grasp import Grasp
from handmap_qp.grasp.objects import Box

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

CAMERA = {"azimuth": 132.0, "elevation": 27.0}
_BALL = 0.0032


@styled
def draw_grasps(scene: Scene) -> Figure:
    """Draw both hands on the cube, and the contacts on its faces."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 3.9))
    width, height = 533, 624
    solids = [
        grasp_triangles(scene.human, scene.human.q),
        grasp_triangles(scene.robot, scene.robot.q),
    ]
    titles = ("Human hand", "Three-fingered robot hand")
    panels = zip(
        solids, (scene.human, scene.robot), titles, (HUMAN_COLOUR, ROBOT_COLOUR), strict=True
    )
    for column, (solid, grasp, title, colour) in enumerate(panels):
        axes = figure.add_axes((column / 3.0, 0.0, 1.0 / 3.0, 0.88))
        camera = Camera.framing(
            solid.vertices.reshape(-1, 3), (width, int(0.88 * height)), margin=0.045, **CAMERA
        )
        draw_hands(axes, solid, camera, marks=spheres(grasp.points, _BALL, colour), supersampling=3)
        heading(
            axes,
            camera,
            title,
            f"{len(grasp.hand.joint_names)} joints, {len(grasp.contacts)} contacts",
        )
    axes = figure.add_axes((2.0 / 3.0, 0.0, 1.0 / 3.0, 0.88))
    size = _box_size(scene.human)
    corners = box_triangles(scene.human.object_pose, size).vertices.reshape(-1, 3)
    camera = Camera.framing(corners, (width, int(0.88 * height)), margin=0.17, **CAMERA)
    blank_axes(axes, camera)
    draw_box_edges(axes, camera, scene.human.object_pose, size)
    for grasp, colour in ((scene.human, HUMAN_COLOUR), (scene.robot, ROBOT_COLOUR)):
        axes.scatter(
            *camera.project(grasp.points).T[:2],
            s=46,
            color=colour,
            edgecolor="white",
            linewidth=0.8,
            zorder=3,
        )
    axes.scatter(*camera.project(scene.human.centre)[:2], s=46, color=INK, zorder=3)
    heading(axes, camera, "Contacts on the cube", "human blue, robot red, centre black")
    return figure


@styled
def draw_ways(run: Run, ways: Mapping[tuple[str, str], Sequence[np.ndarray]]) -> Figure:
    """Draw both hands on the arc with the paths of the object's centres, and their distance.

    Args:
        run: The run to draw.
        ways: Paths of the centre in the human's and in the robot's hand [m], shape (N + 1, 3) each,
            by geometry and object model.

    Returns:
        The picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 5.4))
    poses, steps = object_poses(run), len(run.human.q) - 1
    instants = [0, steps // 2, steps]
    solids = [
        merged([grasp_triangles(grasp, motion.q[i], motion.wrist[i], held[i]) for i in instants])
        for grasp, motion, held in (
            (run.scene.human, run.human, poses[0]),
            (run.scene.robot, run.robot, poses[1]),
        )
    ]
    size = (800, 475)
    corners = np.concatenate([solid.vertices.reshape(-1, 3) for solid in solids])
    camera = Camera.framing(corners, size, azimuth=-103.0, elevation=20.0, margin=0.02)
    blue, red = (
        tube(poses[0][:, :3, 3], 0.0022, HUMAN_COLOUR),
        tube(poses[1][:, :3, 3], 0.0022, ROBOT_COLOUR),
    )
    panels = (
        ("a) Human hand", "blue: the object's centre", [blue]),
        ("b) Robot hand", "red: the object's centre; blue: the human's", [blue, red]),
    )
    for column, (solid, (title, subtitle, lines)) in enumerate(zip(solids, panels, strict=True)):
        axes = figure.add_axes((0.5 * column, 0.36, 0.5, 0.55))
        draw_hands(axes, solid, camera, marks=merged(lines), supersampling=3)
        heading(axes, camera, title, subtitle)
    axes = figure.add_axes((0.06, 0.09, 0.92, 0.22))
    way = np.linspace(0.0, 1.0, steps + 1)
    for (geometry, model), (human, robot) in ways.items():
        colour = COLOURS[2] if model == "rigid" else COLOURS[3]
        style = "-" if geometry == "ours" else (0, (4, 2))
        label = f"{model}, {'correct hand' if geometry == 'ours' else 'fingers as in the toolbox'}"
        axes.plot(
            way,
            1e3 * np.linalg.norm(human - robot, axis=1),
            color=colour,
            linestyle=style,
            label=label,
        )
    axes.set_title("c) Distance between the two centres")
    axes.set_xlabel("share of the path")
    axes.set_ylabel("mm")
    axes.set_xlim(0.0, 1.0)
    axes.set_ylim(bottom=0.0)
    axes.legend(loc="upper left", ncols=2)
    return figure


@styled
def draw_first_step(scene: Scene, found: Mapping[str, Sequence[InHandStep]]) -> Figure:
    """Draw the object's motion and the force changes in the first step, one column per synergy.

    Args:
        scene: Both hands at the start.
        found: One entry per synergy, by object model.

    Returns:
        The picture.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.0, 6.2))
    size = _box_size(scene.human)
    pixels = (533, 420)
    for column, (rigid, soft) in enumerate(zip(found["rigid"], found["quasi-static"], strict=True)):
        for row, title in enumerate((f"Synergy {column + 1}: object motion", "Force changes")):
            axes = figure.add_axes((column / 3.0, 0.505 - 0.465 * row, 1.0 / 3.0, 0.424))
            corners = box_triangles(
                scene.human.object_pose, 1.25 * np.array(size)
            ).vertices.reshape(-1, 3)
            camera = Camera.framing(corners, pixels, margin=0.1, **CAMERA)
            blank_axes(axes, camera)
            draw_box_edges(axes, camera, scene.human.object_pose, size)
            if row == 0:
                for step, width in ((rigid, 2.2), (soft, 1.0)):
                    for motion, colour in (
                        (step.human_motion, HUMAN_COLOUR),
                        (step.robot_motion, ROBOT_COLOUR),
                    ):
                        draw_arrow(
                            axes,
                            camera,
                            scene.human.centre,
                            0.035 * motion / np.linalg.norm(motion),
                            colour,
                            width=width,
                        )
                axes.scatter(*camera.project(scene.human.centre)[:2], s=30, color=INK, zorder=3)
                angles = np.degrees([rigid.angle, soft.angle])
                heading(
                    axes,
                    camera,
                    title,
                    f"angle {angles[0]:.0f}° (rigid, thick), {angles[1]:.0f}° (quasi-static, thin)",
                )
            else:
                for grasp, forces, colour in (
                    (scene.human, soft.human_forces, HUMAN_COLOUR),
                    (scene.robot, soft.robot_forces, ROBOT_COLOUR),
                ):
                    largest = float(np.linalg.norm(forces, axis=1).max())
                    for point, force in zip(grasp.points, forces, strict=True):
                        draw_arrow(axes, camera, point, 0.03 * force / largest, colour)
                    axes.scatter(
                        *camera.project(grasp.points).T[:2],
                        s=26,
                        color=colour,
                        edgecolor="white",
                        linewidth=0.6,
                        zorder=3,
                    )
                most = [
                    1e3 * np.linalg.norm(forces, axis=1).max()
                    for forces in (soft.human_forces, soft.robot_forces)
                ]
                heading(
                    axes,
                    camera,
                    title,
                    f"longest arrows: human {most[0]:.3g} mN, robot {most[1]:.3g} mN",
                )
    note = (
        "Blue: human; red: robot. All motions have the same length; "
        "the forces of each hand are scaled by its largest one."
    )
    figure.text(0.013, 0.012, note, fontsize=8, color=PALE)
    return figure


@styled
def draw_sensitivity(rows: Sequence[Row]) -> Figure:
    """Draw the object-centre error by gamma and by number of steps, one column per model."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 6.0), layout="constrained")
    grid = figure.subplots(2, 2, sharex="row")
    for column, model in enumerate(("rigid", "quasi-static")):
        for row, (sweep, label) in enumerate((("gamma", "gamma"), ("steps", "number of steps"))):
            axes = grid[row, column]
            for synergy in (1, 2, 3):
                for geometry, style in (("toolbox", "-"), ("ours", (0, (3, 2)))):
                    chosen = [
                        r
                        for r in rows
                        if (r["geometry"], r["sweep"], r["synergy"]) == (geometry, sweep, synergy)
                    ]
                    is_solid = geometry == "toolbox"
                    axes.plot(
                        [r[sweep] for r in chosen],
                        [r[f"error_{model}_mm"] for r in chosen],
                        color=COLOURS[synergy - 1],
                        linestyle=style,
                        linewidth=1.8 if is_solid else 1.2,
                        marker="o" if is_solid else None,
                        markersize=3.5,
                        label=f"synergy {synergy}" if is_solid else None,
                    )
            axes.set_xlabel(label)
            axes.set_ylim(bottom=0.0)
            if sweep == "steps":
                axes.set_xscale("log")
                axes.set_xticks(
                    [2, 5, 10, 20, 50, 100, 200], labels=["2", "5", "10", "20", "50", "100", "200"]
                )
                axes.minorticks_off()
    for label, style in (("fingers as in the toolbox", "-"), ("correct hand", (0, (3, 2)))):
        grid[0, 1].plot([], [], color=PALE, linestyle=style, label=label)
    grid[0, 1].legend(loc="upper left")
    grid[0, 0].set_title("Object follows the contacts as a rigid body")
    grid[0, 1].set_title("Quasi-static, unit stiffness")
    for row in grid:
        row[0].set_ylabel("distance of object centres [mm]")
    grid[0, 0].legend(loc="upper left")
    return figure


def grasp_triangles(
    grasp: Grasp,
    q: np.ndarray,
    wrist_pose: np.ndarray | None = None,
    object_pose: np.ndarray | None = None,
) -> Triangles:
    """Return the triangles of a hand and the box that it holds.

    Args:
        grasp: The grasp.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Pose of the wrist, shape (4, 4); the grasp's if omitted.
        object_pose: Pose of the box, shape (4, 4); the grasp's if omitted.

    Returns:
        Triangles in the world.
    """
    hand = load_shape(grasp.hand).triangles(
        q, grasp.wrist_pose if wrist_pose is None else wrist_pose
    )
    return merged(
        [
            hand,
            box_triangles(
                grasp.object_pose if object_pose is None else object_pose, _box_size(grasp)
            ),
        ]
    )


def _box_size(grasp: Grasp) -> tuple[float, float, float]:
    if not isinstance(grasp.shape, Box):
        raise TypeError(f"only boxes are drawn, not {grasp.shape!r}")
    return grasp.shape.size


def heading(axes: Axes, camera: Camera, title: str, subtitle: str) -> None:
    """Write a title and a line below it at the upper left, in the camera's pixels."""
    width, height = camera.size
    axes.text(0.04 * width, 0.0, title, fontsize=11, fontweight="bold", va="bottom")
    axes.text(0.04 * width, 0.012 * height, subtitle, fontsize=8, color=PALE, va="top")
