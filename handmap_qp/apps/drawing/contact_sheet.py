"""A contact sheet of poses: the human's hand and every mapping's robot side by side.

`sheet_rows` picks the samples, `contact_sheet` draws them, `save_contact_sheet` writes the PNG.

All hands are seen in their own palm frames by the same two cameras: from the palm's side, and from
between palm and thumb, where curl and pinches show. The human is drawn as tubes through the raw
landmarks, not as a model fitted to them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise, product
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handmap_core.errors import expect, require
from handmap_core.se3 import (
    Array,
    as_floats,
    inverse_pose,
    rigid_fit,
    transform_points,
)
from handmap_qp.hands import Hand, Side, find_fingers
from handmap_qp.human import (
    FIRST_JOINTS,
    PALM,
    Recording,
    finger_chains,
    measure_hand,
)
from .hands import (
    UPRIGHT,
    HandShape,
    load_shape,
    spheres,
    tube,
)
from .raster import Camera, Colour, Triangles, merged, render
from .sheet import SheetColumn, draw_sheet

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FINGER_COLOURS: dict[str, Colour] = {
    "thumb": (0.84, 0.22, 0.16),
    "index": (0.93, 0.60, 0.10),
    "middle": (0.20, 0.58, 0.36),
    "ring": (0.16, 0.45, 0.78),
    "little": (0.55, 0.30, 0.68),
}
"""Colours of the fingers, human and robot."""
VIEWS: tuple[tuple[float, float], ...] = ((-90.0, 8.0), (-25.0, 18.0))
"""Azimuth and elevation of the cameras for right hands [deg], see `Camera.framing`.

The fingers point up and the palm looks along -y. For left hands, azimuths are mirrored.
"""
_VIEW_NAMES = "palm side  |  three-quarter"
Views = Sequence[tuple[float, float]]
"""Cameras as in `VIEWS`."""
CELL = (170, 190)
"""Width and height of one view [pixel]."""
HUMAN_BACKGROUND = 0.965
"""Grey behind a person's hand."""

_MARGIN = 0.05
_BONE = 0.0062
_JOINT = 0.0068
_TIP = 0.0072
_PALM_BONE = 0.0052
_PALM_COLOUR = (0.80, 0.72, 0.66)
_ROBOT_COLOUR = (0.66, 0.68, 0.72)
# Across the palm: wrist to knuckles, and from knuckle to knuckle.
_KNUCKLES = FIRST_JOINTS.tolist()
_PALM_BONES = (*product((0,), _KNUCKLES), *pairwise(_KNUCKLES))
# The palm is flat, and seen from both sides.
_PALM_FACES = [(0, *pair[::way]) for pair in pairwise(_KNUCKLES) for way in (1, -1)]


class SheetRow(NamedTuple):
    """One pose.

    Attributes:
        label: Its name.
        note: Where it is from, in few words; a line or more.
        landmarks: The human's raw landmarks in the palm frame (origin at the wrist, y distal,
            z dorsal) [m], shape (21, 3).
        q: Joint angles of the robot in every column [rad], in the order of its `joint_names`.
    """

    label: str
    note: str
    landmarks: Array
    q: tuple[Array, ...]


def sheet_rows(
    recording: Recording, poses: Mapping[str, int | None], motions: Sequence[Array]
) -> list[SheetRow]:
    """Pick samples out of a recording and the motions that were mapped from it.

    Args:
        recording: Landmarks of a hand.
        poses: For every pose the index of a sample, or None (`find_poses`). Poses without a sample
            have no row.
        motions: Joint angles of every column [rad], each of shape (T, n).

    Returns:
        Rows in the order of `poses`.

    Raises:
        InvalidInputError: If a motion has another number of samples than the recording, or an index
            is not one of a valid sample.
    """
    for i, q in enumerate(motions):
        as_floats(q, f"motions[{i}]", shape=(len(recording), "n"))
    shown = {label: i for label, i in poses.items() if i is not None}
    for label, i in shown.items():
        expect(
            0 <= i < len(recording) and recording.valid[i],
            f"poses[{label!r}]",
            "index of a valid sample",
            value=i,
        )
    own = landmarks_in_palm(recording, [*shown.values()])
    return [
        SheetRow(
            label,
            f"{recording.time[i] - recording.time[0]:.2f} s",
            landmarks,
            tuple(q[i] for q in motions),
        )
        for (label, i), landmarks in zip(shown.items(), own, strict=True)
    ]


