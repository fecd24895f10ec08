"""What the fingers of a simulated hand feel: `finger_forces`."""

from handmap_qp.hands import finger_by_joint
from .simulator import Simulator


def finger_forces(simulator: Simulator) -> dict[str, float]:
    """Return the normal force of each finger on the object [N]; 0 where it does not touch.

    Contacts of the palm belong to no finger.

    Args:
        simulator: The simulation, now.
    """
    fingers = finger_by_joint(simulator.hand)
    forces = dict.fromkeys(fingers.values(), 0.0)
    for joint, force in simulator.pressing().items():
        if joint in fingers:
            forces[fingers[joint]] += float(force)
    return forces
