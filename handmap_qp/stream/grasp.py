"""Which robot hands can grip, with which fingers, and by which presets."""

from __future__ import annotations

from handmap_core.hands import GraspFinger
from handmap_core.stream import hand_grip
from handmap_qp.hands import THUMB, Hand, Names
from handmap_qp.mapping import PRESETS, HandMapper, TargetSource, robot_fingers
from handmap_qp.mapping.methods.teleoperation import Teleoperation


def grasp_fingers(robot: Hand) -> tuple[GraspFinger, ...]:
    """Return what grips of a robot hand, the thumb first; nothing if it has no thumb or jaws."""
    if not has_grasp(robot):
        return ()
    fingers = robot_fingers(robot)
    return tuple(
        GraspFinger(fingers.pads[name], finger.columns, finger.is_jaw)
        for name, finger in fingers.used.items()
    )


def has_grasp(robot: Hand) -> bool:
    """Return whether a robot hand has a thumb and a finger, or two jaws."""
    # Without its pads, which are found on meshes: most hands that are asked about never grip.
    names = robot_fingers(robot).names
    return THUMB in names and len(names) > 1


def can_grip(source: TargetSource | HandMapper) -> bool:
    """Return whether a `GripFollower` can hold what the robot hand of a source or mapper meets."""
    own = source.source if isinstance(source, HandMapper) else source
    return hand_grip.has_pinches(own) and has_grasp(own.robot)


def gripping_presets() -> Names:
    """Return the names of the presets by which a `GripFollower` can hold things."""
    return tuple(
        name
        for name, preset in PRESETS.items()
        if isinstance(preset.method, Teleoperation)
    )
