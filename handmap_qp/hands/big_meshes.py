"""Meshes of millions of triangles, with bounded time and memory: `read_big_mesh`, `coarsen`.

A hand needs neither more corners than a grid of a millimetre has, nor more sides of a convex hull
than its distances can tell apart. Triangles are read in chunks, so that memory does not grow with
the file.
"""

from collections.abc import Callable, Iterator
from functools import cache, lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, frozen, lengths

MOST_TRIANGLES = 200_000
"""Meshes with more triangles than this are big."""
BIG_FILE = 5_000_000
"""Smaller files have no big mesh [bytes]."""
# Cells of the grid along a mesh's longest side, in bits: three cells fit into 63.
_BITS = 7
# Triangles read at once.
_CHUNK = 100_000
# Length of the lines that are read at once [bytes].
_LINES = 4_000_000
# Directions in which the outermost corners are kept.
_DIRECTIONS = 1000
_HEADER = 84  # bytes
_TRIANGLE = np.dtype(
    [("normal", "<f4", 3), ("corners", "<f4", 9), ("attribute", "<u2")]
)

Chunks = Callable[[], Iterator[Array]]
"""Reads a mesh from its beginning: triangles in chunks, shape (k, 3, 3)."""


class CoarseMesh(NamedTuple):
    """A mesh with fewer triangles.

    Attributes:
        vertices: Corners of the mesh, shape (m, 3): of each cell of a grid of 128 cells along its
            longest side the one that is farthest from the middle of its box.
        faces: Triangles, each seen from the same side as before, shape (k, 3).
        extremes: The outermost vertices in 1,000 directions, shape (n, 3), n <= 1,000. Their convex
            hull is inside the mesh's, and a cell or less beneath it.
    """

    vertices: Array
    faces: Array
    extremes: Array


def stl_triangles(file: str) -> Array | None:
    """Return the triangles of a binary STL file, mapped and not read; None of any other file.

    Shape (n,), with a field `corners`, shape (9,) [m].

    Raises:
        OSError: If it cannot be read.
    """
    path = Path(file)
    if path.suffix.lower() != ".stl":
        return None
    with path.open("rb") as content:
        header = content.read(_HEADER)
    count = int.from_bytes(header[_HEADER - 4 :], "little")
    if count == 0 or path.stat().st_size != _HEADER + count * _TRIANGLE.itemsize:
        return None
    return np.memmap(path, _TRIANGLE, "r", _HEADER, (count,))


def read_big_mesh(file: str) -> CoarseMesh | None:
    """Read a big mesh from a binary STL file; None of a small one, or of another file.

    A file is read once, as long as it does not change.

    Raises:
        OSError: If it cannot be read.
    """
    stat = Path(file).stat()
    return _read(file, stat.st_mtime_ns, stat.st_size)


@lru_cache(maxsize=64)
def _read(file: str, *_: int) -> CoarseMesh | None:
    triangles = stl_triangles(file)
    if triangles is None or len(triangles) <= MOST_TRIANGLES:
        return None

    def chunks() -> Iterator[Array]:
        for start in range(0, len(triangles), _CHUNK):
            corners = triangles["corners"][start : start + _CHUNK]
            yield corners.reshape(-1, 3, 3).astype(float)

    return coarsen(chunks)


def outermost_corners(file: str) -> Array | None:
    """Return the outermost corners of a big mesh in a binary STL or an OBJ file, shape (n, 3).

    They are `CoarseMesh.extremes`; None of a small mesh, or of another file.

    Raises:
        OSError: If it cannot be read.
        ValueError: If a corner in it is no three numbers.
    """
    path = Path(file)
    if path.suffix.lower() != ".obj":
        big = read_big_mesh(file)
        return big.extremes if big else None
    if path.stat().st_size <= BIG_FILE:
        return None
    corners = [*_obj_corners(path)]
    return extremes_of(*corners) if is_many(sum(map(len, corners))) else None


def is_many(corners: int) -> bool:
    """Return whether a mesh with so many corners is big: closed, it has twice as many triangles."""
    return 2 * corners > MOST_TRIANGLES


