"""What all tasks on a table share: an object, a hand with a free wrist, and what is seen of both.

A task is a class that derives from `TableTask`, with its objects and with the goal by physical
state. It may add furniture to the model, such as a hole or a bowl.

What is simplified: the hand passes through table and furniture, so that low objects can be gripped
by hands with thick fingertips; an object that stands has a little putty under it, which resists
tilting (`Household.putty`), so that a pen can stand; links of the hand do not collide with each
other. The wrist goes where the operator wants it, whatever the mapping says of it. Motors have the
torque of the maker.

The place of an object does not depend on the robot or the mapping: it stands across the line of a
person's pinch, turned by up to 20 degrees.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.apps.simulation.pads import Pads
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.errors import expect
from handmap_qp.hands import THUMB, Hand, Names, PadPair
from handmap_qp.mapping import Sphere, surface
from handmap_qp.se3 import (
    Array,
    affine,
    inverse_pose,
    quat_wxyz_from_rotation,
    rotation_from_rpy,
    transform_points,
    unit,
)
from .household import Household
from .mapping import straight_joints
from .operator import OTHER, HumanHand, Joints
from .person import home
from .task import Scene, Signals
from .touch import Contacts

HANDS = ("allegro_right", "leap_right", "shadow_right")
"""Robot hands that the tasks are for by default."""

RATE = 60.0
"""Samples of the operator and commands of the robot in a second."""
FIXTURE = "/fixture"
"""Name of the body that carries the furniture of a task."""
CAMERA = "view"
"""Name of the camera of films."""
_CAMERA_AT = np.array([0.75, -0.55, 0.45])
_LOOKED_AT = np.array([0.08, -0.05, 0.1])
_OBJECT_COLOUR = [0.9, 0.45, 0.1, 1.0]
_FURNITURE_COLOUR = [0.2, 0.45, 0.65, 1.0]
_LOOSE_COLOUR = [0.75, 0.2, 0.25, 1.0]
_HAND_COLOUR = [0.7, 0.7, 0.73, 1.0]
_TABLE_COLOUR = [0.62, 0.6, 0.55, 1.0]
_PLACE = 0.03
"""The object stands off its nominal place by up to this along each axis [m]."""
_ABOVE, _BEHIND, _BESIDE = 0.3, 0.15, 0.05
"""Where the palm starts, from the object [m]."""
_STANDS = 0.002
"""Up to this height an object stands on its putty [m]."""
_LEVEL = 0.7
"""A direction is level if its height is below this."""
_WORLD_UP = np.array([0.0, 0.0, 1.0])

Furnish = Callable[[mujoco.MjSpec], None]
"""Adds furniture to a model before it is compiled."""


class TableTask(ABC):
    """A task with one object on a table. A class that derives from it says what is to be done.

    Args:
        robot: The robot hand, with a floating wrist.
        objects: Names in `things`; the seed chooses one of them in turn. All if omitted.

    Raises:
        InvalidInputError: If there is no such object, or the hand has no thumb or index finger.
        HandError: If the hand has no collision shapes.
    """

    name: ClassVar[str]
    """Short name, for tables."""
    things: ClassVar[Mapping[str, Household]]
    """Objects by name."""
    time_step = 1.0 / RATE
    time_limit: ClassVar[float] = 26.0  # of practice, 12 s of tries, and what follows
    hold: ClassVar[int] = 15
    raised: ClassVar[float] = 0.0
    """Height of the object's lowest point above the table at the beginning [m]."""
    carried: ClassVar[tuple[float, float]] = (0.2, 0.0)
    """Where the held point of the object is to go, from the object's first place [m]."""
    yaw: ClassVar[float] = math.radians(20.0)
    """The object is turned by up to this [rad]."""
    other: Hand | None = None
    """The robot's other hand; None in a task of one hand."""

    def __init__(self, robot: Hand, objects: Names = ()) -> None:
        unknown = {*objects} - {*self.things}
        expect(
            not unknown,
            "objects",
            f"some of {', '.join(self.things)}",
            got=", ".join(sorted(unknown)),
        )
        self._robot = robot
        self._objects = tuple(objects) or tuple(self.things)
        self._pads = Pads(robot)
        self._rest = straight_joints(robot)
        self._benches: dict[str, _Bench] = {}
        self.reset(0)

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
        self._object_name = object_of(seed, self._objects)
        self._bench = self._bench_of(self._object_name)
        self._simulator = self._bench.simulator
        self._object = self.things[self._object_name]
        random = np.random.default_rng([seed, 57])
        self._rest_height = self._bench.rest_height + self.raised
        place = np.append(random.uniform(-_PLACE, _PLACE, 2), self._rest_height)
        # x runs along the line of a person's pinch, which is forward.
        yaw = math.pi / 2.0 + random.uniform(-self.yaw, self.yaw)
        self._start = affine(rotation_from_rpy((0.0, 0.0, yaw)), place)
        self._target = affine(np.eye(3), (*(place[:2] + self.carried), 0.0))
        beside = random.uniform(-_BESIDE, _BESIDE)
        palm = affine(home(), place + np.array([beside, -_BEHIND, _ABOVE]))
        wrist = palm @ inverse_pose(self._robot.wrist_to_palm)
        self._command = dict(self._rest)
        self._place_furniture()
        self._simulator.reset(
            self._configuration(wrist), self._start, self._put_other(place)
        )
        self._set_further()
        self._has_lifted = False
        self._steps = 0
        self._course: list[Touch] = []
        return self._scene()

    def step(self, hand: HumanHand, command: Joints) -> Scene:
        """Move for one time step: the wrist by the operator, the fingers by the command."""
        known = {name: command[name] for name in self._command if name in command}
        self._command |= known
        self._set_putty()
        goal = self._configuration(hand.wrist)
        others = self._lead_other(hand, command)
        self._simulator.follow(goal, self.time_step, others)
        self._steps += 1
        return self._scene()

    @abstractmethod
    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the attempt failed."""

    # -- what a task adds

    @abstractmethod
    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        """Return whether the goal holds now, by the object's pose, shape (4, 4)."""

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add furniture, as a body `FIXTURE` or as bodies that move; none by default."""
        return

    def _place_furniture(self) -> None:
        """Put the furniture to its place of this attempt; under the target by default."""
        fixture = mujoco.mj_name2id(self.model, mujoco.mjtObj.mjOBJ_BODY, FIXTURE)
        if fixture >= 0:
            self.model.body_pos[fixture] = self._target[:3, 3]

    def _set_further(self) -> None:
        """Set the joints of further bodies at the beginning, after the hand and the object."""
        return

    def _put_other(self, place: Array) -> Mapping[str, Array]:
        """Return where the other hand starts, by its prefix, for an object at a place [m]."""
        return {}

    def _lead_other(self, hand: HumanHand, command: Joints) -> Mapping[str, Array]:
        """Return the configuration that the other hand is commanded, by its prefix."""
        return {}

    def _is_gripped(self, touch: Touch) -> bool:
        """Return whether the hand has the object."""
        return touch.is_lifted

    def _faces(self, pose: Array) -> Array:
        """Return where the object is to be pinched in the world [m], shape (2, 3)."""
        half = self._bench.across(pose) / 2.0
        middle = self._middle(pose)
        return np.array([middle - half, middle + half])

    def _middle(self, pose: Array) -> Array:
        """Return where the object is to be held in the world [m], shape (3,)."""
        return pose[:3, 3]

    def _bottom(self, pose: Array) -> Array:
        """Return the object's lowest point in the world [m], shape (3,)."""
        return self._bench.bottom(pose)

    def _surfaces(self, pads: Array) -> Array:
        """Return the points of thumb and finger that the operator is to bring to the object.

        Args:
            pads: Middles of both pads in the world [m], shape (2, 3).

        Returns:
            Where the surfaces of the pads face each other [m], shape (2, 3).
        """
        return pad_surfaces(pads, self._pads.pair)

    # -- the loop

    def _build(self, spec: mujoco.MjSpec) -> None:
        """Add furniture, and what makes films readable: a camera, lights and colours."""
        self._furnish(spec)
        add_view(spec)

    def _bench_of(self, name: str) -> "_Bench":
        """Return the simulator of an object; each is built once."""
        if name not in self._benches:
            others = {} if self.other is None else {OTHER: self.other}
            self._benches[name] = _Bench(
                self._robot, self.things[name], self._build, others
            )
        return self._benches[name]

    def _configuration(self, wrist: Array) -> Array:
        """Return the configuration of the robot with the last commands, at a wrist pose."""
        return self._robot.configuration_vector([*self._command.values()], wrist)

    def _set_putty(self) -> None:
        """Let the putty resist tilting where the object stands, and let go where it does not."""
        height = self._simulator.object_pose[2, 3] - self._rest_height
        weight = self._object.mass * float(
            np.linalg.norm(self._simulator.physics.gravity)
        )
        resists = (
            self._object.friction * weight * self._object.putty
            if height < _STANDS
            else 0.0
        )
        self._simulator.model.joint(OBJECT).frictionloss = [0.0] * 3 + [resists] * 3

    def _scene(self) -> Scene:
        simulator = self._simulator
        pose = simulator.object_pose
        surfaces = self._surfaces(self._pads.places(simulator))
        signals = self._signals(pose, surfaces)
        return Scene(
            time=self._steps * self.time_step,
            observation=np.zeros(0),
            poses={"object": pose, "wrist": simulator.wrist, "target": self._target},
            points={
                "pads": surfaces,
                "faces": self._faces(pose),
                "bottom": self._bottom(pose)[None],
            },
            signals=signals,
            joints=dict(
                zip(self._robot.joint_names, simulator.q.tolist(), strict=True)
            ),
        )

    def _signals(self, pose: Array, pads: Array) -> Signals:
        contacts = self._bench.contacts
        forces = contacts.by_link(self.data)
        by_finger = contacts.by_finger(forces)
        thumb = by_finger.get(THUMB, 0.0)
        line = unit(pads[1] - pads[0])
        off = self._middle(pose) - pads[0]
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
        return Signals(
            is_reached=self._is_reached(touch, pose),
            touching=frozenset(by_finger),
            is_gripped=self._is_gripped(touch),
            force=max(forces.values(), default=0.0),
            moved=float(np.linalg.norm(travel)),
        )


