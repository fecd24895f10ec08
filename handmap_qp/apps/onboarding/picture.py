"""Pictures to check a description: a hand with its labels, and its matched posture."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.apps.drawing import (
    AXIS_COLOURS,
    UPRIGHT,
    Camera,
    Colour,
    Triangles,
    draw_hands,
    load_shape,
    merged,
    require_matplotlib,
    save_panels,
    save_picture,
    spheres,
)
from handmap_qp.apps.drawing.contact_sheet import (
    FINGER_COLOURS,
    SheetRow,
    contact_sheet,
)
from handmap_qp.hands import Hand
from handmap_qp.mapping import resting_posture
from handmap_qp.se3 import Array, inverse_pose, lengths, transform_points, unit
from .match import Match

_PANEL = (760, 820)
# Radius of a marked point, in lengths of the hand.
_MARK = 0.022
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


def picture_path(given: str, kind: str) -> Path | None:
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
    scene = hand_scene(hand.with_points(points), *directions)
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
    arrows = []
    for hand in hands:
        pose = hand.frame_pose("palm", hand.rest)
        ends = transform_points(pose, _ROBOT_AXES * np.eye(3))
        starts = 3 * [pose[:3, 3]]
        arrows += zip(starts, ends, ("", "", ""), AXIS_COLOURS, strict=True)
    scene = _Scene(load_shape(hands[0]).triangles(hands[0].rest), arrows)
    panels = {name: partial(scene.draw, azimuth=a) for name, a in _ROBOT_VIEWS.items()}
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


class _Scene(NamedTuple):
    """What a picture shows.

    Attributes:
        triangles: Solid parts.
        arrows: Start and end [m], label and colour of each arrow.
        points: Points [m], shape (m, 3).
        labels: The name and the colour of each point.
    """

    triangles: Triangles
    arrows: list[tuple[Array, Array, str, Colour]]
    points: Array = np.zeros((0, 3))
    labels: Sequence[tuple[str, Colour]] = ()

    def draw(self, axes: Any, azimuth: float) -> None:
        """Draw one view into a matplotlib axes."""
        corners = self.triangles.vertices.reshape(-1, 3)
        ends = [end for _, end, *_ in self.arrows]
        # The margin leaves room for labels on both sides.
        camera = Camera.framing(
            np.vstack([corners, self.points, ends]),
            _PANEL,
            azimuth=azimuth,
            elevation=_ELEVATION,
            margin=0.13 if self.labels else 0.04,
        )
        marks = [
            spheres(point, _MARK * lengths(self.points).max(), colour)
            for point, (_, colour) in zip(self.points, self.labels, strict=True)
        ]
        draw_hands(axes, self.triangles, camera, marks=merged(marks))
        write = partial(axes.annotate, va="center", fontsize=10, bbox=_BOX)
        # The first ones, the palm's axes, lie over the others.
        for start, end, label, colour in reversed(self.arrows):
            tail, head = camera.project(np.array([start, end]))[:, :2]
            write(
                label,
                xy=tail,
                xytext=head,
                ha="center",
                color=colour,
                arrowprops={"arrowstyle": "<-", "color": colour, "linewidth": 2.5},
            )
        # The points' names are at the panel's edges, each with a line to its point.
        places = camera.project(self.points)[:, :2]
        order = np.argsort(places[:, 1])
        is_right = places[:, 0] > 0.5 * _PANEL[0]
        for side, edge in ((is_right, _PANEL[0] - 8), (~is_right, 8)):
            chosen = order[side[order]]
            # At least this far apart [pixel], and inside the panel if they fit.
            steps = 24.0 * np.arange(len(chosen))
            heights = np.maximum.accumulate(places[chosen, 1] - steps) + steps
            excess = max(0.0, heights.max(initial=0.0) - _PANEL[1] + 20.0)
            for i, height in zip(chosen, heights - excess, strict=True):
                name, colour = self.labels[i]
                write(
                    name,
                    xy=places[i],
                    xytext=(edge, height),
                    ha="right" if edge > 8 else "left",
                    color=colour,
                    arrowprops={"arrowstyle": "-", "color": colour, "linewidth": 0.8},
                )


def hand_scene(hand: Hand, *directions: Any) -> _Scene:
    """Return a hand at rest, with its palm's distal axis up and its back towards +y.

    Args:
        hand: The hand.
        *directions: As of `draw_hand`.
    """
    pose = UPRIGHT @ inverse_pose(hand.frame_pose("palm", hand.rest))
    points = transform_points(pose, hand.points(hand.rest))
    size = lengths(points).max()
    ends = 0.28 * size * UPRIGHT[:3, :3].T
    origin = np.zeros(3)
    arrows = [*zip(3 * [origin], ends, _AXES, AXIS_COLOURS, strict=True)]
    for row in directions:
        # It ends beyond the palm's axes and their labels.
        end = 0.5 * size * unit(pose[:3, :3] @ row["robot moved, mm"])
        arrows.append((origin, end, row["direction"], _OTHER_COLOUR))
    labels = [
        (point.name, FINGER_COLOURS.get(point.finger or "", _OTHER_COLOUR))
        for point in hand.reference_points
    ]
    shape = load_shape(hand).without_arm()
    return _Scene(shape.triangles(hand.rest).moved(pose), arrows, points, labels)
