"""`DiskColumn`: an array whose rows are on the disk; and `.npz` archives of such arrays."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryFile
from typing import IO

import numpy as np
from numpy.lib import format as npy

from handmap_core.se3 import Array

_AT_ONCE = 1 << 22
"""Bytes that are copied at once."""


class DiskColumn:
    """An array in a file without a name, which is gone when the process ends, however it ends.

    Args:
        folder: Where the file is.
        dtype: Type of the numbers.
        row: Shape of a row.

    Attributes:
        dtype: As given.
    """

    def __init__(self, folder: Path, dtype: np.dtype, row: tuple[int, ...]) -> None:
        self.dtype = dtype
        self._row = row
        self._count = 0
        # Unbuffered: a full disk must be known when rows are written. `close` ends it.
        self._file = TemporaryFile(dir=folder, buffering=0)  # noqa: SIM115

    def __len__(self) -> int:
        """Number of rows."""
        return self._count

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return (self._count, *self._row)

    @property
    def _row_bytes(self) -> int:
        return self.dtype.itemsize * int(np.prod(self._row, dtype=int))

    def append(self, rows: Array) -> None:
        """Write rows behind those that are there.

        Raises:
            OSError: If the disk is full.
        """
        left = memoryview(np.ascontiguousarray(rows, dtype=self.dtype).tobytes())
        self._file.seek(self._count * self._row_bytes)
        while left:
            # A disk that is nearly full takes a part of it, and then raises.
            left = left[self._file.write(left) or 0 :]
        self._count += len(rows)

    def rows(self, samples: slice) -> Array:
        """Read some rows that follow each other."""
        start, stop, _ = samples.indices(self._count)
        self._file.seek(start * self._row_bytes)
        data = bytearray((stop - start) * self._row_bytes)
        left = memoryview(data)
        while left:
            read = self._file.readinto(left)
            if not read:
                raise OSError("a temporary file was cut off")
            left = left[read:]
        return np.frombuffer(data, self.dtype).reshape(stop - start, *self._row)

    def blocks(self, blocks: Sequence[slice]) -> Array:
        """Read blocks of rows as one array."""
        if len(blocks) == 1:
            return self.rows(blocks[0])
        sizes = [block.stop - block.start for block in blocks]
        found = np.empty((sum(sizes), *self._row), self.dtype)
        at = 0
        for block, size in zip(blocks, sizes, strict=True):
            found[at : at + size] = self.rows(block)
            at += size
        return found

    def pieces(self) -> Iterator[Array]:
        """Read all rows, some megabytes at once."""
        size = max(1, _AT_ONCE // self._row_bytes)
        for start in range(0, self._count, size):
            yield self.rows(slice(start, start + size))

    def close(self) -> None:
        """Remove the file."""
        self._file.close()


def write_npz(
    stream: IO[bytes], arrays: Mapping[str, Array | DiskColumn], *, is_compressed: bool
) -> None:
    """Write arrays as numpy's `savez` and `savez_compressed` do, those on the disk by pieces.

    Args:
        stream: The file.
        arrays: Arrays by name.
        is_compressed: Whether to compress them.

    Raises:
        OSError: If the disk is full.
    """
    kind = zipfile.ZIP_DEFLATED if is_compressed else zipfile.ZIP_STORED
    with zipfile.ZipFile(stream, "w", kind) as archive:
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as member:
                if not isinstance(array, DiskColumn):
                    npy.write_array(member, np.asanyarray(array), allow_pickle=False)
                    continue
                header = {
                    "descr": npy.dtype_to_descr(array.dtype),
                    "fortran_order": False,
                    "shape": array.shape,
                }
                npy.write_array_header_1_0(member, header)
                for rows in array.pieces():
                    member.write(rows.tobytes())
