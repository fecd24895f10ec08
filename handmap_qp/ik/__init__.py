"""From targets to motion: a QP with limits."""

from . import collision, gate
from .collision import pair_bounds
from .gate import Gate
from .motion import BEHIND, LONGEST_STEP, SHORTEST_DT, Instant, Motion, When
from .options import LENGTH_UNIT, IkOptions
from .qp import (
    WRIST_LEVERS,
    IkResult,
    PointIk,
    Status,
    result_of,
    solve_by_daqp,
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
    "gate",
    "pair_bounds",
    "result_of",
    "solve_by_daqp",
    "wrist_error",
]
