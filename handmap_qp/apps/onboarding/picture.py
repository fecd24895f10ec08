"""Pictures to check a description: a hand with its labels, and its matched posture."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from handmap_core.se3 import inverse_pose, lengths, transform_points, unit
from handmap_qp.apps.drawing import (
    AXIS_COLOURS,
    PANEL,
    UPRIGHT,
    Scene,
    load_shape,
    require_matplotlib,
    save_panels,
    save_picture,
)
from handmap_qp.apps.drawing.contact_sheet import (
    FINGER_COLOURS,
    SheetRow,
    contact_sheet,
)
from handmap_qp.hands import Hand, Values
from handmap_qp.mapping import resting_posture
from .match import Match

_OTHER_COLOUR = (0.25, 0.25, 0.28)
_AXES = ("x, across", "y, distal", "z, dorsal")
# Caption of both views of a hand, and how far the camera turns from its back to the thumb [deg].
_VIEWS = {"back of the hand": 0.0, "palm, from the thumb's side": 125.0}
_ROBOT_VIEWS = {"from +x": 20.0, "from +y": 80.0}
# Length of the axes of a robot's palms [m].
_ROBOT_AXES = 0.12


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


def draw_hand(hand: Hand, path: Path, directions: Sequence[Values] = ()) -> None:
    """Draw a hand at rest from the back and from the side, fingers up, with all its points.

    Args:
        hand: The hand.
        path: Picture to write; its suffix sets the format.
        directions: Where an arm takes the hand: rows of the table of `check_directions`.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib is not installed.
    """
    require_matplotlib()
    points = [point.name for point in hand.spec.points]
    scene = hand_scene(hand.with_points(points), directions)
    turn = 1.0 if hand.side == "right" else -1.0
    panels = {
        caption: partial(scene.draw, azimuth=90.0 + turn * angle)
        for caption, angle in _VIEWS.items()
    }
    title = f"{hand.name}: a {hand.side} hand, {len(hand.joint_names)} joints; at rest"
    save_panels(path, title, PANEL, panels)


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
    scene = Scene(load_shape(hands[0]).triangles(hands[0].rest), arrows)
    panels = {name: partial(scene.draw, azimuth=a) for name, a in _ROBOT_VIEWS.items()}
    title = f"{robot.name} at rest; palms: red across, green distal, blue dorsal"
    save_panels(path, title, PANEL, panels)


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


def hand_scene(hand: Hand, directions: Sequence[Values] = ()) -> Scene:
    """Return a hand at rest, with its palm's distal axis up and its back towards +y.

    Args:
        hand: The hand.
        directions: As for `draw_hand`.
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
    return Scene(shape.triangles(hand.rest).moved(pose), arrows, points, labels)
