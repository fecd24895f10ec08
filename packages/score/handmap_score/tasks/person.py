"""A person who picks: sees late, moves in sub-movements, closes as recorded, and tries again.

The person watches the robot, not the own hand, and moves the robot's palm with the own palm. All
constants are fixed here. None was chosen by the result of a mapping.

The model, in the order of a try:

1. *Look.* Places of the object, the robot's palm and its pads are `DELAY` old and have noise. What
   the own hand was told to do since then is known (efference copy, as a Smith predictor), and so
   is that the robot follows the hand one sample later.
2. *Observe.* On the way to the object, looks of one try are combined (`Observer`), each by how
   certain it is: the object stands still, and the palm errs by the noise of its own movements.
3. *Aim.* The palm is to stand where the object lies between the pads, by an internal model of where
   the pads meet (`PadModel`), and to turn so that the line of the pads is level and along the
   object's. A place is aimed at for the orientation that the palm will have: a turn that is too
   small to be made does not move the aim.
4. *Move.* Not more often than every `REFRACTORY` seconds, a minimum-jerk sub-movement corrects what
   is left, on top of those that still run. Corrections below `DEAD_ZONE` are not made. The person
   goes on when the palm is seen to rest.
5. *Close* along a recorded closing, at its own speed and to its end.
6. *Judge.* If the object is seen between the pads, lift, carry, lower, open, leave. Else learn from
   where the pads were seen, open, back off, and try again, until `PATIENCE` is over.

Before the first try the person closes the hand `PRACTICE` times in the air and learns from it.

Sources of the constants. *Checked* means that the value was read in the paper's text or abstract,
or in a quotation of its data; *memory* that it was not.

- `DELAY`: 117 ms to correct the direction and 130 to 200 ms to correct the distance of a reach
  after the seen hand was shifted (Saunders and Knill 2005, Exp. Brain Res. 162:458; checked). The
  upper end, because cameras and screens of teleoperation add their own delay.
- `REFRACTORY`: 250 ms in the control of a position (van de Kamp, Gawthrop, Gollee and Loram 2013,
  PLoS Comput. Biol. 9:e1002843; checked); 260 to 310 ms in pursuit (Loram, van de Kamp, Gollee and
  Gawthrop 2012, J. R. Soc. Interface 9:2070; values checked, issue by memory). Event-driven
  intermittent control with a predictor: Gawthrop, Loram, Lakie and Gollee 2011, Biol. Cybern.
  104:31 (abstract checked).
- `Observer`: intermittent control has an observer before its predictor, and moves when the
  *estimated* state exceeds a threshold (Gawthrop et al. 2011, as above; Gawthrop, Gollee and Loram
  2014, arXiv:1407.3543; abstracts and summaries checked). Where a movement is corrected depends on
  the uncertainty of the prediction (Sakaguchi, Tanaka and Inoue 2015, Neural Netw. 67:92; abstract
  checked). Estimates of the own hand's place are those of optimal state estimation (Wolpert,
  Ghahramani and Jordan 1995, Science 269:1880; abstract checked). A dead zone must therefore be
  larger than what noise makes of the estimate; that of a single look is not (see `DEAD_ZONE`).
  `SURPRISE`: chosen so that noise alone exceeds it in less than one of 500 looks.
- Minimum jerk: Flash and Hogan 1985, J. Neurosci. 5:1688 (abstract checked). Sub-movements that
  overlap and add up: Novak, Miller and Houk 2002, Exp. Brain Res. 144:351 (abstract checked).
- `FITTS_INTERCEPT`, `FITTS_SLOPE`: a line through the 16 conditions of Fitts' tapping experiment
  with the light stylus (Fitts 1954, J. Exp. Psychol. 47:381, by the table of MacKenzie 1992;
  checked). `PACE` makes movements slower than that utmost speed: chosen, without a source.
- `MOTOR_NOISE`: spread grows in proportion to speed (Meyer, Abrams, Kornblum, Wright and Smith
  1988, Psychol. Rev. 95:340; checked) and is noise of execution (van Beers, Haggard and Wolpert
  2004, J. Neurophysiol. 91:1050; abstract checked). The share of 4 % of the amplitude is memory.
- `LEARNING`: the next movement corrects a fixed share of the error (van Beers 2012, PLoS ONE
  7:e49373; abstract checked). The share of one half is chosen in the range of .2 to .7 (memory).
- `VISUAL_NOISE`: 2 mm an axis, the figure that the operator was specified with. `ANGLE_NOISE`,
  `DEAD_ZONE` (the length of an error of aim by the noise of one look at object and palm; more than
  twice that of the `Observer` after six looks), `PRACTICE`, `PATIENCE`, and all distances: chosen,
  without a source.
"""

