"""Door and relocate of gymnasium-robotics, with the Adroit hand on its own arm.

Physics, success and places are the maker's: `AdroitHandDoor-v1` and `AdroitHandRelocate-v1`. A
step takes 10 ms and an attempt 200 steps; the goal must hold for 25 steps. The operator moves arm
and wrist by its own joints; the mapping commands the fingers.
"""

from collections.abc import Sequence
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import NamedTuple, Protocol

import mujoco
import numpy as np
from msgspec.structs import replace

from handmap_qp.apps.onboarding.detect import detect_hands
from handmap_qp.apps.onboarding.edit import described
from handmap_qp.apps.onboarding.speeds import with_speed
from handmap_qp.apps.onboarding.write import open_source, write_hand
from handmap_qp.errors import HandmapError, expect
from handmap_qp.hands import FINGERS, Hand, load_hand
from handmap_qp.se3 import Array
from .operator import HumanHand, Joints
from .task import Scene, Signals

ADROIT = "adroit"
"""Name of the hand as `hands init --speed 50` describes it: no motor is slower."""
ADROIT_ASSUMED = "adroit-assumed"
"""Name of the hand as `hands init` describes it, which assumes 5 rad/s."""
SPEEDS = {ADROIT: 50.0, ADROIT_ASSUMED: None}
"""Speed limit of all joints [rad/s]; None for what `hands init` assumes."""

STEPS = 200
HOLD = 25
_FINGER_OF = dict(zip(("th", "ff", "mf", "rf", "lf"), FINGERS, strict=True))
"""Fingers by the first letters of the maker's names of bodies."""
_LIFTED = 0.01
"""Height above its place on the table from which a ball counts as gripped [m]."""
_PUSHED = 0.01
"""Distance from which a ball that was touched counts as pushed away [m]."""
_TURNED = 0.1
"""Angle from which a door counts as moved [rad]."""


class _Kind(NamedTuple):
    """What the tasks differ in.

    Attributes:
        environment: Class of gymnasium_robotics.envs.adroit_hand.
        scene: Its MuJoCo file.
        bodies: Bodies that the hand is to touch; the first is the object.
    """

    environment: str
    scene: str
    bodies: tuple[str, ...]


DOOR = "door"
RELOCATE = "relocate"
KINDS = {
    DOOR: _Kind("AdroitHandDoorEnv", "adroit_door.xml", ("latch", "door")),
    RELOCATE: _Kind("AdroitHandRelocateEnv", "adroit_relocate.xml", ("Object",)),
}


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
            "gymnasium-robotics is not installed: pip install 'examples/score[tasks]' "
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
    return folder / KINDS[kind].scene


def describe_hand(name: str, folder: Path) -> Path:
    """Write the `hand.yaml` of the Adroit hand, as `handmap hands init` does.

    Args:
        name: A name in `SPEEDS`.
        folder: Folder to write to; created if it does not exist.

    Raises:
        MissingTasksError: If gymnasium-robotics is not installed.
    """
    file = folder / name / "hand.yaml"
    file.parent.mkdir(parents=True, exist_ok=True)
    source = open_source(scene_file(RELOCATE), file.parent, overwrite=True)
    found, *others = detect_hands(
        source[0], root="palm", base=None, side="right", thumb=None, name=name
    )
    expect(not others, "scene", "one hand", value=len(others) + 1)
    speed = SPEEDS[name]
    spec = found.spec if speed is None else with_speed(found.spec, speed)
    spec = replace(spec, name=name)
    write_hand(described(found._replace(spec=spec), source), file)
    return file


class AdroitTask:
    """One of the two tasks.

    Args:
        kind: `door` or `relocate`.
        hand: The robot hand that mappings are made for, as path of its hand.yaml. Its joints have
            the maker's names.

    Raises:
        MissingTasksError: If gymnasium-robotics is not installed.
    """

    time_limit = STEPS * 0.01
    hold = HOLD

    def __init__(self, kind: str, hand: str) -> None:
        self.name = kind
        self.robot: Hand = load_hand(hand)
        self._kind = KINDS[kind]
        self._environment = _make(self._kind)
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
        self._object = model.body(self._kind.bodies[0]).id
        self._palm = model.body("palm").id
        self._tips = [model.site(f"S_{prefix}tip").id for prefix in _FINGER_OF]
        self._parts = _hand_parts(model)
        self._is_object = np.isin(
            np.arange(model.nbody), [model.body(name).id for name in self._kind.bodies]
        )

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

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why an attempt failed, by the classes of this task."""
        return door_cause(course) if self.name == DOOR else relocate_cause(course)

    def _scene(self, observation: Array, *, is_reached: bool) -> Scene:
        poses = {
            "object": _pose(self.data, self._object),
            "wrist": _pose(self.data, self._palm),
        }
        if self.name == RELOCATE:
            target = np.eye(4)
            target[:3, 3] = self.data.site("target").xpos
            poses["target"] = target
        pads = self.data.site_xpos[self._tips].copy()
        return Scene(
            time=self._steps * self.time_step,
            observation=np.asarray(observation, dtype=float),
            poses=poses,
            points={"pads": pads},
            signals=self._signals(is_reached=is_reached),
        )

    def _signals(self, *, is_reached: bool) -> Signals:
        touching, force = self._contacts()
        if self.name == DOOR:
            moved = float(self.data.joint("door_hinge").qpos[0])
            is_gripped = len(touching) > 1
        else:
            travel = self.data.xpos[self._object] - self._start
            moved = float(np.linalg.norm(travel))
            is_gripped = bool(touching) and float(travel[2]) > _LIFTED
        return Signals(is_reached, touching, is_gripped, force, moved)

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
    if grips[0].moved - first.moved > _PUSHED:
        is_thumb = first.touching == {"thumb"}
        return f"pushed away by {'the thumb' if is_thumb else 'a finger'}"
    return "touched, never gripped"


def _make(kind: _Kind) -> _Environment:
    """Return a new environment, without the wrappers that check and count for learners."""
    require_gymnasium()
    classes = import_module("gymnasium_robotics.envs.adroit_hand")
    return vars(classes)[kind.environment]()


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
