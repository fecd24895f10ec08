"""Both hands side by side in a viser scene: `HandScene.draw` shows one sample.

The scene's axes are those of the human's palm at the first sample: +y is distal and up, +z is
dorsal. Each hand's world is a node of the scene, so its children take coordinates of that world.
The robot's world is rotated by the mapping's alignment, so that equal motions look equal.
"""

from __future__ import annotations

import io
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR, mesh_file
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.urdf.elements import parse_urdf
from handmap_qp.mapping.decomposition import polar
from handmap_qp.mapping.options import Alignment, Rotation
from handmap_qp.transform import inverse_pose, quat_wxyz_from_rotation, transform_points
from handmap_qp.viewer.camera import BrowserCameras
from handmap_qp.viewer.merged_shapes import merge_shapes
from handmap_qp.viewer.replay import ViewSample

if TYPE_CHECKING:
    import viser

Follow = Literal["hands", "world"]
DeformationShape = Literal["ellipsoid", "cube", "off"]

TARGET_COLOUR = (0.98, 0.66, 0.10)
DEFORMATION_COLOUR = (0.45, 0.30, 0.80)
# Radii relative to the hand's size, about those of fingertips. Targets are larger, so that a point
# that has arrived does not hide its target.
_HUMAN_POINT_SIZE, _ROBOT_POINT_SIZE, _TARGET_SIZE = 0.08, 0.1, 0.115
# Between the two hands [m].
_GAP = 0.05
# Height added to the view for names and caption below the hands, and the same above [m].
_CAPTION_ROOM = 0.15
# A travel box grows by this margin more than needed, so that it does not grow at every sample [m].
_MARGIN = 0.05
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i + 1, 8) if bin(i ^ j).count("1") == 1])


@dataclass
class _World:
    """One hand's world in the scene.

    Attributes:
        hand: The hand.
        model: Its shapes, a `ViserUrdf`.
        order: For each joint of the model, its index in `hand.joint_names`; None for a joint that
            is not one of the hand's.
        root: URDF root link.
        frame: Node of the world.
        body: Node of the root link.
        label: Node of the hand's name.
        axes: From the world's axes to the scene's, shape (3, 3).
        focus: The hand's centre in its wrist frame [m], shape (3,).
        radius: Distance of its farthest part from the centre [m].
        anchor: Position in the scene at which the view shows the centre, or the middle of its
            travel [m], shape (3,).
        travel: Box of the centre's positions that the view has room for, lowest and highest corner
            along the scene's axes [m], shape (2, 3).
    """

    hand: Hand
    model: Any
    order: list[int | None]
    root: str
    frame: Any
    body: Any
    label: Any
    axes: np.ndarray
    focus: np.ndarray
    radius: float
    anchor: np.ndarray = field(default_factory=lambda: np.zeros(3))
    travel: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    def centre(self, wrist: np.ndarray) -> np.ndarray:
        """Return the hand's centre for a wrist pose (4, 4), along the scene's axes [m], (3,)."""
        return self.axes @ transform_points(wrist, self.focus[None])[0]

    def include(self, centre: np.ndarray) -> None:
        """Extend `travel` to include a position (3,)."""
        if not len(self.travel):
            self.travel = np.array([centre, centre])
        elif (centre < self.travel[0]).any() or (centre > self.travel[1]).any():
            low, high = self.travel
            self.travel = np.array(
                [
                    np.where(centre < low, centre - _MARGIN, low),
                    np.where(centre > high, centre + _MARGIN, high),
                ]
            )


