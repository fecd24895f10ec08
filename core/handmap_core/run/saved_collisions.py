"""`SavedCollisions`: pairs of shapes that a saved robot keeps apart."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING

from handmap_core.core import core
from handmap_core.hands import Names
from handmap_core.ik.gate import moving_columns
from handmap_core.models import CollisionModel, encode
from handmap_core.se3 import Array
from .records import CollisionsRecord

if TYPE_CHECKING:
    from handmap_core import _core


class SavedPairs:
    """What never changes of the pairs; see `PairBounds`.

    Args:
        record: What was saved.
    """

    def __init__(self, record: CollisionsRecord) -> None:
        self._record = record

    def __copy__(self) -> SavedPairs:
        """Return itself: they never change."""
        return self

    def __deepcopy__(self, memo: object) -> SavedPairs:
        """Return itself: they never change."""
        return self

    def __reduce__(self) -> tuple[type[SavedPairs], tuple[CollisionsRecord]]:
        """Make them again from the record in another process."""
        return type(self), (self._record,)

    @cached_property
    def core(self) -> _core.PairBounds:
        """The core's own."""
        return core.PairBounds(encode(self._record.pairs))

    @property
    def links(self) -> tuple[Names, ...]:
        """Links of both shapes of each pair; at -1, there are none."""
        return self._record.links

    def moving_columns(self, spread: Array) -> Array:
        """Return which active coordinates move shapes against each other, shape (k,)."""
        return moving_columns(self._record.pairs.levers, spread)


class SavedCollisions:
    """Pairs of shapes that are kept apart, and how; see `Collisions`.

    Args:
        record: What was saved.

    Attributes:
        bounds: The pairs.
    """

    def __init__(self, record: CollisionsRecord) -> None:
        self._record = record
        self.bounds = SavedPairs(record)

    @property
    def model(self) -> CollisionModel:
        """How they are kept apart."""
        return self._record.model
