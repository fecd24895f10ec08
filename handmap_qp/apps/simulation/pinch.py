"""Pinch and carry: a recorded pinch closes on an object, which must then stay (`PinchScene`).

The object stands on a stand where the robot's pads come together when nothing is between them, or
where the person's do. The hand starts open, and thumb, index finger and palm clear of it. Another
finger that is in its place, as after pointing, touches it once it has left: in life, nobody puts an
object where a finger is. The stand lets go when the thumb and
another finger have pressed on it for a while, or when the pads should have met it long ago. From
then until the human opens his hand, the object must stay between the pads. `random_trials` draws
many objects and places, and how far mappings that know a place are wrong.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import chain
from typing import Literal, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_core.errors import InvalidInputError, expect
from handmap_core.se3 import (
    Array,
    Arrays,
    affine,
    inverse_pose,
    lengths,
    rotation_from_rpy,
)
from handmap_qp.apps.offline.trajectory import RobotMotion
from handmap_qp.hands import Names, Vector
from handmap_qp.mapping import (
    KINDS,
    Box,
    Shape,
    Sphere,
    parse_object,
    surface,
)
from .commands import PinchWindow
from .losses import Loss, Touch, loss_in_try
from .pad_motion import Meeting, PadMotion
from .pads import FingersInTheWay, Pads, largest_slide
from .physics import Physics, turn_up
from .simulator import Episode, Instant, Simulator

CUBE = Box((0.03, 0.03, 0.03))
"""The nominal object."""

# The stand lets go when thumb and another finger press without a break for such a time [s].
_GRIPPED = 0.2
# A grip that is not there so long after the pads should have met the object does not come [s].
_LATEST = 1.0
# A hand starts with its pads so far from the object [m].
_CLEAR = 0.015
# The object is lost farther than this, and half its size, from the middle between the pads [m].
_LOST = 0.02
# The object of the simulation in which the pads meet, far from the hand.
_NOTHING = Sphere(0.01)
_FAR = affine(np.eye(3), (0.0, 0.0, 100.0))

Objects = Literal["nominal", "varied"]
"""One object at random places, or random objects at random places."""

# Standard deviation of the place along each axis [m], and largest turn about the vertical [rad].
_PLACE = 0.004
_YAW = math.radians(20.0)
_SIZES = (0.02, 0.045)
_MASSES = (0.02, 0.2)
_FRICTIONS = (0.5, 1.0)
# Errors of known places are drawn apart from the objects, so that they change no object.
_ERRORS = 1


class PinchTrial(NamedTuple):
    """One object and its place.

    Attributes:
        shape: The object's shape; a cube of 30 mm if omitted.
        mass: Its mass [kg].
        friction: Coulomb coefficient.
        offset: Displacement of its place from where the pads meet [m], in world axes.
        yaw: Rotation about the vertical [rad].
        place_error: Error of the place that a mapping knows, along each world axis, in standard
            deviations of that error. A mapping that knows no place, or the exact one, has none.
    """

    shape: Shape = CUBE
    mass: float = 0.05
    friction: float = 0.8
    offset: Vector = (0.0, 0.0, 0.0)
    yaw: float = 0.0
    place_error: Vector = (0.0, 0.0, 0.0)


class PinchOutcome(NamedTuple):
    """Result of one trial.

    Attributes:
        is_held: Whether the object stayed between the pads until the human opened the hand.
        held_time: Time from the stand's letting go to the loss, or to the opening [s].
        pinch_time: Time from the stand's letting go to the opening [s].
        slip: Largest displacement of the object against the wrist while held [m]. Fingers that go
            on moving carry it along.
        slide: The same against the pads of thumb and index finger [m].
        rotation: Rotation of the object against the wrist, at the end or the loss [rad].
        force: Mean normal force while held [N].
        torque: Largest torque of a finger's actuator while held [N m].
        episode: The simulation.
        loss: Why it was not held; None if it was.
        course: How the hand touched it, at each instant of the episode.
        in_the_way: Fingers that were in its place before the pads met, and passed through it until
            they had left.
    """

    is_held: bool
    held_time: float
    pinch_time: float
    slip: float
    slide: float
    rotation: float
    force: float
    torque: float
    episode: Episode
    loss: Loss | None
    course: tuple[Touch, ...]
    in_the_way: Names = ()

    @property
    def columns(self) -> Arrays:
        """Plain arrays by name, as written to a file: those of the episode, and of the touches."""
        return {
            **self.episode.columns,
            "thumb_force": np.array([one.thumb for one in self.course]),
            "other_force": np.array([one.others for one in self.course]),
            "beside_pads": np.array([one.beside for one in self.course]),
            "moved": np.array([one.moved for one in self.course]),
            "loss": np.array(self.loss or ""),
        }


@dataclass(eq=False)
class PinchScene:
    """A robot that follows a recorded pinch, and objects for it.

    Attributes:
        commands: Motion that the mapping commands for the whole recording; of a robot with several
            hands, the first one pinches.
        window: When the human pinches.
        physics: Actuators, gravity and time steps; the friction is that of each trial.
        placing: Pads between which objects stand; the robot's own if omitted.
        least_clear: Distance of the pads from the object at the start that will do where 15 mm
            cannot be had [m].

    Raises:
        InvalidInputError: If the hand has no thumb, or no index finger.
        HandError: If the hand has no collision shapes.
    """

    commands: RobotMotion
    window: PinchWindow
    physics: Physics
    placing: PadMotion | None = None
    least_clear: float = _CLEAR

    def __post_init__(self) -> None:
        self.pads = Pads(self.commands.robot.hands[0])

    def run(self, trial: PinchTrial) -> PinchOutcome:
        """Simulate one trial.

        Args:
            trial: The object and its place; the friction is the trial's.

        Returns:
            What became of the object.

        Raises:
            InvalidInputError: If the open hand overlaps the object, but for fingers that leave, or
                its pads are not `least_clear` from it, wherever the trial may start.
        """
        pads = self.pads
        width = surface(trial.shape).extents[0]
        met = self.meeting(width)
        placing = self.placing or self.closing
        spot = placing.meeting(width)
        place = placing.pair.middle(spot.places) + trial.offset
        # The object's z is up and its x along the pinch, turned about the vertical.
        turn = rotation_from_rpy((0.0, 0.0, trial.yaw))
        axes = turn_up(self.physics.up, spot.places[1] - spot.places[0]).T @ turn
        physics = self.physics.replaced(mass=trial.mass, friction=trial.friction)
        simulator = Simulator(self.commands.robot, trial.shape, physics)
        pose = affine(axes, place)
        leaving = self._leaving(simulator, pose, met)
        until = self._last_there(simulator, pose, leaving, met)
        start = self._put_clear(simulator, pose, leaving)
        in_the_way = FingersInTheWay(simulator, leaving, until)
        instants = []
        course = []
        away = []
        lines = []
        # Index at which the stand lets go, and the time until which there was no grip.
        freed, loose = -1, self.commands.time[start]
        for i, time in enumerate(self._play(simulator, start)):
            in_the_way.update(float(time))
            instants.append(simulator.instant())
            places = pads.places(simulator)
            away.append(simulator.object_pose[:3, 3] - pads.pair.middle(places))
            lines.append(places[1] - places[0])
            touch = pads.touch(simulator, float(time), place)
            course.append(touch)
            if not touch.is_pinched:
                loose = time
            if freed < 0 and time >= min(loose + _GRIPPED, met.time + _LATEST):
                simulator.set_stand(holds=False)
                freed = i
        episode = Episode.of(simulator, instants)
        between = np.array(away), np.array(lines)
        outcome = _outcome(episode, tuple(course), between, freed, width)
        return outcome._replace(in_the_way=in_the_way.names)

    def meeting(self, width: float) -> Meeting:
        """Return the first instant at which the pads are as near as an object is wide.

        Actuators lag behind their commands by some 50 ms, so the pads meet later and, as the wrist
        moves meanwhile, elsewhere than commanded.

        Args:
            width: Width of the object [m].

        Returns:
            The instant, or that of the smallest gap if the pads do not come near enough.
        """
        return self.closing.meeting(width)

    @cached_property
    def closing(self) -> PadMotion:
        """The robot's own motion by the commands, with nothing between the pads."""
        simulator = Simulator(self.commands.robot, _NOTHING, self.physics)
        start = self.window.opened
        simulator.reset(self.commands.at(start), _FAR)
        simulator.set_stand(holds=True)
        # Not by what a subclass makes of the touch.
        played = PinchScene._play(self, simulator, start)
        instants = [(time, self.pads.places(simulator)) for time in played]
        times, places = map(np.array, zip(*instants, strict=True))
        return PadMotion(times, places, self.pads.pair)

    def _leaving(
        self, simulator: Simulator, pose: Array, met: Meeting
    ) -> dict[str, list[str]]:
        """Return the fingers beside the pads' that are clear of the object when the pads meet it.

        Before that, as after pointing, they may be in its place.

        Returns:
            Names of the bodies of each finger, by the finger's name.
        """
        sample = int(np.searchsorted(self.commands.time, met.time))
        simulator.reset(self.commands.at(min(sample, self.window.end)), pose)
        fingers = self.pads.others.items()
        return {
            name: bodies for name, bodies in fingers if simulator.clearance(bodies) > 0
        }

    def _last_there(
        self,
        simulator: Simulator,
        pose: Array,
        leaving: Mapping[str, Sequence[str]],
        met: Meeting,
    ) -> dict[str, float]:
        """Return when each finger's command is in the object's place for the last time.

        A curled finger may be beside that place at the start, and sweep through it as it opens.

        Returns:
            The time before the pads meet [s], by the finger's name; none for fingers that never
            are there.
        """
        time = self.commands.time
        end = min(int(np.searchsorted(time, met.time)), self.window.end)
        until: dict[str, float] = {}
        for sample in range(self.window.opened, end):
            simulator.reset(self.commands.at(sample), pose)
            until |= {
                name: float(time[sample])
                for name, bodies in leaving.items()
                if simulator.clearance(bodies) <= 0.0
            }
        return until

    def _put_clear(
        self, simulator: Simulator, pose: Array, leaving: Mapping[str, Sequence[str]]
    ) -> int:
        """Put the object on its stand, and the hand where it is last clear; return that sample.

        Where the hand is never clear by 15 mm, put it where it is clearest since its pads were last
        in the object's place. Fingers that leave that place in time do not count.
        """
        free = {*chain.from_iterable(leaving.values())}
        links = [name for name in simulator.links if name not in free]
        pads = others = 0.0
        clearest = (self.least_clear, -1)
        for start in range(self.window.start, self.window.opened - 1, -1):
            simulator.reset(self.commands.at(start), pose)
            pads = simulator.clearance(self.pads.bodies)
            others = simulator.clearance(links)
            if others > 0.0:
                clearest = max(clearest, (min(pads, _CLEAR), start))
            # Earlier, pads that were clear would have to pass through the object.
            if clearest >= (_CLEAR, 0) or (pads <= 0.0 and clearest[1] >= 0):
                break
        start = clearest[1]
        if start >= 0:
            simulator.reset(self.commands.at(start), pose)
            simulator.set_stand(holds=True)
            return start
        raise InvalidInputError(
            argument=self.commands.robot.name,
            expected="an open hand clear of the object, its pads by "
            f"{1e3 * self.least_clear:g} mm",
            got=f"pads at {1e3 * pads:.0f} mm, the nearest link at {1e3 * others:.0f} mm",
            advice="try a smaller --object, or another recording",
        )

    def _play(self, simulator: Simulator, start: int) -> Iterator[float]:
        """Follow the recording to the end of the pinch, and yield the time of each sample [s]."""
        time = self.commands.time
        for i in range(start + 1, self.window.end + 1):
            simulator.follow(self.commands.at(i), time[i] - time[i - 1])
            yield time[i]


