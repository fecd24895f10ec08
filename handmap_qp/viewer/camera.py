"""Where the browsers look from: `Camera` keeps both hands in every picture, whatever its shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import viser

_FIELD_OF_VIEW = np.radians(35.0)
# From the palm's side and a little from above.
_DIRECTION = np.array([0.0, 0.3, -1.0]) / np.linalg.norm([0.0, 0.3, -1.0])
# Width by height of a picture of which nothing is known: that of a page which plays by itself, on a
# screen that stands upright.
_CAUTIOUS_ASPECT = 0.75


class Camera:
    """The cameras of all browsers.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._size = np.ones(3)
        self._distances: dict[int, float] = {}
        server.initial_camera.look_at, server.initial_camera.fov = (
            np.zeros(3),
            float(_FIELD_OF_VIEW),
        )

    def fit(self, width: float, height: float, depth: float) -> None:
        """Look at a box about the scene's origin, of this size [m]."""
        self._size = np.array([width, height, depth])
        self._server.initial_camera.position = self._distance(_CAUTIOUS_ASPECT) * _DIRECTION

    def attend(self) -> None:
        """Move the cameras of browsers that are new, have another shape than before, or have something else to look at.

        Their size is that of the room between the panels, which they tell once these are in place.
        Where a user has turned the picture, it stays turned.
        """
        distances = {}
        for name, client in self._server.get_clients().items():
            camera = client.camera
            distances[name] = distance = self._distance(
                camera.image_width / max(camera.image_height, 1)
            )
            if distance != self._distances.get(name):
                sight = camera.position - camera.look_at
                is_new = name not in self._distances
                direction = _DIRECTION if is_new else sight / np.linalg.norm(sight)
                # A camera that is moved takes along what it looks at.
                camera.position, camera.look_at = distance * direction, np.zeros(3)
        self._distances = distances

    def _distance(self, aspect: float) -> float:
        """From where the box fills a picture of this width by height [m]."""
        width, height, depth = self._size
        return float(
            0.5 * max(width / max(aspect, 0.05), height) / np.tan(0.5 * _FIELD_OF_VIEW)
            + 0.5 * depth
        )
