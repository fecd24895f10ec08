"""What stands in the scene's row: landmarks, the human hand, and robot hands.

Each figure's world is a node of the scene, so its children take coordinates of that world. viser
sends what has changed only.
"""

from collections.abc import Iterable
from functools import partial
from itertools import product
from typing import Any, Literal

import numpy as np

from handmap_core.se3 import (
    Array,
    Arrays,
    box_of,
    inverse_pose,
    mirror_sign,
    quat_wxyz_from_rotation,
    transform_points,
)
from handmap_qp.apps.drawing import (
    HUMAN_COLOUR,
    ROBOT_COLOUR,
    Colour,
    LinkShape,
    read_shapes,
)
from handmap_qp.hands import Hand, Names, Values, finger_tips, joined
from handmap_qp.human import TIPS
from handmap_qp.trackers import BONES, NEIGHBOURS
from .sample import HumanView, Variant, ViewSample
from .serving import ViserServer

Posture = tuple[Array, Array | None]
"""Joint angles [rad], shape (n,), and wrist pose, shape (4, 4); None for a fixed hand."""
Shape = Literal["ellipsoid", "cube", "off"]
"""How T_def is shown."""
TARGET_COLOUR = (0.98, 0.66, 0.10)
LANDMARK_COLOUR = (0.10, 0.52, 0.50)
DEFORMATION_COLOUR = (0.45, 0.30, 0.80)
OBJECT_COLOUR = (226, 178, 76)
_LINES = np.array(BONES + NEIGHBOURS)
"""Pairs of landmarks that a line joins, shape (n, 2)."""
TRAIL_LENGTH = 4.0
"""A trail shows this time [s]."""
_LANDMARK_RADIUS = 0.0045
# A box grows by this margin more than needed, so that it does not grow at every sample [m].
_MARGIN = 0.03
# Spheres at the points stand out from the links by about this [m].
_PADDING = 0.006
# A hand may reach out of its room in the instants beyond these percentiles, on each side.
_USUAL = (4.0, 96.0)
_OUTWARDS = np.array([[-1.0], [1.0]])
"""Senses in which the lowest and the highest corner of a box grow."""
_UNIT_BOX = np.array([*product((0, 1), repeat=3)])
_EDGES = np.array([(i, i | j) for i in range(8) for j in (1, 2, 4) if not i & j])
"""Corners of `_UNIT_BOX` at both ends of each edge."""


class Spheres:
    """Spheres at points of a figure's world; their number follows the points, as methods do.

    A slow browser moves all nodes in the same frame, whereas a batch of points would lag.

    Args:
        path: Name of the parent node.
        radius: Radius [m].
        colour: Their colour.
        opacity: 0 to 1; opaque if omitted.
    """

    def __init__(
        self,
        server: ViserServer,
        path: str,
        radius: float,
        colour: Colour,
        opacity: float | None = None,
    ) -> None:
        self._nodes: list[Any] = []
        self._add = lambda: server.scene.add_icosphere(
            f"{path}/{len(self._nodes)}",
            radius,
            colour,
            opacity=opacity,
            cast_shadow=False,
            receive_shadow=False,
        )

    def move(self, points: Array | None) -> None:
        """Place the spheres at points (n, 3), and hide those that have none."""
        places = () if points is None else points
        while len(self._nodes) < len(places):
            self._nodes.append(self._add())
        for i, node in enumerate(self._nodes):
            node.visible = i < len(places)
            if node.visible:
                node.position = places[i]


