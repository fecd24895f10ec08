"""Drawing functions of the paper's figures 4 to 7; `paper` computes their numbers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations, product
from typing import TYPE_CHECKING, Any

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
from handmap_qp.apps.experiments.section_four import (
    InHandStep,
    Run,
    Scene,
    object_poses,
)
from handmap_qp.apps.experiments.style import COLOURS, INK, PALE, styled
from handmap_qp.apps.grasp.contacts import Grasp
from handmap_qp.apps.grasp.objects import Box
from handmap_qp.se3 import transform_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_ANGLES = {"azimuth": 132.0, "elevation": 27.0}
_BALL = 0.0032
_CUBE_COLOUR = (0.93, 0.80, 0.55)
_DASHED = (0, (3, 2))
# Corners of the unit cube, its faces (counter-clockwise from outside) and its edges.
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
_FACES = (
    (0, 1, 3, 2),
    (4, 6, 7, 5),
    (0, 4, 5, 1),
    (2, 3, 7, 6),
    (0, 2, 6, 4),
    (1, 5, 7, 3),
)
_EDGES = [
    (i, j)
    for i, j in combinations(range(8), 2)
    if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1.0
]


@styled
def draw_grasps(scene: Scene) -> Figure:
    """Draw both hands on the cube, and the contacts on its faces."""
    from matplotlib.figure import Figure

    figure, pixels = Figure(figsize=(10.0, 3.9)), (533, 549)
    hands = (
        ("Human hand", scene.human, HUMAN_COLOUR),
        ("Three-fingered robot hand", scene.robot, ROBOT_COLOUR),
    )
    panels = [figure.add_axes((i / 3.0, 0.0, 1.0 / 3.0, 0.88)) for i in range(3)]
    for axes, (title, grasp, colour) in zip(panels[:2], hands, strict=True):
        solid = grasp_triangles(grasp, grasp.q, grasp.wrist, grasp.object_pose)
        camera = Camera.framing(
            solid.vertices.reshape(-1, 3), pixels, margin=0.045, **_ANGLES
        )
        draw_hands(
            axes,
            solid,
            camera,
            marks=spheres(grasp.points, _BALL, colour),
            supersampling=3,
        )
        counts = f"{len(grasp.hand.joint_names)} joints, {len(grasp.contacts)} contacts"
        _heading(axes, camera, title, counts)
    axes, camera = panels[2], _cube_camera(scene.human, pixels, 1.0, 0.17)
    _draw_cube(axes, camera, scene.human)
    for _, grasp, colour in hands:
        _dots(axes, camera, grasp.points, 46, colour, edgecolor="white", linewidth=0.8)
    _dots(axes, camera, scene.human.centre, 46, INK)
    _heading(
        axes, camera, "Contacts on the cube", "human blue, robot red, centre black"
    )
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
    hands = (
        (run.scene.human, run.human, poses[0]),
        (run.scene.robot, run.robot, poses[1]),
    )
    solids = [
        merged(
            [
                grasp_triangles(grasp, motion.q[i], motion.wrist[i], held[i])
                for i in (0, steps // 2, steps)
            ]
        )
        for grasp, motion, held in hands
    ]
    corners = np.concatenate([solid.vertices.reshape(-1, 3) for solid in solids])
    camera = Camera.framing(
        corners, (800, 475), azimuth=-103.0, elevation=20.0, margin=0.02
    )
    blue, red = (
        tube(held[:, :3, 3], 0.0022, colour)
        for held, colour in zip(poses, (HUMAN_COLOUR, ROBOT_COLOUR), strict=True)
    )
    panels = (
        ("a) Human hand", "blue: the object's centre", [blue]),
        ("b) Robot hand", "red: the object's centre; blue: the human's", [blue, red]),
    )
    for column, (solid, (title, subtitle, lines)) in enumerate(
        zip(solids, panels, strict=True)
    ):
        axes = figure.add_axes((0.5 * column, 0.36, 0.5, 0.55))
        draw_hands(axes, solid, camera, marks=merged(lines), supersampling=3)
        _heading(axes, camera, title, subtitle)
    axes = figure.add_axes((0.06, 0.09, 0.92, 0.22))
    for (geometry, model), (human, robot) in ways.items():
        axes.plot(
            np.linspace(0.0, 1.0, steps + 1),
            1e3 * np.linalg.norm(human - robot, axis=1),
            color=COLOURS[2] if model == "rigid" else COLOURS[3],
            linestyle="-" if geometry == "ours" else (0, (4, 2)),
            label=f"{model}, "
            + ("correct hand" if geometry == "ours" else "fingers as in the toolbox"),
        )
    axes.set(xlabel="share of the path", ylabel="mm", xlim=(0.0, 1.0))
    axes.set_title("c) Distance between the two centres")
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
    camera = _cube_camera(scene.human, (533, 420), 1.25, 0.1)
    colours, centre = (HUMAN_COLOUR, ROBOT_COLOUR), scene.human.centre
    for column, (rigid, soft) in enumerate(
        zip(found["rigid"], found["quasi-static"], strict=True)
    ):
        above, below = (
            figure.add_axes((column / 3.0, bottom, 1.0 / 3.0, 0.424))
            for bottom in (0.505, 0.04)
        )
        _draw_cube(above, camera, scene.human)
        for step, width in ((rigid, 2.2), (soft, 1.0)):
            for motion, colour in zip(
                (step.human_motion, step.robot_motion), colours, strict=True
            ):
                arrow = 0.035 * motion / np.linalg.norm(motion)
                _draw_arrow(above, camera, centre, arrow, colour, width)
        _dots(above, camera, centre, 30, INK)
        _heading(
            above,
            camera,
            f"Synergy {column + 1}: object motion",
            f"angle {np.degrees(rigid.angle):.0f}° (rigid, thick), "
            f"{np.degrees(soft.angle):.0f}° (quasi-static, thin)",
        )
        _draw_cube(below, camera, scene.human)
        longest = []
        for grasp, forces, colour in zip(
            (scene.human, scene.robot),
            (soft.human_forces, soft.robot_forces),
            colours,
            strict=True,
        ):
            longest.append(float(np.linalg.norm(forces, axis=1).max()))
            for point, force in zip(grasp.points, forces, strict=True):
                _draw_arrow(
                    below, camera, point, 0.03 * force / longest[-1], colour, 1.8
                )
            _dots(
                below,
                camera,
                grasp.points,
                26,
                colour,
                edgecolor="white",
                linewidth=0.6,
            )
        human, robot = (f"{1e3 * force:.3g} mN" for force in longest)
        _heading(
            below,
            camera,
            "Force changes",
            f"longest arrows: human {human}, robot {robot}",
        )
    note = (
        "Blue: human; red: robot. All motions have the same length; "
        "the forces of each hand are scaled by its largest one."
    )
    figure.text(0.013, 0.012, note, fontsize=8, color=PALE)
    return figure


@styled
def draw_sensitivity(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the object-centre error by gamma and by number of steps, one column per model."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 6.0), layout="constrained")
    grid = figure.subplots(2, 2, sharex="row")
    styles = {
        "toolbox": {"linestyle": "-", "marker": "o", "markersize": 3.5},
        "ours": {"linestyle": _DASHED, "linewidth": 1.2},
    }
    cells = product(("gamma", "steps"), ("rigid", "quasi-static"))
    for axes, (sweep, model) in zip(grid.flat, cells, strict=True):
        for synergy, (geometry, style) in product((1, 2, 3), styles.items()):
            wanted = (geometry, sweep, synergy)
            chosen = [
                r for r in rows if (r["geometry"], r["sweep"], r["synergy"]) == wanted
            ]
            axes.plot(
                [r[sweep] for r in chosen],
                [r[f"error_{model}_mm"] for r in chosen],
                color=COLOURS[synergy - 1],
                label=f"synergy {synergy}" if geometry == "toolbox" else None,
                **style,
            )
        axes.set_ylim(bottom=0.0)
        axes.set_xlabel("gamma" if sweep == "gamma" else "number of steps")
        if sweep == "steps":
            axes.set_xscale("log")
            ticks = [2, 5, 10, 20, 50, 100, 200]
            axes.set_xticks(ticks, labels=list(map(str, ticks)))
            axes.minorticks_off()
    for label, style in (("fingers as in the toolbox", "-"), ("correct hand", _DASHED)):
        grid[0, 1].plot([], [], color=PALE, linestyle=style, label=label)
    grid[0, 0].set_title("Object follows the contacts as a rigid body")
    grid[0, 1].set_title("Quasi-static, unit stiffness")
    for row in grid:
        row[0].set_ylabel("distance of object centres [mm]")
    for axes in grid[0]:
        axes.legend(loc="upper left")
    return figure


def grasp_triangles(
    grasp: Grasp, q: np.ndarray, wrist_pose: np.ndarray, object_pose: np.ndarray
) -> Triangles:
    """Return the triangles of a hand and the box that it holds, in the world.

    Args:
        grasp: The grasp.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Pose of the wrist, shape (4, 4).
        object_pose: Pose of the box, shape (4, 4).
    """
    hand = load_shape(grasp.hand).triangles(q, wrist_pose)
    return merged([hand, box_triangles(object_pose, _box_size(grasp))])


def box_triangles(pose: np.ndarray, size: np.ndarray) -> Triangles:
    """Return the triangles of a box, with outward normals.

    Args:
        pose: Pose of the box, shape (4, 4).
        size: Lengths of its sides [m], shape (3,).
    """
    corners = transform_points(pose, _CORNERS * size)
    faces = [triangle for a, b, c, d in _FACES for triangle in ((a, b, c), (a, c, d))]
    vertices = corners[np.array(faces)]
    normals = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Triangles(
        vertices,
        np.tile(_CUBE_COLOUR, (len(vertices), 1)),
        np.repeat(normals[:, None], 3, axis=1),
    )


def _box_size(grasp: Grasp) -> np.ndarray:
    if not isinstance(grasp.shape, Box):
        raise TypeError(f"only boxes are drawn, not {grasp.shape!r}")
    return np.array(grasp.shape.size)


def _cube_camera(
    grasp: Grasp, pixels: tuple[int, int], growth: float, margin: float
) -> Camera:
    """Return a camera that frames the held box, grown by a factor."""
    corners = transform_points(grasp.object_pose, _CORNERS * growth * _box_size(grasp))
    return Camera.framing(corners, pixels, margin=margin, **_ANGLES)


def _draw_cube(axes: Axes, camera: Camera, grasp: Grasp) -> None:
    """Draw the edges of the held box in empty axes in the camera's pixels; hidden ones dotted."""
    width, height = camera.size
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_axis_off()
    corners = transform_points(grasp.object_pose, _CORNERS * _box_size(grasp))
    hidden = int(np.argmax(transform_points(camera.world_to_camera, corners)[:, 2]))
    for edge in _EDGES:
        x, y = camera.project(corners[list(edge)]).T[:2]
        style, line = (":", 0.8) if hidden in edge else ("-", 1.3)
        axes.plot(x, y, color=PALE, linewidth=line, linestyle=style)