def object_of(seed: int, objects: Names) -> str:
    """Return the object of an attempt: its seed chooses one after another.

    Args:
        seed: Seed of the attempt.
        objects: Names of the objects of the task, or of those that were chosen.
    """
    return objects[seed % len(objects)]


def pad_surfaces(pads: Array, pair: PadPair) -> Array:
    """Return where the surfaces of two pads face each other [m], shape (2, 3).

    Args:
        pads: Middles of the pads of thumb and finger [m], shape (2, 3).
        pair: Their radii.
    """
    line = unit(pads[1] - pads[0])
    return pads + np.outer((pair.thumb.radius, -pair.finger.radius), line)


def add_view(spec: mujoco.MjSpec) -> None:
    """Add a camera that looks across the table, lights, and colours; none of it moves anything."""
    for body in spec.bodies:
        for geom in body.geoms:
            geom.rgba = _colour_of(body.name)
    for geom in spec.worldbody.geoms:
        geom.rgba = _TABLE_COLOUR
    back = _CAMERA_AT - _LOOKED_AT
    right = unit(np.cross(_WORLD_UP, back))
    # A camera looks along its -z, with x to the right.
    axes = np.column_stack([right, unit(np.cross(back, right)), unit(back)])
    spec.worldbody.add_camera(
        name=CAMERA, pos=_CAMERA_AT, quat=quat_wxyz_from_rotation(axes), fovy=32.0
    )
    for place in ([0.6, -0.8, 1.2], [-0.4, 0.6, 1.5]):
        spec.worldbody.add_light(
            pos=place,
            dir=_LOOKED_AT - np.array(place),
            diffuse=[0.4, 0.4, 0.4],
            ambient=[0.1, 0.1, 0.1],
            specular=[0.1, 0.1, 0.1],
            castshadow=False,
        )


