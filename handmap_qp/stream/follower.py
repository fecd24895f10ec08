"""`Follower`: maps the samples of a tracker that make sense, and holds the robot at all others.

The guard judges every sample by named rules. After a hold the robot comes back to the human without
a snap. Samples, never commands, are smoothed by their noise, so that the QP's speed limits hold.
The sessions of the service, `handmap retarget` and `handmap view` all follow in this way.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from copy import deepcopy
from time import perf_counter, thread_time
from typing import Any, Literal, NamedTuple

import numpy as np
import pinocchio as pin
from msgspec import structs

from handmap_core.core import core
from handmap_core.errors import HandmapError, expect
from handmap_core.options import NotNegative, Option, Options, Positive
from handmap_core.se3 import Array, ArrayStruct, affine, lengths, transform_points
from handmap_qp.human import HumanSample, Recording, Verdict
from handmap_qp.ik import SHORTEST_DT, Instant, Task, When
from handmap_qp.mapping import (
    HandMapper,
    HumanPose,
    MapStep,
    check_dt,
    check_when,
    core_pose,
    own_time,
)
from handmap_qp.mapping.exclusive import exclusively
from .guard import BEHIND, StreamGuard
from .step_table import StepTable

RejoinKind = Literal["glide", "clutch"]
"""How the robot comes back to the human after a hold."""

FINGER_SPEED = 0.4
"""Largest speed that fading adds to a point in wrist axes [m/s]."""
PALM_SPEED = 0.5
"""Largest speed that fading adds to the wrist [m/s]."""
TURN_SPEED = 3.0
"""Largest angular speed that fading adds to the wrist [rad/s]."""
_SHORTEST = 0.05  # shortest time of fading [s]
_RUN = 1000  # samples of a recording that the core maps before progress is told
_PEAK = 1.875  # largest speed of a minimum-jerk motion over its mean speed


class _Place(NamedTuple):
    """Where a hand is: points in wrist axes, with the wrist's position behind them (n + 1, 3) [m].

    Without a wrist, points are in the world, and the wrist is its origin.
    """

    points: Array
    rotation: Array
    has_wrist: bool

    @classmethod
    def of(cls, pose: HumanPose) -> _Place:
        """Return where a sample is."""
        wrist = np.eye(4) if pose.wrist is None else pose.wrist
        rotation, position = wrist[:3, :3], wrist[:3, 3]
        points = np.vstack([(pose.points - position) @ rotation, position])
        return cls(points, rotation, pose.wrist is not None)

    def pose(self) -> HumanPose:
        """Return a sample there."""
        wrist = affine(self.rotation, self.points[-1])
        points = transform_points(wrist, self.points[:-1])
        return HumanPose(points, wrist if self.has_wrist else None)

    def to(self, other: _Place) -> Array:
        """Return the way to another place [m], with the turn in own axes behind it [rad]."""
        turn = pin.log3(self.rotation.T @ other.rotation)
        return np.vstack([other.points - self.points, turn])

    def moved(self, way: Array) -> _Place:
        """Return the place at the end of a way."""
        rotation = self.rotation @ pin.exp3(way[-1])
        return _Place(self.points + way[:-1], rotation, self.has_wrist)


class Rejoin(ArrayStruct, frozen=True):
    """State of the return after a sample; `start` and `advance` return the next one.

    Attributes:
        kind: `glide` or `clutch`.
        seen: The last pose that was mapped; None before the first.
        offset: What was seen last minus what the tracker said at the return (`_Place.to`), shape
            (n + 2, 3); None if nothing is added to the samples.
        duration: Time of fading [s].
        elapsed: Time since the return [s].
    """

    kind: RejoinKind = "glide"
    seen: HumanPose | None = None
    offset: Array | None = None
    duration: float = 0.0
    elapsed: float = 0.0

    @property
    def is_fading(self) -> bool:
        """Whether the robot is still on its way to the human."""
        return self.offset is not None and self.elapsed < self.duration

    def start(self, pose: HumanPose, lost: float = math.inf) -> Rejoin:
        """Begin at the first sample after a hold.

        After a brief loss [s], fading takes no longer than that, and one that has begun goes on.
        """
        before = self.seen
        if self.is_fading and lost < math.inf:
            return self
        if before is None or (before.wrist is None) != (pose.wrist is None):
            return structs.replace(self, offset=None)
        offset = _Place.of(pose).to(_Place.of(before))
        *fingers, palm, turn = lengths(offset)
        times = [max(fingers) / FINGER_SPEED]
        if self.kind == "glide":
            times += [palm / PALM_SPEED, turn / TURN_SPEED]
        duration = max(_SHORTEST, min(lost, _PEAK * max(times)))
        return structs.replace(self, offset=offset, duration=duration, elapsed=0.0)

    def advance(self, pose: HumanPose, dt: float) -> tuple[HumanPose, Rejoin]:
        """Return the pose to map for that of the tracker, dt [s] later, and the state after it."""
        if self.offset is None:
            return pose, self
        left = 1.0 - _minimum_jerk(self.elapsed / self.duration)
        offset = left * self.offset
        stays = self.kind == "clutch"
        if stays:
            offset[-2:] = self.offset[-2:]
        moved = _Place.of(pose).moved(offset).pose()
        return moved, structs.replace(
            self,
            offset=self.offset if left > 0.0 or stays else None,
            elapsed=self.elapsed + dt,
        )


def _minimum_jerk(share: float) -> float:
    """Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985)."""
    share = min(max(share, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))


class Smoothing(Options, frozen=True):
    """How much samples are smoothed before they are mapped; see `Smoother`.

    Attributes:
        acceleration: Acceleration that a point at rest may have [m/s^2].
        speed_gain: Rise of the acceleration with the speed of a point [1/s].
    """

    acceleration: Positive = 0.4
    speed_gain: NotNegative = 12.0


SMOOTH_IK = {"speed_weight": 2.0, "acceleration_weight": 8.0}
"""Weights of `IkOptions` that smooth further: they damp what the QP adds to smooth targets."""


class Smoother:
    """Smooths the samples of one hand as much as they are noisy; without options, not at all.

    An alpha-beta filter predicts every point by its velocity, and corrects it by a share of what is
    measured. Kalata's tracking index (IEEE Trans. AES 20 (1984) 174) gives the share: the
    acceleration that a point may have, times the square of the time, over the noise. Two low-pass
    filters of the same share follow, which take from the jerk; the velocity makes up for their lag.
    Without noise, all shares are 1, and samples pass as they are. The compiled core filters
    (`handmap/smoothing.hpp`).

    Args:
        options: How much; None for not at all.

    Attributes:
        options: As given.
        core: The smoother of the compiled core.
    """

    def __init__(self, options: Smoothing | None) -> None:
        self.options = options
        self.core = self._new_core()

    def _new_core(self) -> core.Smoother:
        if self.options is None:
            return core.Smoother(None, 0.0)
        return core.Smoother(self.options.acceleration, self.options.speed_gain)

    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        return {"options": self.options, "saved": self.core.save()}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Continue from the state of another one."""
        self.options = state["options"]
        self.core = self._new_core()
        self.core.restore(state["saved"])

    def smooth(self, pose: HumanPose, dt: float) -> HumanPose:
        """Smooth the next sample, dt [s] after the last call; one that repeats is the same one."""
        return HumanPose.of_core(self.core.smooth(core_pose(pose), dt))

    def wait(self, dt: float) -> None:
        """Let time pass without a sample [s]."""
        self.core.wait(dt)

    def restart(self) -> None:
        """Let the next sample pass as it is, and go on from there with the noise that is known."""
        self.core.restart()

    def forget(self) -> None:
        """Forget the sample that was smoothed last."""
        self.core.forget()


