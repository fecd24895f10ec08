"""T_def as the shape that it makes of a ball or a cube: `DeformationShape`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np

from handmap_qp.mapping.decomposition import polar
from handmap_qp.se3 import quat_wxyz_from_rotation
from handmap_qp.viewer.figure import as_bytes
from handmap_qp.viewer.sample import ViewSample

if TYPE_CHECKING:
    import viser

Shape = Literal["ellipsoid", "cube", "off"]
DEFORMATION_COLOUR = (0.45, 0.30, 0.80)
_CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
_EDGES = np.array([(i, j) for i in range(8) for j in range(i + 1, 8) if bin(i ^ j).count("1") == 1])


class DeformedBall:
    """A ball of the size of the human's points, and what T_def makes of it.

    Args:
        server: A running viser server.
        path: Name of the parent node, whose coordinates are those of W.
        points: Human reference points of the first sample [m], shape (n_h, 3).
    """

    def __init__(self, server: viser.ViserServer, path: str, points: np.ndarray) -> None:
        spread = points - points.mean(axis=0)
        self._radius = float(np.sqrt((spread**2).sum(axis=1).mean()))
        self._ellipsoid = server.scene.add_icosphere(
            f"{path}/ellipsoid",
            self._radius,
            as_bytes(DEFORMATION_COLOUR),
            subdivisions=4,
            opacity=0.2,
            cast_shadow=False,
        )
        self._ball = server.scene.add_icosphere(
            f"{path}/ball",
            self._radius,
            (150, 150, 160),
            subdivisions=2,
            wireframe=True,
            opacity=0.15,
            cast_shadow=False,
        )
        self._cube = server.scene.add_line_segments(
            f"{path}/cube",
            np.zeros((len(_EDGES), 2, 3)),
            as_bytes(DEFORMATION_COLOUR),
            thickness=2.5,
            thickness_units="screen",
        )

    def draw(self, sample: ViewSample, shape: Shape) -> None:
        """Draw the ball or a cube about the pivot as T_def deforms it."""
        if sample.deformation is None:
            shape = "off"
        self._ball.visible = self._ellipsoid.visible = shape == "ellipsoid"
        self._cube.visible = shape == "cube"
        if sample.deformation is None or sample.pivot is None:
            return
        if shape == "ellipsoid":
            # A rotation leaves the ball unchanged, so the rotation that T_def contains with
            # rigid_from="wrist" is not drawn.
            factors = polar(sample.deformation)
            scales = np.maximum(np.abs(factors.stretches), 1e-3)
            self._ellipsoid.scale = (float(scales[0]), float(scales[1]), float(scales[2]))
            axes = factors.axes * (1.0, 1.0, np.sign(np.linalg.det(factors.axes)))
            self._ellipsoid.wxyz = quat_wxyz_from_rotation(axes)
            self._ball.position = self._ellipsoid.position = sample.pivot
        elif shape == "cube":
            corners = (self._radius / np.sqrt(3.0) * _CORNERS) @ sample.deformation.T
            self._cube.position = sample.pivot
            self._cube.points = corners[_EDGES].astype(np.float32)
