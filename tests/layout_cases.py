"""Wrist poses as trackers give them, for tests of layouts."""

from __future__ import annotations

import numpy as np

from handmap_qp.hands.spec import Side
from handmap_qp.trackers.layouts.base import Layout, from_own_axes


def wrist_beside(layout: Layout, wrist: np.ndarray, side: Side) -> np.ndarray | None:
    """Return a wrist pose (4, 4) in the tracker's own axes and unit, as `Layout.read` takes it.

    None for a tracker that has none beside its values.
    """
    table = layout.wrist_table
    if table is None or layout.has_wrist:
        return None
    axes = table.axes(side)
    return from_own_axes(wrist[None], axes, layout.table.reflection, layout._length)[0]
