"""`LongRecording`: a recording of hours in a file, which is read by pieces."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, fields, replace

import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array
from handmap_qp.human import Recording

SHORTEST = 20_000
"""Recordings with fewer samples are read as a whole."""
PIECE = 4096
"""Samples that are read at once."""
OVERVIEW = 108_000
"""Most samples of a recording whose overview has all of them: an hour at 30 Hz."""
_BLOCKS, _BLOCK = 12, 4500
"""Blocks that the overview of a longer recording has, and samples of each: 2.5 min at 30 Hz."""


@dataclass(frozen=True, eq=False)
class LongRecording:
    """A recording that does not have to fit into the memory.

    Attributes:
        overview: All samples, if they are at most `OVERVIEW`. Otherwise those of `blocks_of`, the
            last one of each block not valid, so that nothing goes on from one to the next.
        count: Number of samples.
        parts: Reads the file from the start, and yields its samples in parts of at most `PIECE`.
    """

    overview: Recording
    count: int
    parts: Callable[[], Iterator[Recording]]

    def __len__(self) -> int:
        """Number of samples."""
        return self.count

    def changed(self, change: Callable[[Recording], Recording]) -> LongRecording:
        """Return it with a change that each sample takes by itself, such as `mirrored`."""
        parts = self.parts
        return replace(
            self,
            overview=change(self.overview),
            parts=lambda: map(change, parts()),
        )


def blocks_of(count: int) -> list[slice]:
    """Return which samples an overview of so many has: all, or blocks that are evenly spread."""
    if count <= OVERVIEW:
        return [slice(0, count)]
    starts = np.linspace(0, count - _BLOCK, _BLOCKS).astype(int).tolist()
    return [slice(start, start + _BLOCK) for start in starts]


def overview_of(parts: Iterable[Recording], count: int) -> Recording:
    """Read all parts of a recording, and return its overview (`LongRecording.overview`).

    Args:
        parts: The parts, in the order of time.
        count: Number of samples.

    Raises:
        InvalidInputError: If no sample of the overview is valid.
    """
    blocks = blocks_of(count)
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
                for name, column in _columns_of(part):
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
            f"a hand in one of {_BLOCKS} blocks of {_BLOCK} samples, spread evenly",
            got="none",
        )
    words = {
        field.name: getattr(first, field.name)
        for field in fields(Recording)
        if isinstance(getattr(first, field.name), str)
    }
    return Recording(**words, **columns)


def _columns_of(part: Recording) -> list[tuple[str, Array]]:
    """Return the columns that a recording has, by name."""
    values = [(field.name, getattr(part, field.name)) for field in fields(part)]
    return [(name, value) for name, value in values if isinstance(value, Array)]