class Figure:
    """Something in the row, with a name below it and a trail of its fingertips.

    Args:
        node: Name of its node.

    Attributes:
        variant: Index of the variant whose samples it shows.
        part: Index of what it shows of a sample, in `ViewSample.parts`; `seen` below.
        axes: From the world's axes to the scene's, shape (3, 3).
        anchor: Position in the scene of the centre, or of the middle of its travel [m], shape (3,).
        room: What the view has room for, along the scene's axes: the box of the centre's positions,
            and that of all drawn parts about the centre. Each is its lowest and its highest corner
            [m], so the shape is (2, 2, 3). NaN until something is known.
    """

    variant = part = 0
    shows: str
    """The field with its points."""
    colour: Colour
    """Colour of its points and its trail."""
    _points: Spheres

    def __init__(self, server: ViserServer, node: str) -> None:
        self._frame = server.scene.add_frame(f"/{node}", show_axes=False)
        self._label = server.scene.add_label(
            f"/{node}_name", node.replace("_", " "), anchor="top-center"
        )
        self.trail = Trail(server, f"/{node}/trail", self.colour)
        self.anchor = np.zeros(3)
        self.turn(np.eye(3))

    @property
    def is_shown(self) -> bool:
        """Whether it stands in the row."""
        return self._frame.visible

    @is_shown.setter
    def is_shown(self, is_shown: bool) -> None:
        self._frame.visible = self._label.visible = is_shown

    def points(self, seen: Any) -> Array | None:
        """Return its points in the figure's world [m], shape (n, 3); None if they are not known."""
        return known(getattr(seen, self.shows))

    def draw(self, seen: Any) -> None:
        """Draw one instant; points that are not known are hidden."""
        self._points.move(self.points(seen))

    def place_of(self, seen: Any) -> tuple[Array, Array] | None:
        """Return its centre, (3,), and corners, (n, 3), in the figure's world [m], if known."""
        points = self.points(seen)
        return None if points is None else (points.mean(axis=0), points)

    def tips(self, seen: Any) -> Array | None:
        """Return the fingertips in the figure's world [m], shape (n, 3); None for no trail."""
        return None

    def turn(self, axes: Array) -> None:
        """Turn the figure's world to other axes (3, 3), and forget which room it needs."""
        self.axes = axes
        self._frame.wxyz = quat_wxyz_from_rotation(axes)
        self.room = np.full((2, 2, 3), np.nan)

    def fit(self, samples: Iterable[ViewSample]) -> None:
        """Make room for instants that are known beforehand, save for rare excursions."""
        found = [room for each in samples if (room := self._room(each)) is not None]
        if found:
            rooms = np.array(found)
            self.room[0] = box_of(rooms[:, 0, 0])
            # The low percentile of the lowest corners, and the high one of the highest.
            ranges = np.percentile(rooms[:, 1], _USUAL, axis=0)
            self.room[1] = ranges[(0, 1), (0, 1)]

    def include(self, sample: ViewSample) -> None:
        """Make room for one more instant, with a margin where the room has to grow."""
        if (room := self._room(sample)) is not None:
            is_within = _OUTWARDS * (room - self.room) <= 0.0
            self.room = np.where(is_within, self.room, room + _OUTWARDS * _MARGIN)

    def _room(self, sample: ViewSample) -> Array | None:
        """Return the room of one instant, as `room`; None if nothing is known."""
        if not (place := self.place_of(sample.parts[self.part])):
            return None
        centre, corners = place
        middle = self.axes @ centre
        about = (corners - centre) @ self.axes.T
        return np.array([[middle, middle], box_of(about)])

    def stand(self, x: float, low: float) -> None:
        """Centre the figure's room at a place of the row, above its name.

        Args:
            x: The place [m].
            low: Height of the name [m].
        """
        self.anchor = (x, 0.0, 0.0) - self.room[1].mean(axis=0)
        self._label.position = (x, low, 0.0)

    def place(self, middle: Array) -> None:
        """Move the figure's world so that a point of it is at the anchor.

        Args:
            middle: The point, along the scene's axes [m], shape (3,).
        """
        self._frame.position = self.anchor - middle


