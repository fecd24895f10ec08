"""Pinch and carry: a recorded pinch closes on an object, which must then stay (`PinchScene`).

The object stands on a stand where the robot's pads come together when nothing is between them. The
stand lets go when the thumb and another finger press on it, or when the pads should have met it a
while ago. From then until the human opens his hand, the object must stay between the pads.
`random_trials` draws many objects and places.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from scipy.stats import binomtest

from handmap_qp.apps.tables import Row
from handmap_qp.errors import expect
from handmap_qp.hands import THUMB, Hand, find_fingers, find_pads
from handmap_qp.se3 import Array, affine, inverse_pose, lengths, transform_points
from .commands import Commands, PinchWindow
from .physics import (
    KINDS,
    Body,
    Box,
    MeshShape,
    Physics,
    Shape,
    Sphere,
    named_shape,
    turn_up,
)
from .simulator import Episode, Instant, Simulator

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
_FAR = affine(np.eye(3), (0.0, 0.0, 100.0))

Objects = Literal["nominal", "varied"]
"""One object at random places, or random objects at random places."""

# Standard deviation of the place along each axis [m], and largest turn about the vertical [rad].
_PLACE = 0.004
_YAW = math.radians(20.0)
_SIZES = (0.02, 0.045)
_MASSES = (0.02, 0.2)
_FRICTIONS = (0.5, 1.0)


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

    def places(self, simulator: Simulator) -> Array:
        """Return the middles of the pads of thumb and finger in the world [m], shape (2, 3)."""
        return np.array(
            [
                transform_points(
                    simulator.body_pose(self._bodies[pad.joint]), pad.offset
                )
                for pad in self._pads.values()
            ]
        )

    def gap(self, places: Array) -> float:
        """Return the distance between the pads' surfaces at such places [m]."""
        radii = sum(pad.radius for pad in self._pads.values())
        return float(lengths(places[1] - places[0])) - radii

    def middle(self, places: Array) -> Array:
        """Return the point midway between the pads' surfaces at such places [m], shape (3,)."""
        thumb, finger = places
        distance = max(float(lengths(finger - thumb)), 1e-6)
        farther = self._pads[THUMB].radius - self._pads[_INDEX].radius
        share = np.clip(0.5 + 0.5 * farther / distance, 0.0, 1.0)
        return thumb + share * (finger - thumb)

    def is_pinched(self, simulator: Simulator) -> bool:
        """Return whether the thumb and another link press on the object."""
        contacts = simulator.contacts()
        is_thumb = np.isin(contacts.bodies, self._of_thumb)
        pressing = contacts.normal_forces
        return min(pressing[is_thumb].sum(), pressing[~is_thumb].sum()) > _PRESSED


class PinchTrial(NamedTuple):
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


class PinchOutcome(NamedTuple):
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
    places: Array


@dataclass(eq=False)
class PinchScene:
    """A robot that follows a recorded pinch, and objects for it.

    Attributes:
        commands: Commands of the mapping for the whole recording; of a robot with several hands,
            the first one pinches.
        window: When the human pinches.
        physics: Actuators, gravity and time steps; the friction is that of each trial.

    Raises:
        InvalidInputError: If the hand has no thumb, or no index finger.
        HandError: If the hand has no collision shapes.
    """

    commands: Commands
    window: PinchWindow
    physics: Physics

    def __post_init__(self) -> None:
        self.pads = Pads(self.commands.hand.hands[0])

    def run(self, trial: PinchTrial) -> PinchOutcome:
        """Simulate one trial.

        Args:
            trial: The object and its place; the friction is the trial's.

        Returns:
            What became of the object.
        """
        pads = self.pads
        width = trial.shape.width
        met = self.meeting(width)
        place = pads.middle(met.places) + trial.offset
        gravity = np.array(self.physics.gravity)
        up = -gravity if gravity.any() else np.array([0.0, 0.0, 1.0])
        # The object's z is up and its x along the pinch, turned about the vertical.
        turn = Rotation.from_euler("z", trial.yaw).as_matrix()
        axes = turn_up(up, met.places[1] - met.places[0]).T @ turn
        simulator = self._start(
            Body(trial.shape, trial.mass),
            self.physics.replaced(friction=trial.friction),
            affine(axes, place),
        )
        instants = []
        times = []
        distances = []
        for time in self._play(simulator):
            instants.append(simulator.instant())
            is_late = time >= met.time + _LATEST
            if not times and (is_late or pads.is_pinched(simulator)):
                simulator.set_stand(holds=False)
            elif not times:
                continue
            times.append(time)
            middle = pads.middle(pads.places(simulator))
            off = simulator.object_pose[:3, 3] - middle
            distances.append(lengths(off))
        # Pads that never pressed had no object to lose.
        times = times or [0.0]
        distances = distances or [np.inf]
        episode = Episode.of(simulator, instants)
        return _outcome(episode, np.array(distances), times, width)

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
        last = np.argmax(gaps <= width)
        if last == 0:
            # Near from the start, or never.
            return instants[0 if gaps[0] <= width else np.argmin(gaps)]
        share = (gaps[last - 1] - width) / (gaps[last - 1] - gaps[last])
        pairs = zip(instants[last - 1], instants[last], strict=True)
        return Meeting(*(before + share * (after - before) for before, after in pairs))

    @cached_property
    def _closing(self) -> list[Meeting]:
        """The robot's own motion while the human's pinch closes, with nothing between the pads."""
        simulator = self._start(_NOTHING, self.physics, _FAR)
        latest = self.commands.time[self.window.closed] + _LAG
        closing = takewhile(lambda time: time < latest, self._play(simulator))
        return [Meeting(time, self.pads.places(simulator)) for time in closing]

    def _start(self, body: Body, physics: Physics, place: Array) -> Simulator:
        """Put an object on its stand, and the hand where the recording starts."""
        simulator = Simulator(self.commands.hand, body, physics)
        simulator.reset(*self.commands.at(self.window.start), place)
        simulator.set_stand(holds=True)
        return simulator

    def _play(self, simulator: Simulator) -> Iterator[float]:
        """Follow the recording to the end of the pinch, and yield the time of each sample [s]."""
        time = self.commands.time
        for i in range(self.window.start + 1, self.window.end + 1):
            simulator.follow(*self.commands.at(i), time[i] - time[i - 1])
            yield float(time[i])


