"""Pinch and carry: a recorded pinch closes on an object, which must then stay (`PinchScene`).

The object stands on a stand where the robot's pads come together when nothing is between them. The
stand lets go when the thumb and another finger press on it, or when the pads should have met it a
while ago. From then until the human opens his hand, the object must stay between the pads.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.simulation.commands import Commands, PinchWindow
from handmap_qp.apps.simulation.objects import (
    Body,
    Box,
    MeshShape,
    Shape,
    Sphere,
)
from handmap_qp.apps.simulation.physics import Physics, turn_up
from handmap_qp.apps.simulation.simulator import Episode, Instant, Simulator
from handmap_qp.errors import expect
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import THUMB
from handmap_qp.hands.pads import find_pads
from handmap_qp.se3 import affine, inverse_pose, transform_points

CUBE = Box((0.03, 0.03, 0.03))
"""The nominal object."""

_INDEX = "index"
# Force of thumb and of another finger at which the stand lets go [N].
_PRESSED = 0.2
# The stand lets go this long after the pads should have met the object, at the latest [s].
_LATEST = 0.3
# The object is lost farther than this, and half its size, from the middle between the pads [m].
_LOST = 0.02
# The robot's pads meet this long after the human's, at the latest [s]; filters make some late.
_LAG = 1.0
# The object of the simulation in which the pads meet, far from the hand.
_NOTHING = Body(Sphere(0.01), 0.01)
_FAR = affine(np.eye(3), np.array([0.0, 0.0, 100.0]))


class Pads:
    """The pads of a hand's thumb and index finger.

    Args:
        hand: The hand.

    Raises:
        InvalidInputError: If the hand has no index finger, or no thumb.
    """

    def __init__(self, hand: Hand) -> None:
        chains = find_fingers(hand)
        expect(
            {THUMB, _INDEX} <= chains.keys(),
            "robot",
            f"a hand with {THUMB} and {_INDEX}",
            got=f"{hand.name} with {', '.join(chains)}",
        )
        self._pads = find_pads(hand, {name: chains[name] for name in (THUMB, _INDEX)})
        self._bodies = ["world", *hand.model.names[1:]]
        self._of_thumb = [self._bodies[joint] for joint in chains[THUMB].joints]

    def places(self, simulator: Simulator) -> np.ndarray:
        """Return the middles of the pads of thumb and finger in the world [m], shape (2, 3)."""
        return np.array(
            [
                transform_points(
                    simulator.body_pose(self._bodies[pad.joint]), pad.offset
                )
                for pad in self._pads.values()
            ]
        )

    def gap(self, places: np.ndarray) -> float:
        """Return the distance between the pads' surfaces at such places [m]."""
        radii = sum(pad.radius for pad in self._pads.values())
        return float(np.linalg.norm(places[1] - places[0])) - radii

    def middle(self, places: np.ndarray) -> np.ndarray:
        """Return the point midway between the pads' surfaces at such places [m], shape (3,)."""
        thumb, finger = places
        distance = max(float(np.linalg.norm(finger - thumb)), 1e-6)
        farther = self._pads[THUMB].radius - self._pads[_INDEX].radius
        share = np.clip(0.5 + 0.5 * farther / distance, 0.0, 1.0)
        return thumb + share * (finger - thumb)

    def is_pinched(self, simulator: Simulator) -> bool:
        """Return whether the thumb and another link press on the object."""
        contacts = simulator.contacts()
        is_thumb = np.isin(contacts.bodies, self._of_thumb)
        pressing = contacts.normal_forces
        return min(pressing[is_thumb].sum(), pressing[~is_thumb].sum()) > _PRESSED


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


class Meeting(NamedTuple):
    """The robot's pads when they are as near as an object is wide.

    Attributes:
        time: The instant [s].
        places: As of `Pads.places`.
    """

    time: float
    places: np.ndarray


