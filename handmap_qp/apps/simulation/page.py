"""A simulation as a page that plays in a browser without a server: `write_page`.

Hands and objects move in one world, with up upwards, as `handmap view --html` shows a mapping.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.apps.simulation.physics import surface, turn_up
from handmap_qp.apps.simulation.simulator import Episode
from handmap_qp.apps.viewer.figure import HandFigure
from handmap_qp.apps.viewer.scene import set_up_stage
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.output_files import replaced_file
from handmap_qp.se3 import quat_wxyz_from_rotation

if TYPE_CHECKING:
    import viser

# Samples per second in a page [1/s].
_RATE = 30.0
_FIELD_OF_VIEW = np.radians(35.0)
# From the front, slightly from above.
_DIRECTION = np.array([0.1, 0.3, 1.0]) / np.linalg.norm([0.1, 0.3, 1.0])
# Between hands that are shown side by side, and of what is seen around them [m].
_GAP, _MARGIN = 0.12, 0.08
# Rotation from +z up, as in pictures, to +y up, as in the view.
_TO_Y = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
_OBJECT_COLOUR = (237, 140, 38)


def write_page(
    path: Path,
    episodes: Mapping[str, Episode],
    up: np.ndarray,
    title: str,
    progress: Callable[[int], None] = lambda _: None,
) -> None:
    """Write one HTML file that plays simulations in real time.

    Args:
        path: The file.
        episodes: What happened, by the name to show; of one length in time.
        up: Direction against gravity, shape (3,).
        title: Title of the page.
        progress: Called after each instant with the number done.

    Raises:
        MissingExtraError: If viser is not installed.
        InvalidInputError: If the file cannot be written.
    """
    with serving() as server:
        set_up_stage(server, floor=-_MARGIN)
        turn, actors, edge = _TO_Y @ turn_up(up), [], 0.0
        for name, episode in episodes.items():
            actors.append(_Actor(server, name, episode, turn, edge))
            edge = actors[-1].corners[1, 0] + _GAP + _MARGIN
        _frame_camera(server, np.concatenate([actor.corners for actor in actors]))
        for actor in actors:
            actor.draw(0.0)
        serializer = server.get_scene_serializer()
        last = max(float(actor.time[-1]) for actor in actors)
        for count, instant in enumerate(
            np.arange(1.0 / _RATE, last, 1.0 / _RATE), start=1
        ):
            serializer.insert_sleep(1.0 / _RATE)
            for actor in actors:
                actor.draw(float(instant))
            progress(count)
        page = serializer.as_html()
    page = page.replace("<title>Viser</title>", f"<title>{escape(title)}</title>", 1)
    with replaced_file(path, "--html") as file:
        file.write(page.encode())


class _Actor:
    """One hand and its object in the page's scene.

    Args:
        server: A running viser server.
        name: Name to show.
        episode: What happened.
        turn: Rotation from the world to the scene, shape (3, 3).
        edge: Where its box begins, along the row [m].

    Attributes:
        corners: Lowest and highest corner of its box in the scene [m], shape (2, 3).
        time: Instants since the start [s], shape (T,).
    """

    def __init__(
        self,
        server: viser.ViserServer,
        name: str,
        episode: Episode,
        turn: np.ndarray,
        edge: float,
    ) -> None:
        self.episode, self.time = episode, episode.at.time - episode.at.time[0]
        node = name.replace(" ", "_")
        self._hand, self._name = HandFigure(server, node, episode.hand), name
        self._hand.turn(turn)
        box = travel(episode, turn)
        low, middle = box[0], box.mean(axis=0)
        # Hands stand in a row, on one floor.
        place = np.array([edge - low[0], -low[1], -middle[2]])
        self.corners = box + place
        self._hand.anchor, self._hand.extent = middle + place, box - middle
        self._hand.place(middle, low=float(self.corners[0, 1]) - 0.6 * _MARGIN)
        mesh = surface(episode.body.shape)
        self._object: Any = server.scene.add_mesh_simple(
            f"/{node}/object",
            np.asarray(mesh.vertices, dtype=np.float32),
            np.asarray(mesh.faces, dtype=np.uint32),
            color=_OBJECT_COLOUR,
            flat_shading=True,
        )

    def draw(self, instant: float) -> None:
        """Show the sample that is nearest to an instant since the start [s]."""
        at, i = self.episode.at, int(np.argmin(np.abs(self.time - instant)))
        self._hand.show(at.q[i], at.wrist[i])
        pose = at.object_pose[i]
        self._object.wxyz = quat_wxyz_from_rotation(pose[:3, :3])
        self._object.position = pose[:3, 3]
        self._hand.name(
            f"{self._name} · {self.time[i]:.2f} s · {at.normal_force[i]:.1f} N · "
            f"{int(at.links_touching[i])} links touch"
        )


def travel(episode: Episode, turn: np.ndarray) -> np.ndarray:
    """Return the box in which fingertips and wrist move, along turned axes.

    The object counts where it is at first: one that is lost falls far.

    Args:
        episode: What happened.
        turn: Rotation from the world to the box's axes, shape (3, 3).

    Returns:
        Lowest and highest corner [m], shape (2, 3).
    """
    hand, at = episode.hand, episode.at
    shown = np.linspace(0, len(at.time) - 1, 12).round().astype(int)
    points = [
        hand.points(at.q[i], at.wrist[i] if hand.is_floating else None) for i in shown
    ]
    every = (
        np.concatenate([*points, at.wrist[:, :3, 3], at.object_pose[:1, :3, 3]])
        @ turn.T
    )
    return np.array([every.min(axis=0), every.max(axis=0)])


def _frame_camera(server: viser.ViserServer, corners: np.ndarray) -> None:
    """Point the camera at everything that moves, whose corners are of shape (n, 3)."""
    low, high = corners.min(axis=0) - _MARGIN, corners.max(axis=0) + _MARGIN
    middle = 0.5 * (low + high)
    radius = 0.5 * max(high[0] - low[0], high[1] - low[1])
    distance = radius / np.tan(0.5 * _FIELD_OF_VIEW) + 0.5 * (high[2] - low[2])
    camera = server.initial_camera
    camera.look_at, camera.fov = middle, float(_FIELD_OF_VIEW)
    camera.up, camera.position = (
        np.array([0.0, 1.0, 0.0]),
        middle + distance * _DIRECTION,
    )
