"""Moments of a mapped motion as a sheet: the person's hands beside the robot, row by row.

A bare hand is drawn as on a contact sheet: in its palm frame, by two cameras. A robot with arms is
drawn from its front as far as it moves, beside the person's hands in the same directions; each of
its hands follows close by, in its palm frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handmap_core.se3 import Array, affine
from handmap_qp.hands import Hand, Side
from handmap_qp.human import upright_axes
from .contact_sheet import (
    CELL,
    HUMAN_BACKGROUND,
    VIEWS,
    Views,
    hand_pictures,
    human_pictures,
    human_triangles,
    on_background,
)
from .hands import HandShape, load_shape
from .raster import Camera, Triangles, merged, render
from .sheet import SheetColumn, draw_sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

ROW_HEIGHT = 260
"""Height of a row with a robot that has arms [pixel]."""
PERSON_WIDTH = 250
"""Width of the picture of both of the person's hands [pixel]."""
ROBOT_WIDTH = 300
"""Width of the picture of a robot with arms [pixel]."""
HAND_WIDTH = 180
"""Width of the picture of one hand of it [pixel]."""

# Direction of the camera from a robot's front, and above the horizontal plane [deg].
_TURNED, _ELEVATION = 28.0, 14.0
# What stands still is in the picture as far as this around what moves [m].
_AROUND = 0.12
# A robot's own hands are seen where curl and pinches show.
_CLOSE_VIEWS = VIEWS[1:]


class ShownHand(NamedTuple):
    """A robot hand, and the person's hand that it follows, at n moments.

    Attributes:
        hand: The robot hand; of a robot with several, one of `Hand.hands`.
        side: Which hand of the person it follows.
        landmarks: The person's landmarks in the tracker's world [m], shape (n, 21, 3).
        in_palm: The same in the palm frame, as in `SheetRow`.
        is_seen: At which moments the tracker saw the hand, shape (n,). Landmarks of others are not
            drawn.
    """

    hand: Hand
    side: Side
    landmarks: Array
    in_palm: Array
    is_seen: Array


class ShownMotion(NamedTuple):
    """A robot and the person's hands that it follows, at n moments.

    Attributes:
        robot: The robot hand, or the hands of a robot as one.
        q: Its joint positions in the order of `robot.joint_names` [rad or m], shape (n, joints).
        hands: Its hands.
        turn: Rotation from the tracker's world to the robot's, shape (3, 3).
    """

    robot: Hand
    q: Array
    hands: Sequence[ShownHand]
    turn: Array