class PinchScene:
    """A robot that follows a recorded pinch, and objects for it.

    Args:
        commands: Commands of the mapping for the whole recording.
        window: When the human pinches.
        physics: Actuators, gravity and time steps; the friction is that of each trial.

    Raises:
        InvalidInputError: If the hand has no thumb, or no index finger.
        HandError: If the hand has no collision shapes.
    """

    def __init__(
        self, commands: Commands, window: PinchWindow, physics: Physics
    ) -> None:
        self.commands = commands
        self.window = window
        self.physics = physics
        self.pads = Pads(commands.hand)

    def run(self, trial: PinchTrial) -> PinchOutcome:
        """Simulate one trial.

        Args:
            trial: The object and its place; the friction is the trial's.

        Returns:
            What became of the object.
        """
        commands = self.commands
        window = self.window
        pads = self.pads
        width = trial.shape.width
        met = self.meeting(width)
        place = pads.middle(met.places) + np.array(trial.offset)
        simulator = self._start(
            Body(trial.shape, trial.mass),
            self.physics.replaced(friction=trial.friction),
            affine(self._upright(met, trial.yaw), place),
        )
        instants, distances = [], []
        for i in range(window.start + 1, window.end + 1):
            goal, wrist = commands.at(i)
            simulator.follow(goal, wrist, commands.time[i] - commands.time[i - 1])
            instants.append(simulator.instant())
            is_late = commands.time[i] >= met.time + _LATEST
            if not distances and (is_late or pads.is_pinched(simulator)):
                simulator.set_stand(holds=False)
            elif not distances:
                continue
            middle = pads.middle(pads.places(simulator))
            off = simulator.object_pose[:3, 3] - middle
            distances.append(float(np.linalg.norm(off)))
        episode = Episode.of(simulator, instants)
        # Pads that never pressed had no object to lose.
        distances = distances or [np.inf]
        time = commands.time[: window.end + 1][-len(distances) :]
        return _outcome(episode, np.array(distances), time, width)

    def meeting(self, width: float) -> Meeting:
        """Return the first instant at which the pads are as near as an object is wide.

        Actuators lag behind their commands by some 50 ms, so the pads meet later and, as the wrist
        moves meanwhile, elsewhere than commanded.

        Args:
            width: Width of the object [m].

        Returns:
            The instant, or that of the smallest gap if the pads do not come near enough.
        """
        instants = self._closing
        gaps = np.array([self.pads.gap(instant.places) for instant in instants])
        near = np.flatnonzero(gaps <= width)
        if not len(near):
            return instants[int(np.argmin(gaps))]
        last = int(near[0])
        if last == 0:
            return instants[0]
        before, after = instants[last - 1], instants[last]
        share = (gaps[last - 1] - width) / (gaps[last - 1] - gaps[last])
        return Meeting(
            before.time + share * (after.time - before.time),
            before.places + share * (after.places - before.places),
        )

    @cached_property
    def _closing(self) -> list[Meeting]:
        """The robot's own motion while the human's pinch closes, with nothing between the pads."""
        commands = self.commands
        time = commands.time
        window = self.window
        simulator = self._start(_NOTHING, self.physics, _FAR)
        last = int(np.searchsorted(time, time[window.closed] + _LAG))
        instants = []
        for i in range(window.start + 1, min(last, window.end)):
            simulator.follow(*commands.at(i), time[i] - time[i - 1])
            instants.append(Meeting(float(time[i]), self.pads.places(simulator)))
        return instants

    def _start(self, body: Body, physics: Physics, place: np.ndarray) -> Simulator:
        """Put an object on its stand, and the hand where the recording starts."""
        simulator = Simulator(self.commands.hand, body, physics)
        simulator.reset(*self.commands.at(self.window.start), place)
        simulator.set_stand(holds=True)
        return simulator

    def _upright(self, met: Meeting, yaw: float) -> np.ndarray:
        """Return axes with z up and x along the pinch, turned by `yaw` about the vertical."""
        gravity = np.array(self.physics.gravity)
        up = -gravity if gravity.any() else np.array([0.0, 0.0, 1.0])
        thumb, finger = met.places
        turn = Rotation.from_euler("z", yaw).as_matrix()
        return turn_up(up, finger - thumb).T @ turn


def _outcome(
    episode: Episode, distances: np.ndarray, time: np.ndarray, width: float
) -> PinchOutcome:
    """Judge the instants at the end, for which there are distances from the pads' middle."""
    lost = np.flatnonzero(distances > _LOST + width / 2.0)
    last = int(lost[0]) if len(lost) else len(distances) - 1
    first = len(episode.at.time) - len(distances)
    kept = Instant(*(column[first : first + last + 1] for column in episode.at))
    poses = inverse_pose(kept.wrist) @ kept.object_pose
    turn = Rotation.from_matrix(poses[-1, :3, :3] @ poses[0, :3, :3].T).magnitude()
    return PinchOutcome(
        is_held=not len(lost) and bool(episode.at.links_touching[-1] >= 2),
        held_time=float(time[last] - time[0]),
        pinch_time=float(time[-1] - time[0]),
        slip=float(np.linalg.norm(poses[:, :3, 3] - poses[0, :3, 3], axis=1).max()),
        rotation=float(turn),
        force=float(kept.normal_force.mean()),
        episode=episode,
    )
