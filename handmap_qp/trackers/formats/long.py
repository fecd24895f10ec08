"""`LongRecording`: a recording of hours in a file, which is read by pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from handmap_core.errors import HandmapError, expect
from handmap_core.se3 import Array
from handmap_qp.hands import Values
from handmap_qp.human import Recording, RecordingPart

SHORTEST = 20_000
"""Recordings with fewer samples are read as a whole."""
PIECE = 4096
"""Samples that are read at once."""
OVERVIEW = 108_000
"""Most samples of a recording whose overview has all of them: an hour at 30 Hz."""
_BLOCKS, _BLOCK = 12, 4500
"""Blocks that the overview of a longer recording has, and samples of each: 2.5 min at 30 Hz."""
_BLOCK_OF_BOTH = 4000
"""Samples of each block of both hands of a person, who are measured together."""


@dataclass(frozen=True, eq=False)
class LongRecording:
    """A recording that does not have to fit into the memory.

    Attributes:
        overview: All samples, if they are at most `OVERVIEW`. Otherwise those of `blocks`, the
            last one of each block not valid, so that nothing goes on from one to the next.
        count: Number of samples.
        parts: Reads the file from the start, and yields its samples in parts of some `PIECE`.
        blocks: Which samples the overview has.
    """

    overview: Recording
    count: int
    parts: Callable[[], Iterator[Recording]]
    blocks: Sequence[slice]

    @classmethod
    def opened(
        cls, parts: Callable[[], Iterator[Recording]], count: int
    ) -> LongRecording:
        """Read all parts of a recording for the first time, and return what reads them again.

        Args:
            parts: As of the recording.
            count: Number of samples.

        Raises:
            InvalidInputError: If no sample of the overview is valid.
        """
        blocks = blocks_of(count)
        return cls(overview_of(parts(), blocks), count, parts, blocks)

    def __len__(self) -> int:
        """Number of samples."""
        return self.count

    @property
    def has_all(self) -> bool:
        """Whether the overview is the recording: it has all samples."""
        return len(self.overview) == self.count

    def instants(self) -> Array:
        """Return the instants of all samples [s], shape (T,)."""
        if self.has_all:
            return self.overview.time
        return np.concatenate([part.time for part in self.parts()])

    def steps(self) -> Array:
        """Return `Recording.steps` of all samples [s], shape (T,)."""
        if self.has_all:
            return self.overview.steps
        steps = np.diff(self.instants())
        return np.insert(steps, 0, np.median(steps))

    def whole(self) -> Recording:
        """Read all samples into the memory."""
        if self.has_all:
            return self.overview
        return overview_of(self.parts(), [slice(0, self.count)])

    def without_overview(self) -> LongRecording:
        """Return it with its first samples alone in memory, for what takes each sample once."""
        head = part_of(self.overview, slice(0, PIECE))
        return replace(self, overview=head, blocks=[slice(0, len(head))])

    def with_overview(self) -> LongRecording:
        """Return it with the overview that a recording of its length has."""
        if self.has_all or self.blocks == blocks_of(self.count):
            return self
        return LongRecording.opened(self.parts, self.count)

    def changed(self, change: Callable[[Recording], Recording]) -> LongRecording:
        """Return it with a change that each sample takes by itself, such as `mirrored`."""
        parts = self.parts
        return replace(
            self,
            overview=change(self.overview),
            parts=lambda: map(change, parts()),
        )

    def filtered(
        self, change: Callable[[Iterator[Recording]], Iterator[Recording]]
    ) -> LongRecording:
        """Return it with a change that takes all parts, such as `look_ahead_parts`."""
        parts = self.parts
        return replace(
            self,
            overview=overview_of(change(parts()), self.blocks),
            parts=lambda: change(parts()),
        )


def open_or_read(
    count: int,
    open_long: Callable[[], LongRecording | None],
    read: Callable[[], Recording],
) -> Recording | LongRecording:
    """Open a recording to be read by pieces if it is long, and read it as a whole otherwise.

    Args:
        count: Number of its samples.
        open_long: Opens it; returns None if it has to be read as a whole.
        read: Reads it as a whole.

    Raises:
        HandmapError: If it is damaged. Where it fits into the memory, `read` says what is wrong.
    """
    if count < SHORTEST:
        return read()
    try:
        long = open_long()
    except HandmapError:
        if count > OVERVIEW:
            raise
        return read()
    return long or read()


def in_memory(recording: Recording | LongRecording) -> Recording:
    """Return the samples of a recording that are in the memory: all, or those of its overview."""
    if isinstance(recording, LongRecording):
        return recording.overview
    return recording


def without_overview(
    recording: Recording | LongRecording,
) -> Recording | LongRecording:
    """Return a recording that takes little memory if it is long: see `LongRecording`."""
    if isinstance(recording, LongRecording):
        return recording.without_overview()
    return recording


def all_long(
    recordings: Sequence[Recording | LongRecording],
) -> list[LongRecording] | None:
    """Return the recordings of both hands of a person to be read by pieces; None if none is long.

    They have overviews, also if those that were given have none (`without_overview`).

    If both have more samples together than blocks of `_BLOCK_OF_BOTH`, their overviews show the
    same spans of time: blocks of the one that has most samples.
    """
    if not any(isinstance(each, LongRecording) for each in recordings):
        return None
    found = [
        each if isinstance(each, LongRecording) else in_pieces(each)
        for each in recordings
    ]
    most = len(found) * _BLOCKS * _BLOCK_OF_BOTH
    if len(found) == 1 or sum(map(len, found)) <= most:
        return [each.with_overview() for each in found]
    index = max(range(len(found)), key=lambda i: len(found[i]))
    blocks = _spread(len(found[index]), _BLOCK_OF_BOTH)
    leading = _with_blocks(found[index], blocks)
    time = leading.overview.time
    ends = np.cumsum([block.stop - block.start for block in leading.blocks])
    firsts = time[np.append(0, ends[:-1])]
    return [
        leading if i == index else _within(each, firsts, time[ends - 1])
        for i, each in enumerate(found)
    ]


def in_pieces(recording: Recording) -> LongRecording:
    """Return a recording that is in the memory, to be read by pieces as a long one is."""

    def parts() -> Iterator[Recording]:
        for samples in pieces_of(len(recording)):
            yield part_of(recording, samples)

    count = len(recording)
    return LongRecording(recording, count, parts, [slice(0, count)])


def _within(recording: LongRecording, firsts: Array, lasts: Array) -> LongRecording:
    """Return a recording whose overview has the samples of spans of time.

    Args:
        recording: The recording.
        firsts: First instants of the spans [s], shape (b,).
        lasts: Their last instants [s], shape (b,).
    """
    time = recording.instants()
    starts = np.searchsorted(time, firsts, "left")
    stops = np.searchsorted(time, lasts, "right")
    blocks = [
        slice(start, stop)
        for start, stop in zip(starts.tolist(), stops.tolist(), strict=True)
        if start < stop
    ]
    expect(blocks, "hands", "recordings of both at the same time", got="others")
    return _with_blocks(recording, blocks)


def _with_blocks(recording: LongRecording, blocks: Sequence[slice]) -> LongRecording:
    """Return a recording whose overview has some blocks of samples."""
    overview = overview_of(recording.parts(), blocks)
    return replace(recording, overview=overview, blocks=blocks)


def pieces_of(count: int) -> Iterator[slice]:
    """Yield which samples each piece of so many has."""
    for start in range(0, count, PIECE):
        yield slice(start, min(start + PIECE, count))


def part_of(recording: Recording, samples: slice) -> Recording:
    """Return consecutive samples, in none of which the hand has to be seen."""
    columns: Values = {
        field.name: value[samples] if isinstance(value, Array) else value
        for field in fields(recording)
        for value in [getattr(recording, field.name)]
    }
    return RecordingPart(**columns)


def blocks_of(count: int) -> list[slice]:
    """Return which samples an overview of so many has: all, or blocks that are evenly spread."""
    if count <= OVERVIEW:
        return [slice(0, count)]
    return _spread(count, _BLOCK)


def _spread(count: int, block: int) -> list[slice]:
    """Return blocks of a number of samples that are evenly spread over so many."""
    starts = np.linspace(0, count - block, _BLOCKS).astype(int).tolist()
    return [slice(start, start + block) for start in starts]


def overview_of(parts: Iterable[Recording], blocks: Sequence[slice]) -> Recording:
    """Read all parts of a recording, and return its overview (`LongRecording.overview`).

    Args:
        parts: The parts, in the order of time.
        blocks: Which samples the overview has, in the order of time.

    Raises:
        InvalidInputError: If no sample of the overview is valid.
    """
    columns: dict[str, Array] = {}
    size = sum(block.stop - block.start for block in blocks)
    start = 0
    first = None
    for part in parts:
        first = first or part
        offset = 0
        for block in blocks:
            # The samples that part and block have in common.
            begin = max(start, block.start)
            end = min(start + len(part), block.stop)
            if begin < end:
                at = offset + begin - block.start
                for name, column in columns_of(part):
                    if name not in columns:
                        columns[name] = np.empty(
                            (size, *column.shape[1:]), column.dtype
                        )
                    columns[name][at : at + end - begin] = column[
                        begin - start : end - start
                    ]
            offset += block.stop - block.start
        start += len(part)
    expect(first is not None, "time", "at least one instant", got="none")
    if len(blocks) > 1:
        ends = np.cumsum([block.stop - block.start for block in blocks]) - 1
        columns["valid"][ends] = False
        expect(
            columns["valid"].any(),
            "valid",
            f"a hand in one of {len(blocks)} blocks of samples, spread evenly",
            got="none",
        )
    words = {
        field.name: getattr(first, field.name)
        for field in fields(Recording)
        if isinstance(getattr(first, field.name), str)
    }
    return Recording(**words, **columns)


def columns_of(part: Recording) -> list[tuple[str, Array]]:
    """Return the columns that a recording has, by name."""
    values = [(field.name, getattr(part, field.name)) for field in fields(part)]
    return [(name, value) for name, value in values if isinstance(value, Array)]