def landmarks_in_palm(recording: Recording, samples: Sequence[int]) -> Array:
    """Return landmarks in the palm frame (`SheetRow.landmarks`) [m], shape (n, 21, 3).

    Args:
        recording: Landmarks of a hand.
        samples: Indices of n valid samples.
    """
    palm = measure_hand(recording).palm(recording.side)
    found = np.empty((len(samples), *recording.landmarks.shape[1:]))
    for row, i in enumerate(samples):
        landmarks = recording.landmarks[i]
        found[row] = transform_points(rigid_fit(landmarks[PALM], palm), landmarks)
    return found


def contact_sheet(
    columns: Sequence[tuple[str, Hand]],
    rows: Sequence[SheetRow],
    *,
    side: Side = "right",
    title: str = "",
    footnote: str = "",
) -> Figure:
    """Draw poses in rows, the human and every mapping in columns.

    Columns of the same hand are drawn at the same scale, and all rows of a column are too.

    Args:
        columns: Name and robot of every mapping.
        rows: The poses, of `sheet_rows` (of one recording or several).
        side: Which hand the landmarks are of.
        title: Printed above the human's column.
        footnote: Printed below, such as the poses that a recording does not show.

    Returns:
        The picture, one pixel per pixel at its own resolution. The human's column comes first; each
        column has the views of `VIEWS` side by side.

    Raises:
        InvalidInputError: If there are no rows.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    pictures = pose_pictures(columns, rows, side=side)
    # The views of a column stand side by side.
    shape = len(rows), CELL[1], len(VIEWS) * CELL[0], 3
    drawn = np.moveaxis(pictures, 3, 2).swapaxes(0, 1)
    names = ["human", *(name for name, _ in columns)]
    return draw_sheet(
        [
            SheetColumn(name, _VIEW_NAMES, views.reshape(shape))
            for name, views in zip(names, drawn, strict=True)
        ],
        [(row.label, row.note) for row in rows],
        title=title,
        footnote=footnote,
    )


def pose_pictures(
    columns: Sequence[tuple[str, Hand]],
    rows: Sequence[SheetRow],
    *,
    side: Side = "right",
) -> Array:
    """Draw the poses without labels, such as the frames of an animation.

    Args:
        columns: Name and robot of every mapping.
        rows: The poses.
        side: Which hand the landmarks are of.

    Returns:
        Red, green and blue from 0 to 1, shape (rows, 1 + columns, views, height, width, 3); the
        human's column comes first.

    Raises:
        InvalidInputError: If there are no rows.
        MissingExtraError: If trimesh is not installed.
    """
    advice = "find_poses finds them"
    expect(rows, "rows", "at least one pose", got="none", advice=advice)
    human = human_pictures([row.landmarks for row in rows], side)
    pictures = np.stack([human] * (1 + len(columns)))
    # Columns of the same hand have the same scale.
    for hand in {hand for _, hand in columns}:
        own = [i for i, (_, other) in enumerate(columns) if other is hand]
        drawn = hand_pictures(load_shape(hand), [row.q[i] for i in own for row in rows])
        pictures[1:][own] = drawn.reshape(-1, *human.shape)
    return pictures.swapaxes(0, 1)


def human_pictures(
    landmarks: Sequence[Array],
    side: Side,
    *,
    views: Views = VIEWS,
    size: tuple[int, int] = CELL,
) -> Array:
    """Draw a person's hand in its palm frame at one scale.

    Args:
        landmarks: Landmarks as in `SheetRow` [m], n times (21, 3).
        side: Which hand they are of.
        views: Cameras, as in `VIEWS`.
        size: Width and height of a picture [pixel].

    Returns:
        Red, green and blue from 0 to 1, shape (n, views, height, width, 3).

    Raises:
        MissingExtraError: If trimesh is not installed.
    """
    solids = [human_triangles(transform_points(UPRIGHT, each)) for each in landmarks]
    return _pictures(solids, side, HUMAN_BACKGROUND, views, size)


def hand_pictures(
    shape: HandShape,
    postures: Sequence[Array],
    *,
    views: Views = VIEWS,
    size: tuple[int, int] = CELL,
) -> Array:
    """Draw a robot hand without its arm in its palm frame at one scale, as `human_pictures` does.

    Args:
        shape: The hand.
        postures: Joint angles in the order of its `joint_names` [rad], n times (joints,).
        views: Cameras, as in `VIEWS`.
        size: Width and height of a picture [pixel].
    """
    hand = shape.hand
    coloured = _coloured(shape)
    solids = []
    for q in postures:
        # In its palm frame, upright.
        pose = UPRIGHT @ inverse_pose(hand.frame_pose("palm", q))
        solids.append(coloured.triangles(q).moved(pose))
    return _pictures(solids, hand.side, 1.0, views, size)


def save_contact_sheet(
    file: Path | str,
    recording: Recording,
    poses: Mapping[str, int | None],
    methods: Sequence[tuple[str, Hand, Array]],
) -> Path:
    """Draw the contact sheet of one recording and write it as PNG.

    Args:
        file: Where to.
        recording: Landmarks of the hand that the methods were given.
        poses: For every pose the index of a sample, or None (`find_poses`).
        methods: Name, robot and joint angles [rad], shape (T, n), of every mapping.

    Returns:
        The file.

    Raises:
        InvalidInputError: If there is no pose, or shapes do not fit.
        MissingExtraError: If matplotlib or trimesh is not installed.
    """
    rows = sheet_rows(recording, poses, [q for _, _, q in methods])
    absent = [label for label, i in poses.items() if i is None]
    footnote = f"Not in this recording: {', '.join(absent)}." if absent else ""
    columns = [(name, hand) for name, hand, _ in methods]
    figure = contact_sheet(
        columns, rows, side=recording.side, title=recording.name, footnote=footnote
    )
    figure.savefig(file)
    return Path(file)


def on_background(image: Array, background: float = 1.0) -> Array:
    """Return a rendered image (..., 4) on a grey from 0 to 1, shape (..., 3)."""
    return background + image[..., 3:] * (image[..., :3] - background)


def _pictures(
    solids: list[Triangles],
    side: Side,
    background: float,
    views: Views,
    size: tuple[int, int],
) -> Array:
    """Render solids at one scale, shape (solids, views, height, width, 3)."""
    points = merged(solids).vertices.reshape(-1, 3)
    cameras = [
        Camera.framing(
            points,
            size,
            azimuth=azimuth if side == "right" else 180.0 - azimuth,
            elevation=elevation,
            margin=_MARGIN,
        )
        for azimuth, elevation in views
    ]
    images = np.array([[render(one, camera) for camera in cameras] for one in solids])
    return on_background(images, background)


def human_triangles(points: Array) -> Triangles:
    """Return tubes through landmarks [m], shape (21, 3), a colour for every finger."""
    palm = require("trimesh", "plot").Trimesh(points, _PALM_FACES)
    normals = palm.face_normals[:, None].repeat(3, axis=1)
    parts = [
        Triangles.painted(palm.triangles, normals, _PALM_COLOUR),
        spheres(points[PALM], _JOINT, _PALM_COLOUR),
    ]
    parts += [tube(points[[*pair]], _PALM_BONE, _PALM_COLOUR) for pair in _PALM_BONES]
    for finger, colour in zip(
        finger_chains(points), FINGER_COLOURS.values(), strict=True
    ):
        parts += [tube(bone, _BONE, colour) for bone in pairwise(finger)]
        parts += [
            spheres(finger[1:3], _JOINT, colour),
            spheres(finger[3], _TIP, colour),
        ]
    return merged(parts)


def _coloured(shape: HandShape) -> HandShape:
    """The same shape without an arm, grey, with every finger's links in the finger's colour."""
    fingers = find_fingers(shape.hand).items()
    colours = {
        joint: FINGER_COLOURS[name] for name, one in fingers for joint in one.own
    }
    links = {}
    for link, solid in shape.without_arm().links.items():
        joint = shape.hand.frames[link].parentJoint
        colour = colours.get(joint, _ROBOT_COLOUR)
        links[link] = Triangles.painted(solid.vertices, solid.normals, colour)
    return HandShape(shape.hand, links)
