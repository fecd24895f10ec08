"""Drawing functions of the paper's figures 4 to 7; `paper` computes their numbers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import wraps
from itertools import combinations, pairwise, product
from typing import TYPE_CHECKING, Any, ParamSpec

import common
import numpy as np
import trimesh

from handmap_qp.apps.drawing.hands import (
    HUMAN_COLOUR,
    ROBOT_COLOUR,
    draw_hands,
    load_shape,
    pixel_axes,
    require_matplotlib,
    solid,
    spheres,
    tube,
)
from handmap_qp.apps.drawing.raster import Camera, Triangles, merged
from handmap_qp.mapping.objects import Box
from handmap_qp.se3 import transform_points
from section_four.contacts import Grasp
from section_four.experiment import (
    InHandStep,
    Run,
    Scene,
    object_poses,
)

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK, PALE = "#222831", "#8a929c"
COLOURS = ("#c8452f", "#2f7d6b", "#3f6fb5", "#c48a1d", "#7a56a6")
STYLE: dict[Any, Any] = common.STYLE | {
    "figure.dpi": 160,
    "savefig.dpi": 160,
    # A fixed salt: the same numbers must give the same file.
    "svg.hashsalt": "handmap",
}

_ANGLES = {"azimuth": 132.0, "elevation": 27.0}
_BALL = 0.0032
_CUBE_COLOUR = (0.93, 0.80, 0.55)
_DASHED = (0, (3, 2))
_TICKS = (2, 5, 10, 20, 50, 100, 200)
# Corners of the unit cube, its faces (counter-clockwise from outside) and its edges.
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
_FACES = np.array(
    (
        (0, 1, 3, 2),
        (4, 6, 7, 5),
        (0, 4, 5, 1),
        (2, 3, 7, 6),
        (0, 2, 6, 4),
        (1, 5, 7, 3),
    )
)
_EDGES = [
    (i, j)
    for i, j in combinations(range(8), 2)
    if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1.0
]


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


@dataclass(frozen=True)
class _Panel:
    """Axes in the pixels of a camera.

    Attributes:
        axes: The axes.
        camera: The camera.
    """

    axes: Axes
    camera: Camera

    def heading(self, title: str, subtitle: str) -> None:
        """Write a title and a line below it at the upper left."""
        width, height = self.camera.size
        self.axes.text(
            0.04 * width, 0.0, title, fontsize=11, fontweight="bold", va="bottom"
        )
        self.axes.text(
            0.04 * width, 0.012 * height, subtitle, fontsize=8, color=PALE, va="top"
        )

    def cube(self, grasp: Grasp) -> None:
        """Draw the edges of the held box; hidden ones dotted."""
        pixel_axes(self.axes, self.camera)
        corners = transform_points(grasp.object_pose, _CORNERS * _box_size(grasp))
        depths = transform_points(self.camera.world_to_camera, corners)[:, 2]
        hidden = int(np.argmax(depths))
        for edge in _EDGES:
            x, y = self.camera.project(corners[list(edge)]).T[:2]
            style, line = (":", 0.8) if hidden in edge else ("-", 1.3)
            self.axes.plot(x, y, color=PALE, linewidth=line, linestyle=style)

    def dots(self, points: np.ndarray, size: float, colour: Any, **edge: Any) -> None:
        """Draw points in space as dots."""
        x, y = self.camera.project(points).T[:2]
        self.axes.scatter(x, y, s=size, color=colour, zorder=3, **edge)

    def arrow(
        self, start: np.ndarray, vector: np.ndarray, colour: Any, width: float
    ) -> None:
        """Draw a vector in space as an arrow."""
        tail, head = self.camera.project(np.array([start, start + vector]))[:, :2]
        style = {
            "arrowstyle": "-|>",
            "color": colour,
            "linewidth": width,
            "shrinkA": 0,
            "shrinkB": 0,
            "mutation_scale": 5.0 + 3.5 * width,
        }
        self.axes.annotate("", xy=head, xytext=tail, arrowprops=style)


@styled
def draw_grasps(scene: Scene) -> Figure:
    """Draw both hands on the cube, and the contacts on its faces."""
    figure = new_figure(figsize=(10.0, 3.9))
    pixels = (533, 549)
    hands = (
        ("Human hand", scene.human, HUMAN_COLOUR),
        ("Three-fingered robot hand", scene.robot, ROBOT_COLOUR),
    )
    panels = [figure.add_axes((i / 3.0, 0.0, 1.0 / 3.0, 0.88)) for i in range(3)]
    cube = _Panel(panels[2], _cube_camera(scene.human, pixels, 1.0, 0.17))
    cube.cube(scene.human)
    for axes, (title, grasp, colour) in zip(panels, hands, strict=False):
        held = grasp_triangles(grasp, grasp.q, grasp.wrist, grasp.object_pose)
        corners = held.vertices.reshape(-1, 3)
        camera = Camera.framing(corners, pixels, margin=0.045, **_ANGLES)
        marks = spheres(grasp.points, _BALL, colour)
        draw_hands(axes, held, camera, marks=marks, supersampling=3)
        counts = f"{len(grasp.hand.joint_names)} joints, {len(grasp.contacts)} contacts"
        _Panel(axes, camera).heading(title, counts)
        cube.dots(grasp.points, 46, colour, edgecolor="white", linewidth=0.8)
    cube.dots(scene.human.centre, 46, INK)
    cube.heading("Contacts on the cube", "human blue, robot red, centre black")
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
    figure = new_figure(figsize=(10.0, 5.4))
    poses = object_poses(run)
    steps = len(poses[0]) - 1
    hands = ((run.scene.human, run.human), (run.scene.robot, run.robot))
    solids = [
        merged(
            [
                grasp_triangles(grasp, motion.q[i], motion.wrist[i], held[i])
                for i in (0, steps // 2, steps)
            ]
        )
        for (grasp, motion), held in zip(hands, poses, strict=True)
    ]
    corners = merged(solids).vertices.reshape(-1, 3)
    camera = Camera.framing(
        corners, (800, 475), azimuth=-103.0, elevation=20.0, margin=0.02
    )
    blue, red = (
        merged([tube(ends, 0.0022, colour) for ends in pairwise(held[:, :3, 3])])
        for held, colour in zip(poses, (HUMAN_COLOUR, ROBOT_COLOUR), strict=True)
    )
    panels = (
        ("a) Human hand", "blue: the object's centre", [blue]),
        ("b) Robot hand", "red: the object's centre; blue: the human's", [blue, red]),
    )
    for i, (title, subtitle, lines) in enumerate(panels):
        axes = figure.add_axes((0.5 * i, 0.36, 0.5, 0.55))
        draw_hands(axes, solids[i], camera, marks=merged(lines), supersampling=3)
        _Panel(axes, camera).heading(title, subtitle)
    axes = figure.add_axes((0.06, 0.09, 0.92, 0.22))
    share = np.linspace(0.0, 1.0, steps + 1)
    colours = {"rigid": COLOURS[2], "quasi-static": COLOURS[3]}
    geometries = {
        "ours": ("correct hand", "-"),
        "toolbox": ("fingers as in the toolbox", (0, (4, 2))),
    }
    for (geometry, model), (human, robot) in ways.items():
        name, style = geometries[geometry]
        axes.plot(
            share,
            1e3 * np.linalg.norm(human - robot, axis=1),
            color=colours[model],
            linestyle=style,
            label=f"{model}, {name}",
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
    figure = new_figure(figsize=(10.0, 6.2))
    camera = _cube_camera(scene.human, (533, 420), 1.25, 0.1)
    steps = zip(found["rigid"], found["quasi-static"], strict=True)
    for column, (rigid, soft) in enumerate(steps):
        above, below = (
            _Panel(figure.add_axes((column / 3.0, y, 1.0 / 3.0, 0.424)), camera)
            for y in (0.505, 0.04)
        )
        above.cube(scene.human)
        for step, width in ((rigid, 2.2), (soft, 1.0)):
            for motion, colour in (
                (step.human_motion, HUMAN_COLOUR),
                (step.robot_motion, ROBOT_COLOUR),
            ):
                arrow = 0.035 * motion / np.linalg.norm(motion)
                above.arrow(scene.human.centre, arrow, colour, width)
        above.dots(scene.human.centre, 30, INK)
        above.heading(
            f"Synergy {column + 1}: object motion",
            f"angle {np.degrees(rigid.angle):.0f}° (rigid, thick), "
            f"{np.degrees(soft.angle):.0f}° (quasi-static, thin)",
        )
        below.cube(scene.human)
        human, robot = (
            _draw_forces(below, grasp, forces, colour)
            for grasp, forces, colour in (
                (scene.human, soft.human_forces, HUMAN_COLOUR),
                (scene.robot, soft.robot_forces, ROBOT_COLOUR),
            )
        )
        below.heading("Force changes", f"longest arrows: human {human}, robot {robot}")
    note = (
        "Blue: human; red: robot. All motions have the same length; "
        "the forces of each hand are scaled by its largest one."
    )
    figure.text(0.013, 0.012, note, fontsize=8, color=PALE)
    return figure


def _draw_forces(panel: _Panel, grasp: Grasp, forces: np.ndarray, colour: Any) -> str:
    """Draw forces at contacts, shape (n_c, 3); return the largest one in words."""
    longest = float(np.linalg.norm(forces, axis=1).max())
    for point, force in zip(grasp.points, forces, strict=True):
        panel.arrow(point, 0.03 * force / longest, colour, 1.8)
    panel.dots(grasp.points, 26, colour, edgecolor="white", linewidth=0.6)
    return f"{1e3 * longest:.3g} mN"


@styled
def draw_sensitivity(rows: Sequence[dict[str, Any]]) -> Figure:
    """Draw the object-centre error by gamma and by number of steps, one column per model."""
    figure = new_figure(figsize=(8.6, 6.0), layout="constrained")
    grid = figure.subplots(2, 2, sharex="row")
    models = {
        "rigid": "Object follows the contacts as a rigid body",
        "quasi-static": "Quasi-static, unit stiffness",
    }
    for axes, (sweep, model) in zip(
        grid.flat, product(("gamma", "steps"), models), strict=True
    ):
        _draw_errors(axes, rows, sweep, f"error_{model}_mm")
    for axes in grid[1]:
        axes.set_xlabel("number of steps")
        axes.set_xscale("log")
        axes.set_xticks(_TICKS, labels=list(map(str, _TICKS)))
        axes.minorticks_off()
    for label, style in (("fingers as in the toolbox", "-"), ("correct hand", _DASHED)):
        grid[0, 1].plot([], [], color=PALE, linestyle=style, label=label)
    for axes, title in zip(grid[0], models.values(), strict=True):
        axes.set_title(title)
        axes.set_xlabel("gamma")
        axes.legend(loc="upper left")
    for axes in grid[:, 0]:
        axes.set_ylabel("distance of object centres [mm]")
    return figure


def _draw_errors(
    axes: Axes, rows: Sequence[dict[str, Any]], sweep: str, error: str
) -> None:
    """Draw the errors of each synergy with both robot hands."""
    styles: dict[str, dict[str, Any]] = {
        "toolbox": {"marker": "o", "markersize": 3.5},
        "ours": {"linestyle": _DASHED, "linewidth": 1.2},
    }
    for synergy, (geometry, style) in product((1, 2, 3), styles.items()):
        found = selected(rows, geometry=geometry, sweep=sweep, synergy=synergy)
        axes.plot(
            [row[sweep] for row in found],
            [row[error] for row in found],
            color=COLOURS[synergy - 1],
            label=f"synergy {synergy}" if geometry == "toolbox" else None,
            **style,
        )
    axes.set_ylim(bottom=0.0)


def selected(rows: Sequence[dict[str, Any]], **wanted: Any) -> list[dict[str, Any]]:
    """Return the rows that have the wanted values."""
    return [row for row in rows if wanted.items() <= row.items()]


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
    faces = np.concatenate([_FACES[:, [0, 1, 2]], _FACES[:, [0, 2, 3]]])
    box = trimesh.Trimesh(_CORNERS * size, faces, process=False)
    return solid(box, _CUBE_COLOUR).moved(pose)


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
