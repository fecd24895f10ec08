"""The names of `trackers.layouts`: orders of landmarks that wrong input may be in."""

from typing import NamedTuple

from handmap_core.se3 import Array


class Layout(NamedTuple):
    """The order of a layout with 21 landmarks."""

    indices: Array

    @property
    def shapes(self) -> tuple[tuple[int, int], ...]:
        return ((len(self.indices), 3),)

    def order(self, side: str) -> Array:
        del side
        return self.indices


LAYOUTS: dict[str, Layout] = {}
"""By name: those that the last hand was saved with."""