class _Spheres:
    """Spheres at points of a hand's world; their number follows the points, as methods do.

    A slow browser moves all nodes in the same frame, whereas a batch of points would lag.

    Args:
        server: A running viser server.
        world: The hand's world.
        name: Name of the parent node.
        size: Radius, relative to the hand's.
        colour: Red, green and blue, 0 to 1.
        opacity: 0 to 1; opaque if omitted.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        world: _World,
        name: str,
        size: float,
        colour: tuple[float, float, float],
        *,
        opacity: float | None = None,
    ) -> None:
        self._server, self._path = server, f"{world.frame.name}/{name}"
        self._radius, self._colour, self._opacity = size * world.radius, _bytes(colour), opacity
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
            node.visible = i < count
            if points is not None and i < count:
                node.position = points[i]


class HandScene:
    """A human hand and a robot hand, their points, targets and deformation.

    Args:
        server: A running viser server.
        human: The human hand.
        robot: The robot hand.
        first: First sample; its palm gives the scene's axes.
        alignment: Rotation from the human's world axes to the robot's, as of `MappingOptions`.

    Attributes:
        follow: `hands` keeps each hand in place; `world` shows how it travels.
        deformation_shape: How T_def is shown.
        cameras: The browsers' cameras; call `cameras.update()` at every frame.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        human: Hand,
        robot: Hand,
        first: ViewSample,
        alignment: Alignment | Rotation,
    ) -> None:
        self.server = server
        self.follow: Follow = "hands"
        self.deformation_shape: DeformationShape = "ellipsoid"
        self._first = first
        self._set_up_stage()
        self._human = self._add_hand("human", human, first.human_q)
        self._robot = self._add_hand("robot", robot, first.robot_q)
        self.cameras = BrowserCameras(server)
        self.align(alignment)
        self._human_points = _Spheres(
            server, self._human, "points", _HUMAN_POINT_SIZE, HUMAN_COLOUR
        )
        self._robot_points = _Spheres(
            server, self._robot, "points", _ROBOT_POINT_SIZE, ROBOT_COLOUR
        )
        self._targets = _Spheres(
            server, self._robot, "targets", _TARGET_SIZE, TARGET_COLOUR, opacity=0.5
        )
        spread = first.human_points - first.human_points.mean(axis=0)
        self._ball = float(np.sqrt((spread**2).sum(axis=1).mean()))
        self._ellipsoid = server.scene.add_icosphere(
            "/human/ellipsoid",
            self._ball,
            _bytes(DEFORMATION_COLOUR),
            subdivisions=4,
            opacity=0.2,
            cast_shadow=False,
        )
        self._reference_ball = server.scene.add_icosphere(
            "/human/ball",
            self._ball,
            (150, 150, 160),
            subdivisions=2,
            wireframe=True,
            opacity=0.15,
            cast_shadow=False,
        )
        self._cube = server.scene.add_line_segments(
            "/human/cube",
            np.zeros((len(_EDGES), 2, 3)),
            _bytes(DEFORMATION_COLOUR),
            thickness=2.5,
            thickness_units="screen",
        )
        self._caption = server.scene.add_label(
            "/caption", "", position=(0.0, 0.0, 0.0), anchor="top-center", font_screen_scale=1.1
        )
        self._laid_out: tuple[object, ...] = ()

    def align(self, alignment: Alignment | Rotation) -> None:
        """Rotate both worlds: the first human palm is upright, and equal motions look equal.

        Args:
            alignment: Rotation from the human's world axes to the robot's.
        """
        first = self._first
        human_palm = (first.human_wrist @ self._human.hand.wrist_to_palm)[:3, :3]
        robot_palm = (first.robot_wrist @ self._robot.hand.wrist_to_palm)[:3, :3]
        self._human.axes = human_palm.T
        if alignment == "world":
            self._robot.axes = human_palm.T
        elif alignment == "palm":
            self._robot.axes = robot_palm.T
        else:
            self._robot.axes = human_palm.T @ np.array(alignment).T
        for world in (self._human, self._robot):
            world.frame.wxyz = quat_wxyz_from_rotation(world.axes)
            world.travel = np.empty((0, 3))

    def reserve_travel(self, samples: Sequence[ViewSample]) -> None:
        """Make room in the view for the travel of both hands.

        Without this, the view has room for what was drawn since `align`.

        Args:
            samples: All samples that will be drawn.
        """
        for world, wrists in (
            (self._human, np.array([sample.human_wrist for sample in samples])),
            (self._robot, np.array([sample.robot_wrist for sample in samples])),
        ):
            centres = (wrists[:, :3, :3] @ world.focus + wrists[:, :3, 3]) @ world.axes.T
            world.travel = np.array([centres.min(axis=0), centres.max(axis=0)])

    def draw(self, sample: ViewSample) -> None:
        """Show one sample.

        Args:
            sample: The sample.
        """
        centres = self._human.centre(sample.human_wrist), self._robot.centre(sample.robot_wrist)
        if sample.human_q is None:
            centres = self._human.axes @ sample.human_points.mean(axis=0), centres[1]
        with self.server.atomic():
            self._lay_out(centres)
            self._place(self._human, sample.human_q, sample.human_wrist, centres[0])
            self._place(self._robot, sample.robot_q, sample.robot_wrist, centres[1])
            self._human_points.move(sample.human_points)
            self._robot_points.move(sample.robot_points)
            self._targets.move(sample.targets)
            self._draw_deformation(sample)
            self._caption.text = caption(sample)

    def _draw_deformation(self, sample: ViewSample) -> None:
        """Draw a ball or a cube about the pivot as T_def deforms it."""
        shape = self.deformation_shape if sample.deformation is not None else "off"
        self._reference_ball.visible = shape == "ellipsoid"
        self._ellipsoid.visible, self._cube.visible = shape == "ellipsoid", shape == "cube"
        if sample.deformation is None or sample.pivot is None:
            return
        if shape == "ellipsoid":
            # A rotation leaves the ball unchanged, so the rotation that T_def contains with
            # rigid_from="wrist" is not drawn.
            factors = polar(sample.deformation)
            scales = np.maximum(np.abs(factors.stretches), 1e-3)
            self._ellipsoid.scale = (float(scales[0]), float(scales[1]), float(scales[2]))
            self._reference_ball.position = sample.pivot
            axes = factors.axes * (1.0, 1.0, np.sign(np.linalg.det(factors.axes)))
            self._ellipsoid.wxyz = quat_wxyz_from_rotation(axes)
            self._ellipsoid.position = sample.pivot
        elif shape == "cube":
            corners = (self._ball / np.sqrt(3.0) * _CORNERS) @ sample.deformation.T
            self._cube.position = sample.pivot
            self._cube.points = corners[_EDGES].astype(np.float32)

    def _lay_out(self, centres: tuple[np.ndarray, np.ndarray]) -> None:
        """Place the hands side by side with room for their travel, and fit the cameras."""
        human, robot = self._human, self._robot
        for world, centre in zip((human, robot), centres, strict=True):
            world.include(centre)
        is_travelling = self.follow == "world"
        state = (
            (is_travelling, human.travel.tobytes(), robot.travel.tobytes())
            if is_travelling
            else (is_travelling,)
        )
        if state != self._laid_out:
            self._laid_out = state
            sizes = [
                2.0 * world.radius + is_travelling * np.ptp(world.travel, axis=0)
                for world in (human, robot)
            ]
            width, height = sizes[0][0] + _GAP + sizes[1][0], max(size[1] for size in sizes)
            # Seen from the palm side, +x points left.
            human.anchor = np.array([0.5 * (width - sizes[0][0]), 0.0, 0.0])
            robot.anchor = np.array([-0.5 * (width - sizes[1][0]), 0.0, 0.0])
            self._caption.position = (0.0, -0.5 * height - 0.055, 0.0)
            # A hand is widest at its centre, not at the front of its sphere.
            depth = max(sizes[0][2] - human.radius, sizes[1][2] - robot.radius)
            self.cameras.fit(width, height + _CAPTION_ROOM, depth)

    def _place(
        self, world: _World, q: np.ndarray | None, wrist: np.ndarray, centre: np.ndarray
    ) -> None:
        """Place a hand in its world and its world in the scene; hide a hand of unknown posture."""
        hand = world.hand
        world.body.visible = q is not None
        if q is not None:
            pose = hand.link_poses([world.root], q, wrist if hand.is_floating else None)[0]
            world.model.update_cfg(in_order(world.order, q))
            world.body.wxyz, world.body.position = (
                quat_wxyz_from_rotation(pose[:3, :3]),
                pose[:3, 3],
            )
        world.frame.position = world.anchor - (
            centre if self.follow == "hands" else world.travel.mean(axis=0)
        )
        low = max(self._human.radius, self._robot.radius) + 0.02
        world.label.position = world.frame.position + centre - (0.0, low, 0.0)

    def _add_hand(self, node: str, hand: Hand, q: np.ndarray | None) -> _World:
        from viser.extras import ViserUrdf

        scene = self.server.scene
        urdf = load_urdf(hand)
        q = hand.rest if q is None else q
        frame = scene.add_frame(f"/{node}", show_axes=False)
        body = scene.add_frame(f"/{node}/body", show_axes=False)
        model = ViserUrdf(self.server, urdf, root_node_name=f"/{node}/body")
        order = joint_places(hand, model.get_actuated_joint_names())
        label = scene.add_label(
            f"/{node}_name", hand.name, anchor="top-center", font_screen_scale=1.3
        )
        model.update_cfg(in_order(order, q))
        to_wrist = inverse_pose(hand.frame_pose("wrist", q))
        if hand.has_moving_wrist and not hand.is_floating:
            # On an arm: fit the view to the hand; parts of the arm may lie outside.
            points = transform_points(to_wrist, hand.points(q))
            focus, radius = 0.5 * points.mean(axis=0), float(np.linalg.norm(points, axis=1).max())
        else:
            low, high = urdf.scene.bounds
            in_wrist = to_wrist @ hand.link_poses([urdf.base_link], q)[0]
            focus, radius = (
                transform_points(in_wrist, 0.5 * (low + high)[None])[0],
                0.45 * float(np.linalg.norm(high - low)),
            )
        return _World(
            hand, model, order, urdf.base_link, frame, body, label, np.eye(3), focus, radius
        )

    def _set_up_stage(self) -> None:
        scene = self.server.scene
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
            position=(0.0, -0.22, 0.0),
        )


