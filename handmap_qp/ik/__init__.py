"""From targets to motion: a QP with limits."""

from handmap_core.ik import gate
from handmap_core.ik.gate import Gate
from handmap_core.ik.motion import (
    BEHIND,
    LONGEST_STEP,
    SHORTEST_DT,
    Instant,
    Motion,
    When,
)
from handmap_core.ik.options import LENGTH_UNIT, IkOptions
from handmap_core.ik.result import (
    WRIST_LEVERS,
    IkResult,
    Status,
    result_of,
    wrist_error,
)
from handmap_core.ik.tasks import (
    AttachedPoints,
    JointPositions,
    PointDistances,
    PointOffset,
    Task,
    TaskRows,
)
from . import collision
from .collision import pair_bounds
from .qp import PointIk

__all__ = [
    "BEHIND",
    "LENGTH_UNIT",
    "LONGEST_STEP",
    "SHORTEST_DT",
    "WRIST_LEVERS",
    "AttachedPoints",
    "Gate",
    "IkOptions",
    "IkResult",
    "Instant",
    "JointPositions",
    "Motion",
    "PointDistances",
    "PointIk",
    "PointOffset",
    "Status",
    "Task",
    "TaskRows",
    "When",
    "collision",
    "gate",
    "pair_bounds",
    "result_of",
    "wrist_error",
]
