"""Pick and place of household objects on a table: `PickTask`.

The hand is to pick an object up and put it down in a tray of 16 cm beside it. Objects have
about the sizes of YCB's.
"""

from collections.abc import Sequence

import numpy as np

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.se3 import Array
from .household import HOUSEHOLD
from .table import TableTask
from .task import Signals
from .touch import cause_of_lost_grip, cause_of_no_grip

PICK = "pick"
"""Name of the task."""
TRAY = 0.08
"""The object is put down within this distance from the target, level with it [m]."""
_ON_TABLE = 0.03
"""An object whose middle is lower than this above its place is put down [m]."""


class PickTask(TableTask):
    """Pick one of the objects up, and put it down in the tray."""

    name = PICK
    things = HOUSEHOLD

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the attempt failed, by what happened in its last try."""
        return pick_cause(self.course)

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        to_target = pose[:2, 3] - self._target[:2, 3]
        is_there = float(np.linalg.norm(to_target)) < TRAY and touch.height < _ON_TABLE
        return self._has_lifted and is_there and not touch.is_touched


def pick_cause(course: Sequence[Touch]) -> str:
    """Return why an object was not put down in the tray, by forces and places.

    Args:
        course: Every step of the attempt, in order.
    """
    return cause_of_lost_grip(course) or cause_of_no_grip(course)
