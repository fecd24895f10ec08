"""From targets to motion: options, limits, the gate, and the terms of the QP."""

from .gate import Gate
from .motion import (
    BEHIND,
    LONGEST_STEP,
    SHORTEST_DT,
    Instant,
    Motion,
    When,
)
from .options import (
    LENGTH_UNIT,
    IkOptions,
)
from .result import (
    WRIST_LEVERS,
    IkResult,
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
    "PointOffset",
    "Status",
    "Task",
    "TaskRows",
    "When",
    "result_of",
    "wrist_error",
]