def _dots(
    axes: Axes,
    camera: Camera,
    points: np.ndarray,
    size: float,
    colour: Any,
    **edge: Any,
) -> None:
    axes.scatter(*camera.project(points).T[:2], s=size, color=colour, zorder=3, **edge)


def _draw_arrow(
    axes: Axes,
    camera: Camera,
    start: np.ndarray,
    vector: np.ndarray,
    colour: Any,
    width: float,
) -> None:
    """Draw a vector in space as an arrow, in the camera's pixels."""
    tail, head = camera.project(np.array([start, start + vector]))
    style = {
        "arrowstyle": "-|>",
        "color": colour,
        "linewidth": width,
        "shrinkA": 0,
        "shrinkB": 0,
    }
    style["mutation_scale"] = 5.0 + 3.5 * width
    axes.annotate(
        "", xy=(head[0], head[1]), xytext=(tail[0], tail[1]), arrowprops=style
    )


def _heading(axes: Axes, camera: Camera, title: str, subtitle: str) -> None:
    """Write a title and a line below it at the upper left, in the camera's pixels."""
    width, height = camera.size
    axes.text(0.04 * width, 0.0, title, fontsize=11, fontweight="bold", va="bottom")
    axes.text(0.04 * width, 0.012 * height, subtitle, fontsize=8, color=PALE, va="top")