import math
import os
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum, auto
from functools import cache, partial
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.offline.comparison import Take, prepare_take
from handmap_qp.apps.simulation.commands import find_pinch
from handmap_qp.errors import expect
from handmap_qp.hands import Hand, Side
from handmap_qp.human import Recording, tip_gaps
from handmap_qp.se3 import Array, affine, inverse_pose, transform_points, unit
from handmap_qp.trackers import read_recording
from .operator import HumanHand, Joints
from .task import Scene

DELAY = 0.2
"""Age of what the person sees [s]."""
VISUAL_NOISE = 0.002
"""Standard deviation of a seen place along each axis [m]."""
ANGLE_NOISE = math.radians(3.0)
"""Standard deviation of a seen direction about the vertical [rad]."""
REFRACTORY = 0.25
"""Shortest time between two decisions [s]."""
DEAD_ZONE = 0.005
"""Error of place below which no correction is made [m]."""
TURN_DEAD_ZONE = math.radians(6.0)
"""Error of direction below which no correction is made [rad]."""
FITTS_INTERCEPT = 0.0128
"""Time of a movement of no difficulty [s]."""
FITTS_SLOPE = 0.0947
"""Time of a movement for each bit of difficulty [s]."""
PACE = 1.5
"""Time of a movement over that of Fitts' law."""
MOTOR_NOISE = 0.04
"""Standard deviation of where a sub-movement ends, over its amplitude, along each axis."""
SURPRISE = 4.0
"""What is seen farther than this from its estimate has moved, in standard deviations."""
LEARNING = 0.5
"""Share of an error of the internal model that one closing corrects."""
PRACTICE = 3
"""Closings in the air before the first try."""
PATIENCE = 12.0
"""Time from the first try in which the person begins new ones [s]."""
LARGEST_STEP = math.radians(25.0)
"""Largest turn of one sub-movement about an object that is held [rad]."""
TRACKER_NOISE = 3e-4
"""Standard deviation of each coordinate of a tracked landmark [m]."""

PITCH = math.radians(45.0)
"""How far the fingers point down at home [rad]."""
STANDOFF = 0.15
"""Height above the grip at which the open hand comes over the object before it goes down [m]."""
LARGEST_TURN = math.radians(60.0)
"""Largest turn of the wrist from home [rad]."""
CLEARANCE = 0.008
"""Distance that the open pads keep from the object where there is room [m]."""
ROUGH = 0.02
"""Error of place that is good enough on the way [m]."""
LIFT = 0.12
"""Height to which the object is lifted [m]."""
LOST = 0.02
"""The object counts as lost farther than this and half its width from the pads' middle [m]."""
LOOSE = 0.015
"""Pads farther apart than the object's width and this do not hold it [m]."""
_FINGERTIP = 0.007  # from a landmark of a fingertip to its surface [m]
_UP = np.array([0.0, 0.0, 1.0])
_SETTLE = 0.5  # from the first sample until the first closing [s]
_ENTERS = 3.0  # time after which the person gives up to get around the object, and backs off [s]
_PAUSE = 0.1  # from the end of a closing until it is judged, beside the delay [s]
_FOLLOWS = 0.3  # from the begin of a lift until the object is expected to follow [s]
_LEAVE = 0.15  # how far the hand goes up in the end [m]
_NEAR = 0.1  # the closest pinch is looked for so long after the pinch has closed [s]
_WIDE = (
    0.95  # the closing begins where the hand was last open by this share of its widest
)


def home() -> Array:
    """Return the palm's orientation at home: distal is forward (+y) and down, shape (3, 3)."""
    return Rotation.from_rotvec([-PITCH, 0.0, 0.0]).as_matrix()


class Closing(NamedTuple):
    """A closing of thumb and index finger, from open to its closest pinch.

    Attributes:
        time: Instants from 0 [s], shape (T,).
        landmarks: Landmarks in the palm's frame [m], shape (T, 21, 3).
        hand: The person's hand.
        q: Joints of that hand, fitted to the landmarks [rad], shape (T, n).
    """

    time: Array
    landmarks: Array
    hand: Hand
    q: Array

    @property
    def duration(self) -> float:
        """Time from the open hand to the closest pinch [s]."""
        return float(self.time[-1])

    @property
    def gap(self) -> float:
        """Distance between the tips of thumb and index finger in the open hand [m]."""
        return float(tip_gaps(self.landmarks[:1])[0, 0])

    def landmarks_at(self, elapsed: float) -> Array:
        """Return the landmarks at an instant of the closing [m], shape (21, 3)."""
        return self._at(elapsed, self.landmarks)

    def joints_at(self, elapsed: float) -> Joints:
        """Return the joints of the person's own hand at an instant of the closing [rad]."""
        q = self._at(elapsed, self.q)
        return dict(zip(self.hand.joint_names, q.tolist(), strict=True))

    def _at(self, elapsed: float, rows: Array) -> Array:
        """Return rows of all samples at an instant, linearly between two samples."""
        after = int(np.clip(np.searchsorted(self.time, elapsed), 1, len(self.time) - 1))
        begin, end = self.time[after - 1 : after + 1]
        share = np.clip((elapsed - begin) / (end - begin), 0.0, 1.0)
        return (1.0 - share) * rows[after - 1] + share * rows[after]


