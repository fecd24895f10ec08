"""Pinch and carry: a recorded pinch closes on an object, which must then stay (`PinchScene`).

The object stands on a stand where the robot's pads come together when nothing is between them. The
stand lets go when the thumb and another finger press on it, or when the pads should have met it a
while ago. From then until the human opens his hand, the object must stay between the pads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.se3 import affine
from handmap_qp.simulation.actuators import Actuators
from handmap_qp.simulation.commands import Commands
from handmap_qp.simulation.episode import Episode, Recorder
from handmap_qp.simulation.meeting import Closing, Meeting
from handmap_qp.simulation.pads import PadFinder
from handmap_qp.simulation.physics import Body, MeshShape, Physics
from handmap_qp.simulation.pinch_window import PinchWindow
from handmap_qp.simulation.simulator import Simulator

# The stand lets go this long after the pads should have met the object, at the latest [s].
_LATEST = 0.3
# Force of thumb and of another finger at which the stand lets go [N].
_PRESSED = 0.2
# The object is lost farther than this, and half its size, from the middle between the pads [m].
_LOST = 0.02

CUBE = Box((0.03, 0.03, 0.03))
"""The nominal object."""


@dataclass(frozen=True, slots=True, eq=False)
class PinchTrial:
    """One object and its place.

    Attributes:
        shape: The object's shape; a cube of 30 mm if omitted.
        mass: Its mass [kg].
        friction: Coulomb coefficient.
        offset: Displacement of its place from where the pads meet [m], in world axes.
        yaw: Rotation about the vertical [rad].
    """

    shape: Shape | MeshShape = CUBE
    mass: float = 0.05
    friction: float = 0.8
    offset: tuple[float, float, float] = (0.0, 0.0, 0.0)
    yaw: float = 0.0

    @property
    def kind(self) -> str:
        """Name of the kind of its shape, such as box."""
        return type(self.shape).__name__.lower()

    @property
    def size(self) -> float:
        """Width of the object along the pinch, about [m]."""
        shape = self.shape
        if isinstance(shape, Box):
            return shape.size[0]
        if isinstance(shape, Sphere | Cylinder):
            return 2.0 * shape.radius
        return float(np.ptp(shape.points[:, 0]))


@dataclass(frozen=True, slots=True, eq=False)
class PinchOutcome:
    """Result of one trial.

    Attributes:
        is_held: Whether the object stayed between the pads until the human opened the hand.
        held_time: Time from the stand's letting go to the loss, or to the opening [s].
        pinch_time: Time from the stand's letting go to the opening [s].
        slip: Largest displacement of the object from its place between the pads [m], while held.
        rotation: Rotation of the object against the wrist, at the end or the loss [rad].
        force: Mean normal force while held [N].
        episode: The simulation.
    """

    is_held: bool
    held_time: float
    pinch_time: float
    slip: float
    rotation: float
    force: float
    episode: Episode


class Regulator(Protocol):
    """Changes the mapped command while the pads press on the object."""

    def command(
        self,
        pads: PadFinder,
        q: np.ndarray,
        command: np.ndarray,
        wrist: np.ndarray,
        stiffness: float,
    ) -> np.ndarray:
        """Return the command for the joints [rad], shape (n,)."""
        ...


class PinchScene:
    """A robot that follows a recorded pinch, and objects for it.

    Args:
        commands: Commands of the mapping for the whole recording.
        window: When the human pinches.
        physics: Stiffness, gravity and time steps.
        actuators: What moves the joints; servos if omitted.

    Raises:
        InvalidInputError: If the hand has no thumb, or no such finger.
        HandError: If the hand has no collision shapes.
    """

    def __init__(
        self,
        commands: Commands,
        window: PinchWindow,
        physics: Physics,
        actuators: Actuators | None = None,
    ) -> None:
        self.commands, self.window, self.physics = commands, window, physics
        self.actuators = actuators
        self.pads = PadFinder(commands.hand, window.finger)

    @cached_property
    def closing(self) -> Closing:
        """The robot's own motion without an object."""
        return Closing(self.pads, self.commands, self.window, self.physics, self.actuators)

    def run(self, trial: PinchTrial, regulator: Regulator | None = None) -> PinchOutcome:
        """Simulate one trial.

        Args:
            trial: The object and its place; the friction is the trial's.
            regulator: Squeeze term; position control alone if omitted.

        Returns:
            What became of the object.
        """
        commands, window, pads = self.commands, self.window, self.pads
        met = self.closing.meeting(trial.size)
        simulator = self._start(trial, met)
        recorder = Recorder(simulator)
        released: int | None = None
        distances: list[float] = []
        for i in range(window.start + 1, window.end + 1):
            self._follow(simulator, i, regulator)
            recorder.sample()
            is_late = commands.time[i] >= met.time + _LATEST
            if released is None and (is_late or pads.is_pinched(simulator, _PRESSED)):
                simulator.set_stand(holds=False)
                released = i
            if released is not None:
                between = simulator.object_pose[:3, 3] - pads.middle(simulator.q, simulator.wrist)
                distances.append(float(np.linalg.norm(between)))
        if released is None:
            return _outcome(recorder.episode(), np.full(1, np.inf), commands.time[-1:], trial)
        time = commands.time[released : window.end + 1]
        return _outcome(recorder.episode(), np.array(distances), time, trial)

    def _start(self, trial: PinchTrial, met: Meeting) -> Simulator:
        """Put the object on its stand, and the hand where the recording starts."""
        commands, start = self.commands, self.window.start
        physics = replace(self.physics, friction=trial.friction)
        simulator = Simulator(commands.hand, Body(trial.shape, trial.mass), physics, self.actuators)
        place = self.pads.middle(met.q, met.wrist) + np.array(trial.offset)
        simulator.reset(
            commands.q[start],
            commands.wrist[start] if commands.hand.is_floating else None,
            affine(_upright(self.pads, met, physics, trial.yaw), place),
        )
        simulator.set_stand(holds=True)
        return simulator

    def _follow(self, simulator: Simulator, i: int, regulator: Regulator | None) -> None:
        """Simulate up to sample i."""
        commands, pads = self.commands, self.pads
        goal = commands.q[i]
        if regulator is not None and pads.is_pinched(simulator, _PRESSED):
            stiffness = self.physics.joint_stiffness
            goal = regulator.command(pads, simulator.q, goal, simulator.wrist, stiffness)
        step = float(commands.time[i] - commands.time[i - 1])
        simulator.follow(goal, commands.wrist[i] if commands.hand.is_floating else None, step)


