"""`BrowserCameras`: keep both hands in view in every browser window, whatever its shape."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import viser

_FIELD_OF_VIEW = np.radians(35.0)
# From the palm side, slightly from above.
_DIRECTION = np.array([0.0, 0.3, -1.0]) / np.linalg.norm([0.0, 0.3, -1.0])
# Aspect ratio assumed before the client reports one: a written page on a portrait screen.
_DEFAULT_ASPECT = 0.75


class BrowserCameras:
    """The cameras of all connected browsers.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._size = np.ones(3)
        self._distances: dict[int, float] = {}
        server.initial_camera.look_at = np.zeros(3)
        server.initial_camera.fov = float(_FIELD_OF_VIEW)

    def fit(self, width: float, height: float, depth: float) -> None:
        """Fit the view to a box of this size around the scene's origin [m]."""
        self._size = np.array([width, height, depth])
        self._server.initial_camera.position = self._distance(_DEFAULT_ASPECT) * _DIRECTION

    def update(self) -> None:
        """Move a camera if its browser is new or if its window or the box has changed.

        Browsers report the size of the area between the panels once these are in place. A view
        that the user has rotated keeps its direction.
        """
        distances = {}
        for name, client in self._server.get_clients().items():
            camera = client.camera
            distances[name] = distance = self._distance(
                camera.image_width / max(camera.image_height, 1)
            )
            if distance != self._distances.get(name):
                offset = camera.position - camera.look_at
                is_new = name not in self._distances
                direction = _DIRECTION if is_new else offset / np.linalg.norm(offset)
                # Setting the position moves `look_at` too, so set both.
                camera.position, camera.look_at = distance * direction, np.zeros(3)
        self._distances = distances

    def _distance(self, aspect: float) -> float:
        """Return the distance at which the box fills a window of this aspect ratio [m]."""
        width, height, depth = self._size
        return float(
            0.5 * max(width / max(aspect, 0.05), height) / np.tan(0.5 * _FIELD_OF_VIEW)
            + 0.5 * depth
        )