class ClosingSamples(NamedTuple):
    """Where a recording of a right hand closes.

    Attributes:
        take: The recording with the fitted hand.
        samples: Valid samples from the widest gap to the closest pinch, shape (T,).
    """

    take: Take
    samples: Array


def closing_samples(recording: Recording) -> ClosingSamples:
    """Return the samples in which the longest pinch of a right hand's recording closes.

    Raises:
        InvalidInputError: If it shows no pick (`find_pinch`).
    """
    window = find_pinch(recording)
    take = prepare_take(recording, "right")
    time = recording.time
    gaps = tip_gaps(recording.landmarks)[:, 0]
    is_wide = gaps[: window.closed] > _WIDE * np.nanmax(
        gaps[window.opened : window.start + 1]
    )
    widest = int(np.flatnonzero(is_wide)[-1])
    last = np.searchsorted(time, time[window.closed] + _NEAR)
    near = slice(window.closed, int(last) + 1)
    closest = window.closed + int(np.nanargmin(gaps[near]))
    samples = np.arange(widest, closest + 1)
    return ClosingSamples(take, samples[recording.valid[samples]])


def closing_of(recording: Recording) -> Closing:
    """Return the closing of the longest pinch of a recording of a right hand.

    Args:
        recording: The recording.

    Raises:
        InvalidInputError: If it shows no pick (`find_pinch`).
    """
    take, samples = closing_samples(recording)
    palms = inverse_pose(take.trace.palm[samples])
    landmarks = transform_points(palms, recording.landmarks[samples])
    elapsed = recording.time[samples] - recording.time[samples[0]]
    return Closing(elapsed, landmarks, take.human, take.q[samples])


class PadPlace(NamedTuple):
    """Where the surfaces of thumb and index finger are that face each other.

    Attributes:
        middle: Middle between them [m], shape (3,).
        line: Unit vector from thumb to finger, shape (3,).
        gap: Distance between them [m].
    """

    middle: Array
    line: Array
    gap: float

    def nearer(self, seen: "PadPlace") -> "PadPlace":
        """Return the place after a share of the error was learned."""
        middle = self.middle + LEARNING * (seen.middle - self.middle)
        line = unit(self.line + LEARNING * (seen.line - self.line))
        return PadPlace(middle, line, self.gap + LEARNING * (seen.gap - self.gap))


class PadModel(NamedTuple):
    """Internal model of where the robot's pads are in the palm's frame.

    Attributes:
        opened: In the open hand.
        met: Where they meet the object.
    """

    opened: PadPlace
    met: PadPlace

    @classmethod
    def of_own_hand(cls, closing: Closing, width: float) -> "PadModel":
        """Return where the person's own fingertips are, for an object of a width [m]."""
        gaps = tip_gaps(closing.landmarks)[:, 0] - 2.0 * _FINGERTIP
        last = len(gaps) - 1
        at = int(np.argmax(gaps <= width)) or last
        places = []
        for sample in (0, at):
            thumb, finger = closing.landmarks[sample, [4, 8]]
            line = unit(finger - thumb)
            places.append(PadPlace((thumb + finger) / 2.0, line, float(gaps[sample])))
        return cls(*places)

    def learned(self, opened: PadPlace, met: PadPlace) -> "PadModel":
        """Return the model after the pads were seen elsewhere."""
        return PadModel(self.opened.nearer(opened), self.met.nearer(met))

    def entry(self, width: float) -> Array:
        """Return where an object goes between the open pads [m], shape (3,).

        It is where the pads will meet, moved along the line of the open pads until it is clear of
        both; in their middle if there is no room.

        Args:
            width: Width of the object [m].
        """
        along = float((self.met.middle - self.opened.middle) @ self.opened.line)
        room = max((self.opened.gap - width) / 2.0 - CLEARANCE, 0.0)
        wanted = min(max(along, -room), room)
        return self.met.middle + (wanted - along) * self.opened.line


class Submovement(NamedTuple):
    """A minimum-jerk movement of the palm.

    Attributes:
        start: Instant at which it begins [s].
        duration: How long it takes [s].
        planned: Displacement that the person wants and believes in [m], shape (3,).
        made: Displacement that motor noise makes of it [m], shape (3,).
        turn: Turn, as part of a rotation vector from the first orientation [rad], shape (3,).
    """

    start: float
    duration: float
    planned: Array
    made: Array
    turn: Array

    def share(self, time: float) -> float:
        """Return how much of it is done at an instant, from 0 to 1."""
        x = min(max((time - self.start) / self.duration, 0.0), 1.0)
        return x**3 * (10.0 - 15.0 * x + 6.0 * x**2)


