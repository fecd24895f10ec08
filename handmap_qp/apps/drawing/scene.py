"""A picture of a solid with arrows, and with points whose names stand at its edges."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from handmap_core.se3 import Array, lengths
from .hands import draw_hands, spheres
from .raster import Camera, Colour, Triangles, merged

PANEL = (760, 820)
"""Width and height of a picture [pixel]."""
# Radius of a marked point, in lengths of the hand.
_MARK = 0.022
_ELEVATION = 12.0
_BOX = {
    "facecolor": "white",
    "alpha": 0.75,
    "edgecolor": "none",
    "boxstyle": "round,pad=0.15",
}


class Scene(NamedTuple):
    """What a picture shows.

    Attributes:
        triangles: Solid parts.
        arrows: Start and end [m], label and colour of each arrow.
        points: Points [m], shape (m, 3).
        labels: The name and the colour of each point.
    """

    triangles: Triangles
    arrows: list[tuple[Array, Array, str, Colour]]
    points: Array = np.zeros((0, 3))
    labels: Sequence[tuple[str, Colour]] = ()

    def draw(self, axes: Any, azimuth: float) -> None:
        """Draw one view into a matplotlib axes."""
        corners = self.triangles.vertices.reshape(-1, 3)
        ends = np.reshape([end for _, end, *_ in self.arrows], (-1, 3))
        # The margin leaves room for labels on both sides.
        camera = Camera.framing(
            np.vstack([corners, self.points, ends]),
            PANEL,
            azimuth=azimuth,
            elevation=_ELEVATION,
            margin=0.13 if self.labels else 0.04,
        )
        marks = [
            spheres(point, _MARK * lengths(self.points).max(), colour)
            for point, (_, colour) in zip(self.points, self.labels, strict=True)
        ]
        draw_hands(axes, self.triangles, camera, marks=merged(marks))
        write = partial(axes.annotate, va="center", fontsize=10, bbox=_BOX)
        # The first ones, the palm's axes, lie over the others.
        for start, end, label, colour in reversed(self.arrows):
            tail, head = camera.project(np.array([start, end]))[:, :2]
            write(
                label,
                xy=tail,
                xytext=head,
                ha="center",
                color=colour,
                arrowprops={"arrowstyle": "<-", "color": colour, "linewidth": 2.5},
            )
        # The points' names are at the panel's edges, each with a line to its point.
        places = camera.project(self.points)[:, :2]
        order = np.argsort(places[:, 1])
        is_right = places[:, 0] > 0.5 * PANEL[0]
        for side, edge in ((is_right, PANEL[0] - 8), (~is_right, 8)):
            chosen = order[side[order]]
            # At least this far apart [pixel], and inside the panel if they fit.
            steps = 24.0 * np.arange(len(chosen))
            heights = np.maximum.accumulate(places[chosen, 1] - steps) + steps
            excess = max(0.0, heights.max(initial=0.0) - PANEL[1] + 20.0)
            for i, height in zip(chosen, heights - excess, strict=True):
                name, colour = self.labels[i]
                write(
                    name,
                    xy=places[i],
                    xytext=(edge, height),
                    ha="right" if edge > 8 else "left",
                    color=colour,
                    arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.8},
                )
