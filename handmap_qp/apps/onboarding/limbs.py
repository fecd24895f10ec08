"""What speaks for a chain as a finger and for a body as a palm: names, lengths, what carries it.

Casters, toes, the arms of a trunk, the parts of a mouth and the screw of a gripper branch like
fingers. Each kind of evidence has a weight, so that one name alone decides nothing.
"""

import re
from collections.abc import Iterable, Sequence

LONGEST_FINGER = 0.3
"""A longer branch is a leg or an arm, unless it is named as a finger [m]."""
# No finger is longer, whatever its name [m].
_LONGEST = 0.5
# What is said for a chain as a finger: by its length, its own name, and those of other parts.
_SHORT = 1.0
_LONG = -1.0
_ARM = -3.0
_FINGER_NAME = 2.0
_LIMB_NAME = -2.0
_WHEEL = -4.0
# What is said for a body as a palm: that chains like fingers branch from it, names, and what
# carries it.
_BRANCHES = 1.0
_NAMED = 3.0
_ON_ARM = 1.0
_ON_LEG = -1.5
_ON_HEAD = -2.0
# Parts of a body beside its hands; short words only by themselves.
_LIMB = re.compile(
    r"""shoulder | elbow | knee | ankle | scapula | clavicle | vertebra | pelvis | mandib
    | thigh | coxa | femur | tibia | tarsus | labrum | haltere
    | caster | castor | wheel | roller | antenna | rostrum | propell
    | (?<![a-z]) (?: hip | toes? | leg | legs | foot | feet | paw | neck | tail | wing ) (?![a-z])
    """,
    re.VERBOSE | re.IGNORECASE,
)
# What turns or slides by itself to drive others.
_DRIVE = re.compile("screw|spindle|pulley|gear_?box", re.IGNORECASE)
# Joints of a neck, and of what it carries.
_HEAD = re.compile("head|neck|eye|camera|lidar|velodyne", re.IGNORECASE)
# A finger by its own name.
_FINGER = re.compile("finger|thumb|digit|fngr", re.IGNORECASE)
# What carries a hand, and what does not.
_WRIST = re.compile("wrist|forearm", re.IGNORECASE)
_ARM_PART = re.compile(
    f"shoulder|elbow|{_WRIST.pattern}|(?<![a-z])arm(?![a-z])", re.IGNORECASE
)
_LEG_PART = re.compile(
    r"""knee | ankle | thigh | calf | coxa | femur | tibia | tarsus
    | (?<![a-z]) (?: hip | leg | foot ) (?![a-z])""",
    re.VERBOSE | re.IGNORECASE,
)
_HEAD_PART = re.compile("(?<![a-z])(?:head|neck|rostrum|snout)", re.IGNORECASE)
_HAND = re.compile("hand|palm|grip|finger|thumb|claw|jaw|fngr|carpal", re.IGNORECASE)


def finger_evidence(
    joints: Sequence[str], endless: Iterable[str], length: float
) -> float:
    """Return how much speaks for a chain as a finger; it is none below zero.

    Names of fingers outweigh a length that is more like a leg's, or the name of a limb, but not
    both. A wheel is no finger whatever it is called.

    Args:
        joints: Names of its movable joints, outwards.
        endless: Joints that turn without end.
        length: Its length [m].
    """
    first, *more = joints
    # A wheel, or one on a swivel.
    is_wheel = len(more) < 2 and {*joints} <= {*endless}
    is_drive = not more and bool(_DRIVE.search(first))
    is_limb = is_drive or bool(_HEAD.search(first)) or any(map(_LIMB.search, joints))
    size = _SHORT if length < LONGEST_FINGER else _LONG if length < _LONGEST else _ARM
    named = _FINGER_NAME * all(map(_FINGER.search, joints))
    return size + named + _LIMB_NAME * is_limb + _WHEEL * is_wheel


def palm_evidence(names: Iterable[str], above: Iterable[str]) -> float:
    """Return how much speaks for a body as a palm; it is none below zero.

    Args:
        names: Names of its links, and of the joints and links of its fingers.
        above: Names of the joints that carry it.
    """
    above = [*above]
    terms = (
        (_NAMED, names_hand(names)),
        (_ON_ARM, any(map(_ARM_PART.search, above))),
        (_ON_LEG, any(map(_LEG_PART.search, above))),
        (_ON_HEAD, any(map(_HEAD_PART.search, above))),
    )
    return _BRANCHES + sum(weight for weight, holds in terms if holds)


def names_other_part(joint: str) -> bool:
    """Return whether a joint is named as one of a wrist, a leg or a head, and not of a gripper.

    That it is a part of an arm says nothing: grippers are called so, too (`arm_f1x` of Spot).
    """
    parts = (_WRIST, _LEG_PART, _HEAD, _LIMB)
    return not _HAND.search(joint) and any(part.search(joint) for part in parts)


def names_hand(names: Iterable[str]) -> bool:
    """Return whether a name is that of a hand, a gripper or a part of one."""
    return any(map(_HAND.search, names))
