"""A small software renderer in numpy: triangles in, a shaded picture with transparency out.

A z-buffer resolves occlusion per pixel; painter's sorting fails for fingers that cross. Each pixel
is shaded once: two directional lights, ambient light from the sky, a soft highlight, and ambient
occlusion in creases. The picture is supersampled and averaged, which smooths all edges.
"""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from handmap_core.se3 import Array, affine, transform_points, unit

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""
_NEAR = 1e-3
# Distance of a camera from what it frames, in radii of that: larger ones give less perspective.
_DISTANCE = 5.0
# Relative difference of distances that rounding makes.
_ROUNDING = 1e-9
# Rows of triangles, twice, to look at in one go; bounds the memory of a picture.
_CHUNK = 4_000
# A pixel may be outside its triangle by this [pixel].
_TOLERANCE = 1e-6

# Directions towards the lights in camera axes (x right, y down, z forward): key light from the
# upper left, fill light from the right.
_KEY_DIRECTION = unit(np.array([-0.45, -0.75, -0.5]))
_FILL_DIRECTION = unit(np.array([0.8, -0.05, -0.45]))
_KEY = 0.72
_FILL = 0.16
# Ambient light from the sides, and how much more comes from above and less from below.
_AMBIENT = 0.21
_SKY = 0.09
_HIGHLIGHT = 0.10
# Minimum albedo, so that black parts still show their shape.
_DARKEST = 0.03
_CREASE_RADIUS = 0.007
_CREASE_DEPTH = 0.55
_HIDDEN_MARK_OPACITY = 0.6


class Triangles(NamedTuple):
    """Coloured triangles in the world.

    Attributes:
        vertices: Corners [m], counter-clockwise as seen from outside, shape (n, 3, 3): triangle,
            corner, coordinate.
        colours: Red, green and blue in 0..1, shape (n, 3).
        normals: Unit normals at the corners, for smooth shading, shape (n, 3, 3).
    """

    vertices: Array
    colours: Array
    normals: Array

    @classmethod
    def painted(cls, vertices: Array, normals: Array, colour: Colour) -> Triangles:
        """Return triangles of one colour."""
        return cls(vertices, np.tile(colour, (len(vertices), 1)), normals)

    def moved(self, pose: Array) -> Triangles:
        """Return them moved by a pose, shape (4, 4)."""
        # A product of many small matrices takes five times as long as one of a long one.
        turned = self.normals.reshape(-1, 3) @ pose[:3, :3].T
        placed = transform_points(pose, self.vertices.reshape(-1, 3))
        shape = self.vertices.shape
        return Triangles(placed.reshape(shape), self.colours, turned.reshape(shape))


class Camera(NamedTuple):
    """A pinhole camera with axes x right, y down, z forward; pixel (0, 0) is the upper left corner.

    Attributes:
        world_to_camera: Change of coordinates from world to camera, shape (4, 4).
        focal_length: Focal length [pixel].
        centre: Principal point (x, y) [pixel].
        size: Width and height of the picture [pixel].
    """

    world_to_camera: Array
    focal_length: float
    centre: tuple[float, float]
    size: tuple[int, int]

    @classmethod
    def framing(
        cls,
        points: Array,
        size: tuple[int, int],
        *,
        azimuth: float = -60.0,
        elevation: float = 25.0,
        margin: float = 0.04,
    ) -> Camera:
        """Return the camera that fills a picture with given points.

        Args:
            points: Points that must be in the picture [m], shape (n, 3).
            size: Width and height of the picture [pixel].
            azimuth: Direction from the points to the camera: angle about the world's z axis, from x
                [deg].
            elevation: Angle of that direction above the horizontal plane [deg], in (-90, 90).
            margin: Margin on every side, as a fraction of the smaller of width and height.

        Returns:
            The camera.
        """
        # It takes .1 s to import, and only pictures need it.
        from scipy.spatial.transform import Rotation

        middle = 0.5 * _box(points).sum(axis=0)
        radius = max(_length(points - middle).max(), 1e-6)
        turn = Rotation.from_euler("ZY", (azimuth, -elevation), degrees=True)
        backward, right, up = turn.as_matrix().T
        rotation = np.array([right, -up, -backward])
        place = middle + _DISTANCE * radius * backward
        world_to_camera = affine(rotation, -rotation @ place)
        seen = transform_points(world_to_camera, points)
        low, high = _box(seen[:, :2] / seen[:, 2:])
        room = np.array(size) - 2.0 * margin * min(size)
        focal_length = (room / np.maximum(high - low, 1e-9)).min()
        x, y = (0.5 * (size - focal_length * (low + high))).tolist()
        return cls(world_to_camera, focal_length, (x, y), size)

    def project(self, points: Array) -> Array:
        """Project points into the picture.

        Args:
            points: Points in the world [m], shape (..., 3).

        Returns:
            Pixel x, pixel y (down) and depth along the camera's axis [m], shape (..., 3).
        """
        flat = transform_points(self.world_to_camera, points.reshape(-1, 3))
        seen = flat.reshape(points.shape)
        with np.errstate(divide="ignore", invalid="ignore"):
            seen[..., :2] *= self.focal_length / seen[..., 2:]
        seen[..., :2] += self.centre
        return seen


