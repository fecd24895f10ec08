"""Pick and place of household objects on a table, with a free wrist: `PickTask`.

An object stands on a level table. The hand is to pick it up and put it down in a tray of 16 cm
beside it. Objects have sizes and masses of YCB's. Motors have the torque of the maker.

What is simplified: the hand passes through the table, so that low objects can be gripped by hands
with thick fingertips; an object that stands has a little putty under it, which resists tilting
(`_PUTTY`), so that a pen and a plate can stand; links of the hand do not collide with each other.
The wrist goes where the operator wants it, whatever the mapping says of it.

The place of an object does not depend on the robot or the mapping: it stands across the line of a
person's pinch, turned by up to 20 degrees.
"""

import math
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Loss, Touch, loss_in_try, tries
from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.pinch import Pads
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.errors import expect
from handmap_qp.hands import THUMB, Hand, load_hand
from handmap_qp.mapping import (
    Box,
    Cylinder,
    MeshShape,
    Shape,
    Sphere,
    robot_fingers,
    surface,
)
from handmap_qp.se3 import (
    Array,
    affine,
    inverse_pose,
    rotation_from_rpy,
    transform_points,
    unit,
)
from .operator import HumanHand, Joints
from .person import home
from .task import Scene, Signals

PICK = "pick"
"""Name of the task."""
HANDS = ("allegro_right", "leap_right", "shadow_right")
"""Hands that the task is for by default."""

RATE = 60.0
"""Samples of the operator and commands of the robot in a second."""
TRAY = 0.08
"""The object is put down within this distance from the target, level with it [m]."""
SIDEWAYS = 0.2
"""Distance of the target from the object's first place [m]."""
_PLACE = (
    0.03  # the object stands off its nominal place by up to this along each axis [m]
)
_YAW = math.radians(20.0)  # and is turned by up to this
_ABOVE, _BEHIND, _BESIDE = 0.3, 0.15, 0.05  # where the palm starts, from the object [m]
_TIME_LIMIT = 26.0  # of practice, 12 s of tries, the last of them, and carrying [s]
_HOLD = 15  # steps for which the object must lie in the tray
_STANDS = 0.002  # up to this height it stands on its putty [m]
_PUTTY = 0.01  # lever of the putty: it resists turning with friction times weight times this [m]
_ON_TABLE = (
    0.03  # an object whose middle is lower than this above its place is put down [m]
)
_LEVEL = 0.7  # a direction is level if its height is below this


class Household(NamedTuple):
    """An object of a household.

    Attributes:
        shape: Its shape; z is up, x is across, and the origin is where it is to be held.
        mass: Its mass [kg].
        friction: Coulomb coefficient.
        is_round: Whether it can be held from all sides.
    """

    shape: Shape
    mass: float
    friction: float
    is_round: bool = False


def _bar(width: float, back: float, front: float, height: float) -> MeshShape:
    """Return a bar along y that is held beside its middle."""
    x, z = width / 2.0, height / 2.0
    ends = [(a, b, c) for a in (-x, x) for b in (-back, front) for c in (-z, z)]
    return MeshShape(np.array(ends))


def _rings(*rings: tuple[float, float]) -> MeshShape:
    """Return the hull of circles about z, given by height and radius [m]."""
    turns = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    circle = np.column_stack([np.cos(turns), np.sin(turns), 0.0 * turns])
    return MeshShape(np.concatenate([r * circle + (0.0, 0.0, z) for z, r in rings]))


def _disc(thickness: float, radius: float, inside: float) -> MeshShape:
    """Return a disc that stands on its edge and is held so far inside its upper edge."""
    turns = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)
    y, z = radius * np.cos(turns), radius * np.sin(turns) - radius + inside
    x = np.full(len(turns), thickness / 2.0)
    sides = [np.column_stack([side * x, y, z]) for side in (-1.0, 1.0)]
    return MeshShape(np.concatenate(sides))


_BOTTLE = _rings((-0.08, 0.025), (0.02, 0.025), (0.07, 0.012))
HOUSEHOLD: Mapping[str, Household] = MappingProxyType(
    {
        "tea box": Household(Box((0.036, 0.06, 0.09)), 0.06, 0.5),
        "foam brick": Household(Box((0.05, 0.075, 0.05)), 0.028, 0.8),
        "die": Household(Box((0.02, 0.02, 0.02)), 0.01, 0.6),
        "can": Household(Cylinder(0.033, 0.1), 0.2, 0.6, is_round=True),
        "tube": Household(Cylinder(0.016, 0.08), 0.04, 0.6, is_round=True),
        "golf ball": Household(Sphere(0.0214), 0.046, 0.6, is_round=True),
        "tennis ball": Household(Sphere(0.033), 0.058, 0.9, is_round=True),
        "strawberry": Household(Sphere(0.015), 0.018, 0.7, is_round=True),
        "mug's handle": Household(_bar(0.012, 0.01, 0.1, 0.03), 0.09, 0.7),
        "bottle": Household(_BOTTLE, 0.1, 0.6, is_round=True),
        "pen": Household(Cylinder(0.005, 0.14), 0.012, 0.6, is_round=True),
        "plate's rim": Household(_disc(0.008, 0.09, 0.015), 0.12, 0.5),
    }
)
"""Objects of the sizes and masses of YCB's, made of simple shapes.

The mug's handle is a bar whose weight hangs 45 mm beside the grip, as the mug's does; the mug
itself is not there to be touched.
"""