def _outcome(
    episode: Episode,
    course: tuple[Touch, ...],
    between: tuple[Array, Array],
    freed: int,
    width: float,
) -> PinchOutcome:
    """Judge what happens from an index on; -1 if the stand never let go.

    Args:
        episode: What was simulated.
        course: How the hand touched the object.
        between: Vectors from the pads' middle to the object, and from the thumb's pad to the
            finger's, in world axes [m], shape (T, 3) each.
        freed: The index.
        width: Width of the object [m].
    """
    distances = lengths(between[0])
    is_away = distances > _LOST + width / 2.0
    if freed < 0:
        # Pads that never gripped had no object to lose.
        is_away[-1] = True
    lost = np.flatnonzero(is_away[freed:])
    free = Instant(*(column[freed:] for column in episode.at))
    kept = Instant(*(column[: 1 + lost[0]] if len(lost) else column for column in free))
    poses = inverse_pose(kept.wrist) @ kept.object_pose
    turns = poses[:, :3, :3]
    # Rows times a rotation turn back by it, into the wrist's axes.
    axes = kept.wrist[:, :3, :3]
    away_kept, lines = (
        (vectors[freed:][: len(axes), None] @ axes)[:, 0] for vectors in between
    )
    turn = Rotation.from_matrix(turns[-1] @ turns[0].T).magnitude()
    is_held = bool(
        not len(lost) and free.links_touching[-1] >= 2 and np.ptp(free.time) >= _GRIPPED
    )
    return PinchOutcome(
        is_held=is_held,
        held_time=np.ptp(kept.time),
        pinch_time=np.ptp(free.time),
        slip=lengths(poses[:, :3, 3] - poses[0, :3, 3]).max(),
        slide=largest_slide(away_kept, lines),
        rotation=turn,
        force=kept.normal_force.mean(),
        torque=np.abs(kept.torque[:, ~episode.hand.moves_wrist]).max(),
        episode=episode,
        loss=None if is_held else _loss(course, distances, freed, width),
        course=course,
    )


