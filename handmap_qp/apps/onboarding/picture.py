"""Pictures to check a description: a hand with its labels, and its matched posture."""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.apps.drawing import (
    AXIS_COLOURS,
    GREY,
    UPRIGHT,
    Camera,
    Triangles,
    draw_hands,
    load_shape,
    merged,
    require_matplotlib,
    save_panels,
    save_picture,
    spheres,
    tube,
)
from handmap_qp.apps.drawing.contact_sheet import (
    FINGER_COLOURS,
    SheetRow,
    contact_sheet,
)
from handmap_qp.hands import Hand, PalmKinematics, place_of
from handmap_qp.mapping import resting_posture
from handmap_qp.se3 import inverse_pose, lengths, transform_points, unit
from .match import Match

_PANEL = (760, 820)
# From the end of an axis to the middle of its label, to the side and up [pixel].
_AXIS_GAP = np.array([38.0, -14.0])
_OTHER_COLOUR = (0.25, 0.25, 0.28)
_AXES = ("x, across", "y, distal", "z, dorsal")
# Caption of both views of a hand, and how far the camera turns from its back to the thumb [deg].
_VIEWS = {"back of the hand": 0.0, "palm, from the thumb's side": 125.0}
_ELEVATION = 12.0
_ROBOT_VIEWS = {"from +x": 20.0, "from +y": 80.0}
# Length of the axes of a robot's palms [m].
_ROBOT_AXES = 0.12
# Distal (y) points up, dorsal (z) towards +y: a camera at +y sees the back of the hand.
_BOX = {
    "facecolor": "white",
    "alpha": 0.75,
    "edgecolor": "none",
    "boxstyle": "round,pad=0.15",
}


def picture_path(given: str, kind: str = "hand") -> Path | None:
    """Return the path of a description's picture, beside it; None for one that is given by name.

    Args:
        given: Name, file or folder.
        kind: `hand` or `robot`.
    """
    path = Path(given)
    if path.suffix in (".yaml", ".yml"):
        return path.with_suffix(".png")
    return path / f"{kind}.png" if (path / f"{kind}.yaml").is_file() else None


def draw_hand(hand: Hand, path: Path, *directions: Any) -> None:
    """Draw a hand at rest from the back and from the side, fingers up, with all its points.

    Args:
        hand: The hand.
        path: Picture to write; its suffix sets the format.
        *directions: Where an arm takes the hand: rows of the table of `check_directions`.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib is not installed.
    """
    require_matplotlib()
    points = [point.name for point in hand.spec.points]
    scene = _Scene(hand.with_points(points), *directions)
    turn = 1.0 if hand.side == "right" else -1.0
    panels = {
        caption: partial(scene.draw, azimuth=90.0 + turn * angle)
        for caption, angle in _VIEWS.items()
    }
    title = f"{hand.name}: a {hand.side} hand, {len(hand.joint_names)} joints; at rest"
    save_panels(path, title, _PANEL, panels)


def draw_robot(robot: Hand, path: Path) -> None:
    """Draw a robot at rest with the axes of its palms, from two sides, as `draw_hand` does.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib is not installed.
    """
    hands = robot.hands
    triangles = load_shape(hands[0]).triangles(hands[0].rest)
    poses = [hand.frame_pose("palm", hand.rest) for hand in hands]
    marks = merged(
        [
            tube([pose[:3, 3], end], 0.03 * _ROBOT_AXES, colour)
            for pose in poses
            for end, colour in zip(
                transform_points(pose, _ROBOT_AXES * np.eye(3)),
                AXIS_COLOURS,
                strict=True,
            )
        ]
    )
    corners = np.vstack([triangles.vertices, marks.vertices]).reshape(-1, 3)

    def draw(axes: Any, azimuth: float) -> None:
        camera = Camera.framing(corners, _PANEL, azimuth=azimuth, elevation=_ELEVATION)
        draw_hands(axes, triangles, camera, marks=marks)

    panels = {name: partial(draw, azimuth=a) for name, a in _ROBOT_VIEWS.items()}
    title = f"{robot.name} at rest; palms: red across, green distal, blue dorsal"
    save_panels(path, title, _PANEL, panels)


