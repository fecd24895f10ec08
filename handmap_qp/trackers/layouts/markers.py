"""Layouts of optical markers: names of markers on the links of the human model, which is fitted."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from handmap_qp.errors import expect
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.spec import PointSpec, Side, Vector
from handmap_qp.hands.urdf import mirrored_urdf
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.se3 import FARTHEST, rigid_fit, transform_points
from handmap_qp.trackers.layouts.base import (
    UNITS,
    Hands,
    Layout,
    LayoutTable,
    sized_human,
)

# A left hand is fitted as its mirror image: places on links are those of a right hand.
_MIRROR = np.array([-1.0, 1.0, 1.0])
_FIT = IkOptions(
    rest_weight=0.01,
    damping=0.02,
    max_iterations=60,
    step_tolerance=1e-5,
    wrist_position_weight=0.0,
    wrist_orientation_weight=0.0,
)


class MarkerEntry(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """One marker.

    Attributes:
        name: Its label.
        link: Link of the right human hand that carries it.
        xyz: Its place in the link's axes [m]: x along the bone, y palmar and z radial on fingers;
            on the palm, y distal and z dorsal.
    """

    name: str
    link: str
    xyz: Vector


class MarkerTable(
    LayoutTable, frozen=True, forbid_unknown_fields=True, tag="markers", kw_only=True
):
    """A layout of markers.

    Attributes:
        markers: The markers, in their order.
    """

    markers: tuple[MarkerEntry, ...]


class MarkerLayout(Layout[MarkerTable]):
    """A layout of markers.

    Args:
        table: The table.

    Raises:
        InvalidInputError: If a marker is on no link, or fewer than three are on the palm.
    """

    def __init__(self, table: MarkerTable) -> None:
        super().__init__(table)
        names = [entry.name for entry in table.markers]
        is_each_once = len(set(names)) == len(names)
        expect(is_each_once, "markers", "different names", value=names)
        self._points = tuple(
            PointSpec(f"marker {entry.name}", entry.link, entry.xyz)
            for entry in table.markers
        )
        links = np.array([entry.link for entry in table.markers])
        self._on_palm = np.flatnonzero(links == "palm")
        count = len(self._on_palm)
        expect(count >= 3, "markers", "three markers on the palm", got=f"{count}")
        self._last: tuple[HumanLengths | None, tuple[Hand, Hand, PointIk]] | None = None
        self.shapes = ((len(names), 3),)
        self.columns = tuple(f"{name}_{axis}" for name in names for axis in "xyz")
        self.has_wrist = True

    def rows(self) -> list[dict[str, Any]]:
        """Describe every marker."""
        rows = []
        for i, entry in enumerate(self.table.markers):
            place = ", ".join(f"{1e3 * value:g}" for value in entry.xyz)
            row = {"index": i, "marker": entry.name}
            row["link of the human model"] = entry.link
            row["place on it [mm]"] = place
            rows.append(row)
        return rows

    def hands(
        self,
        values: np.ndarray,
        side: Side,
        wrists: np.ndarray | None = None,
        lengths: HumanLengths | None = None,
    ) -> Hands:
        """Fit the human model to the markers, sample by sample; see `Layout.hands`."""
        mirror = np.ones(3) if side == "right" else _MIRROR
        human, landmarks, ik = self._model(lengths)
        palm = human.points(human.rest)[self._on_palm]
        markers = values * (UNITS[self.table.unit] * self.table.reflection * mirror)
        is_near = np.abs(markers).max() <= FARTHEST
        expected = f"coordinates within {FARTHEST:g} m"
        expect(is_near, "values", expected, got=f"{np.abs(markers).max():.3g} m")
        found, poses = [], []
        for i, sample in enumerate(markers):
            if i == 0:
                wrist = rigid_fit(palm, sample[self._on_palm])
                ik.place(human.configuration_vector(human.rest, wrist))
            ik.solve(sample, None, 1.0)
            pose = ik.configuration.wrist.homogeneous
            points = landmarks.points(ik.configuration.q[human.q_indices])
            found.append(transform_points(pose, points) * mirror)
            poses.append(pose)
        reflection = np.diag([*mirror, 1.0])
        return Hands(np.array(found), reflection @ np.array(poses) @ reflection)

    def write_posture(
        self,
        human: Hand,
        q: npt.ArrayLike,
        wrist: np.ndarray,
    ) -> np.ndarray:
        """Return the markers on the human hand; see `Layout.write_posture`.

        Those of a left hand are the mirror image of those of the right one in the same posture.
        """
        mirror = np.ones(3) if human.spec.side == "right" else _MIRROR
        text = human.urdf_text
        own = HumanLengths.from_urdf(
            text if human.spec.side == "right" else mirrored_urdf(text)
        )
        points = sized_human("right", own, self._points).points(q) * mirror
        world = transform_points(wrist, points)
        return world * self.table.reflection / UNITS[self.table.unit]

    def _model(self, lengths: HumanLengths | None) -> tuple[Hand, Hand, PointIk]:
        """Return the hand with markers, the same with landmarks, and its IK; those of last time."""
        if self._last is None or self._last[0] is not lengths:
            human = sized_human("right", lengths, self._points)
            made = human, human.with_points("landmarks"), PointIk(human, _FIT)
            self._last = lengths, made
        return self._last[1]
