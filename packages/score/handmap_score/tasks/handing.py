"""Hand a bar over from one hand to the other: `HandOverTask`.

The right hand picks the bar up at its right end and offers it. The left hand takes the left end,
and the right hand lets go and leaves. The bar must then stay in the left hand, in the air. Hands do
not collide with each other.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import numpy as np

from handmap_qp.apps.simulation.losses import PRESSED, Touch
from handmap_qp.apps.simulation.pads import Pads
from handmap_qp.errors import HandError
from handmap_qp.hands import THUMB, Hand, Names, load_hand, sided_name
from handmap_qp.mapping import Box
from handmap_qp.se3 import Array, affine, inverse_pose, transform_points
from .household import Household
from .mapping import straight_joints
from .operator import OTHER, HumanHand, Joints
from .person import home, own_hand
from .table import TableTask, pad_surfaces
from .task import Scene, Signals
from .touch import PALM, cause_of_no_grip

HAND_OVER = "hand-over"
"""Name of the task."""
HEIGHT = 0.05
"""Height above its place at which the bar must be in the end [m]."""
AWAY = 0.06
"""The giving hand has left when the bar is farther than this from where that hand had it [m]."""
_IN_AIR = 0.005
"""The bar's lower end must be higher than this above its place, else it leans on the table [m]."""
_WIDTH, _LENGTH = 0.024, 0.2  # of the bar [m]
_GRIP = 0.08  # distance of both grips from the middle of the bar [m]
_APART = 0.2  # further distance of the other hand from the bar at the beginning [m]
_BEHIND, _ABOVE = 0.15, 0.3  # where the other palm starts, from the bar [m]
_MIRROR = np.diag([-1.0, 1.0, 1.0, 1.0])


class NoOtherHandError(HandError):
    """There is no other hand to a hand.

    Attributes:
        name: Name of the hand.
        why: Why the other one cannot be loaded; empty if there is none.
    """

    def __init__(self, name: str, why: str = "") -> None:
        needed = "a task of two hands needs a right hand whose left one is installed"
        super().__init__(": ".join(filter(None, (name, needed, why))))
        self.name = name
        self.why = why


def mirrored_pose(pose: Array) -> Array:
    """Return the mirror image of a pose, (4, 4): x is negated, and so is the frame's own x."""
    return _MIRROR @ pose @ _MIRROR


def mirrored_points(points: Array) -> Array:
    """Return the mirror images of points, shape (n, 3): x is negated."""
    return points * (-1.0, 1.0, 1.0)


def other_hand(robot: Hand) -> Hand:
    """Return the left hand that belongs to a right one, by its name.

    Raises:
        NoOtherHandError: If there is none, or it cannot be loaded.
    """
    if robot.name == own_hand().name:
        return own_hand("left")
    family = robot.name.removesuffix("_right")
    left = sided_name(family, "left")
    if family in (robot.name, left):
        raise NoOtherHandError(robot.name)
    try:
        return load_hand(left)
    except HandError as error:
        raise NoOtherHandError(robot.name, str(error)) from error


