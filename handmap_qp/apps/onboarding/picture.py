"""Draw a hand with its palm axes and reference points labelled, to check a description."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin

from handmap_qp.apps.drawing.hands import (
    HandShape,
    draw_hands,
    load_shape,
    require_matplotlib,
    save_picture,
    spheres,
    tube,
)
from handmap_qp.apps.drawing.raster import Camera, Triangles, merged
from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import transform_points

_PANEL = (760, 820)
# From the end of an axis to its label [pixel].
_AXIS_GAP = 14.0
_FINGER_COLOURS = {
    "thumb": (0.84, 0.16, 0.16),
    "index": (0.95, 0.55, 0.05),
    "middle": (0.16, 0.60, 0.25),
    "ring": (0.13, 0.40, 0.85),
    "little": (0.55, 0.25, 0.70),
}
_OTHER_COLOUR = (0.25, 0.25, 0.28)
_AXES = ("x, across", "y, distal", "z, dorsal")
_AXIS_COLOURS = ((0.80, 0.10, 0.10), (0.10, 0.55, 0.15), (0.10, 0.25, 0.80))
# Title, azimuth and elevation of the two views [deg]; `draw_hand` sets the second azimuth by side.
_VIEWS = (("back of the hand", 90.0, 12.0), ("palm, from the thumb's side", 0.0, 12.0))


def picture_path(hand: str) -> Path | None:
    """Return the path of a `hand.yaml`'s picture, beside it; None for a hand given by name."""
    path = Path(hand)
    if path.suffix in (".yaml", ".yml"):
        return path.with_suffix(".png")
    return path / "hand.png" if (path / "hand.yaml").is_file() else None


def draw_hand(hand: Hand, path: Path) -> None:
    """Draw a hand at rest from the back and from the side, fingers up, with all its points.

    Args:
        hand: The hand.
        path: Picture to write; its suffix sets the format.

    Raises:
        InvalidInputError: If the file cannot be written.
        MissingExtraError: If matplotlib is not installed.
    """
    require_matplotlib()
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    scene = _Scene(hand.with_points([point.name for point in hand.spec.points]))
    figure = Figure(figsize=(2 * _PANEL[0] / 100, _PANEL[1] / 100 + 0.5), dpi=100)
    FigureCanvasAgg(figure)
    height = _PANEL[1] / (_PANEL[1] + 50)
    for i, (title, azimuth, elevation) in enumerate(_VIEWS):
        axes = figure.add_axes((0.5 * i, 0.0, 0.5, height))
        turned = azimuth if i == 0 else (215.0 if hand.side == "right" else -35.0)
        scene.draw(axes, turned, elevation)
        axes.text(
            _PANEL[0] / 2, 14, title, ha="center", va="top", fontsize=11, color="0.35"
        )
    kinds = hand.all_joint_roles
    count = kinds.count("active")
    what = f"{hand.name}: a {hand.side} hand, {count} joint{'s' if count > 1 else ''}"
    if "follower" in kinds:
        count = kinds.count("follower")
        what += f", {count} follower{'s' if count > 1 else ''}"
    figure.text(0.5, 0.975, f"{what}; at rest", ha="center", va="center", fontsize=14)
    save_picture(figure, path, facecolor="white")


