"""Pictures of a simulation by the software renderer: `film`, `picture`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.drawing.hands import HandShape, load_shape
from handmap_qp.drawing.raster import Camera, Triangles, merged, render
from handmap_qp.errors import MissingExtraError
from handmap_qp.grasp.objects import Shape
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import affine, transform_points
from handmap_qp.simulation.episode import Episode
from handmap_qp.simulation.physics import MeshShape
from handmap_qp.simulation.shapes import surface, turn_up

_OBJECT_COLOUR = (0.93, 0.55, 0.15)
_PAPER = np.array([0.965, 0.97, 0.975])
_SIZE = (480, 360)


class Stage:
    """What the camera sees: a hand and its object, turned so that gravity points down.

    Args:
        episode: The simulation.
        up: Direction against gravity, shape (3,).
    """

    def __init__(self, episode: Episode, up: np.ndarray) -> None:
        self.episode = episode
        self._shape = load_shape(episode.hand)
        self._object = _object_triangles(episode.body.shape)
        self._turn = affine(turn_up(up), np.zeros(3))

    def triangles(self, i: int) -> Triangles:
        """Return everything at one instant."""
        episode = self.episode
        hand = _hand_triangles(self._shape, episode, i)
        held = _moved(self._object, episode.object_pose[i])
        return _moved(merged([hand, held]), self._turn)

    def camera(self, size: tuple[int, int] = _SIZE, **view: float) -> Camera:
        """Return a camera that sees the hand's whole motion, and the object at first.

        An object that is lost falls far, and must not make the hand small.
        """
        shown = range(0, len(self.episode.time), max(1, len(self.episode.time) // 8))
        hands = [_moved(_hand_triangles(self._shape, self.episode, i), self._turn) for i in shown]
        seen = merged([self.triangles(0), *hands])
        points = seen.vertices.reshape(-1, 3)[::7]
        return Camera.framing(points, size, **view)

    def frame(self, i: int, camera: Camera, *, supersampling: int = 2) -> np.ndarray:
        """Render one instant.

        Returns:
            Red, green and blue in 0..255, shape (height, width, 3).
        """
        image = render(self.triangles(i), camera, supersampling=supersampling)
        colour, alpha = image[..., :3], image[..., 3:]
        return np.round(255.0 * (alpha * colour + (1.0 - alpha) * _PAPER)).astype(np.uint8)


def film(
    stage: Stage,
    path: Path,
    *,
    rate: float = 15.0,
    progress: Callable[[int], None] | None = None,
) -> None:
    """Write a simulation as a moving picture, in real time.

    Args:
        stage: What the camera sees.
        path: The file: `.gif`, `.webp` or `.png` (an animated PNG).
        rate: Pictures of each second.
        progress: Called after each picture with the number done.

    Raises:
        MissingExtraError: If Pillow is not installed.
        InvalidInputError: If the file cannot be written.
    """
    pillow = _pillow()
    time = stage.episode.time
    instants = np.arange(time[0], time[-1], 1.0 / rate)
    camera = stage.camera()
    pictures = []
    for instant in instants:
        i = int(np.argmin(np.abs(time - instant)))
        pictures.append(pillow.fromarray(stage.frame(i, camera, supersampling=1)))
        if progress is not None:
            progress(len(pictures))
    with replaced_file(path, "--film") as file:
        kind = path.suffix.removeprefix(".").upper()
        pictures[0].save(
            file,
            format=kind,
            save_all=True,
            append_images=pictures[1:],
            duration=1e3 / rate,
            loop=0,
        )


def picture(stage: Stage, path: Path, *, count: int = 4) -> None:
    """Write instants of a simulation side by side.

    Args:
        stage: What the camera sees.
        path: The file, PNG.
        count: Number of instants, evenly spread.

    Raises:
        MissingExtraError: If Pillow is not installed.
        InvalidInputError: If the file cannot be written.
    """
    pillow = _pillow()
    camera = stage.camera()
    chosen = np.linspace(0, len(stage.episode.time) - 1, count).round().astype(int)
    strip = np.concatenate([stage.frame(int(i), camera) for i in chosen], axis=1)
    with replaced_file(path, "--picture") as file:
        pillow.fromarray(strip).save(file, format="PNG", optimize=True)


def _pillow() -> Any:
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingExtraError("pillow", "plot") from error
    return Image


def _hand_triangles(shape: HandShape, episode: Episode, i: int) -> Triangles:
    wrist = episode.wrist[i] if episode.hand.is_floating else None
    return shape.triangles(episode.q[i], wrist)


def _object_triangles(shape: Shape | MeshShape) -> Triangles:
    """Return the surface of an object in its own frame."""
    mesh = surface(shape)
    corners = np.asarray(mesh.vertices)[mesh.faces]
    normals = np.repeat(np.asarray(mesh.face_normals)[:, None], 3, axis=1)
    return Triangles(corners, np.tile(_OBJECT_COLOUR, (len(corners), 1)), normals)


def _moved(triangles: Triangles, motion: np.ndarray) -> Triangles:
    return Triangles(
        transform_points(motion, triangles.vertices),
        triangles.colours,
        triangles.normals @ motion[:3, :3].T,
    )
