"""What stands in the scene's row: `Figure`, and a hand as one, `HandFigure`.

Each figure's world is a node of the scene, so its children take coordinates of that world.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import inverse_pose, quat_wxyz_from_rotation, transform_points
from handmap_qp.viewer.hand_model import HandModel, LinkTree

if TYPE_CHECKING:
    import viser

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""
# A box grows by this margin more than needed, so that it does not grow at every sample [m].
_MARGIN = 0.03
# Spheres at the points stand out from the links by about this [m].
_PADDING = 0.006
# Percentage of the instants in which a hand may reach out of its room.
_RARE = 4.0
_BOX_CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])


class Figure:
    """Something in the row, with a name below it.

    Args:
        server: A running viser server.
        node: Name of its node.

    Attributes:
        frame: Node of the figure's world.
        axes: From the world's axes to the scene's, shape (3, 3).
        anchor: Position in the scene of the centre, or of the middle of its travel [m], shape (3,).
        extent: Box of all drawn parts about the centre, along the scene's axes: lowest and highest
            corner [m], shape (2, 3).
        travel: Box of the centre's positions that the view has room for, likewise.
    """

    def __init__(self, server: viser.ViserServer, node: str) -> None:
        self.frame = server.scene.add_frame(f"/{node}", show_axes=False)
        self._label = server.scene.add_label(
            f"/{node}_name", "", anchor="top-center", font_screen_scale=1.0
        )
        self.axes = np.eye(3)
        self.anchor = np.zeros(3)
        self.forget()

    @property
    def is_shown(self) -> bool:
        """Whether it stands in the row."""
        return self.frame.visible

    @is_shown.setter
    def is_shown(self, is_shown: bool) -> None:
        self.frame.visible = self._label.visible = is_shown

    @property
    def size(self) -> np.ndarray:
        """Size of `extent` [m], shape (3,)."""
        return np.ptp(self.extent, axis=0)

    def forget(self) -> None:
        """Forget which room the figure needs."""
        self.extent, self.travel = np.empty((0, 3)), np.empty((0, 3))

    def turn(self, axes: np.ndarray) -> None:
        """Turn the figure's world to other axes (3, 3)."""
        self.axes = axes
        self.frame.wxyz = quat_wxyz_from_rotation(axes)
        self.forget()

    def fit(self, seen: Sequence[tuple[np.ndarray, np.ndarray]]) -> None:
        """Make room for instants that are known beforehand, save for rare excursions.

        Args:
            seen: Centre (3,) and corners of what is drawn (n, 3) at each instant, in the figure's
                world [m]; not empty.
        """
        centres = np.array([centre for centre, _ in seen]) @ self.axes.T
        self.travel = np.array([centres.min(axis=0), centres.max(axis=0)])
        boxes = np.array([self._box(*instant) for instant in seen])
        low, high = np.percentile(boxes, (_RARE, 100.0 - _RARE), axis=0)
        self.extent = np.array([low[0], high[1]])

    def include(self, centre: np.ndarray, points: np.ndarray) -> None:
        """Make room for one more instant, as of `fit`."""
        self.include_centre(centre)
        self.extent = _extended(self.extent, self._box(centre, points))

    def include_centre(self, centre: np.ndarray) -> None:
        """Make room for one more position of the centre, in the figure's world [m], shape (3,)."""
        self.travel = _extended(self.travel, np.tile(self.axes @ centre, (2, 1)))

    def _box(self, centre: np.ndarray, points: np.ndarray) -> np.ndarray:
        """Return the box of points about a centre, along the scene's axes, shape (2, 3)."""
        about = (points - centre) @ self.axes.T
        return np.array([about.min(axis=0), about.max(axis=0)])

    def place(self, middle: np.ndarray, low: float) -> None:
        """Move the figure's world so that a point of it is at the anchor.

        Args:
            middle: The point, along the scene's axes [m], shape (3,).
            low: Height of the name [m].
        """
        self.frame.position = self.anchor - middle
        x, _, z = self.anchor + self.extent.mean(axis=0)
        self._label.position = (x, low, z)

    def name(self, text: str) -> None:
        """Write the name below the figure."""
        if self._label.text != text:
            self._label.text = text