def movement_time(distance: float, angle: float) -> float:
    """Return the time of a sub-movement [s], at least `REFRACTORY`.

    `PACE (FITTS_INTERCEPT + FITTS_SLOPE log2(2 distance / width))`, where the width is twice the
    dead zone; the longer time of displacement and turn.

    Args:
        distance: Length of the displacement [m].
        angle: Angle of the turn [rad].
    """
    shares = max(distance / DEAD_ZONE, angle / TURN_DEAD_ZONE)
    bits = math.log2(max(shares, 1.0))
    return max(REFRACTORY, PACE * (FITTS_INTERCEPT + FITTS_SLOPE * bits))


class PalmMotion:
    """The palm's motion as a sum of sub-movements.

    Args:
        pose: Pose of the palm at first, shape (4, 4).
        random: For motor noise.
    """

    def __init__(self, pose: Array, random: np.random.Generator) -> None:
        self._pose = pose
        self._random = random
        self._submovements: list[Submovement] = []

    def begin(self, time: float, shift: Array, turn: Array) -> None:
        """Begin a sub-movement: displacement [m] and part of the rotation vector [rad]."""
        distance = float(np.linalg.norm(shift))
        noise = MOTOR_NOISE * distance * self._random.normal(size=3)
        duration = movement_time(distance, float(np.linalg.norm(turn)))
        self._submovements.append(
            Submovement(time, duration, shift, shift + noise, turn)
        )

    def is_moving(self, time: float) -> bool:
        """Return whether a sub-movement runs at an instant."""
        return any(time < one.start + one.duration for one in self._submovements)

    def pose(self, time: float) -> Array:
        """Return the palm's real pose at an instant, shape (4, 4)."""
        position = self._pose[:3, 3].copy()
        turn = np.zeros(3)
        for one in self._submovements:
            position += one.share(time) * one.made
            turn += one.share(time) * one.turn
        return affine(
            Rotation.from_rotvec(turn).as_matrix() @ self._pose[:3, :3], position
        )

    def believed(self, time: float) -> Array:
        """Return where the person believes the palm to be at an instant [m], shape (3,)."""
        shifts = [one.share(time) * one.planned for one in self._submovements]
        return self._pose[:3, 3] + np.sum([np.zeros(3), *shifts], axis=0)

    @property
    def believed_end(self) -> Array:
        """Where the person believes that all sub-movements end [m], shape (3,)."""
        return self.believed(math.inf)

    def turn_to(self, rotation: Array) -> Array:
        """Return the turn that is left to an orientation when all sub-movements have ended."""
        wanted = Rotation.from_matrix(rotation @ self._pose[:3, :3].T).as_rotvec()
        return wanted - self._turned

    def rotation_after(self, turn: Array) -> Array:
        """Return the orientation when all sub-movements and a further turn have ended, (3, 3)."""
        turned = Rotation.from_rotvec(self._turned + turn).as_matrix()
        return turned @ self._pose[:3, :3]

    @property
    def _turned(self) -> Array:
        """Sum of the turns of all sub-movements [rad], shape (3,)."""
        turns = [one.turn for one in self._submovements]
        return np.sum([np.zeros(3), *turns], axis=0)


class Look(NamedTuple):
    """What the person sees, with the noise of seeing.

    Attributes:
        time: Instant at which it was so [s].
        followed: Instant of the person's hand that the robot followed then [s].
        middle: Middle of the object, at the height of its grip [m], shape (3,).
        line: Horizontal unit vector across the object, shape (3,).
        width: Width of the object along it [m].
        bottom: Lowest point of the object [m], shape (3,).
        target: Where it is to stand in the end, on the table [m], shape (3,).
        palm: Position of the robot's palm [m], shape (3,).
        rotation: Orientation of the robot's palm, shape (3, 3).
        pads: The robot's pads in the world.
    """

    time: float
    followed: float
    middle: Array
    line: Array
    width: float
    bottom: Array
    target: Array
    palm: Array
    rotation: Array
    pads: PadPlace

    @property
    def is_between(self) -> bool:
        """Whether the object is seen between the pads."""
        along = abs(float((self.middle - self.pads.middle) @ self.pads.line))
        is_inside = along < max(self.pads.gap, self.width) / 2.0
        is_closed = self.pads.gap < self.width + LOOSE
        return is_inside and is_closed and not self.is_lost

    @property
    def is_lost(self) -> bool:
        """Whether the object is seen away from the pads."""
        off = float(np.linalg.norm(self.middle - self.pads.middle))
        return off > LOST + self.width / 2.0

    @property
    def pads_on_palm(self) -> PadPlace:
        """The pads in the palm's frame."""
        middle = (self.pads.middle - self.palm) @ self.rotation
        return PadPlace(middle, self.pads.line @ self.rotation, self.pads.gap)


