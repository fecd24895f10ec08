"""Common style of the pictures; boxes, box edges and arrows in pictures of hands."""

from __future__ import annotations

from collections.abc import Callable
from functools import wraps
from itertools import combinations, product
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

from handmap_qp.drawing.hands import require_matplotlib
from handmap_qp.drawing.raster import Camera, Triangles
from handmap_qp.se3 import transform_points

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

DPI = 160
INK, PALE = "#222831", "#8a929c"
COLOURS = ("#c8452f", "#2f7d6b", "#3f6fb5", "#c48a1d", "#7a56a6")
STYLE = {
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
    "figure.dpi": DPI,
    "savefig.dpi": DPI,
    "figure.facecolor": "white",
    # A fixed salt: the same numbers must give the same file.
    "svg.hashsalt": "handmap",
}
CUBE_COLOUR = (0.93, 0.80, 0.55)
"""Colour of the held object."""

_Arguments = ParamSpec("_Arguments")
# Corners of the unit cube, its faces (counter-clockwise from outside) and its edges.
_CORNERS = np.array(list(product((-0.5, 0.5), repeat=3)))
_FACES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
_EDGES = [
    (i, j) for i, j in combinations(range(8), 2) if np.abs(_CORNERS[i] - _CORNERS[j]).sum() == 1.0
]


def styled(draw: Callable[_Arguments, Figure]) -> Callable[_Arguments, Figure]:
    """Decorate a drawing function to use `STYLE`, without changing matplotlib's settings."""

    @wraps(draw)
    def drawn(*arguments: _Arguments.args, **named: _Arguments.kwargs) -> Figure:
        with require_matplotlib().rc_context(STYLE):
            return draw(*arguments, **named)

    return drawn


def words(name: str) -> str:
    """Replace the underscores of a name by spaces."""
    return name.replace("_", " ")


def box_triangles(
    pose: np.ndarray, size: Any, colour: tuple[float, float, float] = CUBE_COLOUR
) -> Triangles:
    """Return the triangles of a box.

    Args:
        pose: Pose of the box, shape (4, 4).
        size: Lengths of its sides [m], shape (3,).
        colour: Red, green and blue in [0, 1].

    Returns:
        The triangles, with outward normals.
    """
    corners = transform_points(pose, _CORNERS * np.asarray(size))
    faces = [triangle for a, b, c, d in _FACES for triangle in ((a, b, c), (a, c, d))]
    vertices = corners[np.array(faces)]
    normals = np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Triangles(
        vertices, np.tile(colour, (len(vertices), 1)), np.repeat(normals[:, None], 3, axis=1)
    )


def draw_box_edges(axes: Axes, camera: Camera, pose: np.ndarray, size: Any, **line: Any) -> None:
    """Draw the edges of a box in axes with the camera's pixels as coordinates; hidden ones dotted.

    Args:
        axes: The axes; see `blank_axes`.
        camera: The camera.
        pose: Pose of the box, shape (4, 4).
        size: Lengths of its sides [m], shape (3,).
        line: Further arguments of `Axes.plot`.
    """
    corners = transform_points(pose, _CORNERS * np.asarray(size))
    depth = transform_points(camera.world_to_camera, corners)[:, 2]
    hidden = int(np.argmax(depth))
    for i, j in _EDGES:
        x, y = camera.project(corners[[i, j]]).T[:2]
        is_hidden = hidden in (i, j)
        axes.plot(
            x,
            y,
            color=PALE,
            linewidth=0.8 if is_hidden else 1.3,
            linestyle=":" if is_hidden else "-",
            **line,
        )


def blank_axes(axes: Axes, camera: Camera) -> None:
    """Set the coordinates of empty axes to the camera's pixels."""
    width, height = camera.size
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def draw_arrow(
    axes: Axes,
    camera: Camera,
    start: np.ndarray,
    vector: np.ndarray,
    colour: Any,
    *,
    width: float = 1.8,
) -> None:
    """Draw a vector in space as an arrow, in axes with the camera's pixels as coordinates."""
    tail, head = camera.project(np.array([start, start + vector]))
    style = {
        "arrowstyle": "-|>",
        "color": colour,
        "linewidth": width,
        "shrinkA": 0.0,
        "shrinkB": 0.0,
    }
    style["mutation_scale"] = 5.0 + 3.5 * width
    axes.annotate("", xy=(head[0], head[1]), xytext=(tail[0], tail[1]), arrowprops=style)