class Spheres:
    """Spheres at points of a figure's world; their number follows the points, as methods do.

    A slow browser moves all nodes in the same frame, whereas a batch of points would lag.

    Args:
        server: A running viser server.
        path: Name of the parent node.
        radius: Radius [m].
        colour: Their colour.
        opacity: 0 to 1; opaque if omitted.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        path: str,
        radius: float,
        colour: Colour,
        *,
        opacity: float | None = None,
    ) -> None:
        self._server, self._path = server, path
        self._radius, self._colour, self._opacity = radius, as_bytes(colour), opacity
        self._nodes: list[Any] = []

    def move(self, points: np.ndarray | None) -> None:
        """Place the spheres at points (n, 3), and hide those that have none."""
        count = 0 if points is None else len(points)
        for i in range(len(self._nodes), count):
            self._nodes.append(
                self._server.scene.add_icosphere(
                    f"{self._path}/{i}",
                    self._radius,
                    self._colour,
                    opacity=self._opacity,
                    cast_shadow=False,
                    receive_shadow=False,
                )
            )
        for i, node in enumerate(self._nodes):
            if node.visible != (i < count):
                node.visible = i < count
            if points is not None and i < count:
                node.position = points[i]


class HandFigure(Figure):
    """A hand with its shapes.

    Args:
        server: A running viser server.
        node: Name of its node.
        hand: The hand.

    Attributes:
        hand: The hand.
        radius: About half its size [m], for the sizes of spheres.
    """

    def __init__(self, server: viser.ViserServer, node: str, hand: Hand) -> None:
        super().__init__(server, node)
        self.hand = hand
        self._body = server.scene.add_frame(f"/{node}/body", show_axes=False)
        self._model = HandModel(server, f"/{node}/body", hand)
        is_on_arm = hand.has_moving_wrist and not hand.is_floating
        # On an arm: fit the view to the hand; parts of the arm may lie outside.
        self._corners = {} if is_on_arm else _link_corners(self._model.tree)
        to_wrist = inverse_pose(hand.frame_pose("wrist", hand.rest))
        if is_on_arm:
            points = transform_points(to_wrist, hand.points(hand.rest))
            self._focus = 0.5 * points.mean(axis=0)
            self.radius = float(np.linalg.norm(points, axis=1).max())
        else:
            wrist = np.linalg.inv(to_wrist)
            corners = transform_points(to_wrist, self.outline(hand.rest, wrist))
            low, high = corners.min(axis=0), corners.max(axis=0)
            self._focus = 0.5 * (low + high)
            self.radius = 0.4 * float(np.linalg.norm(high - low))

    def centre(self, wrist: np.ndarray) -> np.ndarray:
        """Return the hand's centre for a wrist pose (4, 4), in its world [m], shape (3,)."""
        return transform_points(wrist, self._focus[None])[0]

    def outline(self, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
        """Return the corners of the boxes around its links, in its world [m], shape (n, 3).

        Args:
            q: Joint angles [rad], shape (n_joints,).
            wrist: Wrist pose, shape (4, 4).
        """
        hand, pose = self.hand, wrist if self.hand.is_floating else None
        if not self._corners:
            points = np.vstack([hand.points(q, pose), wrist[None, :3, 3]])
            return np.vstack([points - 2.0 * _PADDING, points + 2.0 * _PADDING])
        poses = hand.link_poses(list(self._corners), q, pose)
        corners = zip(poses, self._corners.values(), strict=True)
        return np.vstack([transform_points(link, points) for link, points in corners])

    def show(self, q: np.ndarray | None, wrist: np.ndarray) -> None:
        """Show a posture; hide a hand of unknown posture.

        Args:
            q: Joint angles [rad], shape (n_joints,).
            wrist: Wrist pose, shape (4, 4).
        """
        if self._body.visible != (q is not None):
            self._body.visible = q is not None
        if q is not None:
            floating = wrist if self.hand.is_floating else None
            pose = self.hand.link_poses([self._model.tree.root], q, floating)[0]
            self._body.wxyz = quat_wxyz_from_rotation(pose[:3, :3])
            self._body.position = pose[:3, 3]
            self._model.show(q, floating)


def as_bytes(colour: Colour) -> tuple[int, int, int]:
    """Return a colour as three numbers up to 255."""
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


def _link_corners(tree: LinkTree) -> dict[str, np.ndarray]:
    """Return the corners of the boxes around each link's shapes, in the link's frame, (n, 3)."""
    corners = {}
    for link, shapes in tree.shapes.items():
        boxes = []
        for pose, mesh in shapes:
            low, high = mesh.bounds[0] - _PADDING, mesh.bounds[1] + _PADDING
            boxes.append(transform_points(pose, low + _BOX_CORNERS * (high - low)))
        corners[link] = np.vstack(boxes)
    return corners


def _extended(box: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return a box (2, 3) that holds another one too, with a margin where it has to grow."""
    if not len(box):
        return other
    low = np.where(other[0] < box[0], other[0] - _MARGIN, box[0])
    return np.array([low, np.where(other[1] > box[1], other[1] + _MARGIN, box[1])])
