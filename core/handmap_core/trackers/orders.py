"""`KnownOrders`: orders that 21 landmarks may come in by mistake."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import permutations

import numpy as np

from handmap_core.core import core
from handmap_core.hands import FINGERS
from handmap_core.human import LANDMARK_COUNT
from handmap_core.se3 import Array


class KnownOrders:
    """Orders of landmarks: ours, those of layouts, and all orders of fingers; it never changes.

    Args:
        layouts: Index of each of our landmarks among those of a layout, shape (21,), by its name.

    Attributes:
        names: Names of the orders. Ours comes first, and has no name.
        indices: Indices of our landmarks among those that came, in each order, shape (21,).
        core: The orders as the core has them.
    """

    def __init__(self, layouts: Mapping[str, Array] | None = None) -> None:
        self._layouts = dict(layouts or {})
        own = np.arange(LANDMARK_COUNT)
        known = {"": own}
        for name, order in self._layouts.items():
            if (order != own).any():
                known[f"that of the layout {name}"] = order
        known["one with the wrist last"] = np.roll(own, 1)
        # The first one is our own again, which is never better.
        for fingers in permutations(FINGERS):
            chains = own[1:].reshape(-1, 4)[[*map(fingers.index, FINGERS)]]
            name = f"one with the fingers {', '.join(fingers)}"
            known[name] = np.array([0, *chains.ravel()])
        self.names = tuple(known)
        self.indices = tuple(known.values())
        self.core = core.LandmarkOrders([order.tolist() for order in known.values()])

    def __copy__(self) -> KnownOrders:
        """Return itself: it never changes."""
        return self

    def __deepcopy__(self, memo: object) -> KnownOrders:
        """Return itself: it never changes."""
        return self

    def __reduce__(self) -> tuple[type[KnownOrders], tuple[dict[str, Array]]]:
        """Build the same orders in another process."""
        return KnownOrders, (self._layouts,)
