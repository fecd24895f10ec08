"""From targets to motion: a QP with limits."""

from . import collision, compiled, gate
from .collision import pair_bounds
from .compiled import core_tree
from .gate import Gate
from .motion import BEHIND, LONGEST_STEP, SHORTEST_DT, Instant, Motion, When
from .options import LENGTH_UNIT, IkOptions
from .qp import (
    WRIST_LEVERS,
    IkResult,
    PointIk,
    Status,
    result_of,
    wrist_error,
)
from .tasks import (
    AttachedPoints,
    JointPositions,
    PointDistances,
    PointOffset,
    Task,
    TaskRows,
)

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
    "compiled",
    "core_tree",
    "gate",
    "pair_bounds",
    "result_of",
    "wrist_error",
]