def _colour_of(body: str) -> list[float]:
    """Return the colour of a body: all but links of hands have names with one slash."""
    if not body.startswith("/") or body.startswith(OTHER):
        return _HAND_COLOUR
    if body == OBJECT:
        return _OBJECT_COLOUR
    return _FURNITURE_COLOUR if body == FIXTURE else _LOOSE_COLOUR


class _Bench:
    """The simulator of one object, and what of its shape is computed once.

    Attributes:
        simulator: Hand, object and table.
        contacts: Forces of the hand on the object.
        others: Forces of the other hands on it, by their prefixes.
        rest_height: Height of the object's origin when it stands on the table [m].
    """

    def __init__(
        self,
        robot: Hand,
        held: Household,
        furnish: Furnish,
        others: Mapping[str, Hand],
    ) -> None:
        physics = Physics(mass=held.mass, friction=held.friction)
        self.simulator = Simulator(
            robot, held.shape, physics, table=0.0, furnish=furnish, others=others
        )
        self.contacts = Contacts(self.simulator.model, robot, [OBJECT])
        self.others = {
            prefix: Contacts(self.simulator.model, other, [OBJECT], prefix)
            for prefix, other in others.items()
        }
        shape = surface(held.shape)
        self.rest_height = -float(shape.bounds[0, 2])
        self._vertices = np.asarray(shape.vertices, dtype=float)
        self._extents = np.asarray(shape.extents, dtype=float)
        self._is_round = held.is_round
        self._is_ball = isinstance(held.shape, Sphere)

    def bottom(self, pose: Array) -> Array:
        """Return the lowest point of the object in the world [m], shape (3,)."""
        points = transform_points(pose, self._vertices)
        return points[np.argmin(points[:, 2])]

    def across(self, pose: Array) -> Array:
        """Return the vector across the object from face to face in the world [m], shape (3,).

        Of a round object any side is as good as another: across is forward, or square to the axis
        of a cylinder that lies. Of others it is the narrowest level side.
        """
        axis = pose[:3, 2]
        if self._is_round:
            is_lying = abs(axis[2]) < _LEVEL and not self._is_ball
            forward = np.array([0.0, 1.0, 0.0])
            line = unit(np.cross(_WORLD_UP, axis)) if is_lying else forward
            return self._extents[0] * line
        level = [k for k in range(3) if abs(pose[2, k]) < _LEVEL]
        narrowest = min(level, key=lambda k: self._extents[k])
        return self._extents[narrowest] * pose[:3, narrowest]
