"""Door and relocate of gymnasium-robotics, with the Adroit hand on its own arm.

Physics, success and places are the maker's: `AdroitHandDoor-v1` and `AdroitHandRelocate-v1`. A
step takes 10 ms and an attempt 200 steps; the goal must hold for 25 steps. The operator moves arm
and wrist by its own joints; the mapping commands the fingers.
"""

import io
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import redirect_stderr
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import mujoco
import numpy as np

from handmap_qp import init_hands
from handmap_qp.apps.simulation.losses import AWAY
from handmap_qp.errors import HandmapError, expect
from handmap_qp.hands import FINGERS, USUAL_SPEEDS, Hand, load_hand
from handmap_qp.se3 import Array
from .operator import HumanHand, Joints
from .task import Scene, Signals

ADROIT = "adroit"
"""Name of the hand as `hands init --speed 50` describes it: no motor is slower."""
ADROIT_ASSUMED = "adroit-assumed"
"""Name of the hand as `hands init --speed 5` describes it: the speed assumed without better."""
SPEEDS = {ADROIT: 50.0, ADROIT_ASSUMED: USUAL_SPEEDS["revolute"]}
"""Speed limit of all joints [rad/s]."""

STEPS = 200
HOLD = 25
_FINGER_OF = dict(zip(("th", "ff", "mf", "rf", "lf"), FINGERS, strict=True))
"""Fingers by the first letters of the maker's names of bodies."""
_LIFTED = 0.01
"""Height above its place on the table from which a ball counts as gripped [m]."""
_TURNED = 0.1
"""Angle from which a door counts as moved [rad]."""


DOOR = "door"
RELOCATE = "relocate"
SCENES = {DOOR: "adroit_door.xml", RELOCATE: "adroit_relocate.xml"}
"""MuJoCo files of the tasks."""


class _Environment(Protocol):
    """What is used of an environment; gymnasium-robotics has no types."""

    model: mujoco.MjModel
    data: mujoco.MjData

    def reset(self, *, seed: int) -> tuple[Array, dict[str, bool]]: ...

    def step(
        self, action: Array, /
    ) -> tuple[Array, float, bool, bool, dict[str, bool]]: ...


class MissingTasksError(HandmapError, ImportError):
    """A task lies in a package of others that is not installed."""

    def __init__(self) -> None:
        super().__init__(
            "gymnasium-robotics is not installed: pip install 'packages/score[tasks]' "
            "in a checkout"
        )


def require_gymnasium() -> None:
    """Reject a run of these tasks where their package is missing.

    Raises:
        MissingTasksError: If it is.
    """
    if find_spec("gymnasium_robotics") is None:
        raise MissingTasksError


def scene_file(kind: str) -> Path:
    """Return the MuJoCo file of a task.

    Raises:
        MissingTasksError: If gymnasium-robotics is not installed.
    """
    spec = find_spec("gymnasium_robotics")
    if spec is None or spec.origin is None:
        raise MissingTasksError
    folder = Path(spec.origin).parent / "envs" / "assets" / "adroit_hand"
    return folder / SCENES[kind]


def describe_hand(name: str, folder: Path) -> Path:
    """Write the `hand.yaml` of the Adroit hand, as `handmap hands init` does.

    Args:
        name: A name in `SPEEDS`.
        folder: Folder to write to; created if it does not exist.

    Raises:
        InvalidInputError: If there is no such name.
        MissingTasksError: If gymnasium-robotics is not installed.
    """
    known = f"{', '.join(SPEEDS)}, or the path of a hand.yaml with the same joints"
    expect(name in SPEEDS, "--hands", known, got=name)
    file = folder / name / "hand.yaml"
    init_hands(
        scene_file(RELOCATE),
        out=file,
        root="palm",
        side="right",
        speed=SPEEDS[name],
        name=name,
        overwrite=True,
    )
    return file