class Remembered(NamedTuple):
    """A scene, and the instant of the person's hand that the robot followed in it [s]."""

    scene: Scene
    followed: float


class Eyes:
    """Remembers scenes, and shows the one of `DELAY` before, with noise.

    Args:
        wrist_to_palm: Pose of the robot's palm in its wrist, shape (4, 4).
        random: For the noise.
    """

    def __init__(self, wrist_to_palm: Array, random: np.random.Generator) -> None:
        self._wrist_to_palm = wrist_to_palm
        self._random = random
        self._scenes: deque[Remembered] = deque()

    def remember(self, scene: Scene, followed: float) -> None:
        """Take in a scene, and forget those that are older than the one to be shown.

        Args:
            scene: What there is to see.
            followed: Instant of the person's hand that the robot follows in it [s].
        """
        self._scenes.append(Remembered(scene, followed))
        oldest = scene.time - DELAY
        while len(self._scenes) > 1 and self._scenes[1].scene.time <= oldest:
            self._scenes.popleft()

    def look(self) -> Look:
        """Return what is seen now."""
        scene, followed = self._scenes[0]
        first, second = scene.points["faces"]
        thumb, finger = scene.points["pads"]
        palm = scene.poses["wrist"] @ self._wrist_to_palm
        return Look(
            time=scene.time,
            followed=followed,
            middle=self._place((first + second) / 2.0),
            line=self._direction(unit((second - first) * (1.0, 1.0, 0.0))),
            width=float(np.linalg.norm(second - first)),
            bottom=self._place(scene.points["bottom"][0]),
            target=scene.poses["target"][:3, 3],
            palm=self._place(palm[:3, 3]),
            rotation=palm[:3, :3],
            pads=PadPlace(
                self._place((thumb + finger) / 2.0),
                self._direction(unit(finger - thumb)),
                float(np.linalg.norm(finger - thumb))
                + VISUAL_NOISE * self._random.normal(),
            ),
        )

    def _place(self, point: Array) -> Array:
        return point + VISUAL_NOISE * self._random.normal(size=3)

    def _direction(self, line: Array) -> Array:
        angle = ANGLE_NOISE * self._random.normal()
        return Rotation.from_rotvec([0.0, 0.0, angle]).apply(line)


class Estimate:
    """A point that is seen again and again with noise: a Kalman filter, alike along each axis.

    Args:
        noise: Standard deviation of one look along each axis.
    """

    def __init__(self, noise: float) -> None:
        self._noise = noise
        self._point = np.zeros(3)
        self._variance = math.inf

    def update(self, seen: Array, drift: float = 0.0) -> Array:
        """Take a look in, and return the estimate, shape (3,).

        Args:
            seen: The point as it is seen, shape (3,).
            drift: Standard deviation of its motion since the look before, along each axis.
        """
        # Parts of one movement err alike, so their deviations add up, not their variances.
        variance = (math.sqrt(self._variance) + drift) ** 2
        innovation = seen - self._point
        expected = math.sqrt(variance + self._noise**2)
        if float(np.linalg.norm(innovation)) > SURPRISE * expected:
            variance = math.inf
        gain = variance / (variance + self._noise**2) if variance < math.inf else 1.0
        self._point = self._point + gain * innovation
        self._variance = gain * self._noise**2
        return self._point


class Observer:
    """Combines the looks of one try, while the palm comes to the object.

    The object stands still; what has moved farther than noise explains (`SURPRISE`) is taken as it
    is seen. The palm is where the person believes it to be, but for an error that grows with
    each movement by `MOTOR_NOISE`.
    """

    def __init__(self) -> None:
        self._middle = Estimate(VISUAL_NOISE)
        self._line = Estimate(ANGLE_NOISE)
        self._error = Estimate(VISUAL_NOISE)
        self._believed: Array | None = None

    def update(self, look: Look, believed: Array) -> Look:
        """Return a look with estimates of the object's middle and line, and of the palm's place.

        Args:
            look: What is seen.
            believed: Where the person believed the palm to be at that instant [m], shape (3,).
        """
        moved = 0.0
        if self._believed is not None:
            moved = float(np.linalg.norm(believed - self._believed))
        self._believed = believed
        error = self._error.update(look.palm - believed, MOTOR_NOISE * moved)
        return look._replace(
            middle=self._middle.update(look.middle),
            line=unit(self._line.update(look.line)),
            palm=believed + error,
        )


def levelled(line: Array, wanted: Array) -> Array:
    """Return the palm's orientation at which the line of the pads runs along the object's.

    The turn from home is the smallest one, and at most `LARGEST_TURN`. Which pad is on which side
    does not matter.

    Args:
        line: Line of the pads in the palm's frame, shape (3,).
        wanted: Line across the object in the world, shape (3,).

    Returns:
        The orientation, shape (3, 3).
    """
    at_home = home() @ line
    side = wanted if at_home @ wanted >= 0.0 else -wanted
    axis = np.cross(at_home, side)
    angle = math.atan2(float(np.linalg.norm(axis)), float(at_home @ side))
    if angle < 1e-9:
        return home()
    turn = Rotation.from_rotvec(min(angle, LARGEST_TURN) * unit(axis))
    return turn.as_matrix() @ home()


