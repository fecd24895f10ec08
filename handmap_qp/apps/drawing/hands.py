"""Pictures of hands from their URDFs: `load_shape`, `HandShape.triangles`, `draw_hands`.

Visual shapes (boxes, cylinders, spheres, meshes) are read once as triangles in link coordinates,
and placed by the hand's forward kinematics. `apps.drawing.raster` renders the picture into
a matplotlib axes whose coordinates are pixels, so that `camera.project(points)` gives the position
of anything drawn over it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import InvalidInputError, require
from handmap_core.se3 import Array, affine, cross, lengths, transform_points, unit
from handmap_qp.hands import Hand
from .raster import Camera, Colour, Triangles, merged, render
from .shapes import read_shapes

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

HUMAN_COLOUR = (0.13, 0.40, 0.85)
"""Colour of the human's reference points (blue, as in the paper's Fig. 4)."""
ROBOT_COLOUR = (0.84, 0.16, 0.16)
"""Colour of the robot's reference points (red)."""

UPRIGHT = affine(np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]))
"""From palm axes (+y distal, +z dorsal) to a picture's: +z up the fingers, -y out of the palm."""

GREY = (0.62, 0.64, 0.67)
"""Colour of parts without one."""
AXIS_COLOURS = ((0.80, 0.10, 0.10), (0.10, 0.55, 0.15), (0.10, 0.25, 0.80))
"""Colours of the axes x, y and z."""

MAX_MESH_TRIANGLES = 4000
"""Most triangles kept per mesh file."""
# Height of a title above panels [pixel].
_TITLE = 48
_TUBE_SIDES = 10
# Ends of a tube that are nearer coincide [m].
_SHORTEST = 1e-5
# Most cells of a grid in which they are merged, along the longest side of a mesh.
_MOST_CELLS = 96.0
# Faces that meet at a smaller angle than this are shaded as one smooth surface.
_SMOOTH_ANGLE = np.radians(40.0)


class HandShape(NamedTuple):
    """The visual shapes of a hand.

    Attributes:
        hand: The hand.
        links: Triangles in link coordinates, of each link that has shapes.
    """

    hand: Hand
    links: dict[str, Triangles]

    def triangles(self, q: ArrayLike, wrist_pose: Array | None = None) -> Triangles:
        """Return the hand's surface in one posture.

        Args:
            q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).
            wrist_pose: Wrist pose in the world, shape (4, 4); the identity if omitted. Must be
                omitted for a fixed hand.

        Returns:
            Triangles in the world: `vertices` [m], `colours` and `normals`.

        Raises:
            InvalidInputError: On a wrong shape, or a wrist pose for a fixed hand.
        """
        poses = self.hand.link_poses(list(self.links), q, wrist_pose)
        return merged(list(map(Triangles.moved, self.links.values(), poses)))

    def without_arm(self) -> HandShape:
        """Return the shapes of the links that the wrist carries."""
        supports = self.hand.model.supports
        wrist = self.hand.wrist_frame.parentJoint
        links = {
            link: shape
            for link, shape in self.links.items()
            if wrist in supports[self.hand.frames[link].parentJoint]
        }
        return HandShape(self.hand, links)


