"""A person with two hands, who hands a bar over: `TwoHands`.

Each hand is a `Person` with eyes, noise and learning of its own. The left hand is a right one
behind a mirror: it sees mirror images, and what it shows is mirrored. The two know of each other
what a person feels: that the bar is offered, and that the other hand has it.
"""

from types import MappingProxyType

import numpy as np

from handmap_qp.hands import Hand
from handmap_qp.human import Recording
from handmap_qp.se3 import inverse_pose
from .handing import mirrored_points, mirrored_pose, other_hand
from .operator import OTHER, HumanHand
from .person import Look, PalmMotion, Person, Phase
from .task import Scene


class Giver(Person):
    """The hand that picks up, offers, and lets go when the other hand has it."""

    def reset(self, seed: int) -> None:
        """Begin an attempt."""
        super().reset(seed)
        self._is_taken = False

    @property
    def is_offering(self) -> bool:
        """Whether the object is held where the other hand takes it."""
        return self._phase is Phase.USE

    def feel(self, *, is_taken: bool) -> None:
        """Take in whether the other hand has the object."""
        self._is_taken = is_taken

    def _arrived(self, motion: PalmMotion) -> None:
        self._start(Phase.USE, closes=True)

    def _use(self, look: Look, motion: PalmMotion) -> None:
        """Offer: let go when it is taken; open and try again when it is seen to be lost."""
        if self._is_taken:
            self._start(Phase.RELEASE, closes=False)
        elif look.is_lost:
            self._drops += 1
            self._start(Phase.REOPEN, closes=False)


class Taker(Person):
    """The hand that waits for an offer, and takes it."""

    def reset(self, seed: int) -> None:
        """Begin an attempt."""
        super().reset(seed)
        self._is_offered = False
        self._has_it = False

    @property
    def has_it(self) -> bool:
        """Whether the object is in this hand."""
        return self._has_it

    def feel(self, *, is_offered: bool) -> None:
        """Take in whether the other hand offers the object."""
        self._is_offered = is_offered

    def _begin_try(self) -> None:
        """Wait for an offer; patience begins with the first one."""
        if self._is_offered:
            super()._begin_try()
        else:
            self._first_try = self._time
            self._start(Phase.USE, closes=False)

    def _grasped(self, motion: PalmMotion) -> None:
        self._has_it = True
        self._start(Phase.USE, closes=True)

    def _use(self, look: Look, motion: PalmMotion) -> None:
        """Wait for the offer, or hold what was taken."""
        if not self._has_it:
            self._begin_try()
        elif look.is_lost:
            self._has_it = False
            self._drops += 1
            self._start(Phase.REOPEN, closes=False)


class TwoHands:
    """A person whose right hand gives and whose left hand takes.

    Args:
        robot: The robot's right hand; the person watches the left hand of its family too.

    Raises:
        NoOtherHandError: If there is no left hand.
    """

    name = "person"

    def __init__(self, robot: Hand) -> None:
        other = other_hand(robot)
        self._giver = Giver(robot)
        self._taker = Taker(other)
        self._to_palm = other.wrist_to_palm

    @property
    def has_finished(self) -> bool:
        """Whether the giving hand has left, or either hand is out of patience."""
        return self._giver.has_finished or self._taker.has_finished

    def calibrate(self, seed: int) -> Recording:
        """Return a recording of the right hand, whose mirror image is the left one."""
        return self._giver.calibrate(seed)

    def reset(self, seed: int) -> None:
        """Begin an attempt; both hands have a random sequence of their own."""
        first, second = np.random.SeedSequence(seed).generate_state(2).tolist()
        self._giver.reset(first)
        self._taker.reset(second)

    def see(self, scene: Scene) -> HumanHand:
        """Return both hands at the scene's instant."""
        self._taker.feel(is_offered=self._giver.is_offering)
        self._giver.feel(is_taken=self._taker.has_it)
        right = self._giver.see(scene)
        left = self._taker.see(self._seen_by_taker(scene))
        return right._replace(other=self._mirrored(left))

    def _seen_by_taker(self, scene: Scene) -> Scene:
        """Return the mirror image of what concerns the left hand."""
        wrist = scene.poses[f"{OTHER}wrist"]
        # The palms are mirror images of each other, axes of wrists need not be.
        palm = mirrored_pose(wrist @ self._to_palm)
        return Scene(
            scene.time,
            scene.observation,
            {
                "object": mirrored_pose(scene.poses["object"]),
                "target": mirrored_pose(scene.poses["target"]),
                "wrist": palm @ inverse_pose(self._to_palm),
            },
            {
                "pads": mirrored_points(scene.points[f"{OTHER}pads"]),
                "faces": mirrored_points(scene.points[f"{OTHER}faces"]),
                "bottom": mirrored_points(scene.points["bottom"]),
            },
            scene.signals,
        )

    def _mirrored(self, hand: HumanHand) -> HumanHand:
        """Return the left hand whose mirror image this right hand is; joints are the same."""
        palm = mirrored_pose(hand.wrist @ self._to_palm)
        return HumanHand(
            mirrored_points(hand.landmarks),
            palm @ inverse_pose(self._to_palm),
            hand.joints,
        )


OPERATORS = MappingProxyType({"person": TwoHands})
"""Makers of operators by name."""
