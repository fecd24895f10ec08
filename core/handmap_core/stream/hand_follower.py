"""`HandFollower`: maps the samples of one hand that make sense, and holds the robot at all others.

The guard judges every sample by named rules. After a hold the robot comes back to the human without
a snap. Samples, never commands, are smoothed by their noise, so that the QP's speed limits hold.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from time import perf_counter
from typing import Generic, Protocol, TypeAlias, TypeVar

from msgspec import structs

from handmap_core.core import core
from handmap_core.errors import HandmapError, expect
from handmap_core.hands import Hand
from handmap_core.human import HumanSample, Verdict
from handmap_core.ik import SHORTEST_DT, Instant, Motion, When
from handmap_core.mapping import (
    AnyPose,
    HumanPose,
    SampleStep,
    check_dt,
    check_when,
    own_time,
)
from handmap_core.mapping.bound_method import BoundMethod
from handmap_core.mapping.exclusive import WorkLock, exclusively
from handmap_core.mapping.target_source import TargetSource
from handmap_core.options import Option
from .guard import BEHIND, StreamGuard
from .rejoin import Rejoin, RejoinKind
from .smoothing import Smoother, Smoothing

Step = TypeVar("Step", bound=SampleStep)
Step_co = TypeVar("Step_co", bound=SampleStep, covariant=True)

CoreReader: TypeAlias = "core.SampleReader[core.Stages | core.HandRequest]"
"""What maps samples in the core."""


class SampleMapper(Protocol[Step_co]):
    """What maps the samples of a hand: a `HandMapper`, or one hand of a `RobotMapper`.

    Attributes:
        work: Lets one thread at a time work on it.
    """

    work: WorkLock

    @property
    def source(self) -> TargetSource[Hand, BoundMethod]:
        """The human's side of the hand."""

    @property
    def core(self) -> CoreReader | None:
        """What maps the next sample in the core; None where Python has to look at it."""

    @property
    def motion(self) -> Motion:
        """How the robot moves."""

    def map(
        self, sample: HumanPose, dt: When | None = None, *, speed: float = 1.0
    ) -> Step_co:
        """Map a sample; see `HandMapper.map`."""

    def hold(self, dt: When, seen: AnyPose | None = None) -> Step_co:
        """Keep the posture; see `HandMapper.hold`."""


class HandFollower(Generic[Step]):
    """Lets one hand follow the samples of a tracker.

    A `Follower` is one with a `HandMapper`. Each hand of a `RobotMapper` has one, too, whose steps
    are requests.

    Args:
        mapper: Maps the samples; its human hand must be scaled to the person.
        guard: Judges them.
        step_type: Makes a step of what the core made of a sample, and of fields of `SampleStep`.
        rejoin: As of `Follower`.
        smoothing: Likewise.

    Attributes:
        rejoin: As given.
        work: Lets one thread at a time work on it and on the mapper.
    """

    def __init__(
        self,
        mapper: SampleMapper[Step],
        guard: StreamGuard,
        step_type: Callable[..., Step],
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        self._mapper = mapper
        self._step_type = step_type
        self._source = mapper.source
        # To work on the follower is to work on what it leads.
        self.work = mapper.work
        self.rejoin = Option("rejoin", RejoinKind, RejoinKind, "glide").read(rejoin)
        expect(
            isinstance(smoothing, Smoothing | None),
            "smoothing",
            "a Smoothing or None",
            value=smoothing,
        )
        self._smoother = Smoother(smoothing)
        self._guard = guard
        self._return = Rejoin(rejoin)
        self._reference: HumanPose | None = None
        # Where the time of the stream begins on the robot's clock [s]; None before a first command.
        self._origin: float | None = None
        # What `forget` takes back: the return and the reference before the last sample.
        self._before: tuple[Rejoin, HumanPose | None] = self._return, None

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    @exclusively
    def __getstate__(self) -> dict[str, object]:
        """Return what a copy continues from."""
        return vars(self).copy()

    @exclusively
    def map_sample(
        self,
        sample: HumanSample,
        *,
        dt: When | None = None,
        arrival: float | None = None,
    ) -> Step:
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
        in_core = self._mapper.core if self._is_plain else None
        if in_core and self._guard.is_own(sample):
            judged = in_core.map_sample(
                self._guard.core,
                self._smoother.core,
                self._source.landmarks.core,
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
        numbers, made, duration = judged
        verdict = self._guard.verdict_of(numbers)
        if made is None:
            return self._judged(sample, verdict, dt)
        if dt is not None:
            self._origin = None
        self._return = structs.replace(self._return, seen=made.pose)
        return self._step_type(
            made, duration=duration, verdict=verdict, confidence=sample.confidence
        )

    @exclusively
    def forget(self, step: Step) -> None:
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
    ) -> Step:
        """Smooth a pose, and map it without judging it.

        Args:
            pose: The pose.
            dt: Time since the last one, for the filter [s].
            speed: As of `HandMapper.map`.
            when: The instant of the command; dt after the robot's last one if omitted.
        """
        if self._source.reference is not self._reference:
            self._smoother.restart()
        smooth = self._smoother.smooth(pose, check_dt(dt))
        try:
            step = self._mapper.map(smooth, when or dt, speed=speed)
        except HandmapError:
            self._smoother.forget()
            raise
        self._reference = self._source.reference
        return step

    @property
    def _is_plain(self) -> bool:
        """Whether the core may map the next sample: Python takes references, and leads back."""
        is_new = self._source.reference is not self._reference
        return not is_new and self._return.offset is None

    def _judged(self, sample: HumanSample, verdict: Verdict, dt: When | None) -> Step:
        """Map a sample that makes sense, else hold; an error leaves all as it was before."""
        started = perf_counter()
        is_new = self._source.reference is not self._reference
        back = Rejoin(self.rejoin) if is_new else self._return
        try:
            if dt is None:
                granted = max(verdict.dt, SHORTEST_DT)
                when = self._when(verdict, granted)
            else:
                when = check_when(dt)
                granted = check_dt(own_time(when))
            if verdict.is_held:
                self._smoother.wait(granted)
                held = self._mapper.hold(when, back.seen)
                self._note_origin(verdict, dt)
                return structs.replace(
                    held, verdict=verdict, confidence=sample.confidence
                )
            pose, _ = self._source.landmarks.read(sample.landmarks, sample.wrist)
            if verdict.is_return:
                back = back.start(pose, verdict.lost)
                self._smoother.restart()
            moved, back = back.advance(pose, verdict.dt)
            step = self.map(moved, granted, speed=verdict.speed, when=when)
        except HandmapError:
            self._guard.forget()
            raise
        self._return = structs.replace(back, seen=step.pose)
        self._note_origin(verdict, dt)
        return structs.replace(
            step,
            verdict=verdict,
            confidence=sample.confidence,
            is_gliding=back.is_fading,
            duration=perf_counter() - started,
        )

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
        origin = self._mapper.motion.time - verdict.time
        if self._origin is None or origin - self._origin > BEHIND:
            self._origin = origin
