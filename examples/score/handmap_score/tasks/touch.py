"""How a hand touches a thing: forces by finger, and why a grip failed."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from handmap_qp.hands import Hand
from handmap_qp.mapping import robot_fingers

PALM = "palm"
"""Name of all links that belong to no finger."""
LIFTED = 0.01
"""Height above its place from which an object counts as lifted [m]."""
_PRESSED = 0.2  # force with which a finger counts as pressing [N]
_PUSHED = 0.01  # displacement between first and second touch that counts as pushing [m]
_SQUEEZED = 0.2  # time of a grip below which the object was squeezed out at once [s]
_BESIDE_MIDDLE = 0.015  # distance of the object's middle from the line of the pads [m]
_EPISODE = 0.1  # time without touch that ends an episode [s]


@dataclass(frozen=True, slots=True)
class Touch:
    """How the hand touches the object at one instant, for the cause of a failure.

    Attributes:
        time: The instant [s].
        thumb: Normal force of the thumb's links [N].
        others: Normal force of all other links [N].
        beside: Distance of the object's middle from the line through both pads [m].
        moved: Distance of the object from where the attempt began, in the plane of the table [m].
        height: Height of the object above its place [m].
    """

    time: float
    thumb: float
    others: float
    beside: float
    moved: float
    height: float

    @property
    def is_touched(self) -> bool:
        """Whether any link touches."""
        return self.thumb > 0.0 or self.others > 0.0

    @property
    def is_pinched(self) -> bool:
        """Whether thumb and another link press."""
        return min(self.thumb, self.others) > _PRESSED

    @property
    def is_lifted(self) -> bool:
        """Whether it is pinched and off its place."""
        return self.is_pinched and self.height > LIFTED


class Contacts:
    """Normal forces between bodies of a model and the links of a hand.

    Args:
        model: The model.
        hand: The hand; the bodies of its links bear the names of its joints.
        touched: Names of the bodies that are touched.
    """

    def __init__(
        self, model: mujoco.MjModel, hand: Hand, touched: Sequence[str]
    ) -> None:
        self._model = model
        bodies = [model.body(body).name for body in model.geom_bodyid.tolist()]
        finger_of = fingers_of_links(hand)
        links = {*hand.model.names[1:]}
        self._is_touched = np.array([body in touched for body in bodies])
        # Links that are fixed to the world belong to a hand without a floating wrist.
        self._is_hand = np.array([body in links for body in bodies])
        self._bodies = bodies
        self._finger_of = finger_of
        self._force = np.zeros(6)

    def by_link(self, data: mujoco.MjData) -> dict[str, float]:
        """Return the normal force of each link that touches [N], by the link's joint."""
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
    is_in_hand = course[-1].is_touched
    return "gripped, not put down" if is_in_hand else "gripped, then slipped out"


def cause_of_no_grip(course: Sequence[Touch]) -> str:
    """Return why an object was not lifted, by forces and places in the last try that touched it.

    Args:
        course: Every step of the attempt, in order.
    """
    episodes = _episodes(course)
    if not episodes:
        return "never touched"
    episode = episodes[-1]
    first = episode[0]
    thumb = next((one for one in episode if one.thumb > 0.0), None)
    other = next((one for one in episode if one.others > 0.0), None)
    pushed = max(one.moved for one in episode) - first.moved
    if thumb is None or other is None:
        if pushed > _PUSHED:
            return f"{'the thumb' if other is None else 'a finger'} pushed it away"
        return "touched by one side" if thumb is None else "no finger arrived"
    second = max(thumb, other, key=lambda one: one.time)
    if abs(second.moved - first.moved) > _PUSHED:
        return (
            f"{'the thumb' if thumb.time < other.time else 'a finger'} pushed it away"
        )
    grip = [one for one in episode if one.is_pinched]
    duration = len(grip) * _step_of(course)
    if duration < _SQUEEZED - 1e-9:
        return "squeezed out at once"
    beside = float(np.median([one.beside for one in grip]))
    if beside > _BESIDE_MIDDLE:
        return "pads pressed beside the middle"
    return "gripped, not lifted"


def _step_of(course: Sequence[Touch]) -> float:
    """Return the time between two steps of a course [s]."""
    return course[1].time - course[0].time if len(course) > 1 else 0.0


def _episodes(course: Sequence[Touch]) -> list[list[Touch]]:
    """Return the stretches in which the object is touched, with short breaks."""
    episodes: list[list[Touch]] = []
    last = -math.inf
    for one in course:
        if not one.is_touched:
            continue
        if one.time - last > _EPISODE:
            episodes.append([])
        episodes[-1].append(one)
        last = one.time
    return episodes