def draw_match(match: Match, path: Path) -> None:
    """Draw the resting human beside the robot at rest and matched, in palm frames, as PNG.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    human = match.human
    robot = match.robot
    q = resting_posture(human)
    to_palm = inverse_pose(human.frame_pose("palm", q))
    landmarks = transform_points(to_palm, human.points(q))
    rows = [SheetRow("human at rest", "", landmarks, (robot.rest, match.q))]
    columns = [(f"{robot.name}, rest", robot), (f"{robot.name}, matched", robot)]
    figure = contact_sheet(columns, rows, side=robot.side)
    save_picture(figure, path)


class _Scene:
    """A hand at rest, with its palm's distal axis up and its back towards +y."""

    def __init__(self, hand: Hand, *directions: Any) -> None:
        self.hand = hand
        pose = UPRIGHT @ inverse_pose(hand.frame_pose("palm", hand.rest))
        self.points = transform_points(pose, hand.points(hand.rest))
        self.size = lengths(self.points).max()
        shape = load_shape(hand).without_arm()
        self.triangles = (
            shape.triangles(hand.rest).moved(pose)
            if shape.links
            else self._sticks().moved(UPRIGHT)
        )
        axes = 0.28 * self.size * UPRIGHT[:3, :3].T
        self.arrows = [*zip(axes, _AXES, AXIS_COLOURS, strict=True)]
        for row in directions:
            # It ends beyond the palm's axes and their labels.
            tip = 0.5 * self.size * unit(pose[:3, :3] @ row["robot moved, mm"])
            self.arrows.append((tip, row["direction"], _OTHER_COLOUR))
        self.colours = [
            FINGER_COLOURS.get(point.finger or "", _OTHER_COLOUR)
            for point in hand.reference_points
        ]
        marks = [
            spheres(point, 0.022 * self.size, colour)
            for point, colour in zip(self.points, self.colours, strict=True)
        ]
        for tip, _, colour in self.arrows:
            axis = tube([np.zeros(3), tip], 0.008 * self.size, colour)
            marks += [axis, spheres(tip, 0.016 * self.size, colour)]
        self.marks = merged(marks)

    def draw(self, axes: Any, azimuth: float) -> None:
        """Draw one view into a matplotlib axes."""
        corners = self.triangles.vertices.reshape(-1, 3)
        # The margin leaves room for labels on both sides.
        camera = Camera.framing(
            np.vstack([corners, self.points, *(tip for tip, *_ in self.arrows)]),
            _PANEL,
            azimuth=azimuth,
            elevation=_ELEVATION,
            margin=0.13,
        )
        draw_hands(axes, self.triangles, camera, marks=self.marks)
        origin = camera.project(np.zeros(3))[:2]
        write = partial(axes.annotate, va="center", fontsize=10, bbox=_BOX)
        for tip, name, colour in self.arrows:
            # Write beyond the end of the axis, so that the end stays visible.
            way = camera.project(tip)[:2] - origin
            write(
                name,
                xy=origin + way,
                xytext=_AXIS_GAP * unit(way),
                textcoords="offset pixels",
                ha="center",
                color=colour,
            )
        # The points' names are at the panel's edges, each with a line to its point.
        places = camera.project(self.points)[:, :2]
        across = places[:, 0]
        order = np.argsort(places[:, 1])
        is_right = across > 0.5 * (across.min() + across.max())
        for side, edge in ((is_right, _PANEL[0] - 8), (~is_right, 8)):
            chosen = order[side[order]]
            # At least this far apart [pixel], and inside the panel if they fit.
            steps = 24.0 * np.arange(len(chosen))
            heights = np.maximum.accumulate(places[chosen, 1] - steps) + steps
            excess = max(0.0, heights.max(initial=0.0) - _PANEL[1] + 20.0)
            for i, height in zip(chosen, heights - excess, strict=True):
                colour = self.colours[i]
                write(
                    self.hand.reference_points[i].name,
                    xy=places[i],
                    xytext=(edge, height),
                    ha="right" if edge > 8 else "left",
                    color=colour,
                    arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.8},
                )

    def _sticks(self) -> Triangles:
        """Return sticks between joints and to points, for a hand without shapes, in palm axes."""
        hand = self.hand
        model = hand.model
        _, *beyond = model.subtrees[hand.wrist_frame.parentJoint]
        origin = np.zeros(3)
        places = []
        for joint in beyond:
            places += [(model.parents[joint], origin), (joint, origin)]
        for point in hand.reference_points:
            joint, offset = place_of(hand, point)
            places += [(joint, origin), (joint, offset)]
        ends = PalmKinematics(hand).points(hand.rest, places).reshape(-1, 2, 3)
        return merged([tube(pair, 0.015 * self.size, GREY) for pair in ends])