def _box(points: Array) -> Array:
    """Return `box_of(points)`, in a tenth of the time if they are many."""
    columns = np.ascontiguousarray(points.T)
    return np.array([columns.min(axis=1), columns.max(axis=1)])


def _length(vectors: Array) -> Array:
    """Return `lengths(vectors)`, in a third of the time if they are many."""
    return np.sqrt(np.vecdot(vectors, vectors))


_NO_CORNERS = np.zeros((0, 3, 3))
_NOTHING = Triangles.painted(_NO_CORNERS, _NO_CORNERS, (0.0, 0.0, 0.0))


def merged(parts: list[Triangles]) -> Triangles:
    """Concatenate several sets of triangles."""
    return Triangles(*map(np.concatenate, zip(_NOTHING, *parts, strict=True)))


def render(
    triangles: Triangles,
    camera: Camera,
    *,
    marks: Triangles | None = None,
    supersampling: int = 2,
) -> Array:
    """Render a picture.

    Args:
        triangles: Solid parts.
        camera: The camera.
        marks: Parts that stay visible behind solid ones, such as reference points.
        supersampling: Samples per pixel along each side.

    Returns:
        Red, green, blue (not premultiplied) and opacity in 0..1, shape (height, width, 4), first
        row on top.
    """
    pose, focal_length, (x, y), (width, height) = camera
    n = supersampling
    fine = Camera(pose, n * focal_length, (n * x, n * y), (n * width, n * height))
    picture, depth = _shaded(triangles, fine)
    picture[..., :3] *= 1.0 - _CREASE_DEPTH * _creases(depth, fine)[..., None]
    if marks:
        shaded, place = _shaded(marks, fine)
        seen = np.where(place > depth, _HIDDEN_MARK_OPACITY, 1.0)[..., None]
        picture += seen * shaded[..., 3:] * (shaded - picture)
    # Sums of few slices take a quarter of the time of `mean`.
    rows = np.zeros((height, n * width, 4))
    for i in range(n):
        rows += picture[i::n]
    picture = np.zeros((height, width, 4))
    for i in range(n):
        picture += rows[:, i::n] / n**2
    # Colours were averaged premultiplied by opacity: divide by it, then apply gamma.
    light = picture[..., :3] / np.maximum(picture[..., 3:], 1e-6)
    picture[..., :3] = light.clip(0.0, 1.0) ** (1.0 / 2.2)
    return picture


