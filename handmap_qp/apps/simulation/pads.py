"""The pads of thumb and index finger in a simulation, and how they touch the object: `Pads`."""

import math
from collections.abc import Mapping, Sequence
from itertools import chain

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_core.errors import expect
from handmap_core.se3 import Array, lengths, transform_points, unit
from handmap_qp.hands import THUMB, Hand, PadPair
from handmap_qp.mapping import robot_fingers
from .losses import PRESSED, Touch
from .pad_motion import INDEX
from .simulator import Simulator


class Pads:
    """The pads of a hand's thumb and index finger.

    Args:
        hand: The hand.
        prefix: What the names of its bodies begin with in the simulation.

    Attributes:
        pair: The pads.
        bodies: Names of the bodies that carry them.
        others: Names of the bodies of each other finger, by the finger's name.

    Raises:
        InvalidInputError: If the hand has no index finger, or no thumb.
    """

    def __init__(self, hand: Hand, prefix: str = "") -> None:
        fingers = robot_fingers(hand)
        chains = fingers.chains
        expect(
            {THUMB, INDEX} <= chains.keys(),
            "robot",
            f"a hand with {THUMB} and {INDEX}",
            got=f"{hand.name} with {', '.join(chains)}",
        )
        self.pair = PadPair(fingers.pads[THUMB], fingers.pads[INDEX])
        bodies = ["world", *(prefix + name for name in hand.model.names[1:])]
        self.bodies = [bodies[pad.joint] for pad in self.pair]
        self._of_thumb = [bodies[joint] for joint in chains[THUMB].joints]
        self.others = {
            name: [bodies[joint] for joint in finger.joints]
            for name, finger in chains.items()
            if name not in (THUMB, INDEX)
        }

    def places(self, simulator: Simulator) -> Array:
        """Return the middles of the pads of thumb and finger in the world [m], shape (2, 3)."""
        pads = zip(self.bodies, self.pair, strict=True)
        return np.array(
            [
                transform_points(simulator.body_pose(body), pad.offset)
                for body, pad in pads
            ]
        )

    def is_pinched(self, simulator: Simulator) -> bool:
        """Return whether the thumb and another link press on the object."""
        return min(self._forces(simulator)) > PRESSED

    def touch(self, simulator: Simulator, time: float, start: Array) -> Touch:
        """Return how the hand touches the object now.

        Args:
            simulator: The simulation.
            time: The instant [s].
            start: Where the object's middle was at first [m], shape (3,).
        """
        thumb, others = self._forces(simulator)
        places = self.places(simulator)
        line = unit(places[1] - places[0])
        middle = simulator.object_pose[:3, 3]
        off = middle - places[0]
        return Touch(
            time=time,
            thumb=thumb,
            others=others,
            beside=math.dist(off, (off @ line) * line),
            moved=math.dist(middle, start),
            height=float((middle - start) @ unit(simulator.physics.up)),
        )

    def _forces(self, simulator: Simulator) -> tuple[float, float]:
        """Return the normal forces of the thumb, and of all other links [N]."""
        forces = simulator.pressing()
        thumb = sum(forces.get(name, 0.0) for name in self._of_thumb)
        return thumb, sum(forces.values()) - thumb


class FingersInTheWay:
    """Fingers that are, or will pass, where an object is put: they touch it once they have left.

    Args:
        simulator: The simulation, with the object at its place.
        fingers: Names of the bodies of each finger that may be there, by the finger's name.
        until: Time until which a finger's command is in that place [s], by the finger's name;
            without an entry it never is.

    Attributes:
        names: The fingers that pass through it at first.
    """

    def __init__(
        self,
        simulator: Simulator,
        fingers: Mapping[str, Sequence[str]],
        until: Mapping[str, float],
    ) -> None:
        self._simulator = simulator
        self._passing = fingers
        self._until = until
        self.update(-np.inf)
        self.names = tuple(self._passing)

    def update(self, time: float) -> None:
        """Let the fingers that have left the object's place touch it from now on.

        Args:
            time: That of the recording [s].
        """
        if not self._passing:
            return
        self._passing = {
            name: bodies
            for name, bodies in self._passing.items()
            if time < self._until.get(name, -np.inf)
            or self._simulator.clearance(bodies) <= 0.0
        }
        self._simulator.set_passing({*chain.from_iterable(self._passing.values())})


def largest_slide(away: Array, lines: Array) -> float:
    """Return how far an object moves against two pads at most [m].

    The fingers may carry object and pads together: both vectors are in axes that turn with the line
    between the pads, by the smallest rotation.

    Args:
        away: From the middle between the pads to the object, in wrist axes [m], shape (T, 3).
        lines: From the thumb's pad to the finger's, in wrist axes [m], shape (T, 3).
    """
    directions = unit(lines)
    across = np.cross(directions[0], directions)
    sines = lengths(across)
    angles = np.arctan2(sines, directions @ directions[0])
    turns = across * (angles / np.where(sines > 0.0, sines, 1.0))[:, None]
    carried = Rotation.from_rotvec(turns).inv().apply(away)
    return float(lengths(carried - carried[0]).max())
