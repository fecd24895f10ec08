"""Trails of fingertips: `Trail` draws where the tips of one hand have been."""

from __future__ import annotations

from collections import deque
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.viewer.figure import Colour, as_bytes

if TYPE_CHECKING:
    import viser

LENGTH = 4.0
"""A trail shows this time [s]."""
# Least time between two points of a trail [s].
_PERIOD = 1.0 / 30.0


class Trail:
    """The tips of one hand over the last seconds, in the coordinates of a figure's world.

    Args:
        server: A running viser server.
        path: Name of the node.
        colour: Colour of the lines.

    Attributes:
        points: Times [s], tips (n, 3) and the hand's centre (3,) [m], oldest first.
    """

    def __init__(self, server: viser.ViserServer, path: str, colour: Colour) -> None:
        self.points: deque[tuple[float, np.ndarray, np.ndarray]] = deque()
        self._lines = server.scene.add_line_segments(
            path,
            np.zeros((1, 2, 3), dtype=np.float32),
            as_bytes(colour),
            thickness=2.0,
            thickness_units="screen",
            visible=False,
        )

    def clear(self) -> None:
        """Forget the trail."""
        self.points.clear()
        self._lines.visible = False

    def add(self, time: float, tips: np.ndarray, centre: np.ndarray, *, is_pinned: bool) -> None:
        """Add where the tips are, and draw the trail.

        It starts again where time goes backwards or leaps.

        Args:
            time: Time of the sample [s].
            tips: Tips [m], shape (n, 3).
            centre: Centre of the hand [m], shape (3,).
            is_pinned: Whether the view keeps the centre in place: the trail then shows the tips'
                motion relative to it.
        """
        points = self.points
        if points and not 0.0 <= time - points[-1][0] < LENGTH:
            points.clear()
        if points and tips.shape != points[-1][1].shape:
            points.clear()
        if len(points) > 1 and time - points[-2][0] < _PERIOD:
            # Let the last point follow the hand until the next one is due.
            points.pop()
        points.append((time, tips, centre))
        while time - points[0][0] > LENGTH:
            points.popleft()
        places = np.array([tips - is_pinned * (then - centre) for _, tips, then in points])
        self._lines.visible = len(places) > 1
        if len(places) > 1:
            steps = np.stack([places[:-1], places[1:]], axis=2)
            self._lines.points = steps.reshape(-1, 2, 3).astype(np.float32)
