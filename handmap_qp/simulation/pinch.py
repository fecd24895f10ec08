"""Pinch and carry: a recorded pinch closes on an object, which must then stay (`PinchScene`).

The object stands on a stand where the robot's pads come together in the free mapped motion. The
stand lets go when the thumb and another finger press on it, or when the human's pinch has been
closed for a while. From then until the human opens his hand, the object must stay between the pads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.objects import Box, Cylinder, Shape, Sphere
from handmap_qp.hands.fingers import THUMB, find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import Pad, find_pads
from handmap_qp.simulation.episode import Episode, Recorder
from handmap_qp.simulation.physics import Body, MeshShape, Physics
from handmap_qp.simulation.simulator import Simulator
from handmap_qp.trackers.recording import Recording
from handmap_qp.transform import affine

# The human pinches while thumb and index landmarks are nearer than the first, with interruptions
# below the second [m].
_CLOSED, _OPEN = 0.022, 0.035
# Shortest pinch that counts [s].
_SHORTEST = 0.5
# The simulation starts this long before the pinch [s].
_BEFORE = 0.25
# The robot's pads meet this long after the human's, at the latest [s]; filters make some late.
_LAG = 1.0
# The stand lets go this long after the pads should have met the object, at the latest [s].
_LATEST = 0.3
# Force of thumb and of another finger at which the stand lets go [N].
_PRESSED = 0.2
# The object is lost farther than this, and half its size, from the middle between the pads [m].
_LOST = 0.02


CUBE = Box((0.03, 0.03, 0.03))
"""The nominal object."""


class PinchWindow(NamedTuple):
    """When the human pinches.

    Attributes:
        finger: The finger that meets the thumb.
        start: Index of the first sample of the simulation.
        closed: Index of the sample at which the pinch has closed.
        end: Index of the last sample at which it is closed.
    """

    finger: str
    start: int
    closed: int
    end: int


def find_pinch(recording: Recording) -> PinchWindow:
    """Find the longest pinch of thumb and index finger in a recording.

    Raises:
        InvalidInputError: If there is no pinch of half a second.
    """
    gap = np.linalg.norm(recording.landmarks[:, 4] - recording.landmarks[:, 8], axis=1)
    best: tuple[float, int, int] | None = None
    start: int | None = None
    for i, value in enumerate(gap):
        if start is None and value < _CLOSED:
            start = i
        if start is not None and (value > _OPEN or i == len(gap) - 1):
            length = float(recording.time[i] - recording.time[start])
            if best is None or length > best[0]:
                shut = np.flatnonzero(gap[start:i] < _CLOSED)
                best = (length, start, start + int(shut[-1]))
            start = None
    if best is None or best[0] < _SHORTEST:
        raise InvalidInputError(
            argument=recording.name,
            problem=f"no pinch of thumb and index finger of {_SHORTEST:g} s",
        )
    _, closed, end = best
    first = int(np.searchsorted(recording.time, recording.time[closed] - _BEFORE))
    return PinchWindow("index", first, closed, end)


@dataclass(frozen=True, slots=True, eq=False)
class Commands:
    """What a mapping commands over time.

    Attributes:
        name: Name of the mapping.
        hand: The robot hand.
        time: Instants [s], shape (T,).
        q: Joint angles [rad], shape (T, n).
        wrist: Wrist poses, shape (T, 4, 4).
    """

    name: str
    hand: Hand
    time: np.ndarray
    q: np.ndarray
    wrist: np.ndarray


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


def run_pinch(
    commands: Commands,
    window: PinchWindow,
    trial: PinchTrial,
    physics: Physics,
    regulator: Regulator | None = None,
) -> PinchOutcome:
    """Simulate one trial.

    Args:
        commands: Commands of the mapping for the whole recording.
        window: When the human pinches.
        trial: The object and its place.
        physics: Actuators, gravity and time steps; the friction is the trial's.
        regulator: Squeeze term; position control alone if omitted.

    Returns:
        What became of the object.
    """
    hand = commands.hand
    pads = PadFinder(hand, window.finger)
    physics = replace(physics, friction=trial.friction)
    simulator = Simulator(hand, Body(trial.shape, trial.mass), physics)
    met = _meeting(pads, commands, window, trial.size)
    place = pads.middle(commands.q[met], commands.wrist[met]) + np.array(trial.offset)
    simulator.reset(
        commands.q[window.start],
        commands.wrist[window.start] if hand.is_floating else None,
        affine(_upright(pads, commands, met, physics, trial.yaw), place),
    )
    simulator.set_stand(holds=True)
    recorder = Recorder(simulator)
    released: int | None = None
    distances: list[float] = []
    latest = commands.time[met] + _LATEST
    for i in range(window.start + 1, window.end + 1):
        step = float(commands.time[i] - commands.time[i - 1])
        goal = commands.q[i]
        if regulator is not None and pads.is_pinched(simulator, _PRESSED):
            wrist, stiffness = simulator.wrist, physics.joint_stiffness
            goal = regulator.command(pads, simulator.q, goal, wrist, stiffness)
        simulator.follow(goal, commands.wrist[i] if hand.is_floating else None, step)
        recorder.sample()
        if released is None and (
            pads.is_pinched(simulator, _PRESSED) or commands.time[i] >= latest
        ):
            simulator.set_stand(holds=False)
            released = i
        if released is not None:
            between = simulator.object_pose[:3, 3] - pads.middle(simulator.q, simulator.wrist)
            distances.append(float(np.linalg.norm(between)))
    if released is None:
        return _outcome(recorder.episode(), np.full(1, np.inf), commands.time[-1:], trial)
    time = commands.time[released : window.end + 1]
    return _outcome(recorder.episode(), np.array(distances), time, trial)


def _meeting(pads: PadFinder, commands: Commands, window: PinchWindow, size: float) -> int:
    """Return the first sample at which the pads are as near as the object is wide."""
    last = int(np.searchsorted(commands.time, commands.time[window.closed] + _LAG))
    samples = range(window.start + 1, min(last, window.end))
    gaps = np.array([pads.gap(commands.q[i], commands.wrist[i]) for i in samples])
    near = np.flatnonzero(gaps <= size)
    return samples[int(near[0]) if len(near) else int(np.argmin(gaps))]


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


class PadFinder:
    """Places of the pads of the thumb and of one finger.

    Args:
        hand: The hand.
        finger: The finger.

    Raises:
        InvalidInputError: If the hand has no such finger, or no thumb.
    """

    def __init__(self, hand: Hand, finger: str) -> None:
        chains = find_fingers(hand)
        if THUMB not in chains or finger not in chains:
            raise InvalidInputError(
                argument="robot",
                expected=f"a hand with {THUMB} and {finger}",
                got=f"{hand.name} with {', '.join(chains)}",
            )
        self.hand = hand
        found = find_pads(hand, {name: chains[name] for name in (THUMB, finger)})
        self.thumb, self.finger = found[THUMB], found[finger]
        self._data = hand.model.createData()

    def places(self, q: np.ndarray, wrist: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the middles of both pads in the world [m], shape (3,) each."""
        vector = self.hand.configuration_vector(q, wrist if self.hand.is_floating else None)
        pin.forwardKinematics(self.hand.model, self._data, vector)
        return self._place(self.thumb), self._place(self.finger)

    def gap(self, q: np.ndarray, wrist: np.ndarray) -> float:
        """Return the distance between the pads' surfaces [m]."""
        one, other = self.places(q, wrist)
        return float(np.linalg.norm(other - one)) - self.thumb.radius - self.finger.radius

    def middle(self, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        """Return the point midway between the pads' surfaces [m], shape (3,)."""
        one, other = self.places(q, wrist)
        share = 0.5 + 0.5 * (self.thumb.radius - self.finger.radius) / max(
            float(np.linalg.norm(other - one)), 1e-6
        )
        return one + np.clip(share, 0.0, 1.0) * (other - one)

    def is_pinched(self, simulator: Simulator, force: float) -> bool:
        """Return whether the thumb and another link press on the object with a force [N]."""
        contacts = simulator.contacts()
        normal = np.einsum("ci,ci->c", contacts.forces, contacts.normals)
        thumb = np.array(
            [_is_above(self.hand, joint, self.thumb.joint) for joint in contacts.joints], dtype=bool
        )
        return bool(normal[thumb].sum() > force and normal[~thumb].sum() > force)

    def _place(self, pad: Pad) -> np.ndarray:
        return self._data.oMi[pad.joint].act(pad.offset)


def _is_above(hand: Hand, joint: str, tip: int) -> bool:
    """Return whether a joint is on the way from the palm to a tip; False for the palm itself."""
    if not joint or not hand.model.existJointName(joint):
        return False
    return hand.model.getJointId(joint) in list(hand.model.supports[tip])[2:]


def _upright(
    pads: PadFinder, commands: Commands, i: int, physics: Physics, yaw: float
) -> np.ndarray:
    """Return axes with z up and x along the pinch, turned by `yaw` about the vertical."""
    up = -np.array(physics.gravity)
    up = up / np.linalg.norm(up) if up.any() else np.array([0.0, 0.0, 1.0])
    thumb, finger = pads.places(commands.q[i], commands.wrist[i])
    thumb_before, finger_before = pads.places(commands.q[i - 1], commands.wrist[i - 1])
    across = (finger - thumb) + (finger_before - thumb_before)
    across -= (across @ up) * up
    if np.linalg.norm(across) < 1e-6:
        across = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
    x = across / np.linalg.norm(across)
    axes = np.column_stack([x, np.cross(up, x), up])
    return Rotation.from_rotvec(yaw * up).as_matrix() @ axes