class Phase(Enum):
    """What the person is doing."""

    PRACTISE = auto()
    APPROACH = auto()
    ENTER = auto()
    CLOSE = auto()
    USE = auto()
    LIFT = auto()
    CARRY = auto()
    LOWER = auto()
    RELEASE = auto()
    REOPEN = auto()
    DONE = auto()


class Person:
    """An operator who picks an object up and puts it down elsewhere.

    Scenes must have the poses `wrist` and `target` (on the table), and the points `faces` (where
    the object is to be pinched, (2, 3)), `bottom` (the object's lowest, (1, 3)) and `pads`
    (surfaces of thumb and index finger that face each other, (2, 3)).

    Args:
        robot: The robot hand that the person watches.
        recording: The person: measured in it, and closing as in its longest pinch. The package's
            recording `pinch` if omitted.
        name: Name of the operator.
        closing: How the hand closes; the closing of the recording if omitted.

    Raises:
        InvalidInputError: If the recording shows no pick, or is not of a right hand.
    """

    def __init__(
        self,
        robot: Hand,
        recording: Recording | None = None,
        name: str = "person",
        closing: Closing | None = None,
    ) -> None:
        recording = recording or read_recording(Path("pinch"), "right")
        expect(
            recording.side == "right", "recording", "a right hand", got=recording.side
        )
        self.closing = closing or closing_of(recording)
        self._recording = recording
        self._name = name
        self._wrist_to_palm = robot.wrist_to_palm
        self.reset(0)

    @property
    def name(self) -> str:
        """Name of the operator."""
        return self._name

    @property
    def has_finished(self) -> bool:
        """Whether the person has left the object, or is out of patience."""
        return self._phase is Phase.DONE

    @property
    def phase(self) -> Phase:
        """What the person is doing."""
        return self._phase

    @property
    def tries(self) -> int:
        """How often the hand was closed on the object."""
        return self._tries

    @property
    def drops(self) -> int:
        """How often the object was seen to be lost while it was lifted or carried."""
        return self._drops

    def calibrate(self, seed: int) -> Recording:
        """Return the person's recording with further noise of a tracker."""
        random = np.random.default_rng(seed)
        landmarks = self._recording.landmarks
        noise = TRACKER_NOISE * random.normal(size=landmarks.shape)
        return Recording(
            f"{self._name}_{seed}",
            self._recording.time,
            landmarks + noise,
            self._recording.valid,
            self._recording.side,
        )

    def reset(self, seed: int) -> None:
        """Begin an attempt: forget all that was seen and learned."""
        self._random = np.random.default_rng(seed)
        self._eyes = Eyes(self._wrist_to_palm, self._random)
        self._observer = Observer()
        self._motion: PalmMotion | None = None
        self._model: PadModel | None = None
        self._opened: PadPlace | None = None
        self._met: PadPlace | None = None
        self._phase = Phase.PRACTISE
        self._hover = LIFT
        self._since = 0.0
        self._time = 0.0
        self._decides_at = 0.0
        self._practised = 0
        self._first_try = math.inf
        self._elapsed = 0.0
        self._is_closing = False
        self._tries = 0
        self._drops = 0

    def see(self, scene: Scene) -> HumanHand:
        """Return the hand at the scene's instant."""
        now = scene.time
        self._eyes.remember(scene, self._time)
        if self._motion is None:
            self._motion = PalmMotion(
                scene.poses["wrist"] @ self._wrist_to_palm, self._random
            )
        self._move_fingers(now - self._time)
        self._time = now
        if self._phase in (Phase.PRACTISE, Phase.CLOSE):
            self._watch_closing()
        if now >= self._decides_at:
            self._decides_at = now + REFRACTORY
            self._decide(self._motion)
        palm = self._motion.pose(now)
        noise = TRACKER_NOISE * self._random.normal(size=(21, 3))
        shown = self.closing.landmarks_at(self._elapsed)
        return HumanHand(
            transform_points(palm, shown) + noise,
            palm @ inverse_pose(self._wrist_to_palm),
            self.closing.joints_at(self._elapsed),
        )

    # -- fingers

    def _move_fingers(self, dt: float) -> None:
        """Go on closing or opening along the recorded closing."""
        step = dt if self._is_closing else -dt
        self._elapsed = min(max(self._elapsed + step, 0.0), self.closing.duration)

    @property
    def _is_open(self) -> bool:
        return self._elapsed <= 0.0

    @property
    def _is_judged(self) -> bool:
        """Whether the end of the closing has been seen."""
        ended = self._since + self.closing.duration + _PAUSE + DELAY
        return self._is_closing and self._time >= ended

    def _start(self, phase: Phase, *, closes: bool) -> None:
        self._phase = phase
        if phase is Phase.APPROACH:  # the try before may have moved the object
            self._observer = Observer()
        self._since = self._time
        self._is_closing = closes

    def _close(self, look: Look, phase: Phase) -> None:
        """Begin to close, and note where the open pads are."""
        self._opened = look.pads_on_palm
        self._met = None
        self._start(phase, closes=True)

    def _watch_closing(self) -> None:
        """Note where the pads are when they are first seen as near as the object is wide."""
        look = self._eyes.look()
        is_new = self._is_closing and look.time >= self._since
        if self._met is None and is_new and look.pads.gap <= look.width:
            self._met = look.pads_on_palm

    # -- decisions

    def _decide(self, motion: PalmMotion) -> None:
        """Decide once, by what is seen now."""
        look = self._eyes.look()
        if self._model is None:
            self._model = self._own_model(look)
        match self._phase:
            case Phase.PRACTISE:
                self._practise(look)
            case Phase.APPROACH | Phase.ENTER:
                seen = self._observer.update(look, motion.believed(look.followed))
                self._reach(seen, self._model, motion)
            case Phase.CLOSE:
                self._judge(look, motion)
            case Phase.USE:
                self._use(look, motion)
            case Phase.LIFT | Phase.CARRY | Phase.LOWER:
                self._transport(look, motion)
            case Phase.RELEASE | Phase.REOPEN:
                self._finish_opening(motion)
            case Phase.DONE:
                pass

    def _own_model(self, look: Look) -> PadModel:
        """Return the internal model before anything was learned: the own hand's."""
        return PadModel.of_own_hand(self.closing, look.width)

    def _finish_opening(self, motion: PalmMotion) -> None:
        """Leave, or try again, when the hand is open."""
        if not self._is_open:
            return
        if self._phase is Phase.RELEASE:
            motion.begin(self._time, _LEAVE * _UP, np.zeros(3))
            self._start(Phase.DONE, closes=False)
        else:
            self._try_again()

    def _practise(self, look: Look) -> None:
        """Close and open in the air, and learn where the pads meet."""
        if self._time < _SETTLE:
            return
        if not self._is_closing and self._is_open:
            if self._practised == PRACTICE:
                self._first_try = self._time
                self._begin_try()
            else:
                self._close(look, Phase.PRACTISE)
        elif self._is_judged:
            self._learn(look)
            self._practised += 1
            self._is_closing = False

    def _learn(self, look: Look) -> None:
        """Correct the internal model by where the pads met, or came nearest at the end."""
        if self._model is not None and self._opened is not None:
            met = self._met or look.pads_on_palm
            self._model = self._model.learned(self._opened, met)

    def _reach(self, look: Look, model: PadModel, motion: PalmMotion) -> None:
        """Move the palm to where the object lies between the open pads, or stand off before."""
        turn = motion.turn_to(levelled(model.met.line, look.line))
        if float(np.linalg.norm(turn)) <= TURN_DEAD_ZONE:
            turn = np.zeros(3)
        rotation = motion.rotation_after(turn)
        entry = model.entry(look.width)
        goal = look.middle - rotation @ entry
        is_entering = self._phase is Phase.ENTER
        if not is_entering:
            goal = goal + STANDOFF * _UP
        # The robot's palm was not where the person believed the own palm to be.
        bias = look.palm - motion.believed(look.followed)
        shift = goal - motion.believed_end - bias
        tolerance = DEAD_ZONE if is_entering else ROUGH
        if not self._correct(look, motion, shift, tolerance, turn):
            if is_entering and self._time > self._since + _ENTERS:
                self._start(Phase.REOPEN, closes=False)
            return
        if not is_entering:
            self._start(Phase.ENTER, closes=False)
            return
        self._tries += 1
        self._close(look, Phase.CLOSE)
        # While the hand closes, the palm goes to where the pads meet in the object's middle.
        rest = rotation @ (entry - model.met.middle)
        if float(np.linalg.norm(rest)) > DEAD_ZONE:
            motion.begin(self._time, rest, np.zeros(3))

    def _correct(
        self,
        look: Look,
        motion: PalmMotion,
        shift: Array,
        tolerance: float,
        turn: Array | None = None,
    ) -> bool:
        """Begin a sub-movement if one is needed; return whether the palm rests where it should.

        It must be seen to rest: the noise of a movement that has just ended was not seen yet.

        Args:
            look: What is seen.
            motion: The palm's motion.
            shift: Error of place [m], shape (3,).
            tolerance: Length below which it is not corrected [m].
            turn: Turn that is needed [rad], shape (3,); none if omitted.
        """
        is_off = float(np.linalg.norm(shift)) > tolerance
        turn = np.zeros(3) if turn is None else turn
        if is_off or turn.any():
            motion.begin(self._time, shift, turn)
            return False
        return not motion.is_moving(look.followed)

    def _judge(self, look: Look, motion: PalmMotion) -> None:
        """Use what is seen between the pads; else learn and open."""
        if not self._is_judged:
            return
        if look.is_between:
            self._grasped(motion)
        else:
            self._learn(look)
            self._start(Phase.REOPEN, closes=False)

    def _transport(self, look: Look, motion: PalmMotion) -> None:
        """Move the object up, over its target, and down; open if it is seen to be lost."""
        if look.is_lost and self._time > self._since + _FOLLOWS + DELAY:
            self._drops += self._phase is not Phase.LIFT
            self._start(Phase.REOPEN, closes=False)
            return
        shift = look.target - (*self._guided(look)[:2], look.bottom[2])
        if self._phase is Phase.LIFT:
            shift[:2] = 0.0
        if self._phase is not Phase.LOWER:
            shift += self._hover * _UP
        since_then = motion.believed_end - motion.believed(look.followed)
        # Only high above the target a rough place is good enough.
        is_rough = self._phase is not Phase.LOWER and self._hover == LIFT
        tolerance = ROUGH if is_rough else DEAD_ZONE
        is_down = self._phase is Phase.LOWER and self._is_down(look)
        if not is_down and not self._correct(
            look, motion, shift - since_then, tolerance
        ):
            return
        match self._phase:
            case Phase.LIFT:
                self._phase = Phase.CARRY
            case Phase.CARRY:
                self._arrived(motion)
            case _:
                self._start(Phase.RELEASE, closes=False)

    def _try_again(self) -> None:
        if self._time > self._first_try + PATIENCE:
            self._start(Phase.DONE, closes=False)
        else:
            self._begin_try()

    # -- what people with another task do in another way

    def _begin_try(self) -> None:
        """Begin a try: approach with an open hand."""
        self._start(Phase.APPROACH, closes=False)

    def _grasped(self, motion: PalmMotion) -> None:
        """Go on with the object in the hand: lift it."""
        self._hover = LIFT
        self._start(Phase.LIFT, closes=True)

    def _is_down(self, look: Look) -> bool:
        """Return whether the object is seen to be put down, wherever it was to go exactly."""
        return False

    def _guided(self, look: Look) -> Array:
        """Return the point of the object that is to be over the target [m], shape (3,)."""
        return look.middle

    def _arrived(self, motion: PalmMotion) -> None:
        """Go on with the object over its target: lower it."""
        self._phase = Phase.LOWER

    def _use(self, look: Look, motion: PalmMotion) -> None:
        """Decide once in `Phase.USE`, which this person never begins."""
        raise NotImplementedError

    def _turn_about_pads(
        self, look: Look, motion: PalmMotion, axis: Array, angle: float
    ) -> None:
        """Begin a sub-movement that turns the palm about the middle of the pads.

        Args:
            look: What is seen, for where the pads are on the palm.
            motion: The palm's motion, which has ended.
            axis: Unit vector in the world, shape (3,).
            angle: Angle [rad]; the palm leaves its arc by `r (1 - cos(angle / 2))`.
        """
        now = motion.pose(self._time)[:3, :3]
        lever = now @ look.pads_on_palm.middle
        turn = Rotation.from_rotvec(angle * axis).as_matrix()
        motion.begin(self._time, lever - turn @ lever, motion.turn_to(turn @ now))