def joint_places(hand: Hand, names: Sequence[str]) -> list[int | None]:
    """Return each drawn joint's index in `hand.joint_names`; None if it is not the hand's."""
    places = {name: i for i, name in enumerate(hand.joint_names)}
    return [places.get(name) for name in names]


def in_order(order: list[int | None], q: np.ndarray) -> np.ndarray:
    """Return the joint angles of a drawn model; 0 for joints that are not the hand's."""
    return np.array([0.0 if i is None else q[i] for i in order])


def caption(sample: ViewSample) -> str:
    """Return the line below both hands: time, mean point error and status."""
    parts = [f"{sample.time:.2f} s"]
    if sample.targets is not None:
        parts.append(f"point error {1e3 * sample.point_error.mean():.1f} mm")
    is_named = sample.is_seen or ":" in sample.status
    parts.append(sample.status if is_named else "hand not seen, robot held")
    return " · ".join(parts)


def load_urdf(hand: Hand) -> Any:
    """Load the hand's URDF with its meshes for `ViserUrdf`."""
    from yourdfpy import URDF

    robot = parse_urdf(hand.urdf_text)
    # ViserUrdf names the nodes of links and of shapes alike, and a shape with a link's name would
    # replace the link: rename all shapes.
    for link in robot.iterfind("link"):
        for i, visual in enumerate(link.iterfind("visual")):
            visual.set("name", f"{link.get('name')}_shape_{i}")
    text = io.BytesIO(ET.tostring(robot))
    urdf = URDF.load(text, filename_handler=lambda fname: str(mesh_file(fname, hand.spec)))
    merge_shapes(urdf)
    return urdf


def _bytes(colour: tuple[float, float, float]) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue
