"""Wrist poses as trackers give them, for tests of layouts."""

from __future__ import annotations

import numpy as np

from handmap_qp.hands import Side
from handmap_qp.trackers.layouts.base import Layout


def wrist_beside(layout: Layout, wrist: np.ndarray, side: Side) -> np.ndarray | None:
    """Return a wrist pose (4, 4) in the tracker's own axes and unit, as `Layout.read` takes it.

    None for a tracker that has none beside its values.
    """
    if layout.wrist is None or layout.has_wrist:
        return None
    world, axes = np.linalg.inv([layout.world, layout.wrist_axes(side)])
    return world @ wrist @ axes