class _Scene:
    """A hand at rest, with its palm's distal axis up and its back towards +y."""

    def __init__(self, hand: Hand) -> None:
        self.hand = hand
        palm = hand.frame_pose("palm", hand.rest)
        # Distal (y) points up, dorsal (z) towards +y: a camera at +y sees the back of the hand.
        upright = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
        self._to_picture = np.eye(4)
        self._to_picture[:3, :3] = upright @ palm[:3, :3].T
        self._to_picture[:3, 3] = -self._to_picture[:3, :3] @ palm[:3, 3]
        self.points = transform_points(self._to_picture, hand.points(hand.rest))
        self.size = float(np.linalg.norm(self.points, axis=1).max())
        self.triangles = self._solid()
        length = 0.28 * self.size
        self.axes = length * (upright.T)
        self.marks = self._marks()

    def draw(self, axes: Any, azimuth: float, elevation: float) -> None:
        """Draw one view into a matplotlib axes."""
        around = [
            self.triangles.vertices.reshape(-1, 3),
            self.points,
            self.axes,
            np.zeros((1, 3)),
        ]
        # The margin leaves room for labels on both sides.
        camera = Camera.framing(
            np.concatenate(around),
            _PANEL,
            azimuth=azimuth,
            elevation=elevation,
            margin=0.13,
        )
        draw_hands(axes, self.triangles, camera, marks=self.marks, supersampling=2)
        origin = camera.project(np.zeros(3))[:2]
        for tip, name, colour in zip(self.axes, _AXES, _AXIS_COLOURS, strict=True):
            x, y, _ = camera.project(tip)
            right, down = x - origin[0], y - origin[1]
            # Write beyond the end of the axis, so that the end stays visible.
            is_upright = abs(down) > abs(right)
            horizontal = "center" if is_upright else "left" if right > 0.0 else "right"
            vertical = ("top" if down > 0.0 else "bottom") if is_upright else "center"
            x += 0.0 if is_upright else np.copysign(_AXIS_GAP, right)
            y += np.copysign(_AXIS_GAP, down) if is_upright else 0.0
            axes.text(
                x,
                y,
                name,
                color=colour,
                fontsize=10,
                ha=horizontal,
                va=vertical,
                bbox=_box(),
            )
        self._label(axes, camera.project(self.points)[:, :2])

    def _label(self, axes: Any, places: np.ndarray) -> None:
        """Write the points' names at the panel's edges, each with a line to its point."""
        middle = 0.5 * float(places[:, 0].min() + places[:, 0].max())
        names = [point.name for point in self.hand.reference_points]
        for is_right in (False, True):
            chosen = [
                i for i in range(len(places)) if (places[i, 0] > middle) == is_right
            ]
            # Among points at the same height, label the farthest from the edge on top, so that its
            # line passes above the others.
            towards = 1.0 if is_right else -1.0
            chosen.sort(
                key=lambda i, towards=towards: (
                    round(places[i, 1] / 20.0),
                    towards * places[i, 0],
                )
            )
            heights = _spaced(
                np.array([places[i, 1] for i in chosen]), 24.0, 50.0, _PANEL[1] - 20.0
            )
            for i, height in zip(chosen, heights, strict=True):
                colour = self._colour(i)
                edge = _PANEL[0] - 8 if is_right else 8
                axes.annotate(
                    names[i],
                    xy=(places[i, 0], places[i, 1]),
                    xytext=(edge, height),
                    ha="right" if is_right else "left",
                    va="center",
                    fontsize=10,
                    color=colour,
                    bbox=_box(),
                    arrowprops={
                        "arrowstyle": "-",
                        "color": colour,
                        "linewidth": 0.8,
                        "shrinkA": 0,
                        "shrinkB": 3,
                    },
                )

    def _colour(self, i: int) -> tuple[float, float, float]:
        return _FINGER_COLOURS.get(
            self.hand.reference_points[i].finger or "", _OTHER_COLOUR
        )

    def _marks(self) -> Triangles:
        parts = [
            spheres(self.points[i : i + 1], 0.022 * self.size, self._colour(i))
            for i in range(len(self.points))
        ]
        for tip, colour in zip(self.axes, _AXIS_COLOURS, strict=True):
            parts.append(tube(np.array([np.zeros(3), tip]), 0.008 * self.size, colour))
            parts.append(spheres(tip, 0.016 * self.size, colour))
        return merged(parts)

    def _solid(self) -> Triangles:
        """Return the hand's surface without its arm; sticks between joints if it has no shapes."""
        hand, model = self.hand, self.hand.model
        shape = load_shape(hand)
        wrist = model.frames[hand.wrist_frame_id].parentJoint
        own = [link for link in shape.links if self._is_of_hand(link.link, wrist)]
        if own:
            vertices, colours, normals = HandShape(hand, tuple(own)).triangles(
                hand.rest
            )
        else:
            vertices, colours, normals = merged(self._sticks(wrist))
        return Triangles(
            transform_points(self._to_picture, vertices),
            colours,
            normals @ self._to_picture[:3, :3].T,
        )

    def _is_of_hand(self, link: str, wrist: int) -> bool:
        model = self.hand.model
        joint = model.frames[model.getFrameId(link, pin.FrameType.BODY)].parentJoint
        return wrist == 0 or wrist in model.supports[joint]

    def _sticks(self, wrist: int) -> list[Triangles]:
        hand, model = self.hand, self.hand.model
        workspace = hand.configuration()
        workspace.place_frames(hand.configuration_vector(hand.rest))
        grey, thickness = (0.62, 0.64, 0.67), 0.015 * self.size
        joints = [
            i
            for i in range(1, model.njoints)
            if wrist == 0 or (i != wrist and wrist in model.supports[i])
        ]
        ends = [
            (
                workspace.data.oMi[model.parents[i]].translation,
                workspace.data.oMi[i].translation,
            )
            for i in joints
        ]
        for i, point in enumerate(hand.reference_points):
            parent = model.frames[
                model.getFrameId(point.link, pin.FrameType.BODY)
            ].parentJoint
            ends.append(
                (workspace.data.oMi[parent].translation, hand.points(hand.rest)[i])
            )
        return [
            tube(np.array(pair), thickness, grey)
            for pair in ends
            if np.linalg.norm(pair[1] - pair[0]) > 1e-4
        ]


def _spaced(heights: np.ndarray, gap: float, top: float, bottom: float) -> np.ndarray:
    """Move ascending heights apart to at least `gap`, inside the panel if they fit."""
    placed = np.clip(heights, top, bottom)
    for _ in range(200):
        for i in range(1, len(placed)):
            lack = gap - (placed[i] - placed[i - 1])
            if lack > 0.0:
                placed[i - 1] -= lack / 2.0
                placed[i] += lack / 2.0
        placed = np.clip(placed, top, bottom)
    return placed


def _box() -> dict[str, Any]:
    return {
        "facecolor": "white",
        "alpha": 0.75,
        "edgecolor": "none",
        "boxstyle": "round,pad=0.15",
    }
