"""The seam of tasks: a scene in MuJoCo, moved by an operator's wrist and a robot's joints."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import mujoco

from handmap_qp.hands import Hand
from handmap_qp.se3 import Array
from .operator import HumanHand, Joints


class Signals(NamedTuple):
    """What a task measures in one step.

    Attributes:
        is_reached: Whether the task's goal holds now; it succeeds when it has held for `hold`.
        touching: Parts of the hand that touch the object: `palm`, `thumb`, `index` and so on.
        is_gripped: Whether the hand has the object: off the table, or its latch turned.
        force: Largest normal force between the hand and the object [N]; 0 without contact.
        moved: Distance of the object from where it was at the beginning [m]; for an object on a
            hinge the angle [rad].
    """

    is_reached: bool
    touching: frozenset[str]
    is_gripped: bool
    force: float
    moved: float


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What can be seen at one instant.

    Attributes:
        time: Time since the beginning of the attempt [s].
        observation: The vector that the task's expert takes; empty where there is none.
        poses: Poses by name in the task's world, (4, 4) each. `object` and `wrist` (the robot's
            real one) always; others, such as `target`, as the task says.
        points: Points by name in the task's world [m], (n, 3) each; such as `pads`.
        signals: What the task measures. Not for operators.
        joints: Positions of the robot's joints as encoders measure them, by name [rad or m]; empty
            where a task does not measure them. Not for operators.
    """

    time: float
    observation: Array
    poses: Mapping[str, Array]
    points: Mapping[str, Array]
    signals: Signals
    joints: Joints = field(default_factory=dict)


class Record(NamedTuple):
    """Physics of an attempt, enough to show it and to judge it again.

    Attributes:
        seed: Seed of the task, which chose the scene.
        times: Instants, from 0 [s], shape (T,).
        qpos: MuJoCo's joint positions at each instant, shape (T, nq).
        body_pos: The model's positions of bodies in their parents [m], shape (nbody, 3); a task
            may place them by the seed.
        site_pos: The same of sites, shape (nsite, 3).
    """

    seed: int
    times: Array
    qpos: Array
    body_pos: Array
    site_pos: Array


class Task(Protocol):
    """A task of a robot hand. An object of it is used by one process, for one attempt at a time."""

    @property
    def name(self) -> str:
        """Short name, for tables."""
        ...

    @property
    def time_step(self) -> float:
        """Time between two commands [s]."""
        ...

    @property
    def time_limit(self) -> float:
        """Longest time of an attempt [s]."""
        ...

    @property
    def hold(self) -> int:
        """Steps in a row for which the goal must hold."""
        ...

    @property
    def model(self) -> mujoco.MjModel:
        """The model, with bodies and sites where the last `reset` put them."""
        ...

    @property
    def data(self) -> mujoco.MjData:
        """The state after the last `reset` or `step`."""
        ...

    @property
    def robot(self) -> Hand:
        """The robot hand that mappings are made for."""
        ...

    @property
    def other(self) -> Hand | None:
        """The robot's other hand, which gets a mapping of its own; None in a task of one hand."""
        ...

    def reset(self, seed: int) -> Scene:
        """Begin an attempt; the seed chooses where things are."""
        ...

    def step(self, hand: HumanHand, command: Joints) -> Scene:
        """Move for one time step.

        Args:
            hand: The operator's hand; its wrist, or the joints of its arm, move the robot's wrist.
            command: Commanded joints of the robot's fingers [rad or m]; names of the other hand's
                begin with `operator.OTHER`. Joints that are missing keep their last command; names
                that the robot does not have are ignored.
        """
        ...

    def cause(self, course: Sequence[Signals]) -> str:
        """Return in a few words why an attempt failed, by its signals in order of time."""
        ...
