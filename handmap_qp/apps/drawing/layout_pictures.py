"""Draw the convention of a tracker's layout: indices on both hands, and axes of the wrists."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from handmap_core.errors import InvalidInputError
from handmap_core.se3 import Array, lengths, transform_points, unit
from handmap_qp.hands import HUMAN_JOINTS, Hand, Side
from handmap_qp.trackers import (
    SIDES,
    AngleLayout,
    Layout,
    MarkerLayout,
    PointLayout,
    sized_human,
)
from .hands import AXIS_COLOURS, HUMAN_COLOUR, UPRIGHT, load_shape, save_panels
from .scene import PANEL, Scene

_SKIN = (0.93, 0.80, 0.72)
_OTHER = (0.55, 0.57, 0.60)
_AXIS_LENGTH = 0.045  # m
_OUT = {1.0: ", out of the back", -1.0: ", out of the palm"}
# Abduction of the fingers in the picture [rad].
_SPREADS = (0.75, 0.16, 0.02, -0.12, -0.28)
# Joints of the forearm that lie farther from the wrist are left out [m].
_FARTHEST = 0.12
_Entries = tuple[Array, Sequence[object] | Array, Array]
"""Places [m], their indices, and whether they are landmarks."""


def save_layout_picture(layout: Layout, path: Path) -> None:
    """Draw a left and a right hand from the back, fingers up, with the layout's indices.

    Blue points are landmarks, grey ones are not used. Arrows are the wrist's own axes, where the
    layout says which they are.

    Args:
        layout: The layout.
        path: Picture to write (.png).

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    scenes = {side: _scene(layout, side) for side in SIDES}
    panels = {
        f"{side} hand, from its back": partial(scene.draw, azimuth=90.0)
        for side, scene in scenes.items()
    }
    title = f"{layout.name}: {layout.title} ({layout.unit})"
    save_panels(path, title, PANEL, panels)


def _scene(layout: Layout, side: Side) -> Scene:
    human = sized_human(side)
    # Spread fingers, so that joints do not cover one another.
    q = 0.25 * human.rest
    # Abduction is the first of a finger's four joints.
    q[::4] = _SPREADS
    q = np.clip(q, *human.limits)
    points, indices, is_used = _entries(layout, human, q)
    colours = [HUMAN_COLOUR if used else _OTHER for used in is_used]
    directions = _wrist_axes(layout, side)
    ends = _AXIS_LENGTH * directions @ UPRIGHT[:3, :3].T
    words = [_OUT.get(height, "") for height in directions[:, 2].round(6)]
    names = map("".join, zip("xyz", words, strict=True))
    arrows = zip(np.zeros((3, 3)), ends, names, AXIS_COLOURS, strict=True)
    return Scene(
        load_shape(human, colour=_SKIN).triangles(q).moved(UPRIGHT),
        [arrow for arrow in arrows if arrow[1].any()],
        transform_points(UPRIGHT, points),
        [*zip(map(str, indices), colours, strict=True)],
    )


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
