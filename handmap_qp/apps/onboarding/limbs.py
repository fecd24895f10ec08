"""Which chains of a robot are no fingers by their names, and which names are those of a hand.

Casters, toes, the arms of a trunk and the screw of a gripper branch like fingers.
"""

import re
from collections.abc import Iterable, Sequence

# Parts of a body beside its hands; short words only by themselves.
_LIMB = re.compile(
    r"""shoulder | elbow | knee | ankle | scapula | clavicle | vertebra | pelvis | mandib
    | caster | castor | wheel | roller | antenna | rostrum | propell
    | (?<![a-z]) (?: hip | toes? | leg | legs | foot | feet | paw | neck | tail | wing ) (?![a-z])
    """,
    re.VERBOSE | re.IGNORECASE,
)
# What turns or slides by itself to drive others.
_DRIVE = re.compile("screw|spindle|pulley|gear_?box", re.IGNORECASE)
# Joints of a neck, and of what it carries.
_HEAD = re.compile("head|neck|eye|camera|lidar|velodyne", re.IGNORECASE)
_HAND = re.compile("hand|palm|grip|finger|thumb|claw|jaw|fngr|carpal", re.IGNORECASE)


def is_limb(joints: Sequence[str], endless: Iterable[str]) -> bool:
    """Return whether a chain of joints is no finger: a limb, a wheel, a caster, a head or a drive.

    Args:
        joints: Names of its movable joints, outwards.
        endless: Joints that turn without end.
    """
    first, *more = joints
    # A wheel, or one on a swivel.
    is_wheel = len(more) < 2 and {*joints} <= {*endless}
    is_drive = not more and bool(_DRIVE.search(first))
    is_head = bool(_HEAD.search(first))
    return is_wheel or is_drive or is_head or any(map(_LIMB.search, joints))


def names_hand(names: Iterable[str]) -> bool:
    """Return whether a name is that of a hand, a gripper or a part of one."""
    return any(map(_HAND.search, names))