class AdroitTask(ABC):
    """What the tasks have in common.

    Args:
        hand: The robot hand that mappings are made for, as path of its hand.yaml. Its joints have
            the maker's names.

    Attributes:
        name: Name of the task.
        time_limit: Longest time of an attempt [s].
        hold: Steps in a row for which the goal must hold.

    Raises:
        MissingTasksError: If gymnasium-robotics is not installed.
    """

    name: str
    time_limit = STEPS * 0.01
    hold = HOLD
    _environment_class: str
    """Class of gymnasium_robotics.envs.adroit_hand."""
    _bodies: tuple[str, ...]
    """Bodies that the hand is to touch; the first one is the object."""

    def __init__(self, hand: str) -> None:
        self.robot: Hand = load_hand(hand)
        self.other: Hand | None = None
        self._environment = _make(self._environment_class)
        model = self._environment.model
        self._joints = actuated_joints(model)
        expect(
            {*self.robot.joint_names} <= {*self._joints},
            "hand",
            "joints of the Adroit hand",
            got=self.robot.name,
        )
        low, high = model.actuator_ctrlrange.T
        self._middle = 0.5 * (low + high)
        self._half = 0.5 * (high - low)
        self._object = model.body(self._bodies[0]).id
        self._palm = model.body("palm").id
        self._tips = [model.site(f"S_{prefix}tip").id for prefix in _FINGER_OF]
        self._parts = _hand_parts(model)
        touched = [model.body(name).id for name in self._bodies]
        self._is_object = np.isin(np.arange(model.nbody), touched)

    @property
    def time_step(self) -> float:
        """Time between two commands [s]."""
        return 0.01

    @property
    def model(self) -> mujoco.MjModel:
        """The maker's model, with the actuators as the environment sets them."""
        return self._environment.model

    @property
    def data(self) -> mujoco.MjData:
        """The state."""
        return self._environment.data

    def reset(self, seed: int) -> Scene:
        """Begin an attempt; the seed chooses the place of the door, or of ball and target."""
        observation, _ = self._environment.reset(seed=seed)
        self._steps = 0
        self._control = np.clip(
            0.0, self._middle - self._half, self._middle + self._half
        )
        self._start = self.data.xpos[self._object].copy()
        return self._scene(observation, is_reached=False)

    def step(self, hand: HumanHand, command: Joints) -> Scene:
        """Move for 10 ms: arm and wrist by the operator's joints, fingers by the command."""
        wanted = {**hand.joints, **command}
        self._control = np.array(
            [
                wanted.get(name, last)
                for name, last in zip(self._joints, self._control, strict=True)
            ]
        )
        action = np.clip((self._control - self._middle) / self._half, -1.0, 1.0)
        observation, _, _, _, about = self._environment.step(action)
        self._steps += 1
        return self._scene(observation, is_reached=bool(about["success"]))

    @abstractmethod
    def cause(self, course: Sequence[Signals]) -> str:
        """Return why an attempt failed, by the classes of this task."""

    @abstractmethod
    def _moved(self) -> float:
        """Return how far the object is from its start, as of `Signals`."""

    @abstractmethod
    def _is_gripped(self, touching: frozenset[str]) -> bool:
        """Return whether the hand has the object, by the parts that touch it."""

    def _scene(self, observation: Array, *, is_reached: bool) -> Scene:
        touching, force = self._contacts()
        return Scene(
            time=self._steps * self.time_step,
            observation=np.asarray(observation, dtype=float),
            poses={
                "object": _pose(self.data, self._object),
                "wrist": _pose(self.data, self._palm),
            },
            points={"pads": self.data.site_xpos[self._tips].copy()},
            signals=Signals(
                is_reached=is_reached,
                touching=touching,
                is_gripped=self._is_gripped(touching),
                force=force,
                moved=self._moved(),
            ),
        )

    def _contacts(self) -> tuple[frozenset[str], float]:
        """Return the parts of the hand that touch the object, and the largest force [N]."""
        data = self.data
        bodies = self.model.geom_bodyid[data.contact.geom]
        touching: set[str] = set()
        force = 0.0
        for i in np.flatnonzero(self._is_object[bodies].any(axis=1)):
            # A contact may be within the margin of two shapes that do not touch.
            other = next((int(b) for b in bodies[i] if not self._is_object[b]), -1)
            part = self._parts.get(other)
            if part is None or data.contact.dist[i] > 0.0:
                continue
            wrench = np.zeros(6)
            mujoco.mj_contactForce(self.model, data, int(i), wrench)
            touching.add(part)
            force = max(force, float(wrench[0]))
        return frozenset(touching), force