class Trail:
    """The tips of one hand over the last seconds, in the coordinates of a figure's world."""

    def __init__(self, server: ViserServer, path: str, colour: Colour) -> None:
        # Times [s], tips (n, 3) and the hand's centre (3,) [m], oldest first.
        self._points = []
        self._lines = _add_lines(server, path, colour, 2.0)
        self.clear()

    def clear(self) -> None:
        """Forget the trail."""
        self._points.clear()
        self._lines.visible = False

    def add(self, time: float, tips: Array, centre: Array, *, is_pinned: bool) -> None:
        """Add where the tips are, and draw the trail, without what is later or too long ago.

        Args:
            time: Time of the sample [s].
            tips: Tips [m], shape (n, 3).
            centre: Centre of the hand [m], shape (3,).
            is_pinned: Whether the view keeps the centre in place: the trail then shows the tips'
                motion relative to it.
        """
        self._points = [
            point for point in self._points if 0.0 <= time - point[0] <= TRAIL_LENGTH
        ]
        self._points.append((time, tips, centre))
        places = np.array(
            [tips - is_pinned * (then - centre) for _, tips, then in self._points]
        )
        self._lines.visible = len(places) > 1
        if self._lines.visible:
            steps = np.stack([places[:-1], places[1:]], axis=2)
            self._lines.points = steps.reshape(-1, 2, 3)


class LandmarkFigure(Figure):
    """The landmarks as the tracker gave them, with bones between; hidden at first."""

    shows = "landmarks"
    colour = LANDMARK_COLOUR

    def __init__(self, server: ViserServer, node: str) -> None:
        super().__init__(server, node)
        self.is_shown = False
        self._points = Spheres(server, f"/{node}/points", _LANDMARK_RADIUS, self.colour)
        self._bones = _add_lines(server, f"/{node}/bones", self.colour, 3.0)

    def draw(self, seen: HumanView) -> None:
        """Show the landmarks with their bones."""
        super().draw(seen)
        points = self.points(seen)
        self._bones.visible = points is not None
        if points is not None:
            self._bones.points = points[_LINES]


class HandFigure(Figure):
    """A hand with its shapes.

    Args:
        node: Name of its node.
        hand: The hand.
        drawn: Links that are drawn, and that the view is fitted to; all if omitted, or if none of
            these has a shape.

    Attributes:
        hand: The hand.
        radius: About half its size [m], for the sizes of spheres.
        links: Nodes of the links with shapes, by name.
    """

    point_size = 0.1
    """Radius of the reference points, relative to the hand's size: about that of fingertips."""
    shows = "robot_points"
    colour = ROBOT_COLOUR

    def __init__(
        self,
        server: ViserServer,
        node: str,
        hand: Hand,
        drawn: Names | None = None,
    ) -> None:
        super().__init__(server, node)
        self.hand = hand
        # Its fingertips, or its own points where no finger has a name.
        tips = (h.with_points([*finger_tips(h).values()] or None) for h in hand.hands)
        self._tips = joined(hand.name, *tips)
        self._body = server.scene.add_frame(f"/{node}/body", show_axes=False)
        self.links: Values = {}
        self._corners: Arrays = {}
        every = link_meshes(hand)
        # Points and axes of a hand without any shape are drawn all the same.
        kept = (
            every.keys() if drawn is None else every.keys() & {*drawn} or every.keys()
        )
        for link, meshes in every.items():
            if link not in kept:
                continue
            path = f"/{node}/body/{link}"
            self.links[link] = server.scene.add_frame(path, show_axes=False)
            for i, mesh in enumerate(meshes):
                server.scene.add_mesh_trimesh(f"{path}/{i}", mesh)
            if drawn is not None or self._is_in_view(link):
                box = box_of(np.vstack([mesh.bounds for mesh in meshes]))
                padded = box + _OUTWARDS * _PADDING
                self._corners[link] = padded[_UNIT_BOX, range(3)]
        to_base = inverse_pose(self._base(hand.rest))
        corners = transform_points(to_base, self._boxes(hand.rest))
        box = box_of(corners)
        self._focus = box.mean(axis=0)
        if hand.parts:
            box = hand.hands[0].points(hand.rest)
        self.radius = 0.4 * float(np.linalg.norm(np.ptp(box, axis=0)))
        self._points = Spheres(
            server, f"/{node}/points", self.point_size * self.radius, self.colour
        )

    def posture(self, seen: Any) -> Posture | None:
        """Return the posture, if it is known; points may be known without it."""
        return seen.robot_q, seen.robot_wrist if self.hand.is_floating else None

    def place_of(self, seen: Any) -> tuple[Array, Array] | None:
        """Return the hand's centre and corners of its links' boxes, or those of its points."""
        if not (at := self.posture(seen)):
            return super().place_of(seen)
        return transform_points(self._base(*at), self._focus), self._boxes(*at)

    def tips(self, seen: Any) -> Array | None:
        """Return the tips of the posture."""
        at = self.posture(seen)
        return at and self._tips.points(*at)

    def draw(self, seen: Any) -> None:
        """Draw the hand and its points; hide a hand of unknown posture."""
        super().draw(seen)
        at = self.posture(seen)
        self._body.visible = at is not None
        if at and self.links:
            # Links are placed relative to the first one: those that do not move in the hand are
            # sent once.
            poses = self.hand.link_poses(list(self.links), *at)
            place_node(self._body, poses[0])
            placed = inverse_pose(poses[0]) @ poses
            for node, pose in zip(self.links.values(), placed, strict=True):
                place_node(node, pose)

    def _is_in_view(self, link: str) -> bool:
        """Return whether the view is fitted to a link: no arm, nor what a robot does not move."""
        if self.hand.parts:
            return self.hand.frames[link].parentJoint > 0
        return self.hand.is_floating or not self.hand.has_moving_wrist

    def _base(self, q: Array, wrist: Array | None = None) -> Array:
        """Return the pose of the hand's wrist, or of a robot's world, shape (4, 4)."""
        hand = self.hand
        return np.eye(4) if hand.parts else hand.frame_pose("wrist", q, wrist)

    def _boxes(self, q: Array, wrist: Array | None = None) -> Array:
        """Return corners of the links' boxes, or about points and wrist, [m], shape (n, 3)."""
        if not self._corners:
            base = self._base(q, wrist)
            points = np.vstack([self.hand.points(q, wrist), base[:3, 3]])
            padded = points + 2.0 * _PADDING * _OUTWARDS[:, None]
            return padded.reshape(-1, 3)
        poses = self.hand.link_poses(list(self._corners), q, wrist)
        return np.vstack(list(map(transform_points, poses, self._corners.values())))


