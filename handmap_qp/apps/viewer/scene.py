"""A human hand and robot hands side by side in a viser scene: `HandScene.draw` shows one instant.

The scene's axes are those of the human's palm at the first sample: +y is distal and up, +z is
dorsal. Each robot's world is rotated by its mapping's alignment, so that equal motions look equal.
"""

import math
from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, Literal, NamedTuple

import msgspec
import numpy as np

from handmap_core.errors import expect
from handmap_core.se3 import Array, unit
from handmap_qp.hands import Hand, Values
from handmap_qp.mapping import rotation_of
from .figure import Figure, HumanFigure, LandmarkFigure, RobotFigure, Shape
from .sample import Variant, ViewSample
from .serving import ViserServer

# Between two figures [m].
_GAP = 0.035
_FLOOR = msgspec.yaml.decode(Path(__file__).with_suffix(".yaml").read_bytes())
# Samples for which room is reserved; a hand hardly moves between them.
_RESERVED = 60
_FIELD_OF_VIEW = math.radians(30.0)
# From the palm side, slightly from above.
_DIRECTION = unit(np.array([0.0, 0.25, -1.0]))
# From V to the scene's axes for a robot with several hands, seen from the front (REP 103).
_FRONT = rotation_of("y-up").T
# Window assumed before the client reports one: a written page on a portrait screen [px].
_DEFAULT_WINDOW = (600, 800)
# Room for the names below the figures, and for a margin on every side [px].
_NAMES = 64
_MARGIN = 14
# Where the area of the hands is narrower than this, the gauges' panel is folded away [px].
_NARROW = 480


class Display(NamedTuple):
    """What a scene shows.

    Attributes:
        follow: `hands` keeps each hand in place; `world` shows how it travels.
        shape: How T_def is shown.
        has_landmarks: Whether the landmarks stand beside the human hand.
        has_trails: Whether the fingertips leave trails.
    """

    follow: Literal["hands", "world"] = "hands"
    shape: Shape = "ellipsoid"
    has_landmarks: bool = False
    has_trails: bool = False


class HandScene:
    """A row of figures: landmarks, human hand, robot hands.

    Args:
        human: The human hand, or several as one (`joined`); None for robots alone.
        variants: The robots from left to right, at least one. The first sample of the first one
            gives the scene's axes.

    Attributes:
        robots: The figures of the robots.
        cameras: The browsers' cameras; call `cameras.update()` at every frame.
    """

    def __init__(
        self, server: ViserServer, human: Hand | None, variants: Sequence[Variant]
    ) -> None:
        self.server = server
        # Turn +y up, and draw the floor.
        server.scene.set_up_direction("+y")
        server.scene.world_axes.visible = False
        server.scene.add_grid("/floor", **_FLOOR)
        self.cameras = BrowserCameras(server)
        self._people: list[tuple[LandmarkFigure, HumanFigure]] = []
        hands = human.hands if human else ()
        # From the right hand on, as they are seen.
        for place, hand in enumerate(reversed(hands), 1):
            whose = f"_{hand.side}" if hands[1:] else ""
            landmarks = LandmarkFigure(server, f"landmarks{whose}")
            figure = HumanFigure(server, f"human{whose}", hand)
            landmarks.part = figure.part = -place
            self._people.append((landmarks, figure))
        self.robots: list[RobotFigure] = []
        self.set_variants(variants)

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show these robots, with room for all their samples.

        Both worlds are rotated so that the human's first palm is upright, or so that a robot with
        several hands is.

        Args:
            variants: The robots, all of the hand of the first.

        Raises:
            InvalidInputError: If their samples lack the human hand that is shown.
        """
        upright = None
        first = variants[0]
        people = first.samples[0].humans
        expect(people or not self._people, "variants", "samples with their humans")
        if self._people and (wrist := people[0].wrist) is not None:
            upright = (wrist @ self._people[0][1].hand.wrist_to_palm)[:3, :3].T
            if first.robot.parts:
                upright = _FRONT @ rotation_of(_alignment(first))
            for figure in chain(*self._people):
                figure.turn(upright)
        for i, variant in enumerate(variants):
            if i == len(self.robots):
                self.robots.append(RobotFigure(self.server, variant, i))
            robot = self.robots[i]
            robot.turn(_robot_axes(variant, upright))
            robot.label = variant.label
        self.clear_trails()
        for figure in self._figures:
            figure.is_shown = figure.variant < len(variants)
            if figure.is_shown:
                samples = variants[figure.variant].samples
                figure.fit(samples[:: max(len(samples) // _RESERVED, 1)])

    def clear_trails(self) -> None:
        """Forget where the fingertips have been."""
        for figure in self._figures:
            figure.trail.clear()

    def draw(self, samples: Sequence[ViewSample], display: Display = Display()) -> None:
        """Show one instant.

        Args:
            samples: One sample for each variant; the human hand is that of the first.
            display: What is drawn, and how.
        """
        is_pinned = display.follow == "hands"
        for landmarks, human in self._people:
            landmarks.is_shown = display.has_landmarks
            human.shape = display.shape
        row = [
            figure
            for figure in self._figures
            if figure.is_shown and np.isfinite(figure.room).all()
        ]
        with self.server.atomic():
            self._lay_out(row, is_pinned=is_pinned)
            for figure in row:
                sample = samples[figure.variant]
                seen = sample.parts[figure.part]
                figure.draw(seen)
                if not (place := figure.place_of(seen)):
                    continue
                centre, _ = place
                middle = figure.room[0].mean(axis=0)
                figure.place(figure.axes @ centre if is_pinned else middle)
                tips = figure.tips(seen) if display.has_trails else None
                if tips is not None:
                    figure.trail.add(sample.time, tips, centre, is_pinned=is_pinned)

    def make_room(self, sample: ViewSample) -> None:
        """Make room for one more instant of a single robot, not known beforehand."""
        for figure in self._figures:
            figure.include(sample)

    @property
    def _figures(self) -> list[Figure]:
        """All figures from left to right."""
        return [*chain(*self._people), *self.robots]

    def _lay_out(self, row: Sequence[Figure], *, is_pinned: bool) -> None:
        """Place the figures side by side above their names, and fit the cameras."""
        # Without the centres' travel if the hands stay in place.
        rooms = [figure.room[int(is_pinned) :] for figure in row]
        sizes = [np.ptp(room, axis=1).sum(axis=0) for room in rooms]
        widths, heights, depths = np.transpose(sizes)
        height = heights.max()
        ends = (widths + _GAP).cumsum() - _GAP
        width = ends[-1]
        # Seen from the palm side, +x points left.
        places = 0.5 * (width + widths) - ends
        for figure, x in zip(row, places, strict=True):
            figure.stand(x, -0.5 * height)
        self.cameras.fit(width, height, depths.max())


class BrowserCameras:
    """The cameras of all connected browsers: they keep the figures in view in every window."""

    def __init__(self, server: ViserServer) -> None:
        self._server = server
        # Width, height and depth of what must be in view [m].
        self._size = (0.0, 0.0, 0.0)
        self._views = {}
        self._folded = set[int]()
        server.initial_camera.fov = _FIELD_OF_VIEW

    def fit(self, width: float, height: float, depth: float) -> None:
        """Fit the view to a box of this size around the scene's origin [m]."""
        # Looking down, the box's depth adds to its height.
        size = width, height + depth * abs(_DIRECTION[1]), depth
        if size != self._size:
            self._size = size
            view = self._view(*_DEFAULT_WINDOW)
            _look(self._server.initial_camera, view, _DIRECTION)

    @property
    def view(self) -> Values:
        """What a page needs to fit the view to its window, as `_view` does."""
        return {
            "size": self._size,
            "names": _NAMES,
            "margin": _MARGIN,
            "fov": _FIELD_OF_VIEW,
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
            columns = camera.image_width
            rows = max(camera.image_height, 1)
            if columns < _NARROW and name not in self._folded:
                # The main panel holds the gauges; the controls have one of their own.
                client.gui.main_panel.minimize()
                self._folded.add(name)
            views[name] = view = self._view(columns, rows)
            if view != self._views.get(name):
                offset = camera.position - camera.look_at
                _look(camera, view, unit(offset) if name in self._views else _DIRECTION)
        self._views = views

    def _view(self, columns: int, rows: int) -> tuple[float, float]:
        """Return how far the camera has to be from where it looks, and the height of that [m]."""
        width, height, depth = self._size
        pixel = max(
            width / max(columns - 2 * _MARGIN, 50),
            height / max(rows - _NAMES - 2 * _MARGIN, 50),
        )
        distance = 0.5 * pixel * rows / math.tan(0.5 * _FIELD_OF_VIEW) + 0.25 * depth
        return distance, -0.5 * _NAMES * pixel


def _look(camera: Any, view: tuple[float, float], direction: Array) -> None:
    """Move a camera to see, in this direction from the hands, what `BrowserCameras` has found."""
    distance, low = view
    middle = (0.0, low, 0.0)
    # Setting the position moves `look_at` too, so set both.
    camera.position = middle + distance * direction
    camera.look_at = middle


def _robot_axes(variant: Variant, upright: Array | None) -> Array:
    """Return the rotation from V to the scene's axes, shape (3, 3).

    `upright` is that from W, (3, 3); without it, the robot's first palm is upright.
    """
    if variant.axes is not None:
        return variant.axes
    if variant.robot.parts:
        return _FRONT
    alignment = _alignment(variant)
    if upright is None or alignment == "palm":
        wrist = variant.samples[0].robot_wrist
        return (wrist @ variant.robot.wrist_to_palm)[:3, :3].T
    return upright @ rotation_of(alignment).T


def _alignment(variant: Variant) -> Any:
    method = variant.choice and variant.choice.method
    return getattr(method, "alignment", "world")
