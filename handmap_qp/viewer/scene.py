"""A human hand and robot hands side by side in a viser scene: `HandScene.draw` shows one instant.

The scene's axes are those of the human's palm at the first sample: +y is distal and up, +z is
dorsal. Each robot's world is rotated by its mapping's alignment, so that equal motions look equal.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.hands.fingers import finger_tips
from handmap_qp.hands.hand import Hand
from handmap_qp.human.landmarks import TIPS
from handmap_qp.se3 import quat_wxyz_from_rotation
from handmap_qp.viewer.camera import BrowserCameras
from handmap_qp.viewer.deformation import DeformedBall, Shape
from handmap_qp.viewer.figure import Figure, HandFigure, Spheres
from handmap_qp.viewer.landmark_figure import LandmarkFigure
from handmap_qp.viewer.sample import Variant, ViewSample
from handmap_qp.viewer.trails import Trail

if TYPE_CHECKING:
    import viser

Follow = Literal["hands", "world"]
_Outline = tuple[np.ndarray, np.ndarray]

TARGET_COLOUR = (0.98, 0.66, 0.10)
# Radii relative to the hand's size, about those of fingertips. Targets are larger, so that a point
# that has arrived does not hide its target.
_HUMAN_POINT_SIZE, _ROBOT_POINT_SIZE, _TARGET_SIZE = 0.08, 0.1, 0.115
# Between two figures [m].
_GAP = 0.035
# Samples for which room is reserved; a hand hardly moves between them.
_RESERVED = 60


class _HumanFigure(HandFigure):
    """The human hand, with its reference points and the deformation."""

    def __init__(self, server: viser.ViserServer, hand: Hand, first: ViewSample) -> None:
        super().__init__(server, "human", hand)
        self.name("human")
        self._points = Spheres(
            server, "/human/points", _HUMAN_POINT_SIZE * self.radius, HUMAN_COLOUR
        )
        points = first.human_points
        self._ball = None if points is None else DeformedBall(server, "/human", points)
        self._tips = _with_tips(hand)
        self._trail = Trail(server, "/human/trail", HUMAN_COLOUR)

    def centre_of(self, sample: ViewSample) -> np.ndarray:
        """Return the centre of the hand, or of its points, in W [m], shape (3,)."""
        if sample.human_wrist is not None and sample.human_q is not None:
            return self.centre(sample.human_wrist)
        points = sample.human_points
        return np.zeros(3) if points is None else points.mean(axis=0)

    def outline_of(self, sample: ViewSample) -> _Outline | None:
        """Return centre and corners in W; None if nothing of the hand is known."""
        points = sample.human_points
        if sample.human_q is not None and sample.human_wrist is not None:
            points = self.outline(sample.human_q, sample.human_wrist)
        return None if points is None else (self.centre_of(sample), points)

    def draw(self, sample: ViewSample, shape: Shape) -> None:
        """Draw the hand, its points and the deformation."""
        if sample.human_wrist is not None:
            self.show(sample.human_q, sample.human_wrist)
        self._points.move(sample.human_points)
        if self._ball is not None:
            self._ball.draw(sample, shape)

    def draw_trail(self, sample: ViewSample, *, is_pinned: bool) -> None:
        """Add the tips to the trail."""
        if sample.landmarks is not None:
            tips = sample.landmarks[TIPS]
        elif sample.human_q is not None:
            tips = self._tips.points(sample.human_q, sample.human_wrist)
        else:
            return
        if np.isfinite(tips).all():
            self._trail.add(sample.time, tips, self.centre_of(sample), is_pinned=is_pinned)

    def clear_trail(self) -> None:
        """Forget the trail."""
        self._trail.clear()


class _RobotFigure(HandFigure):
    """A robot hand, with its reference points and their targets."""

    def __init__(self, server: viser.ViserServer, node: str, hand: Hand) -> None:
        super().__init__(server, node, hand)
        size, path = self.radius, f"/{node}"
        self._points = Spheres(server, f"{path}/points", _ROBOT_POINT_SIZE * size, ROBOT_COLOUR)
        self._targets = Spheres(
            server, f"{path}/targets", _TARGET_SIZE * size, TARGET_COLOUR, opacity=0.5
        )
        self._tips = _with_tips(hand)
        self._trail = Trail(server, f"{path}/trail", ROBOT_COLOUR)

    def outline_of(self, sample: ViewSample) -> _Outline:
        """Return centre and corners in V."""
        corners = self.outline(sample.robot_q, sample.robot_wrist)
        return self.centre(sample.robot_wrist), corners

    def draw(self, sample: ViewSample, label: str) -> None:
        """Draw the hand, its points and targets, and write its name and state."""
        self.show(sample.robot_q, sample.robot_wrist)
        self._points.move(sample.robot_points)
        self._targets.move(sample.targets)
        self.name("\n".join(filter(None, (self.hand.name, label, state_text(sample)))))

    def draw_trail(self, sample: ViewSample, *, is_pinned: bool) -> None:
        """Add the tips to the trail."""
        wrist = sample.robot_wrist if self._tips.is_floating else None
        tips = self._tips.points(sample.robot_q, wrist)
        centre = self.centre(sample.robot_wrist)
        self._trail.add(sample.time, tips, centre, is_pinned=is_pinned)

    def clear_trail(self) -> None:
        """Forget the trail."""
        self._trail.clear()


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """An object in the world of the first robot.

    Attributes:
        vertices: Vertices in the object's frame [m], shape (n, 3).
        faces: Indices of the vertices of each triangle, shape (m, 3).
    """

    vertices: np.ndarray
    faces: np.ndarray


class HandScene:
    """A row of figures: landmarks, human hand, robot hands.

    Args:
        server: A running viser server.
        human: The human hand; None for robots alone.
        variants: The robots from left to right, at least one. The first sample of the first one
            gives the scene's axes.
        solid: An object beside the first robot, placed by `ViewSample.object_pose`.

    Attributes:
        follow: `hands` keeps each hand in place; `world` shows how it travels.
        deformation_shape: How T_def is shown.
        has_landmarks: Whether the landmarks stand beside the human hand.
        has_trails: Whether the fingertips leave trails.
        cameras: The browsers' cameras; call `cameras.update()` at every frame.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        human: Hand | None,
        variants: Sequence[Variant],
        solid: Solid | None = None,
    ) -> None:
        self.server = server
        self.follow: Follow = "hands"
        self.deformation_shape: Shape = "ellipsoid"
        self.has_landmarks = self.has_trails = False
        first = variants[0].samples[0]
        set_up_stage(server, floor=-0.22)
        self.cameras = BrowserCameras(server)
        self._human = None if human is None else _HumanFigure(server, human, first)
        self._landmarks: LandmarkFigure | None = None
        self._robots: list[_RobotFigure] = []
        self._solid = None if solid is None else _add_solid(server, solid)
        self._laid_out: tuple[object, ...] = ()
        self.set_variants(variants)

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show these robots, with room for all their samples.

        Both worlds are rotated so that the human's first palm is upright.

        Args:
            variants: The robots, all of the hand of the first.
        """
        self._variants = tuple(variants)
        for i in range(len(self._robots), len(variants)):
            node = "robot" if i == 0 else f"robot_{i + 1}"
            self._robots.append(_RobotFigure(self.server, node, variants[i].robot))
        for i, robot in enumerate(self._robots):
            robot.is_shown = i < len(variants)
        first = variants[0].samples[0]
        upright = None
        if self._human is not None and first.human_wrist is not None:
            upright = (first.human_wrist @ self._human.hand.wrist_to_palm)[:3, :3].T
            self._human.turn(upright)
            if self._landmarks is not None:
                self._landmarks.turn(upright)
        for robot, variant in zip(self._robots, variants, strict=False):
            robot.turn(_robot_axes(robot.hand, variant, upright))
        self.clear_trails()
        self._laid_out = ()
        self._fit()

    def clear_trails(self) -> None:
        """Forget where the fingertips have been."""
        for hand in self._hands:
            hand.clear_trail()

    def draw(self, samples: Sequence[ViewSample]) -> None:
        """Show one instant.

        Args:
            samples: One sample for each variant; the human hand is that of the first.
        """
        with self.server.atomic():
            self._show_landmarks(samples[0])
            placed = list(self._centres(samples))
            for figure, centre in placed:
                figure.include_centre(centre)
            low = self._lay_out()
            for figure, centre in placed:
                figure.place(self._middle(figure, centre), low)
            if self._human is not None:
                self._human.draw(samples[0], self.deformation_shape)
            for robot, variant, sample in zip(self._robots, self._variants, samples, strict=False):
                robot.draw(sample, variant.label)
            if self.has_trails:
                self._draw_trails(samples)
            if self._solid is not None and samples[0].object_pose is not None:
                pose = samples[0].object_pose
                self._solid.wxyz = quat_wxyz_from_rotation(pose[:3, :3])
                self._solid.position = pose[:3, 3]

    def make_room(self, samples: Sequence[ViewSample]) -> None:
        """Make room for one more instant, of samples that are not known beforehand."""
        for figure, variant, outline in self._outlines:
            seen = outline(samples[variant])
            if seen is not None and len(figure.extent):
                figure.include(*seen)

    @property
    def _hands(self) -> list[_HumanFigure | _RobotFigure]:
        """The human hand and the robots that are shown."""
        human = [] if self._human is None else [self._human]
        return [*human, *self._robots[: len(self._variants)]]

    @property
    def _row(self) -> list[Figure]:
        """The figures from left to right."""
        landmarks = self._landmarks
        first: list[Figure] = [] if landmarks is None or not landmarks.is_shown else [landmarks]
        return [figure for figure in (*first, *self._hands) if len(figure.extent)]

    def _show_landmarks(self, sample: ViewSample) -> None:
        """Show or hide the landmarks, whose nodes are made when they are first shown."""
        if self._landmarks is None:
            if not self.has_landmarks or self._human is None or sample.landmarks is None:
                return
            self._landmarks = LandmarkFigure(self.server, "landmarks")
            self._landmarks.turn(self._human.axes)
            self._fit()
        if self._landmarks.is_shown != self.has_landmarks:
            self._landmarks.is_shown = self.has_landmarks
        if self.has_landmarks:
            self._landmarks.show(sample.landmarks)

    def _centres(self, samples: Sequence[ViewSample]) -> Iterator[tuple[Figure, np.ndarray]]:
        """Yield the figures and their centres in their worlds [m], shape (3,)."""
        seen = _landmark_outline(samples[0])
        if self._landmarks is not None and seen is not None:
            yield self._landmarks, seen[0]
        if self._human is not None:
            yield self._human, self._human.centre_of(samples[0])
        for robot, sample in zip(self._robots, samples, strict=False):
            yield robot, robot.centre(sample.robot_wrist)

    def _draw_trails(self, samples: Sequence[ViewSample]) -> None:
        is_pinned = self.follow == "hands"
        if self._human is not None:
            self._human.draw_trail(samples[0], is_pinned=is_pinned)
        for robot, sample in zip(self._robots, samples, strict=False):
            robot.draw_trail(sample, is_pinned=is_pinned)

    def _middle(self, figure: Figure, centre: np.ndarray) -> np.ndarray:
        """Return what is to be at a figure's anchor, along the scene's axes [m], shape (3,)."""
        return figure.axes @ centre if self.follow == "hands" else figure.travel.mean(axis=0)

    @property
    def _outlines(self) -> Iterator[tuple[Figure, int, Callable[[ViewSample], _Outline | None]]]:
        """Figures, whose variant's samples they show, and what they show of one."""
        if self._landmarks is not None:
            yield self._landmarks, 0, _landmark_outline
        if self._human is not None:
            yield self._human, 0, self._human.outline_of
        for i, robot in enumerate(self._robots[: len(self._variants)]):
            yield robot, i, robot.outline_of

    def _fit(self) -> None:
        """Make room for all samples of the variants."""
        for figure, variant, outline in self._outlines:
            samples = self._variants[variant].samples
            few = samples[:: max(len(samples) // _RESERVED, 1)]
            seen = [instant for sample in few if (instant := outline(sample)) is not None]
            if seen:
                figure.fit(seen)

    def _lay_out(self) -> float:
        """Place the figures side by side, fit the cameras, and return the height of the names."""
        row, is_travelling = self._row, self.follow == "world"
        state = (
            is_travelling,
            *(
                (id(figure), figure.extent.tobytes(), is_travelling and figure.travel.tobytes())
                for figure in row
            ),
        )
        sizes = [figure.size + is_travelling * np.ptp(figure.travel, axis=0) for figure in row]
        width, height, depth = np.max(sizes, axis=0)
        width = sum(size[0] for size in sizes) + _GAP * (len(row) - 1)
        if state != self._laid_out:
            self._laid_out = state
            # Seen from the palm side, +x points left.
            left = 0.5 * width
            for figure, size in zip(row, sizes, strict=True):
                cell = np.array([left - 0.5 * size[0], 0.0, 0.0])
                figure.anchor = cell - figure.extent.mean(axis=0)
                left -= size[0] + _GAP
            self.cameras.fit(width, height, depth)
        return -0.5 * float(height)


def _with_tips(hand: Hand) -> Hand:
    """Return a hand whose points are its fingertips, or its own where no finger has a name."""
    return hand.with_points(list(finger_tips(hand).values()) or None)


def _landmark_outline(sample: ViewSample) -> _Outline | None:
    """Return centre and places of the landmarks in W; None if they are not known."""
    points = sample.landmarks
    if points is None or not np.isfinite(points).all():
        return None
    return points.mean(axis=0), points


def _robot_axes(robot: Hand, variant: Variant, upright: np.ndarray | None) -> np.ndarray:
    """Return the rotation from V to the scene's axes, shape (3, 3).

    Args:
        robot: The robot hand.
        variant: What moves it.
        upright: The rotation from W to the scene's axes, shape (3, 3); None without a human hand,
            and the robot's first palm is upright then.
    """
    alignment = variant.choice.method.values.get("alignment", "world")
    if upright is None or (isinstance(alignment, str) and alignment == "palm"):
        return (variant.samples[0].robot_wrist @ robot.wrist_to_palm)[:3, :3].T
    if isinstance(alignment, str):
        return upright
    return upright @ np.array(alignment).T


def state_text(sample: ViewSample) -> str:
    """Return why the robot does not follow the human at a sample; empty if it does."""
    if sample.is_seen:
        return sample.status if sample.status in ("released", "gliding") else ""
    return sample.status if ":" in sample.status else "hand not seen, robot held"


def _add_solid(server: viser.ViserServer, solid: Solid) -> Any:
    return server.scene.add_mesh_simple(
        "/robot/object", solid.vertices, solid.faces, color=(226, 178, 76)
    )


def set_up_stage(server: viser.ViserServer, floor: float) -> None:
    """Turn +y up, and draw the floor.

    Args:
        server: The server of the page.
        floor: Height of the floor [m].
    """
    scene = server.scene
    scene.set_up_direction("+y")
    scene.world_axes.visible = False
    scene.add_grid(
        "/floor",
        plane="xz",
        infinite_grid=True,
        cell_size=0.05,
        section_size=0.25,
        cell_color=(225, 228, 232),
        section_color=(205, 210, 216),
        cell_thickness=0.6,
        section_thickness=0.8,
        fade_distance=3.0,
        position=(0.0, floor, 0.0),
    )
