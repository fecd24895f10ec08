"""How a hand touches a thing: forces by finger, and why a grip failed."""

from collections.abc import Sequence

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Loss, Touch, loss_in_try, tries
from handmap_qp.hands import Hand
from handmap_qp.mapping import robot_fingers

PALM = "palm"
"""Name of all links that belong to no finger."""


class Contacts:
    """Normal forces between bodies of a model and the links of a hand.

    Args:
        model: The model.
        hand: The hand; the bodies of its links bear the names of its joints.
        touched: Names of the bodies that are touched.
        prefix: What the names of the hand's bodies begin with in the model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        hand: Hand,
        touched: Sequence[str],
        prefix: str = "",
    ) -> None:
        self._model = model
        bodies = [model.body(body).name for body in model.geom_bodyid.tolist()]
        of_links = fingers_of_links(hand)
        finger_of = {prefix + link: finger for link, finger in of_links.items()}
        links = {prefix + name for name in hand.model.names[1:]}
        self._is_touched = np.array([body in touched for body in bodies])
        # Links that are fixed to the world belong to a hand without a floating wrist.
        self._is_hand = np.array([body in links for body in bodies])
        self._bodies = bodies
        self._finger_of = finger_of
        self._force = np.zeros(6)

    def by_link(self, data: mujoco.MjData) -> dict[str, float]:
        """Return the normal force of each link that touches [N], by the name of its body."""
        contact = data.contact
        first, second = contact.geom.reshape(-1, 2).T
        forward = self._is_touched[first] & self._is_hand[second]
        backward = self._is_touched[second] & self._is_hand[first]
        is_touch = (forward | backward) & (contact.efc_address >= 0)
        found: dict[str, float] = {}
        for row in np.flatnonzero(is_touch).tolist():
            geom = second[row] if forward[row] else first[row]
            mujoco.mj_contactForce(self._model, data, row, self._force)
            link = self._bodies[geom]
            found[link] = found.get(link, 0.0) + float(self._force[0])
        return found

    def by_finger(self, forces: dict[str, float]) -> dict[str, float]:
        """Return the sum of links' forces for each finger that touches [N]."""
        found: dict[str, float] = {}
        for link, force in forces.items():
            finger = self._finger_of.get(link, PALM)
            found[finger] = found.get(finger, 0.0) + force
        return found


def fingers_of_links(hand: Hand) -> dict[str, str]:
    """Return the finger of each link, by the name of the joint that carries it."""
    names = hand.model.names
    return {
        names[joint]: finger
        for finger, chain in robot_fingers(hand).chains.items()
        for joint in chain.joints
    }


def cause_of_lost_grip(course: Sequence[Touch]) -> str:
    """Return why an object that was lifted is not where it should be; empty if it never was."""
    if not any(one.is_lifted for one in course):
        return ""
    return "gripped, not put down" if course[-1].is_touched else Loss.SLIPPED


def cause_of_no_grip(course: Sequence[Touch]) -> str:
    """Return why an object was not lifted, by forces and places in the last try that touched it.

    Args:
        course: Every step of the attempt, in order.
    """
    last = tries(course)[-1:]
    return loss_in_try(last[0] if last else ()) or "gripped, not lifted"
