"""The landmarks as the tracker gave them, as a figure beside the hands: `LandmarkFigure`."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.viewer.figure import Figure, Spheres, as_bytes

if TYPE_CHECKING:
    import viser

LANDMARK_COLOUR = (0.10, 0.52, 0.50)
_RADIUS = 0.0045
_THICKNESS = 3.0
_FINGERS = [(0, *range(first, first + 4)) for first in (1, 5, 9, 13, 17)]
BONES = np.array(
    [pair for chain in _FINGERS for pair in pairwise(chain)] + [(5, 9), (9, 13), (13, 17)]
)
"""Pairs of landmarks that a line joins, shape (n, 2)."""


class LandmarkFigure(Figure):
    """Landmarks and bones.

    Args:
        server: A running viser server.
        node: Name of its node.
    """

    def __init__(self, server: viser.ViserServer, node: str) -> None:
        super().__init__(server, node)
        self.name("landmarks")
        self._points = Spheres(server, f"/{node}/points", _RADIUS, LANDMARK_COLOUR)
        self._bones = server.scene.add_line_segments(
            f"/{node}/bones",
            np.zeros((len(BONES), 2, 3), dtype=np.float32),
            as_bytes(LANDMARK_COLOUR),
            thickness=_THICKNESS,
            thickness_units="screen",
        )

    def show(self, landmarks: np.ndarray | None) -> None:
        """Show landmarks (21, 3); hide those that are not known."""
        is_known = landmarks is not None and bool(np.isfinite(landmarks).all())
        self._points.move(landmarks if is_known else None)
        self._bones.visible = is_known
        if is_known and landmarks is not None:
            self._bones.points = landmarks[BONES].astype(np.float32)