def load_shape(hand: Hand, *, colour: Colour | None = None) -> HandShape:
    """Read the visual shapes of a hand from its URDF, or its collision shapes if there are none.

    Mesh paths are resolved as in `handmap_qp.hands.sources.find_mesh`. A mesh that cannot be
    read is left out.

    Args:
        hand: The hand.
        colour: Red, green and blue in 0..1 for the whole hand; the URDF's colours if omitted.

    Returns:
        The shapes.

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    found = read_shapes(hand, "visual") or read_shapes(hand, "collision")
    links = {
        link: merged([_drawn(shape, colour or own or GREY) for shape, own in shapes])
        for link, shapes in found.items()
    }
    return HandShape(hand, links)


def solid(mesh: Any, colour: Colour) -> Triangles:
    """Return a mesh of one colour, with normals that are smooth except at edges.

    Args:
        mesh: A `trimesh.Trimesh` [m].
        colour: Red, green and blue in 0..1.
    """
    # They take .2 s to import, and only pictures with meshes need them.
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    faces = mesh.faces
    count = len(faces)
    # A surface is faces that meet at small angles: in each, a vertex has a normal of its own.
    # trimesh's `smooth_shade` does the same, but cuts the mesh into its surfaces, which is slow.
    pairs = mesh.face_adjacency[mesh.face_adjacency_angles < _SMOOTH_ANGLE]
    meets = coo_array((np.ones(len(pairs)), pairs.T), (count, count))
    _, surface = connected_components(meets, directed=False)
    keys = surface.astype(np.int64)[:, None] * len(mesh.vertices) + faces
    _, owner = np.unique(keys.ravel(), return_inverse=True)
    # Faces count by their angle at the vertex.
    parts = mesh.face_angles[..., None] * mesh.face_normals[:, None]
    sums = [np.bincount(owner, part) for part in parts.reshape(-1, 3).T]
    normals = unit(np.transpose(sums)[owner]).reshape(-1, 3, 3)
    return Triangles.painted(mesh.triangles, normals, colour)


def spheres(centres: ArrayLike, radius: float, colour: Colour) -> Triangles:
    """Return small spheres that mark points.

    Args:
        centres: Points [m], shape (n, 3).
        radius: Radius [m].
        colour: Red, green and blue in 0..1.

    Returns:
        Their triangles.

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    corners = _ball()
    places = np.reshape(centres, (-1, 1, 1, 3))
    vertices = (places + radius * corners).reshape(-1, 3, 3)
    return Triangles.painted(vertices, np.tile(corners, (len(places), 1, 1)), colour)


def tube(ends: ArrayLike, radius: float, colour: Colour) -> Triangles:
    """Return a thin straight tube; nothing if its ends coincide.

    Args:
        ends: Both ends [m], shape (2, 3).
        radius: Radius [m].
        colour: Red, green and blue in 0..1.

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    if lengths(np.ptp(ends, axis=0)) < _SHORTEST:
        return merged([])
    first, last = np.asarray(ends, dtype=float)
    axis = unit(last - first)
    # Any frame with this z axis will do.
    side = unit(cross(axis, np.eye(3)[np.abs(axis).argmin()]))
    turn = np.column_stack([side, cross(axis, side), axis])
    stretch = np.diag([radius, radius, lengths(last - first)])
    vertices, normals = _rod()
    place = affine(turn @ stretch, 0.5 * (first + last))
    placed = transform_points(place, vertices.reshape(-1, 3)).reshape(vertices.shape)
    turned = (normals.reshape(-1, 3) @ turn.T).reshape(normals.shape)
    return Triangles.painted(placed, turned, colour)


@cache
def _ball() -> Array:
    """Return the triangles of a ball of radius 1, shape (320, 3, 3)."""
    return require("trimesh", "plot").creation.icosphere(subdivisions=2).triangles


@cache
def _rod() -> tuple[Array, Array]:
    """Return triangles and normals of a rod along z of radius and length 1, from -.5 to .5."""
    cylinder = require("trimesh", "plot").creation.cylinder
    rod = solid(cylinder(1.0, 1.0, sections=_TUBE_SIDES), GREY)
    return rod.vertices, rod.normals


def draw_hands(
    axes: Axes,
    triangles: Triangles,
    camera: Camera,
    *,
    marks: Triangles | None = None,
    supersampling: int = 2,
) -> None:
    """Draw hands into an axes, whose coordinates become the camera's pixels.

    Draw everything in one call, so that hands occlude one another correctly.

    Args:
        axes: The axes; its frame and ticks are removed.
        triangles: All solid parts, combined with `merged`.
        camera: The camera; see `Camera.framing`.
        marks: `spheres` and `tube`s that stay visible behind solid parts.
        supersampling: Samples per pixel along each side.
    """
    image = render(triangles, camera, marks=marks, supersampling=supersampling)
    width, height = camera.size
    axes.imshow(image, extent=(0.0, width, height, 0.0), interpolation="antialiased")
    pixel_axes(axes, camera)


def pixel_axes(axes: Axes, camera: Camera) -> None:
    """Let the coordinates of an axes be a camera's pixels, and remove its frame and ticks."""
    width, height = camera.size
    axes.set_xlim(0.0, width)
    axes.set_ylim(height, 0.0)
    axes.set_aspect("equal")
    axes.set_axis_off()


