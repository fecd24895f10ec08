"""Places of a hand's pads, and whether they press on the object: `PadFinder`."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.fingers import THUMB, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.simulation.simulator import Simulator


class PadFinder:
    """Places of the pads of the thumb and of one finger.

    Args:
        hand: The hand.
        finger: The finger.

    Raises:
        InvalidInputError: If the hand has no such finger, or no thumb.
    """

    def __init__(self, hand: Hand, finger: str) -> None:
        chains = find_fingers(hand)
        if THUMB not in chains or finger not in chains:
            raise InvalidInputError(
                argument="robot",
                expected=f"a hand with {THUMB} and {finger}",
                got=f"{hand.name} with {', '.join(chains)}",
            )
        self.hand = hand
        found = find_pads(hand, {name: chains[name] for name in (THUMB, finger)})
        self.thumb, self.finger = found[THUMB], found[finger]
        self._data = hand.model.createData()

    def places(self, q: np.ndarray, wrist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the middles of both pads in the world [m], shape (3,) each."""
        vector = self.hand.configuration_vector(q, wrist if self.hand.is_floating else None)
        pin.forwardKinematics(self.hand.model, self._data, vector)
        return self._place(self.thumb), self._place(self.finger)

    def gap(self, q: np.ndarray, wrist: np.ndarray) -> float:
        """Return the distance between the pads' surfaces [m]."""
        one, other = self.places(q, wrist)
        return float(np.linalg.norm(other - one)) - self.thumb.radius - self.finger.radius

    def middle(self, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        """Return the point midway between the pads' surfaces [m], shape (3,)."""
        one, other = self.places(q, wrist)
        share = 0.5 + 0.5 * (self.thumb.radius - self.finger.radius) / max(
            float(np.linalg.norm(other - one)), 1e-6
        )
        return one + np.clip(share, 0.0, 1.0) * (other - one)

    def is_pinched(self, simulator: Simulator, force: float) -> bool:
        """Return whether the thumb and another link press on the object with a force [N]."""
        contacts = simulator.contacts()
        normal = np.einsum("ci,ci->c", contacts.forces, contacts.normals)
        thumb = np.array(
            [_is_above(self.hand, joint, self.thumb.joint) for joint in contacts.joints], dtype=bool
        )
        return bool(normal[thumb].sum() > force and normal[~thumb].sum() > force)

    def _place(self, pad: Pad) -> np.ndarray:
        return self._data.oMi[pad.joint].act(pad.offset)


def _is_above(hand: Hand, joint: str, tip: int) -> bool:
    """Return whether a joint is on the way from the palm to a tip; False for the palm itself."""
    if not joint or not hand.model.existJointName(joint):
        return False
    return hand.model.getJointId(joint) in list(hand.model.supports[tip])[2:]