def _loss(course: tuple[Touch, ...], away: Array, freed: int, width: float) -> Loss:
    """Return why an object was not held: one try, which ends as the object is away."""
    end = len(course)
    if freed >= 0 and len(gone := np.flatnonzero(away[freed:] > _LOST + width / 2.0)):
        end = freed + gone[0] + 1
    elif course[-1].is_pinched:
        return Loss.TOO_LATE
    return loss_in_try(course[:end]) or Loss.SLIPPED


def random_errors(count: int, seed: int) -> list[Vector]:
    """Draw errors of known places, in standard deviations along each axis.

    Args:
        count: Number of objects.
        seed: Seed of the random numbers.
    """
    random = np.random.default_rng((seed, _ERRORS))
    return [(x, y, z) for x, y, z in random.normal(size=(count, 3)).tolist()]


def random_trials(
    count: int,
    seed: int,
    objects: Objects = "varied",
    nominal: PinchTrial = PinchTrial(),
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
    expect(count >= 1, "trials", "an integer >= 1", value=count)
    expect(seed >= 0, "seed", "an integer >= 0", value=seed)
    random = np.random.default_rng(seed)
    trials = []
    for error in random_errors(count, seed):
        x, y, z = random.normal(0.0, _PLACE, 3).tolist()
        trial = nominal._replace(
            offset=(x, y, z), yaw=random.uniform(-_YAW, _YAW), place_error=error
        )
        if objects == "varied":
            kind = random.choice(KINDS)
            trial = trial._replace(
                shape=parse_object(f"{kind}:{random.uniform(*_SIZES)}"),
                mass=float(np.exp(random.uniform(*np.log(_MASSES)))),
                friction=random.uniform(*_FRICTIONS),
            )
        trials.append(trial)
    return trials
