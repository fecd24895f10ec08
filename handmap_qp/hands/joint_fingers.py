"""Which finger a joint belongs to."""

import numpy as np

from .hand import Hand, moved_by


def finger_by_joint(hand: Hand) -> dict[str, str]:
    """Return the finger of each joint that moves points of one finger alone, by their names.

    Joints that follow others count too; those of a wrist, an arm or a palm have no finger.

    Args:
        hand: The hand.
    """
    moves = moved_by(hand.model, [frame.parentJoint for frame in hand.point_frames])
    of_point = np.array([str(point.finger or "") for point in hand.reference_points])
    found = {}
    for joint in hand.model.joints[1:]:
        fingers = {*of_point[moves[:, joint.idx_v] > 0].tolist()}
        if len(fingers) == 1 and "" not in fingers:
            found[hand.model.names[joint.id]] = fingers.pop()
    return found
