"""Move a hand to measure how it responds to commands: `handmap calibrate-actuators`."""

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands import Hand
from .driver import check_places
from .joints import Progress, free_groups, free_spans, measure_joints
from .motion import Motion
from .pinches import meet, plan_pinches, with_encoders
from .space import EXACT, Space
from .tuning import Compensated, Tuning


def find_tuning(
    motion: Motion, hand: Hand, progress: Progress = lambda *_: None
) -> Tuning:
    """Move a hand for two minutes, and return what it makes of its commands.

    Args:
        motion: Its motors.
        hand: The hand, with a fixed wrist.
        progress: Called with how much is done [%], and what is.

    Raises:
        InvalidInputError: If a joint is where it cannot be, or fingers are in the way of each
            other.
        DriverError: If motors do not answer or report a fault, or a joint does not do what joints
            do.
    """
    driver = motion.driver
    space = Space(hand, driver)
    spans = free_spans(space)
    groups = free_groups(space, spans)
    # Not before: while this was planned, the hand may have been moved.
    motion.start()
    check_places(motion.goal, driver.joint_names, space.limits)
    expect(
        space.is_free(np.clip(motion.goal, *space.limits), space.home, EXACT),
        "HAND",
        "fingers whose way to the open hand is free",
        advice="open the hand while it has no torque",
    )
    joints = measure_joints(motion, space, spans, groups, progress)
    rough = Tuning.of(driver.joint_names, joints, {})
    # Motors that hear nothing for a moment may lose their torque, and begin where they are then.
    motion.stop()
    pinches = plan_pinches(space, rough, motion.effort)
    motion.start(Compensated(driver, rough, space.weights))
    met = meet(motion, space, joints, pinches, progress)
    joints, off = with_encoders(space, joints, met)
    return Tuning.of(driver.joint_names, joints, off)