def moments_sheet(
    motions: Sequence[ShownMotion], times: Sequence[float], footnote: str = ""
) -> Figure:
    """Draw robots beside the person's hands, a row for each moment.

    Args:
        motions: One robot or several.
        times: Instants of the n moments [s].
        footnote: Printed below.

    Returns:
        The sheet. Each motion has columns of its own: for a bare hand the person's and the robot's;
        for a robot with arms the person's hands in the robot's directions, the robot, and then the
        person's and the robot's hand of each side.

    Raises:
        InvalidInputError: If there are no moments.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    is_tall = any(motion.robot.is_on_arm for motion in motions)
    height = ROW_HEIGHT if is_tall else CELL[1]
    columns = []
    for motion in motions:
        shape = load_shape(motion.robot.hands[0])
        if motion.robot.is_on_arm:
            columns += _overview(motion, shape)
        for shown in motion.hands:
            columns += _close_up(motion, shown, shape, height)
    rows = [(f"{time:.2f} s", _unseen_text(motions, i)) for i, time in enumerate(times)]
    return draw_sheet(columns, rows, footnote=footnote)


def _overview(motion: ShownMotion, shape: HandShape) -> list[SheetColumn]:
    """Draw the person's hands and the whole robot, both from the robot's front."""
    axes = upright_axes(motion.robot.upright)
    turn = axes @ motion.turn
    people = []
    for i in range(len(motion.q)):
        seen = [hand.landmarks[i] for hand in motion.hands if hand.is_seen[i]]
        people.append(merged([human_triangles(points @ turn.T) for points in seen]))
    # One after the other: a robot may have half a million triangles.
    robots = (shape.triangles(q).moved(affine(axes)) for q in motion.q)
    corners = merged(people).vertices.reshape(-1, 3)
    size = PERSON_WIDTH, ROW_HEIGHT
    person = _pictures(people, corners, size, HUMAN_BACKGROUND)
    size = ROBOT_WIDTH, ROW_HEIGHT
    robot = _pictures(robots, _moving_corners(motion, shape, axes), size, 1.0)
    return [
        SheetColumn("person", "seen from the robot's front", person),
        SheetColumn(motion.robot.name, "from the front", robot),
    ]


def _pictures(
    solids: Iterable[Triangles],
    corners: Array,
    size: tuple[int, int],
    background: float,
) -> Array:
    """Draw solids by one camera that has all corners (m, 3) [m] in its picture."""
    camera = Camera.framing(
        corners, size, azimuth=_TURNED, elevation=_ELEVATION, margin=0.03
    )
    images = np.array([render(solid, camera) for solid in solids])
    return on_background(images, background)


def _moving_corners(motion: ShownMotion, shape: HandShape, axes: Array) -> Array:
    """Return the vertices of all moments that are to be in the picture [m], shape (m, 3).

    Those of links that move, and of others near them: legs and wheels of a robot are not shown
    whole.
    """
    frames = shape.hand.frames
    links: tuple[dict[str, Triangles], dict[str, Triangles]] = ({}, {})
    for name, solid in shape.links.items():
        links[frames[name].parentJoint > 0][name] = solid
    still, moving = (HandShape(shape.hand, each) for each in links)
    # One corner of each triangle is enough: the picture has a margin.
    corners = np.concatenate([moving.triangles(q).vertices[:, 0] for q in motion.q])
    others = still.triangles(motion.q[0]).vertices[:, 0]
    low, high = corners.min(axis=0) - _AROUND, corners.max(axis=0) + _AROUND
    is_near = ((low <= others) & (others <= high)).all(axis=1)
    return np.concatenate([corners, others[is_near]]) @ axes.T


def _close_up(
    motion: ShownMotion, shown: ShownHand, shape: HandShape, height: int
) -> list[SheetColumn]:
    """Draw the person's hand and the robot's in their palm frames."""
    views: Views = _CLOSE_VIEWS if motion.robot.is_on_arm else VIEWS
    size = (HAND_WIDTH if motion.robot.is_on_arm else CELL[0]), height
    seen = np.flatnonzero(shown.is_seen)
    person = np.full((len(motion.q), len(views), height, size[0], 3), HUMAN_BACKGROUND)
    if len(seen):
        landmarks = [*shown.in_palm[seen]]
        person[seen] = human_pictures(landmarks, shown.side, views=views, size=size)
    own = HandShape(shown.hand, shape.links)
    robot = hand_pictures(own, [*motion.q], views=views, size=size)
    note = "three-quarter" if motion.robot.is_on_arm else "palm side  |  three-quarter"
    name = f"{shown.side} hand" if motion.robot.is_on_arm else motion.robot.name
    return [
        SheetColumn(f"person, {shown.side}", note, _side_by_side(person)),
        SheetColumn(name, note, _side_by_side(robot)),
    ]


def _side_by_side(views: Array) -> Array:
    """Put the views of each row beside each other: (n, views, h, w, 3) to (n, h, views * w, 3)."""
    count, _, height, _, channels = views.shape
    return views.swapaxes(1, 2).reshape(count, height, -1, channels)


def _unseen_text(motions: Sequence[ShownMotion], i: int) -> str:
    """Return which of the person's hands are not seen at a moment; a line each."""
    hands = [hand for motion in motions for hand in motion.hands]
    return "\n".join(f"{hand.side} not seen" for hand in hands if not hand.is_seen[i])