def _outcome(
    episode: Episode, distances: Array, time: Sequence[float], width: float
) -> PinchOutcome:
    """Judge the instants at the end, for which there are distances from the pads' middle."""
    lost = np.flatnonzero(distances > _LOST + width / 2.0)
    last = int(lost[0]) if len(lost) else len(distances) - 1
    kept = Instant(*(each[-len(distances) :][: last + 1] for each in episode.at))
    poses = inverse_pose(kept.wrist) @ kept.object_pose
    turn = Rotation.from_matrix(poses[-1, :3, :3] @ poses[0, :3, :3].T).magnitude()
    return PinchOutcome(
        is_held=not len(lost) and bool(episode.at.links_touching[-1] >= 2),
        held_time=time[last] - time[0],
        pinch_time=time[-1] - time[0],
        slip=lengths(poses[:, :3, 3] - poses[0, :3, 3]).max(),
        rotation=float(turn),
        force=kept.normal_force.mean(),
        episode=episode,
    )


def random_trials(
    count: int,
    seed: int,
    objects: Objects = "varied",
    nominal: PinchTrial | None = None,
) -> list[PinchTrial]:
    """Draw objects and places.

    Every place is off by 4 mm (standard deviation) along each axis, and turned by up to 20 degrees.
    `varied` objects are cubes, spheres and cylinders, 20 to 45 mm wide, 20 to 200 g (uniform in the
    logarithm), with friction 0.5 to 1.0.

    Args:
        count: Number of trials.
        seed: Seed of the random numbers; the same seed gives the same trials.
        objects: Which objects.
        nominal: The object of `nominal` trials; the cube of `PinchTrial` if omitted.
    """
    fixed = nominal or PinchTrial()
    expect(count >= 1, "trials", "an integer >= 1", value=count)
    expect(seed >= 0, "seed", "an integer >= 0", value=seed)
    random = np.random.default_rng(seed)
    trials = []
    for _ in range(count):
        x, y, z = random.normal(0.0, _PLACE, 3).tolist()
        trial = fixed._replace(offset=(x, y, z), yaw=random.uniform(-_YAW, _YAW))
        if objects == "varied":
            kind = random.choice(KINDS)
            trial = trial._replace(
                shape=named_shape(kind, random.uniform(*_SIZES)),
                mass=float(np.exp(random.uniform(*np.log(_MASSES)))),
                friction=random.uniform(*_FRICTIONS),
            )
        trials.append(trial)
    return trials


def success_rate(held: int, count: int) -> tuple[float, float, float]:
    """Return a success rate with its 95 % interval (Wilson).

    Args:
        held: Number of successes.
        count: Number of trials.

    Returns:
        Rate, lower and upper end.
    """
    found = binomtest(held, count)
    interval = found.proportion_ci(method="wilson")
    return found.statistic, interval.low, interval.high


def trial_row(name: str, outcomes: Sequence[PinchOutcome]) -> Row:
    """Summarise the trials of one mapping in a row of a table."""
    held = [outcome for outcome in outcomes if outcome.is_held]
    rate, low, high = success_rate(len(held), len(outcomes))
    shares = [o.held_time / max(o.pinch_time, 1e-9) for o in outcomes]
    return {
        "mapping": name,
        "trials": len(outcomes),
        "held %": round(100.0 * rate, 1),
        "95 % interval": f"{100.0 * low:.0f}-{100.0 * high:.0f}",
        "time held %": round(100.0 * np.mean(shares), 1),
        "slip mm": _median([1e3 * outcome.slip for outcome in held]),
        "force N": _median([outcome.force for outcome in held]),
    }


def _median(values: list[float]) -> float | str:
    return round(np.median(values), 1) if values else "-"


def describe_trial(trial: PinchTrial) -> Row:
    """Describe an object and its place by plain values, in metres, kilograms and radians."""
    return trial._asdict() | {
        "shape": type(trial.shape).__name__.lower(),
        "width": trial.shape.width,
        "offset": list(trial.offset),
    }


def outcome_row(name: str, outcome: PinchOutcome) -> Row:
    """Describe one trial in a row of a table."""
    return {
        "mapping": name,
        "held": "yes" if outcome.is_held else "no",
        "held s": round(outcome.held_time, 2),
        "of s": round(outcome.pinch_time, 2),
        "slip mm": round(1e3 * outcome.slip, 1),
        "rotation deg": round(math.degrees(outcome.rotation)),
        "force N": round(outcome.force, 1),
    }
