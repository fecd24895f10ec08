"""What a stream of samples makes of the robot: checks and tables that need no mapper."""

from .following import FollowingCheck
from .step_table import (
    RULE_NAMES,
    STATUS_NAMES,
    StepTable,
)

__all__ = [
    "RULE_NAMES",
    "STATUS_NAMES",
    "FollowingCheck",
    "StepTable",
]
