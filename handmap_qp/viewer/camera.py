"""`BrowserCameras`: keep the figures in view in every browser window, whatever its shape."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    import viser

_FIELD_OF_VIEW = np.radians(30.0)
# From the palm side, slightly from above.
_DIRECTION = np.array([0.0, 0.25, -1.0]) / np.linalg.norm([0.0, 0.25, -1.0])
# Window assumed before the client reports one: a written page on a portrait screen [px].
_DEFAULT_WINDOW = (600, 800)
# Room for the names below the figures, and for a margin on every side [px].
_NAMES, _MARGIN = 64, 14
# Where the area of the hands is narrower than this, the gauges' panel is folded away [px].
_NARROW = 480


class BrowserCameras:
    """The cameras of all connected browsers.

    Args:
        server: A running viser server.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        self._server = server
        self._size = np.ones(3)
        self._views: dict[int, tuple[float, float]] = {}
        self._folded: set[int] = set()
        server.initial_camera.look_at = np.zeros(3)
        server.initial_camera.fov = float(_FIELD_OF_VIEW)

    def fit(self, width: float, height: float, depth: float) -> None:
        """Fit the view to a box of this size around the scene's origin [m]."""
        self._size = np.array([width, height, depth])
        distance, low = self._view(*_DEFAULT_WINDOW)
        self._server.initial_camera.look_at = np.array([0.0, low, 0.0])
        self._server.initial_camera.position = distance * _DIRECTION + (0.0, low, 0.0)

    @property
    def view(self) -> dict[str, Any]:
        """What a page needs to fit the view to its window, as `_view` does."""
        width, height, depth = map(float, self._size)
        return {
            "width": width,
            "height": height + depth * abs(float(_DIRECTION[1])),
            "depth": depth,
            "names": _NAMES,
            "margin": _MARGIN,
            "fov": float(_FIELD_OF_VIEW),
            "direction": _DIRECTION.tolist(),
        }

    def update(self) -> None:
        """Move a camera if its browser is new or if its window or the box has changed.

        Browsers report the size of the area between the panels once these are in place. A view
        that the user has rotated keeps its direction.
        """
        views = {}
        for name, client in self._server.get_clients().items():
            camera = client.camera
            window = camera.image_width, max(camera.image_height, 1)
            if window[0] < _NARROW and name not in self._folded:
                # The main panel holds the gauges; the controls have one of their own.
                client.gui.main_panel.minimize()
                self._folded.add(name)
            views[name] = distance, low = self._view(*window)
            if views[name] != self._views.get(name):
                offset = camera.position - camera.look_at
                is_new = name not in self._views
                direction = _DIRECTION if is_new else offset / np.linalg.norm(offset)
                middle = np.array([0.0, low, 0.0])
                # Setting the position moves `look_at` too, so set both.
                camera.position, camera.look_at = middle + distance * direction, middle
        self._views = views
        self._folded &= views.keys()

    def _view(self, columns: int, rows: int) -> tuple[float, float]:
        """Return where the camera has to be for the box to fill a window of this size [px].

        Returns:
            Distance from the point that it looks at [m], and the height of that point [m].
        """
        width, height, depth = self._size
        # Looking down, the box's depth adds to its height.
        height += depth * abs(float(_DIRECTION[1]))
        free = max(columns - 2 * _MARGIN, 50), max(rows - _NAMES - 2 * _MARGIN, 50)
        pixel = max(width / free[0], height / free[1])
        distance = 0.5 * pixel * rows / np.tan(0.5 * _FIELD_OF_VIEW) + 0.25 * depth
        return float(distance), float(-0.5 * _NAMES * pixel)