class Door(AdroitTask):
    """Turn the latch of a door, and pull the door open."""

    name = DOOR
    _environment_class = "AdroitHandDoorEnv"
    _bodies = ("latch", "door")

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the door was not opened."""
        return door_cause(course)

    def _moved(self) -> float:
        return float(self.data.joint("door_hinge").qpos[0])

    def _is_gripped(self, touching: frozenset[str]) -> bool:
        return len(touching) > 1


class Relocate(AdroitTask):
    """Lift a ball, and carry it to a place in the air."""

    name = RELOCATE
    _environment_class = "AdroitHandRelocateEnv"
    _bodies = ("Object",)

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the ball did not arrive."""
        return relocate_cause(course)

    def _moved(self) -> float:
        return float(np.linalg.norm(self._travel()))

    def _is_gripped(self, touching: frozenset[str]) -> bool:
        return bool(touching) and float(self._travel()[2]) > _LIFTED

    def _travel(self) -> Array:
        """Return the way of the ball from its start [m], shape (3,)."""
        return self.data.xpos[self._object] - self._start


def door_cause(course: Sequence[Signals]) -> str:
    """Return why a door was not opened."""
    if not any(one.touching for one in course):
        return "never reached"
    opened = max(one.moved for one in course)
    if opened < _TURNED:
        gripped = any(one.is_gripped for one in course)
        return "gripped, not opened" if gripped else "touched by one part, not opened"
    return "opened, not wide enough"


def relocate_cause(course: Sequence[Signals]) -> str:
    """Return why a ball did not arrive, by what touched it and whether it left the table."""
    first = next((one for one in course if one.touching), None)
    if first is None:
        return "never reached"
    if any(one.is_gripped for one in course):
        is_held = course[-1].is_gripped
        return "gripped, not at the target" if is_held else "gripped, then lost"
    grips = [one for one in course if len(one.touching) > 1]
    if not grips:
        return "touched by one part"
    if grips[0].moved - first.moved > AWAY:
        is_thumb = first.touching == {"thumb"}
        return f"pushed away by {'the thumb' if is_thumb else 'a finger'}"
    return "touched, never gripped"


def _make(name: str) -> _Environment:
    """Return a new environment, without the wrappers that check and count for learners."""
    require_gymnasium()
    # The package prints notes for learners, on rewards that nobody uses here.
    with redirect_stderr(io.StringIO()):
        classes = import_module("gymnasium_robotics.envs.adroit_hand")
    return vars(classes)[name]()


def actuated_joints(model: mujoco.MjModel) -> tuple[str, ...]:
    """Return the name of each actuator's joint."""
    return tuple(model.joint(joint).name for joint in model.actuator_trnid[:, 0])


def _hand_parts(model: mujoco.MjModel) -> dict[int, str]:
    """Return the finger of each of the hand's bodies, or `palm`."""
    parts = {}
    for body in range(model.nbody):
        name = model.body(body).name
        if name == "palm":
            parts[body] = name
        elif name[:2] in _FINGER_OF:
            parts[body] = _FINGER_OF[name[:2]]
    return parts


def _pose(data: mujoco.MjData, body: int) -> Array:
    """Return the pose of a body, shape (4, 4)."""
    pose = np.eye(4)
    pose[:3, :3] = data.xmat[body].reshape(3, 3)
    pose[:3, 3] = data.xpos[body]
    return pose
