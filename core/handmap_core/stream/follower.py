"""`Follower`: lets a mapper follow the samples of a tracker that make sense.

The sessions of the service, `handmap retarget` and `handmap view` all follow in this way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import thread_time
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

from msgspec import structs

from handmap_core.core import core
from handmap_core.human import HumanSample, Recording
from handmap_core.ik import Task, When
from handmap_core.mapping import MapStep
from handmap_core.mapping.exclusive import exclusively
from .further_terms import TaskedMapper, further_terms
from .guard import StreamGuard
from .hand_follower import HandFollower, SampleMapper
from .rejoin import RejoinKind
from .smoothing import Smoothing
from .step_table import StepTable

if TYPE_CHECKING:
    from handmap_core import _core

_RUN = 1000  # samples of a recording that the core maps before progress is told


class RecordingMapper(SampleMapper[MapStep], TaskedMapper, Protocol):
    """What maps the samples of recordings: a `HandMapper`."""

    @property
    def core(self) -> _core.HandMapper | None:
        """What maps the next sample in the core; None where Python has to look at it."""


AnyMapper = TypeVar("AnyMapper", bound=RecordingMapper)


class Follower(HandFollower[MapStep], Generic[AnyMapper]):
    """Lets a mapper follow the samples of a tracker.

    A new reference of the mapper (`HandMapper.engage`, `reset`) ends a return and the smoothing.

    Args:
        mapper: Maps the samples; its human hand must be scaled to the person.
        guard: Judges them.
        rejoin: How the robot comes back to the human after a hold: `glide` there, or stay where it
            is with its palm, as after a `clutch`.
        smoothing: How samples are smoothed before they are mapped; None for not at all.

    Attributes:
        mapper: As given.
        rejoin: As given.

    Raises:
        InvalidOptionsError: If `rejoin` is something else.
        InvalidInputError: If `smoothing` is.
    """

    def __init__(
        self,
        mapper: AnyMapper,
        guard: StreamGuard,
        *,
        rejoin: RejoinKind = "glide",
        smoothing: Smoothing | None = Smoothing(),
    ) -> None:
        self.mapper = mapper
        super().__init__(
            # The checker takes the base's type variable for that of this class.
            mapper,  # ty: ignore[invalid-argument-type]
            guard,
            MapStep,
            rejoin=rejoin,
            smoothing=smoothing,
        )

    @exclusively
    def map_samples(
        self,
        samples: Recording,
        progress: Callable[[int], None] | None = None,
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
        table = StepTable(self._source.robot, count)
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
            in_core = self.mapper.core if self._is_plain else None
            origin = self._origin
            if in_core and origin is not None:
                i, numbers, seen = in_core.run(
                    self._guard.core,
                    self._smoother.core,
                    self._source.landmarks.core,
                    origin,
                    columns,
                    i,
                    min(count, i + _RUN),
                    table.rows,
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


def map_with(
    follower: Follower[AnyMapper],
    terms: Sequence[Task],
    sample: HumanSample,
    *,
    dt: When | None = None,
    arrival: float | None = None,
) -> MapStep:
    """Map one sample with further terms of the QP's cost, which no other sample has.

    Args:
        follower: Follows the samples.
        terms: The terms.
        sample: The sample.
        dt: As of `Follower.map_sample`.
        arrival: Likewise.
    """
    if not terms:
        return follower.map_sample(sample, dt=dt, arrival=arrival)
    with further_terms([follower.mapper], [terms]):
        return follower.map_sample(sample, dt=dt, arrival=arrival)
