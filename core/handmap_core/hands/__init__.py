"""Hands, as far as what runs for every sample needs to know them."""

from .configuration import (
    AttachedPoints,
    Configuration,
    Frame,
    KinematicModel,
    PlacedHand,
    Pose,
    moved_by,
)
from .contact_yield import (
    ContactYield,
)
from .grasp import GraspFinger
from .hand import (
    Hand,
    Point,
    joints_at_limit,
)
from .names import (
    CONTACT_GAP,
    FINGERS,
    LINK_MARGIN,
    LONGEST_STOP,
    OTHER_SIDE,
    SIDES,
    THUMB,
    UPRIGHT,
    Names,
    Side,
    Values,
)
from .pad import (
    Pad,
    PadPair,
)
from .stiffness import (
    SLIDING_STIFFNESS,
    STIFFNESS,
)

__all__ = [
    "CONTACT_GAP",
    "FINGERS",
    "LINK_MARGIN",
    "LONGEST_STOP",
    "OTHER_SIDE",
    "SIDES",
    "SLIDING_STIFFNESS",
    "STIFFNESS",
    "THUMB",
    "UPRIGHT",
    "AttachedPoints",
    "Configuration",
    "ContactYield",
    "Frame",
    "GraspFinger",
    "Hand",
    "KinematicModel",
    "Names",
    "Pad",
    "PadPair",
    "PlacedHand",
    "Point",
    "Pose",
    "Side",
    "Values",
    "joints_at_limit",
    "moved_by",
]