class HumanFigure(HandFigure):
    """The human hand, and what T_def makes of a ball of the size of its points.

    Args:
        node: Its name.
        hand: The human hand.

    Attributes:
        shape: How T_def is shown.
    """

    point_size = 0.08
    shows = "points"
    colour = HUMAN_COLOUR

    def __init__(self, server: ViserServer, node: str, hand: Hand) -> None:
        super().__init__(server, node, hand)
        self.shape: Shape = "ellipsoid"
        self._size = hand.extent
        ball: Any = partial(
            server.scene.add_icosphere, radius=self._size, cast_shadow=False
        )
        self._ellipsoid = ball(
            f"/{node}/ellipsoid",
            color=DEFORMATION_COLOUR,
            subdivisions=4,
            opacity=0.2,
        )
        self._ball = ball(
            f"/{node}/ball",
            color=(150, 150, 160),
            subdivisions=2,
            wireframe=True,
            opacity=0.15,
        )
        self._cube = _add_lines(server, f"/{node}/cube", DEFORMATION_COLOUR, 2.5)

    def posture(self, seen: HumanView) -> Posture | None:
        """Return the posture, if it is known."""
        return None if seen.q is None else (seen.q, seen.wrist)

    def tips(self, seen: HumanView) -> Array | None:
        """Return the tracked tips, or else those of the posture."""
        if seen.landmarks is not None:
            return known(seen.landmarks[TIPS])
        return super().tips(seen)

    def draw(self, seen: HumanView) -> None:
        """Draw the hand, its points and the deformation."""
        super().draw(seen)
        motion = seen.motion_deformation
        pivot = seen.pivot
        shape = "off" if motion is None else self.shape
        self._ball.visible = self._ellipsoid.visible = shape == "ellipsoid"
        self._cube.visible = shape == "cube"
        if motion is None or pivot is None:
            return
        linear = motion[:3, :3]
        self._ball.position = self._ellipsoid.position = self._cube.position = pivot
        if shape == "ellipsoid":
            # A rotation leaves the ball unchanged, so the rotation that T_def contains with
            # rigid_from="wrist" is not drawn.
            axes, stretches, _ = np.linalg.svd(linear)
            self._ellipsoid.scale = tuple(np.maximum(stretches, 1e-3).tolist())
            axes[:, 2] *= mirror_sign(axes)
            self._ellipsoid.wxyz = quat_wxyz_from_rotation(axes)
        elif shape == "cube":
            corners = (self._size / np.sqrt(3.0) * (2.0 * _UNIT_BOX - 1.0)) @ linear.T
            self._cube.points = corners[_EDGES]