RECORDINGS = "HANDMAP_RECORDINGS"
"""Variable of the environment that names a folder of recordings of people."""
OWN = "own"
"""Name of the hand of the package's person, taken as a robot hand."""


@cache
def own_hand(side: Side = "right") -> Hand:
    """Return a hand of the person in the package's recording, as a robot hand."""
    return prepare_take(read_recording(Path("pinch"), "right"), side).human


OPERATORS: Mapping[str, Callable[[Hand], Person]] = MappingProxyType({"person": Person})
"""Makers of operators by name; each takes the robot hand."""


def recordings_of_people() -> dict[str, Path]:
    """Return recordings of right hands by name, for `--operators`.

    They are looked for in the folder that `HANDMAP_RECORDINGS` names, else in ../shared/recordings.
    """
    folder = Path(os.environ.get(RECORDINGS) or Path("..", "shared", "recordings"))
    return {file.stem: file for file in sorted(folder.glob("*right*.npz"))}


def recorded_person(file: Path, robot: Hand) -> Person:
    """Return the person of a recording.

    Raises:
        InvalidInputError: If the recording shows no pick.
    """
    return Person(robot, read_recording(file, "right"), file.stem)


def people() -> dict[str, Callable[[Hand], Person]]:
    """Return makers of the package's person and of those of `recordings_of_people`, by name."""
    recorded = {
        name: partial(recorded_person, file)
        for name, file in recordings_of_people().items()
    }
    return {**OPERATORS, **recorded}
