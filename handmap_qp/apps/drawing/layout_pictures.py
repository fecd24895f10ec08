"""Draw the convention of a tracker's layout: indices on both hands, and axes of the wrists."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands import HUMAN_JOINTS, Hand, Side, Values
from handmap_qp.se3 import Array, lengths, transform_points, unit
from handmap_qp.trackers import (
    SIDES,
    AngleLayout,
    Layout,
    MarkerLayout,
    PointLayout,
    sized_human,
)
from .hands import (
    AXIS_COLOURS,
    HUMAN_COLOUR,
    UPRIGHT,
    draw_hands,
    load_shape,
    save_panels,
)
from .raster import Camera

_PANEL = (430, 500)
_SKIN = (0.93, 0.80, 0.72)
_OTHER = (0.55, 0.57, 0.60)
_AXIS_LENGTH = 0.045  # m
_ARROW = {"arrowstyle": "-|>", "lw": 2.2, "shrinkA": 0, "shrinkB": 0}
_OUT = {1.0: " (out of the back)", -1.0: " (out of the palm)"}
# Abduction of the fingers in the picture [rad].
_SPREADS = (0.75, 0.16, 0.02, -0.12, -0.28)
# Joints of the forearm that lie farther from the wrist are left out [m].
_FARTHEST = 0.12
_Entries = tuple[Array, Sequence[object] | Array, Array]
"""Places [m], their indices, and whether they are landmarks."""


def save_layout_picture(layout: Layout, path: Path) -> None:
    """Draw a left and a right hand from the back, fingers up, with the layout's indices.

    Blue dots are landmarks, grey ones are not used. Arrows are the wrist's own axes, where the
    layout says which they are.

    Args:
        layout: The layout.
        path: Picture to write (.png).

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    panels = {
        f"{side} hand, from its back": partial(_draw_side, layout, side)
        for side in SIDES
    }
    title = f"{layout.name}: {layout.title} ({layout.unit})"
    save_panels(path, title, _PANEL, panels)


def _draw_side(layout: Layout, side: Side, axes: Any) -> None:
    human = sized_human(side)
    # Spread fingers, so that indices do not cover one another.
    q = 0.25 * human.rest
    # Abduction is the first of a finger's four joints.
    q[::4] = _SPREADS
    q = np.clip(q, *human.limits)
    solid = load_shape(human, colour=_SKIN).triangles(q).moved(UPRIGHT)
    points, labels, is_used = _entries(layout, human, q)
    directions = _wrist_axes(layout, side)
    # The wrist, the ends of its axes, and the entries.
    marks = np.vstack([np.zeros(3), _AXIS_LENGTH * directions, points])
    places = transform_points(UPRIGHT, marks)
    around = np.vstack([solid.vertices.reshape(-1, 3), places])
    camera = Camera.framing(around, _PANEL, azimuth=90.0, elevation=14.0, margin=0.07)
    draw_hands(axes, solid, camera)
    pixels = camera.project(places)[:, :2]
    _draw_axes(axes, pixels[:4], directions)
    shown = pixels[4:]
    colours = np.where(is_used[:, None], HUMAN_COLOUR, _OTHER)
    sizes = np.where(is_used, 34.0, 16.0)
    axes.scatter(
        *shown.T, s=sizes, c=colours, edgecolors="white", linewidths=0.8, zorder=3
    )
    # Landmarks have room at their right. Joints between wrist and knuckles stand close together,
    # so their labels are turned and go below.
    for (x, y), label, is_own in zip(shown, labels, is_used, strict=True):
        text = axes.text(x + 6, y - 6, label, zorder=5, **_halo())
        text.set(fontsize=8, color="0.1")
        if not is_own:
            text.set(x=x + 1, y=y + 6, fontsize=7, color="0.35")
            text.set(rotation=90, ha="center", va="top")


def _draw_axes(axes: Any, pixels: Array, directions: Array) -> None:
    """Draw the wrist's axes as arrows, by the pixels of the wrist and of their ends, (4, 2)."""
    origin, *ends = pixels
    for (x, y), direction, name, colour in zip(
        ends, directions, "xyz", AXIS_COLOURS, strict=True
    ):
        if direction.any():
            arrow = _ARROW | {"color": colour}
            axes.annotate("", xy=(x, y), xytext=origin, arrowprops=arrow, zorder=4)
            text = name + _OUT.get(direction[2].round(6), "")
            axes.text(
                x + 5, y + 11, text, color=colour, fontsize=9, zorder=6, **_halo()
            )


def _halo() -> Values:
    from matplotlib import patheffects

    return {"path_effects": [patheffects.withStroke(linewidth=2.5, foreground="white")]}


def _entries(layout: Layout, human: Hand, q: Array) -> _Entries:
    """Return what the layout shows on a hand."""
    if isinstance(layout, AngleLayout):
        # Two of a finger's angles share its first joint.
        indices: dict[int, list[str]] = {}
        for i, entry in enumerate(layout.angles):
            finger, k = divmod(HUMAN_JOINTS.index(entry.joint), 4)
            indices.setdefault(1 + 4 * finger + max(0, k - 1), []).append(f"{i}")
        labels = [*map(", ".join, indices.values())]
        return human.points(q)[[*indices]], labels, np.full(len(labels), True)
    if not isinstance(layout, PointLayout | MarkerLayout):
        expected = "points, angles or markers"
        raise InvalidInputError(argument="layout", expected=expected, value=layout)
    written = layout.write_posture(human, q, np.eye(4))
    # Rows are points, poses, or a position and a quaternion.
    read = written[:, :3, 3] if written.ndim == 3 else written[:, :3]
    places = transform_points(layout.world, read)
    index = np.arange(len(places))
    if isinstance(layout, MarkerLayout):
        return places, index, index >= 0
    if layout.is_relative:
        places = transform_points(np.linalg.inv(layout.wrist_axes(human.side)), read)
    is_used = np.isin(index, layout.order(human.side))
    is_between = np.isin(index, [*layout.between])
    shown = np.flatnonzero(is_used | is_between & (lengths(places) < _FARTHEST))
    return places[shown], shown, is_used[shown]


def _wrist_axes(layout: Layout, side: Side) -> Array:
    """Return the wrist's x, y and z axes in our wrist frame, shape (3, 3); zeros if unknown."""
    if layout.wrist is None:
        return np.eye(3) * isinstance(layout, MarkerLayout)
    # Axes of left-handed data point where the data says, mirrored into the right-handed world.
    return unit(layout.wrist_axes(side)[:3, :3].T).T