def _outcome(
    episode: Episode, distances: np.ndarray, time: np.ndarray, trial: PinchTrial
) -> PinchOutcome:
    lost = np.flatnonzero(distances > _LOST + trial.size / 2.0)
    last = int(lost[0]) if len(lost) else len(distances) - 1
    first = len(episode.time) - len(distances)
    poses = episode.object_in_wrist[first : first + last + 1]
    turn = Rotation.from_matrix(poses[-1, :3, :3] @ poses[0, :3, :3].T).magnitude()
    return PinchOutcome(
        is_held=len(lost) == 0 and bool(episode.touching[-1] >= 2),
        held_time=float(time[min(last, len(time) - 1)] - time[0]),
        pinch_time=float(time[-1] - time[0]),
        slip=float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max()),
        rotation=float(turn),
        force=float(episode.force[first : first + last + 1].mean()),
        episode=episode,
    )


def _upright(pads: PadFinder, met: Meeting, physics: Physics, yaw: float) -> np.ndarray:
    """Return axes with z up and x along the pinch, turned by `yaw` about the vertical."""
    up = -np.array(physics.gravity)
    up = up / np.linalg.norm(up) if up.any() else np.array([0.0, 0.0, 1.0])
    thumb, finger = pads.places(met.q, met.wrist)
    across = finger - thumb
    across -= (across @ up) * up
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    x = across / np.linalg.norm(across)
    axes = np.column_stack([x, np.cross(up, x), up])
    return Rotation.from_rotvec(yaw * up).as_matrix() @ axes
