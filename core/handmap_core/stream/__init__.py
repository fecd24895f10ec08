"""What a stream of samples makes of the robot: checks and tables that need no mapper."""

from .following import FollowingCheck
from .guard import (
    FROZEN_AFTER,
    GAP,
    SETTLING,
    ArrivalCredit,
    SampleClock,
    StreamGuard,
)
from .smoothing import (
    SMOOTH_IK,
    Smoothing,
)
from .step_table import (
    RULE_NAMES,
    STATUS_NAMES,
    StepTable,
)

__all__ = [
    "FROZEN_AFTER",
    "GAP",
    "RULE_NAMES",
    "SETTLING",
    "SMOOTH_IK",
    "STATUS_NAMES",
    "ArrivalCredit",
    "FollowingCheck",
    "SampleClock",
    "Smoothing",
    "StepTable",
    "StreamGuard",
]