def _rasterise(vertices: Array, camera: Camera) -> tuple[Array, ...]:
    """Find the triangle in front at every pixel's centre; cull those seen from behind.

    The k covered pixels, their triangles and barycentric coordinates, (k, 3); and all depths.
    """
    width, height = camera.size
    corners = camera.project(vertices)
    # x, y and depth of the three corners, (3, 3, n).
    x, y, depths = np.ascontiguousarray(corners.transpose(2, 1, 0))
    area = (x[1] - x[0]) * (y[2] - y[0]) - (x[2] - x[0]) * (y[1] - y[0])
    is_ahead = (depths[0] > _NEAR) & (depths[1] > _NEAR) & (depths[2] > _NEAR)
    # y points down, so a counter-clockwise triangle has a negative area in the picture.
    seen = np.flatnonzero((area < 0.0) & is_ahead)
    x, y, area = x[:, seen], y[:, seen], area[seen]
    # Barycentric coordinates are linear in the pixel: coefficients of x, y, and the constant.
    after, before = [1, 2, 0], [2, 0, 1]
    constants = x[after] * y[before] - x[before] * y[after]
    shares = np.array([y[after] - y[before], x[before] - x[after], constants]) / area
    # Triangle, corner, coefficient.
    planes = np.ascontiguousarray(shares.transpose(2, 1, 0))
    nearness = np.vecmat(1.0 / depths.T[seen], planes)
    nearest = np.zeros(width * height)
    front = np.zeros(width * height, dtype=int)
    lines = _between(y.min(axis=0), y.max(axis=0), height)
    for owner, row in np.array_split(lines, 1 + lines.size // _CHUNK, axis=1):
        # Shares that grow along the row are positive from their zero on, the others up to it.
        slopes, down, constants = planes[owner].T
        with np.errstate(divide="ignore", invalid="ignore"):
            zeros = (down * (row + 0.5) + constants) / -slopes
        # The tolerance assigns a pixel on a shared edge to at least one of its triangles: no holes.
        left = np.where(slopes > 0.0, zeros, 0.0).max(axis=0) - _TOLERANCE
        right = np.where(slopes < 0.0, zeros, width).min(axis=0) + _TOLERANCE
        line, column = _between(left, right, width)
        owner = owner[line]
        pixel = row[line] * width + column
        near = np.vecdot(nearness[owner], _centres(pixel, width))
        np.maximum.at(nearest, pixel, near)
        # Of surfaces that lie in one plane, the last one is in front everywhere.
        is_front = near > nearest[pixel] * (1.0 - _ROUNDING)
        front[pixel[is_front]] = owner[is_front]
    pixels = np.flatnonzero(nearest)
    owner = front[pixels]
    shares = np.matvec(planes[owner], _centres(pixels, width))
    with np.errstate(divide="ignore"):
        depth = 1.0 / nearest.reshape(height, width)
    return pixels, seen[owner], shares, depth


def _between(low: Array, high: Array, size: int) -> Array:
    """Return the index of bounds, and its own, of each pixel with its centre in them, (2, k)."""
    first = np.ceil(low - 0.5).clip(0, size).astype(int)
    counts = np.floor(high + 0.5).clip(first, size).astype(int) - first
    owner = np.arange(len(low)).repeat(counts)
    start = first - counts.cumsum() + counts
    return np.array([owner, start[owner] + np.arange(len(owner))])


def _centres(pixels: Array, width: int) -> Array:
    """Return the centres of pixels of a picture as x, y and 1, shape (k, 3)."""
    row, column = np.divmod(pixels, width)
    return np.column_stack([column + 0.5, row + 0.5, np.ones(len(row))])


def _shaded(triangles: Triangles, camera: Camera) -> tuple[Array, Array]:
    """Return linear light and opacity at every pixel, (height, width, 4), and its depth [m]."""
    width, height = camera.size
    picture = np.zeros((height * width, 4))
    pixels, triangle, shares, depth = _rasterise(triangles.vertices, camera)
    rotation = camera.world_to_camera[:3, :3]
    normals = unit(np.vecmat(shares, triangles.normals[triangle]) @ rotation.T)
    rays = _centres(pixels, width) - (*camera.centre, 1.0 - camera.focal_length)
    light = _AMBIENT + _SKY * (normals @ rotation[:, 2])
    # Wrapped diffuse lighting: softens the terminator, as on skin.
    light += _KEY * np.maximum((normals @ _KEY_DIRECTION + 0.2) / 1.2, 0.0)
    light += _FILL * np.maximum(normals @ _FILL_DIRECTION, 0.0)
    halfway = unit(_KEY_DIRECTION - unit(rays))
    shine = np.vecdot(normals, halfway).clip(0.0)
    albedo = _DARKEST + (1.0 - _DARKEST) * triangles.colours[triangle] ** 2.2
    picture[pixels, :3] = albedo * light[:, None] + _HIGHLIGHT * shine[:, None] ** 40
    picture[pixels, 3] = 1.0
    return picture.reshape(height, width, 4), depth


def _creases(depth: Array, camera: Camera) -> Array:
    """Estimate ambient occlusion at each pixel, 0..1, shape (height, width).

    A pixel is in a hollow if it is behind the mean depth of two opposite neighbours.
    """
    # It takes .1 s to import, and only pictures need it.
    from scipy.ndimage import gaussian_filter

    is_solid = np.isfinite(depth)
    solid = depth[is_solid]
    hollow = np.zeros_like(depth)
    if not len(solid):
        return hollow
    scale = camera.focal_length / np.median(solid)
    reach = max(2.0, _CREASE_RADIUS * scale)
    # Repeat the border of the picture, and look at solid pixels only.
    room = int(np.ceil(reach)) + 1
    padded = np.pad(depth, room, mode="edge")
    stride = padded.shape[1]
    padded = padded.ravel()
    places = (np.argwhere(is_solid) + room) @ (stride, 1)
    total = np.zeros(len(solid))
    for radius, turn in product((0.3, 0.65, 1.0), range(4)):
        way = radius * reach * np.exp(1j * (turn * np.pi / 4 + radius))
        step = round(way.imag) * stride + round(way.real)
        bump = solid - 0.5 * (padded[places + step] + padded[places - step])
        bump /= radius * _CREASE_RADIUS
        # Ignore large steps: they are outlines of parts in front, not hollows.
        total += bump.clip(0.0, 1.0) * (3.0 - bump / 2.0).clip(0.0, 1.0)
    hollow[is_solid] = np.clip(0.15 * total, 0.0, 1.0)
    return gaussian_filter(hollow, 0.15 * reach)