class RobotFigure(HandFigure):
    """A robot hand, with the targets of its reference points.

    Args:
        variant: The robot, and the object beside it.
        index: Index of the variant whose samples it shows.

    Attributes:
        label: Name of what moves it.
    """

    def __init__(self, server: ViserServer, variant: Variant, index: int) -> None:
        node = f"robot_{index + 1}" if index else "robot"
        super().__init__(server, node, variant.robot, variant.drawn)
        self.variant = index
        self.label = ""
        solid = variant.solid
        self._solid: Any = solid and server.scene.add_mesh_simple(
            f"/{node}/object",
            solid.vertices,
            solid.faces,
            color=OBJECT_COLOUR,
            flat_shading=True,
        )
        # Larger than the points, so that one that has arrived does not hide its target.
        radius = 1.15 * self.point_size * self.radius
        self._targets = Spheres(server, f"/{node}/targets", radius, TARGET_COLOUR, 0.5)

    def draw(self, seen: ViewSample) -> None:
        """Draw the hand, its points, targets and object, and write its name and state."""
        super().draw(seen)
        self._targets.move(seen.targets)
        if self._solid and seen.object_pose is not None:
            place_node(self._solid, seen.object_pose)
        lines = self.hand.name, self.label, state_text(seen)
        self._label.text = "\n".join(filter(None, lines))


def state_text(sample: ViewSample) -> str:
    """Return a sample's note, or why the robot does not follow; empty if it does."""
    if sample.note:
        return sample.note
    if sample.is_seen:
        if sample.status in ("released", "gliding"):
            return sample.status
        return f"held by {' and '.join(sample.held_by)}" if sample.held_by else ""
    missed = f"{sample.status}: {sample.rule}"
    return missed if sample.rule else "hand not seen, robot held"


def link_meshes(hand: Hand) -> dict[str, list[Any]]:
    """Read the visual shapes of each link with any, in the link's frame.

    Shapes of a link are merged into one mesh, so that a page has few objects to receive and to
    draw; only those with textures stay apart.

    Args:
        hand: The hand.

    Returns:
        Meshes of trimesh by the link's name.
    """
    shapes = read_shapes(hand, "visual")
    return {link: _merged(parts) for link, parts in shapes.items()}


def _merged(shapes: list[LinkShape]) -> list[Any]:
    """Return one mesh of those without textures, each face in its colour, and the others."""
    from trimesh.util import concatenate

    plain, textured = [], []
    for meshes, colour in shapes:
        for mesh in meshes:
            if mesh.visual.kind == "texture":
                textured.append(mesh)
                continue
            mesh.visual.face_colors = colour or mesh.visual.face_colors
            plain.append(mesh)
    return [concatenate(plain), *textured] if plain else textured


def _add_lines(server: ViserServer, path: str, colour: Colour, thickness: float) -> Any:
    """Add line segments [px], whose points are set later."""
    return server.scene.add_line_segments(
        path,
        np.zeros((1, 2, 3)),
        colour,
        thickness=thickness,
        thickness_units="screen",
    )


def place_node(node: Any, pose: Array) -> None:
    """Move a node of the scene to a pose (4, 4)."""
    node.wxyz = quat_wxyz_from_rotation(pose[:3, :3])
    node.position = pose[:3, 3]


def known(points: Array | None) -> Array | None:
    """Return points if all of them are known."""
    return points if points is not None and np.isfinite(points).all() else None