def require_matplotlib() -> ModuleType:
    """Import matplotlib.

    Raises:
        MissingExtraError: If it is not installed.
    """
    return require("matplotlib", "plot")


def require_drawing() -> None:
    """Check, before any work, that hands can be drawn.

    Raises:
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    require_matplotlib()
    require("trimesh", "plot")


def save_panels(
    path: Path,
    title: str,
    size: tuple[int, int],
    panels: Mapping[str, Callable[[Axes], None]],
) -> None:
    """Draw panels side by side under a title into the file that `--picture` names.

    Args:
        path: The file.
        title: The title.
        size: Width and height of a panel [pixel].
        panels: What draws each panel, by its caption.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib is not installed.
    """
    width, height = size
    share = 1.0 / len(panels)
    inches = 0.01 * width / share, 0.01 * (height + _TITLE)
    figure = require("matplotlib.figure", "plot").Figure(
        inches, dpi=100, facecolor="white"
    )
    for i, (caption, draw) in enumerate(panels.items()):
        axes = figure.add_axes((i * share, 0.0, share, height / (height + _TITLE)))
        draw(axes)
        axes.text(0.5 * width, 13, caption, ha="center", va="top", color="0.35")
    figure.text(0.5, 0.975, title, ha="center", va="center", fontsize=12)
    save_picture(figure, path)


def save_picture(figure: Figure, path: Path) -> None:
    """Write a figure into the file that `--picture` names.

    Args:
        figure: The figure.
        path: The file; its suffix names the format.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    try:
        figure.savefig(path)
    except (OSError, ValueError) as error:
        raise InvalidInputError(
            f"cannot write {path}: {error}", argument="--picture", value=str(path)
        ) from error


def _drawn(meshes: list[Any], colour: Colour) -> Triangles:
    """Simplify a shape's meshes, and turn faces outwards, or to both sides of an open one."""
    trimesh = require("trimesh", "plot")
    bare = [trimesh.Trimesh(mesh.vertices, mesh.faces) for mesh in meshes]
    mesh = trimesh.util.concatenate(bare)
    mesh.merge_vertices()
    coarse = simplified(mesh)
    is_closed = mesh.is_watertight and mesh.is_winding_consistent
    if not is_closed or mesh.volume < 0.0:
        inverse = coarse.copy()
        inverse.invert()
        coarse = inverse if is_closed else trimesh.util.concatenate(coarse, inverse)
    return solid(coarse, colour)


def simplified(mesh: Any, most: int = MAX_MESH_TRIANGLES) -> Any:
    """Merge a mesh's vertices in each cell of the finest grid that gives few triangles.

    Args:
        mesh: A mesh of trimesh.
        most: Most triangles; a mesh that has no more is returned as it is.
    """
    coarse = mesh
    cells = _MOST_CELLS / mesh.extents.max()
    while len(coarse.faces) > most:
        coarse = mesh.copy()
        coarse.apply_scale(cells)
        # Vertices of one cell are the same without digits behind the point.
        coarse.merge_vertices(digits_vertex=0)
        coarse.update_faces(coarse.nondegenerate_faces())
        coarse.apply_scale(1.0 / cells)
        cells *= 0.85
    return coarse