class PickTask:
    """Pick one of the objects up, and put it down in the tray.

    Args:
        robot: The robot hand, with a floating wrist.
        objects: Names in `HOUSEHOLD`; the seed chooses one of them in turn.

    Raises:
        InvalidInputError: If there is no such object, or the hand has no thumb or index finger.
        HandError: If the hand has no collision shapes.
    """

    time_step = 1.0 / RATE
    time_limit = _TIME_LIMIT
    hold = _HOLD

    def __init__(self, robot: Hand, objects: Sequence[str] = tuple(HOUSEHOLD)) -> None:
        unknown = {*objects} - {*HOUSEHOLD}
        expect(
            objects and not unknown,
            "objects",
            f"some of {', '.join(HOUSEHOLD)}",
            got=", ".join(sorted(unknown)) or "none",
        )
        self._robot = robot
        self._objects = tuple(objects)
        self._pads = Pads(self._robot)
        self._finger_of = _fingers_of_links(self._robot)
        self._simulators: dict[str, Simulator] = {}
        self.reset(0)

    @property
    def name(self) -> str:
        """Short name, for tables."""
        return PICK

    @property
    def object_name(self) -> str:
        """Name of the object of this attempt."""
        return self._object_name

    @property
    def robot(self) -> Hand:
        """The robot hand."""
        return self._robot

    @property
    def model(self) -> mujoco.MjModel:
        """The model of the hand with the object of this attempt."""
        return self._simulator.model

    @property
    def data(self) -> mujoco.MjData:
        """The state."""
        return self._simulator.data

    @property
    def course(self) -> Sequence[Touch]:
        """How the hand touched the object, step by step."""
        return self._course

    def reset(self, seed: int) -> Scene:
        """Begin an attempt; the seed chooses the object, its place, and where the hand starts."""
        self._object_name = self._objects[seed % len(self._objects)]
        self._object = HOUSEHOLD[self._object_name]
        self._simulator = self._simulator_of(self._object_name)
        random = np.random.default_rng([seed, 57])
        self._rest_height = -float(surface(self._object.shape).bounds[0, 2])
        place = np.append(random.uniform(-_PLACE, _PLACE, 2), self._rest_height)
        # x runs along the line of a person's pinch, which is forward.
        yaw = math.pi / 2.0 + random.uniform(-_YAW, _YAW)
        self._start = affine(rotation_from_rpy((0.0, 0.0, yaw)), place)
        self._target = affine(np.eye(3), (place[0] + SIDEWAYS, place[1], 0.0))
        beside = random.uniform(-_BESIDE, _BESIDE)
        palm = affine(home(), place + np.array([beside, -_BEHIND, _ABOVE]))
        wrist = palm @ inverse_pose(self._robot.wrist_to_palm)
        self._command = dict(
            zip(self._robot.joint_names, _rest(self._robot).tolist(), strict=True)
        )
        self._simulator.reset(self._configuration(wrist), self._start)
        self._has_lifted = False
        self._steps = 0
        self._course: list[Touch] = []
        return self._scene()

    def step(self, hand: HumanHand, command: Joints) -> Scene:
        """Move for one time step: the wrist by the operator, the fingers by the command."""
        known = {name: command[name] for name in self._command if name in command}
        self._command |= known
        self._set_putty()
        self._simulator.follow(self._configuration(hand.wrist), self.time_step)
        self._steps += 1
        return self._scene()

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the attempt failed, by what happened in its last try."""
        return pick_cause(self._course)

    def _simulator_of(self, name: str) -> Simulator:
        """Return the simulator of an object; each is built once."""
        if name not in self._simulators:
            held = HOUSEHOLD[name]
            physics = Physics(
                mass=held.mass,
                friction=held.friction,
            )
            self._simulators[name] = Simulator(
                self._robot, held.shape, physics, table=0.0
            )
        return self._simulators[name]

    def _configuration(self, wrist: Array) -> Array:
        """Return the configuration of the robot with the last commands, at a wrist pose."""
        return self._robot.configuration_vector([*self._command.values()], wrist)

    def _set_putty(self) -> None:
        """Let the putty resist tilting where the object stands, and let go where it does not."""
        height = self._simulator.object_pose[2, 3] - self._rest_height
        weight = self._object.mass * float(
            np.linalg.norm(self._simulator.physics.gravity)
        )
        resists = self._object.friction * weight * _PUTTY if height < _STANDS else 0.0
        self._simulator.model.joint(OBJECT).frictionloss = [0.0] * 3 + [resists] * 3

    def _scene(self) -> Scene:
        simulator = self._simulator
        pose = simulator.object_pose
        pads = self._pads.places(simulator)
        line = unit(pads[1] - pads[0])
        pair = self._pads.pair
        surfaces = pads + np.outer((pair.thumb.radius, -pair.finger.radius), line)
        half = _across(self._object, pose) / 2.0
        signals = self._signals(pose, surfaces)
        return Scene(
            time=self._steps * self.time_step,
            observation=np.zeros(0),
            poses={"object": pose, "wrist": simulator.wrist, "target": self._target},
            points={
                "pads": surfaces,
                "faces": np.array([pose[:3, 3] - half, pose[:3, 3] + half]),
                "bottom": _bottom(self._object.shape, pose)[None],
            },
            signals=signals,
        )

    def _signals(self, pose: Array, pads: Array) -> Signals:
        forces = self._simulator.pressing()
        by_finger: dict[str, float] = {}
        for link, force in forces.items():
            finger = self._finger_of.get(link, "palm")
            by_finger[finger] = by_finger.get(finger, 0.0) + force
        thumb = by_finger.get(THUMB, 0.0)
        line = unit(pads[1] - pads[0])
        off = pose[:3, 3] - pads[0]
        travel = pose[:3, 3] - self._start[:3, 3]
        touch = Touch(
            time=self._steps * self.time_step,
            thumb=thumb,
            others=sum(force for name, force in by_finger.items() if name != THUMB),
            beside=float(np.linalg.norm(off - (off @ line) * line)),
            moved=float(np.linalg.norm(travel[:2])),
            height=float(travel[2]),
        )
        self._course.append(touch)
        self._has_lifted |= touch.is_lifted
        to_target = pose[:2, 3] - self._target[:2, 3]
        is_there = float(np.linalg.norm(to_target)) < TRAY and touch.height < _ON_TABLE
        return Signals(
            is_reached=self._has_lifted and is_there and not forces,
            touching=frozenset(by_finger),
            is_gripped=touch.is_lifted,
            force=max(forces.values(), default=0.0),
            moved=float(np.linalg.norm(travel)),
        )


def make_pick(hand: str) -> PickTask:
    """Return the task with all objects for a robot hand, by its name or the path of hand.yaml.

    Raises:
        HandmapError: If the hand cannot be loaded, or has no thumb, index finger or shapes.
    """
    return PickTask(load_hand(hand))


def pick_cause(course: Sequence[Touch]) -> str:
    """Return why an object was not put down in the tray, by forces and places.

    Of an object that was never lifted, the last try decides that touched it.

    Args:
        course: Every step of the attempt, in order.
    """
    if any(one.is_lifted for one in course):
        return "gripped, not put down" if course[-1].is_touched else Loss.SLIPPED
    last = tries(course)[-1:]
    return loss_in_try(last[0] if last else ()) or "gripped, not lifted"


def _rest(hand: Hand) -> Array:
    """Return the joints of a hand with straight fingers, as near as its limits allow."""
    return np.clip(np.zeros(len(hand.joint_names)), *hand.limits)


def _fingers_of_links(hand: Hand) -> dict[str, str]:
    """Return the finger of each link, by the name of the joint that carries it."""
    names = hand.model.names
    return {
        names[joint]: finger
        for finger, chain in robot_fingers(hand).chains.items()
        for joint in chain.joints
    }


def _bottom(shape: Shape, pose: Array) -> Array:
    """Return the lowest point of an object in the world [m], shape (3,)."""
    points = transform_points(pose, surface(shape).vertices)
    return points[np.argmin(points[:, 2])]


def _across(held: Household, pose: Array) -> Array:
    """Return the vector across an object from face to face in the world [m], shape (3,).

    Of a round object any side is as good as another: across is forward, or square to the axis of
    a cylinder that lies. Of others it is the narrowest level side.
    """
    extents = surface(held.shape).extents
    axis = pose[:3, 2]
    if held.is_round:
        is_lying = abs(axis[2]) < _LEVEL and not isinstance(held.shape, Sphere)
        forward = np.array([0.0, 1.0, 0.0])
        line = unit(np.cross((0.0, 0.0, 1.0), axis)) if is_lying else forward
        return extents[0] * line
    level = [k for k in range(3) if abs(pose[2, k]) < _LEVEL]
    narrowest = min(level, key=lambda k: extents[k])
    return extents[narrowest] * pose[:3, narrowest]