class Follower:
    """Lets a mapper follow the samples of a tracker.

    A new reference of the mapper (`HandMapper.clutch`, `reset`) ends a return and the smoothing.

    Args:
        mapper: Maps the samples; its human hand must be scaled to the person.
        rejoin: How the robot comes back to the human after a hold: `glide` there, or stay where it
            is with its palm, as after a `clutch`.
        smoothing: How samples are smoothed before they are mapped; None for not at all.

    Attributes:
        mapper: As given.
        rejoin: As given.

    Raises:
        InvalidOptionsError: If `rejoin` is something else.
        InvalidInputError: If `smoothing` is.
        HandError: If the human hand has no landmarks.
    """

    def __init__(
        self,
        mapper: HandMapper,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        self.mapper = mapper
        # Whoever works on the follower works on the mapper.
        self.work = mapper.work
        self.rejoin = Option("rejoin", RejoinKind, RejoinKind, "glide").read(rejoin)
        expect(
            isinstance(smoothing, Smoothing | None),
            "smoothing",
            "a Smoothing or None",
            value=smoothing,
        )
        self._smoother = Smoother(smoothing)
        self._guard = StreamGuard(mapper.human)
        self._return = Rejoin(rejoin)
        self._reference: HumanPose | None = None
        # Where the time of the stream begins on the robot's clock [s]; None before a first command.
        self._origin: float | None = None
        # What `forget` takes back.
        self._before: tuple[Any, ...] = ()

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @exclusively
    def __getstate__(self) -> dict[str, Any]:
        """Return what a copy continues from."""
        return vars(self).copy()

    @exclusively
    def map_sample(
        self,
        sample: HumanSample,
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> MapStep:
        """Map one sample of a tracker, if it makes sense; else hold.

        Args:
            sample: The sample. Its time stamps say how much time has passed. The robot takes the
                time since its last command, whatever that was for. A stream that is more than 1 s
                behind, because the robot was held while the stamps paused, is related again to the
                robot's clock: this sample takes (nearly) no time.
            dt: Time since the robot's last command [s], or the instant of this one on the robot's
                clock; by the time stamps if omitted.
            arrival: When the sample arrived, on a monotonic clock [s], to check the rate of the
                time stamps; not checked if omitted.

        Returns:
            Every stage of the step; of a held one, targets and points are the robot's own.

        Raises:
            InvalidInputError: If it is no sample, or one of the other hand, or cannot be used; the
                mapper is then as it was before.
            InvalidOptionsError: If a reference point of the human is not a landmark.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
            MapperBusyError: If another thread works on the mapper.
        """
        self._before = self._return, self._reference
        judged = None
        cores = self._cores()
        if cores and self._guard.is_own(sample):
            judged = self.mapper.core.map_sample(
                *cores,
                sample.time,
                sample.landmarks,
                sample.wrist,
                bool(sample.valid),
                sample.confidence,
                dt,
                arrival,
                self._origin,
            )
        if judged is None:
            verdict = self._guard.check(sample, arrival=arrival)
            return self._judged(sample, verdict, dt)
        numbers, stages, duration = judged
        verdict = self._guard.verdict_of(numbers)
        if stages is None:
            return self._judged(sample, verdict, dt)
        if dt is not None:
            self._origin = None
        self._return = structs.replace(self._return, seen=stages.pose)
        return MapStep(stages, (), duration, verdict, sample.confidence)

    @exclusively
    def map_samples(
        self, samples: Recording, progress: Callable[[int], None] | None = None
    ) -> StepTable:
        """Map the samples of a recording, as `map_sample` one by one; return all numbers.

        The compiled core maps those that simply follow the ones before by itself, without the
        interpreter's lock, so that threads map recordings side by side.

        Args:
            samples: The samples, as of `sample_columns`.
            progress: Called with the number of samples done.

        Raises:
            MapperBusyError: If another thread works on the mapper. While this one does, its other
                calls raise that in other threads.
        """
        self._guard.check_side(samples, Recording)
        count = len(samples)
        table = StepTable(self.mapper.robot, count)
        columns = core.Samples(
            samples.time,
            samples.landmarks,
            samples.valid,
            samples.confidence,
            samples.wrist,
        )
        i = 0
        while i < count:
            # That about a sample which the core has judged, and leaves to the return here.
            verdict = None
            cores = self._cores()
            origin = self._origin
            if cores and origin is not None:
                i, numbers, seen = self.mapper.core.run(
                    *cores, origin, columns, i, min(count, i + _RUN), table.rows
                )
                verdict = numbers and self._guard.verdict_of(numbers)
                if seen:
                    self._return = structs.replace(self._return, seen=seen)
            if i < count:
                started = thread_time()
                sample = samples.sample(i)
                verdict = verdict or self._guard.check(sample)
                step = self._judged(sample, verdict, None)
                table.write(i, step, thread_time() - started)
                i += 1
            if progress:
                progress(i)
        return table

    @exclusively
    def forget(self, step: MapStep) -> None:
        """Forget the sample that `map_sample` was given last, by its step."""
        self._return, self._reference = self._before
        self._guard.forget()
        if not step.is_held:
            self._smoother.forget()

    @exclusively
    def map(
        self,
        pose: HumanPose,
        dt: float,
        *,
        speed: float = 1.0,
        when: When | None = None,
    ) -> MapStep:
        """Smooth a pose, and map it without judging it.

        Args:
            pose: The pose.
            dt: Time since the last one, for the filter [s].
            speed: As of `HandMapper.map`.
            when: The instant of the command; dt after the robot's last one if omitted.
        """
        if self._has_new_reference:
            self._smoother.restart()
        smooth = self._smoother.smooth(pose, check_dt(dt))
        try:
            step = self.mapper.map(smooth, when or dt, speed=speed)
        except HandmapError:
            self._smoother.forget()
            raise
        self._reference = self.mapper.reference
        return step

    def _cores(
        self,
    ) -> tuple[core.StreamGuard, core.Smoother, core.LandmarkReader] | None:
        """Return what the core judges, smooths and reads the next sample by, if it maps it."""
        mapper = self.mapper
        # Python leads back to the hand, and takes a reference.
        is_plain = self._return.offset is None and not self._has_new_reference
        if not (mapper.core and is_plain):
            return None
        return self._guard.core, self._smoother.core, mapper.landmarks.core

    def _judged(
        self, sample: HumanSample, verdict: Verdict, dt: When | None
    ) -> MapStep:
        """Map a sample that makes sense, else hold; an error leaves all as it was before."""
        started = perf_counter()
        back = Rejoin(self.rejoin) if self._has_new_reference else self._return
        said: dict[str, Any] = {"verdict": verdict, "confidence": sample.confidence}
        try:
            if dt is None:
                granted = max(verdict.dt, SHORTEST_DT)
                when = self._when(verdict, granted)
            else:
                when = check_when(dt)
                granted = check_dt(own_time(when))
            if verdict.is_held:
                self._smoother.wait(granted)
                held = self.mapper.hold(when, back.seen)
                self._note_origin(verdict, dt)
                return structs.replace(held, **said)
            pose, _ = self.mapper.landmarks.read(sample.landmarks, sample.wrist)
            if verdict.is_return:
                back = back.start(pose, verdict.lost)
                self._smoother.restart()
            moved, back = back.advance(pose, verdict.dt)
            step = self.map(moved, granted, speed=verdict.speed, when=when)
        except HandmapError:
            self._guard.forget()
            raise
        self._return = structs.replace(back, seen=step.stages.pose)
        self._note_origin(verdict, dt)
        said |= {"is_gliding": back.is_fading, "duration": perf_counter() - started}
        return structs.replace(step, **said)

    def _when(self, verdict: Verdict, longest: float) -> When:
        """Return when the command for a sample is.

        Args:
            verdict: About the sample.
            longest: Longest time that the command may take [s].
        """
        if self._origin is None:
            # The stream is not on the robot's clock yet.
            return longest
        return Instant(self._origin + verdict.time, longest)

    def _note_origin(self, verdict: Verdict, dt: When | None) -> None:
        """Note where the stream's time begins, after the command for a sample.

        Args:
            verdict: About the sample.
            dt: The time that the caller gave for it; time stamps then count from the next one.
        """
        if dt is not None:
            self._origin = None
            return
        # Holds between samples may have taken more time than the stream's clock.
        origin = self.mapper.motion.time - verdict.time
        if self._origin is None or origin - self._origin > BEHIND:
            self._origin = origin

    @property
    def _has_new_reference(self) -> bool:
        return self.mapper.reference is not self._reference


@contextmanager
def further_terms(
    mappers: Sequence[HandMapper], terms: Sequence[Sequence[Task]]
) -> Iterator[None]:
    """Give mappers further terms of the QP's cost for a while.

    Args:
        mappers: The mappers.
        terms: The terms of each. A mapper without any is left as it is.
    """
    pairs = zip(mappers, terms, strict=True)
    changed = [(mapper, mapper.tasks, own) for mapper, own in pairs if own]
    for mapper, tasks, own in changed:
        mapper.configure(tasks=(*tasks, *own))
    try:
        yield
    finally:
        for mapper, tasks, _ in changed:
            mapper.configure(tasks=tasks)


def map_with(
    follower: Follower, terms: Sequence[Task], sample: HumanSample, **times: Any
) -> MapStep:
    """Map one sample with further terms of the QP's cost, which no other sample has.

    Args:
        follower: Follows the samples.
        terms: The terms.
        sample: The sample.
        **times: As of `Follower.map_sample`.
    """
    if not terms:
        return follower.map_sample(sample, **times)
    with further_terms([follower.mapper], [terms]):
        return follower.map_sample(sample, **times)
