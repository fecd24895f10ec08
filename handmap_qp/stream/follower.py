"""`Follower`: maps the samples of a tracker that make sense, and holds the robot at all others.

The guard judges every sample by named rules. After a hold the robot comes back to the human without
a snap, and samples may be smoothed before they are mapped. The sessions of the service, `handmap
map` and `handmap view` all follow in this way.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from time import perf_counter, thread_time_ns
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
import pinocchio as pin
from msgspec import structs

from handmap_qp.errors import HandmapError, InvalidOptionsError
from handmap_qp.human.recording import SampleColumns
from handmap_qp.human.sample import HumanSample, Verdict
from handmap_qp.ik.limits import SHORTEST_DT
from handmap_qp.mapping.mapper import HandMapper, check_dt
from handmap_qp.mapping.method import HumanPose, MapStep
from handmap_qp.se3 import affine, lengths
from handmap_qp.stream.guard import StreamGuard
from handmap_qp.stream.smoothing import Smoothing, SmoothState, smooth_sample
from handmap_qp.stream.step_table import StepTable

RejoinKind = Literal["glide", "clutch"]
"""How the robot comes back to the human after a hold."""

FINGER_SPEED = 0.4
"""Largest speed that fading adds to a point in wrist axes [m/s]."""
PALM_SPEED = 0.5
"""Largest speed that fading adds to the wrist [m/s]."""
TURN_SPEED = 3.0
"""Largest angular speed that fading adds to the wrist [rad/s]."""
_SHORTEST = 0.1
"""Shortest time of fading [s]."""
_RUN = 1000
"""Samples of a recording that the core maps before progress is told."""
_PEAK = 1.875
"""Largest speed of a minimum-jerk motion over its mean speed."""


class _Offset(NamedTuple):
    """What was seen last minus what the tracker says, at the return.

    Attributes:
        points: In wrist axes, or in the world without a wrist [m], shape (n, 3).
        position: Of the wrist [m], shape (3,).
        turn: Rotation vector of the wrist, in its own axes [rad], shape (3,).
        duration: Time of fading [s].
    """

    points: np.ndarray
    position: np.ndarray
    turn: np.ndarray
    duration: float

    def added(self, pose: HumanPose, fingers: float, palm: float) -> HumanPose:
        """Add shares of the offset to a pose."""
        points = pose.in_wrist + fingers * self.points
        wrist = pose.wrist
        if wrist is not None:
            rotation = wrist[:3, :3] @ pin.exp3(palm * self.turn)
            wrist = affine(rotation, wrist[:3, 3] + palm * self.position)
        return HumanPose.placed(points, wrist)


class Rejoin(NamedTuple):
    """State of the return after a sample; `start` and `advance` return the next one.

    Attributes:
        kind: `glide` or `clutch`.
        seen: The last pose that was mapped; None before the first.
        offset: What is added to the samples; None if nothing.
        elapsed: Time since the return [s].
    """

    kind: RejoinKind = "glide"
    seen: HumanPose | None = None
    offset: _Offset | None = None
    elapsed: float = 0.0

    @property
    def is_fading(self) -> bool:
        """Whether the robot is still on its way to the human."""
        return self.offset is not None and self.elapsed < self.offset.duration

    def start(self, pose: HumanPose) -> Rejoin:
        """Begin at the first sample after a hold.

        Args:
            pose: The hand as the tracker sees it.
        """
        before = self.seen
        if before is None or (before.wrist is None) != (pose.wrist is None):
            return self._replace(offset=None)
        points = before.in_wrist - pose.in_wrist
        position = np.zeros(3)
        turn = np.zeros(3)
        if before.wrist is not None and pose.wrist is not None:
            position = before.wrist[:3, 3] - pose.wrist[:3, 3]
            turn = pin.log3(pose.wrist[:3, :3].T @ before.wrist[:3, :3])
        times = [lengths(points).max() / FINGER_SPEED]
        if self.kind == "glide":
            times += [lengths(position) / PALM_SPEED, lengths(turn) / TURN_SPEED]
        duration = max(_SHORTEST, _PEAK * float(max(times)))
        return self._replace(
            offset=_Offset(points, position, turn, duration),
            elapsed=0.0,
        )

    def advance(self, pose: HumanPose, dt: float) -> tuple[HumanPose, Rejoin]:
        """Return the pose to map, and the state after it.

        Args:
            pose: The hand as the tracker sees it.
            dt: Time since the sample before [s]; ignored in the first sample after a hold.
        """
        offset = self.offset
        if offset is None:
            return pose, self._replace(seen=pose)
        left = 1.0 - _minimum_jerk(self.elapsed / offset.duration)
        stays = self.kind == "clutch"
        moved = offset.added(pose, left, 1.0 if stays else left)
        return moved, self._replace(
            seen=moved,
            offset=offset if left > 0.0 or stays else None,
            elapsed=self.elapsed + dt,
        )


def _minimum_jerk(share: float) -> float:
    """Go from 0 to 1 with no speed and no acceleration at either end (Flash and Hogan 1985)."""
    share = min(max(share, 0.0), 1.0)
    return share * share * share * (10.0 + share * (6.0 * share - 15.0))


class Follower:
    """Lets a mapper follow the samples of a tracker.

    A new reference of the mapper (`HandMapper.clutch`, `reset`) ends a return and restarts the
    smoothing.

    Args:
        mapper: Maps the samples; its human hand must be scaled to the person.
        rejoin: How the robot comes back to the human after a hold: `glide` there, or stay where it
            is with its palm, as after a `clutch`.
        smoothing: How samples are smoothed before they are mapped; not at all if omitted.

    Attributes:
        mapper: As given.
        rejoin: As given.
        smoothing: As given; another one counts from the next sample.

    Raises:
        InvalidOptionsError: If `rejoin` is something else.
        HandError: If the human hand has no landmarks.
    """

    def __init__(
        self,
        mapper: HandMapper,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = None,
    ) -> None:
        if rejoin not in get_args(RejoinKind):
            kinds = ", ".join(get_args(RejoinKind))
            raise InvalidOptionsError(
                option="rejoin", expected=f"one of {kinds}", value=rejoin
            )
        self.mapper = mapper
        self.rejoin = rejoin
        self.smoothing = smoothing
        self._guard = StreamGuard(mapper.human)
        self._return = Rejoin(rejoin)
        self._smooth: SmoothState | None = None
        self._reference: HumanPose | None = None
        # That of the mapper while the samples simply follow those before, and their last step.
        self._core: Any = None
        self._last: MapStep | None = None

    # A shallow copy would move the same robot.
    __copy__ = deepcopy

    def map_sample(
        self,
        sample: HumanSample,
        *,
        dt: float | None = None,
        arrival: float | None = None,
    ) -> MapStep:
        """Map one sample of a tracker, if it makes sense; else hold.

        Args:
            sample: The sample. Its time stamps say how much time has passed.
            dt: Time that the step may account for [s]; that of the time stamps if omitted.
            arrival: When the sample arrived, on a monotonic clock [s], to check the rate of the
                time stamps; not checked if omitted.

        Returns:
            Every stage of the step; of a held one, targets and points are the robot's own.

        Raises:
            InvalidInputError: If the sample is of the other hand, or cannot be used; the mapper is
                then as it was before.
            InvalidOptionsError: If a reference point of the human is not a landmark.
            DegeneratePointsError: If the sample becomes the reference and its points do not
                determine the motion.
        """
        found = None
        if self._simply_follows():
            readers = self._guard.core, self.mapper.landmarks.core
            # The step, or the verdict about a sample that Python has to look at, if it is known.
            found = self._core.map_sample(*readers, sample, dt, arrival)
        if isinstance(found, MapStep):
            self._last = found
            return found
        dt = None if dt is None else check_dt(dt)
        verdict = found or self._guard.check(sample, arrival=arrival)
        return self._judged(sample, verdict, dt)

    def map_samples(
        self, samples: SampleColumns, progress: Callable[[int], None] | None = None
    ) -> StepTable:
        """Map the samples of a recording, as `map_sample` one by one.

        The compiled core maps those that simply follow the ones before by itself, without the
        interpreter's lock, so that threads map recordings side by side.

        Args:
            samples: The samples.
            progress: Called with the number of samples done.

        Returns:
            The numbers of all steps.

        Raises:
            InvalidInputError: As of `map_sample`.
            DegeneratePointsError: Likewise.
        """
        self._guard.check_side(samples)
        count = len(samples.time)
        table = StepTable(self.mapper.robot, count)
        i = 0
        while i < count:
            # The verdict about a sample that the core has judged, and leaves to the return here.
            i, verdict = self._run(samples, i, table)
            if i < count:
                started = thread_time_ns()
                sample = samples.sample(i)
                verdict = verdict or self._guard.check(sample)
                step = self._judged(sample, verdict, None)
                table.write(i, step, 1e-9 * (thread_time_ns() - started))
                i += 1
            if progress is not None:
                progress(i)
        return table

    def map(self, pose: HumanPose, dt: float, *, speed: float = 1.0) -> MapStep:
        """Smooth a pose, and map it without judging it; arguments as of `HandMapper.map`."""
        smooth = None
        if self.smoothing is not None:
            before = None if self._has_new_reference else self._smooth
            pose, smooth = smooth_sample(self.smoothing, before, pose, check_dt(dt))
        step = self.mapper.map(pose, dt, speed=speed)
        self._smooth = smooth
        self._reference = self.mapper.reference
        return step

    def _simply_follows(self) -> bool:
        """Return whether the core maps the next sample, unless the guard stops it."""
        is_same = self._core is self.mapper.core
        return bool(self._core) and is_same and not self.smoothing

    def _run(
        self, samples: SampleColumns, first: int, table: StepTable
    ) -> tuple[int, Verdict | None]:
        """Map samples in the core; return the first that it leaves, and its verdict if known."""
        if not self._simply_follows():
            return first, None
        readers = self._guard.core, self.mapper.landmarks.core
        last = min(len(samples.time), first + _RUN)
        run = *readers, samples, first, last, table.rows
        count, verdict, seen = self._core.run(*run)
        if seen is not None:
            self._return = self._return._replace(seen=seen)
            self._last = None
        return count, verdict

    def _judged(
        self, sample: HumanSample, verdict: Verdict, dt: float | None
    ) -> MapStep:
        """Map a sample that makes sense, else hold; an error leaves all as it was before."""
        started = perf_counter()
        granted = max(verdict.dt, SHORTEST_DT) if dt is None else dt
        back = self._present_return()
        said: dict[str, Any] = {"verdict": verdict, "confidence": sample.confidence}
        try:
            if verdict.is_held:
                return structs.replace(self.mapper.hold(granted, back.seen), **said)
            pose, _ = self.mapper.landmarks.read(sample.landmarks, sample.wrist)
            back = back.start(pose) if verdict.is_return else back
            moved, back = back.advance(pose, verdict.dt)
            step = self.map(moved, granted, speed=verdict.speed)
        except HandmapError:
            self._guard.forget()
            raise
        self._return = back
        self._last = None
        is_plain = self._guard.core and not (self.smoothing or back.offset)
        self._core = self.mapper.core if is_plain else None
        said |= {"is_gliding": back.is_fading, "duration": perf_counter() - started}
        return structs.replace(step, **said)

    def _present_return(self) -> Rejoin:
        if self._has_new_reference:
            return Rejoin(self.rejoin)
        if self._last is None:
            return self._return
        return self._return._replace(seen=self._last.stages.pose)

    @property
    def _has_new_reference(self) -> bool:
        return self.mapper.reference is not self._reference