def _obj_corners(path: Path) -> Iterator[Array]:
    """Yield the corners of an OBJ file in chunks, in single precision, shape (k, 3)."""
    with path.open("rb") as content:
        while lines := content.readlines(_LINES):
            rows = [line.split()[1:4] for line in lines if line.startswith(b"v ")]
            if rows:
                yield np.array(rows, np.float32)


def extremes_of(*corners: Array) -> Array:
    """Return the outermost corners of a mesh that is in memory in parts, shape (m, 3) each."""

    def chunks() -> Iterator[Array]:
        for part in corners:
            # Corners alone tell what is outermost: each is a triangle of no size.
            yield part[:, None].astype(float).repeat(3, axis=1)

    return coarsen(chunks).extremes


def coarsen_triangles(vertices: Array, faces: Array) -> CoarseMesh:
    """Coarsen a mesh that is in memory.

    Args:
        vertices: Corners, shape (m, 3).
        faces: Indices of three corners each, shape (k, 3).
    """

    def chunks() -> Iterator[Array]:
        for start in range(0, len(faces), _CHUNK):
            yield np.asarray(vertices, float)[faces[start : start + _CHUNK]]

    return coarsen(chunks)


def coarsen(chunks: Chunks) -> CoarseMesh:
    """Merge a mesh's corners in each cell of a grid, and find the outermost vertices.

    Triangles whose corners lie in fewer than three cells are dropped (vertex clustering: Rossignac
    and Borrel, "Multi-resolution 3D approximations for rendering complex scenes", 1993), and those
    between the same three cells are one.

    Args:
        chunks: Reads the triangles; called twice.
    """
    ends = np.array(
        [(c.min(axis=(0, 1)), c.max(axis=(0, 1))) for c in chunks() if len(c)]
    )
    low = ends[:, 0].min(axis=0)
    high = ends[:, 1].max(axis=0)
    middle = (low + high) / 2.0
    size = (high - low).max()
    scale = (1 << _BITS) * (1.0 - 1e-9) / max(size, 1e-12)
    cells = np.zeros(0, np.int64)
    places = np.zeros((0, 3))
    codes = np.zeros(0, np.int64)
    for triangles in chunks():
        steps = ((triangles - low) * scale).astype(np.int64)
        keys = (steps[..., 0] << 2 * _BITS) | (steps[..., 1] << _BITS) | steps[..., 2]
        cells, places = _farthest(
            np.append(cells, keys),
            np.vstack([places, triangles.reshape(-1, 3)]),
            middle,
        )
        a, b, c = keys.T
        is_whole = (a != b) & (b != c) & (c != a)
        codes = np.union1d(codes, _codes(keys[is_whole]))
    corners = 3 * _BITS
    mask = (1 << corners) - 1
    keys = np.column_stack(
        [codes >> 2 * corners, codes >> corners & mask, codes & mask]
    )
    outermost = np.unique((directions() @ places.T).argmax(axis=1))
    return CoarseMesh(
        frozen(places),
        frozen(np.searchsorted(cells, keys)),
        frozen(places[outermost]),
    )


def _farthest(cells: Array, places: Array, middle: Array) -> tuple[Array, Array]:
    """Return each cell once, in order, with its place that is farthest from the middle."""
    order = np.argsort(-lengths(places - middle), kind="stable")
    found, first = np.unique(cells[order], return_index=True)
    return found, places[order[first]]


def _codes(keys: Array) -> Array:
    """Return one number for each triangle of cells, shape (k, 3): the least cell first."""
    start = keys.argmin(axis=1)[:, None]
    turned = np.take_along_axis(keys, (start + np.arange(3)) % 3, axis=1)
    corners = 3 * _BITS
    return (turned[:, 0] << 2 * corners) | (turned[:, 1] << corners) | turned[:, 2]


@cache
def directions() -> Array:
    """Return unit vectors that are evenly spread over a sphere, shape (1000, 3).

    A Fibonacci lattice: along z in even steps, turned by the golden angle each time.
    """
    steps = np.arange(_DIRECTIONS)
    z = 1.0 - (2.0 * steps + 1.0) / _DIRECTIONS
    turn = np.pi * (3.0 - np.sqrt(5.0)) * steps
    across = np.sqrt(1.0 - z**2)
    return frozen(np.column_stack([across * np.cos(turn), across * np.sin(turn), z]))