class HandOverTask(TableTask):
    """Hand a bar over.

    Args:
        robot: The robot's right hand, which gives. The left hand of its family takes.
        objects: As of `TableTask`.

    Raises:
        NoOtherHandError: If there is no left hand.
    """

    name = HAND_OVER
    hold = 30
    time_limit = 32.0
    # The grip, 80 mm to the right of the bar's middle, goes 100 mm to the left.
    carried = (_GRIP - 0.1, 0.0)
    things = MappingProxyType(
        {"bar": Household(Box((_WIDTH, _LENGTH, _WIDTH)), 0.02, 0.7)}
    )

    def __init__(self, robot: Hand, objects: Names = ()) -> None:
        other = other_hand(robot)
        self.other = other
        self._taker = other
        self._other_pads = Pads(other, OTHER)
        self._other_rest = straight_joints(other)
        super().__init__(robot, objects)

    def reset(self, seed: int) -> Scene:
        """Begin an attempt with the bar on the table."""
        self._given_at: Array | None = None
        self._is_taken = False
        self._has_taken = False
        self._other_command = dict(self._other_rest)
        return super().reset(seed)

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the bar is not in the other hand."""
        if not self._has_lifted:
            return cause_of_no_grip(self.course)
        is_held = self.course[-1].is_touched
        if not self._has_taken:
            return "not taken" if is_held else "dropped before it was taken"
        return "not let go" if is_held else "taken, then lost"

    def _put_other(self, place: Array) -> Mapping[str, Array]:
        left = place + np.array([-_APART, -_BEHIND, _ABOVE])
        palm = affine(mirrored_pose(affine(home(), np.zeros(3)))[:3, :3], left)
        wrist = palm @ inverse_pose(self._taker.wrist_to_palm)
        return {OTHER: self._other_configuration(wrist)}

    def _lead_other(self, hand: HumanHand, command: Joints) -> Mapping[str, Array]:
        for name in self._other_command:
            self._other_command[name] = command.get(
                OTHER + name, self._other_command[name]
            )
        if hand.other is None:
            return {}
        return {OTHER: self._other_configuration(hand.other.wrist)}

    def _other_configuration(self, wrist: Array) -> Array:
        joints = [*self._other_command.values()]
        return self._taker.configuration_vector(joints, wrist)

    def _grip(self, pose: Array, along: float) -> Array:
        """Return a point on the bar's axis [m], shape (3,); to the right where `along` < 0."""
        return pose[:3, 3] + along * pose[:3, 1]

    def _middle(self, pose: Array) -> Array:
        return self._grip(pose, -_GRIP)

    def _bottom(self, pose: Array) -> Array:
        return self._middle(pose) - (0.0, 0.0, _WIDTH / 2.0)

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        palm = self._simulator.wrist @ self._robot.wrist_to_palm
        at = transform_points(inverse_pose(palm), pose[:3, 3])
        if self._given_at is None and touch.is_lifted:
            self._given_at = at
        if self._given_at is None:
            return False
        is_away = float(np.linalg.norm(at - self._given_at)) > AWAY
        lower_end = touch.height - abs(float(pose[2, 1])) * _LENGTH / 2.0
        is_in_air = touch.height > HEIGHT and lower_end > _IN_AIR
        return is_away and self._is_taken and is_in_air

    def _signals(self, pose: Array, pads: Array) -> Signals:
        """Measure the touch of both hands; the object is gripped if either hand has it."""
        contacts = self._bench.others[OTHER]
        forces = contacts.by_link(self.data)
        by_finger = contacts.by_finger(forces)
        thumb = by_finger.pop(THUMB, 0.0)
        by_finger.pop(PALM, None)
        self._is_taken = min(thumb, sum(by_finger.values())) > PRESSED
        self._has_taken |= self._is_taken
        signals = super()._signals(pose, pads)
        force = max(signals.force, *forces.values(), 0.0)
        is_held = self._is_taken and self._has_lifted
        return signals._replace(force=force, is_gripped=signals.is_gripped or is_held)

    def _scene(self) -> Scene:
        """Add what concerns the other hand to the scene: its wrist, pads and end of the bar."""
        scene = super()._scene()
        pose = scene.poses["object"]
        simulator = self._simulator
        half = (self._faces(pose)[1] - self._faces(pose)[0]) / 2.0
        middle = self._grip(pose, _GRIP)
        pads = pad_surfaces(self._other_pads.places(simulator), self._other_pads.pair)
        wrist = simulator.wrist_of(OTHER)
        return Scene(
            scene.time,
            scene.observation,
            {**scene.poses, f"{OTHER}wrist": wrist},
            {
                **scene.points,
                f"{OTHER}pads": pads,
                f"{OTHER}faces": np.array([middle - half, middle + half]),
            },
            scene.signals,
            scene.joints,
        )
