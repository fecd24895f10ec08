"""Layouts of optical markers: names of markers on the links of the human model, which is fitted."""

from collections.abc import Iterable

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.se3 import FARTHEST, Array, rigid_fit, transform_points
from handmap_qp.hands import Document, Hand, HumanLengths, PointSpec, Side, Vector
from handmap_qp.human import LANDMARK_COUNT
from handmap_qp.ik import IkOptions, PointIk
from .base import Hands, HandsOf, Layout, Rows, sized_human

_FIT = IkOptions(
    rest_weight=0.01,
    damping=0.02,
    max_iterations=60,
    step_tolerance=1e-5,
    wrist_position_weight=0.0,
    wrist_orientation_weight=0.0,
)


class MarkerEntry(Document, frozen=True):
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


class _MarkerFit:
    """Fits the human model to markers; each sample starts at the posture of the one before.

    Args:
        human: The human hand, its reference points the markers.
        world: `Layout.world`.
        on_palm: Indices of the markers on the palm.
    """

    def __init__(self, human: Hand, world: Array, on_palm: list[int]) -> None:
        self._human = human
        self._world = world
        self._on_palm = on_palm
        self._landmarks = human.with_points("landmarks")
        self._ik = PointIk(human, _FIT)
        self._is_placed = False

    def __call__(self, values: Array, wrists: Array | None) -> Hands:
        """Fit the next samples; see `Layout.hands`."""
        human = self._human
        markers = transform_points(self._world, values)
        if not self._is_placed:
            palm = human.points(human.rest)[self._on_palm]
            wrist = rigid_fit(palm, markers[0, self._on_palm])
            self._ik.place(human.configuration_vector(human.rest, wrist))
            self._is_placed = True
        landmarks = np.empty((len(markers), LANDMARK_COUNT, 3))
        poses = np.empty((len(markers), 4, 4))
        for i, sample in enumerate(markers):
            # A fit takes 40 kB: none is kept.
            fit = self._ik.solve(sample, None, 1.0)
            poses[i] = fit.wrist
            landmarks[i] = self._landmarks.points(fit.q[human.q_indices], fit.wrist)
        return landmarks, poses


class MarkerLayout(Layout, tag="markers", kw_only=True):
    """A layout of markers.

    Attributes:
        markers: The markers, in their order.
        wrist: None: the markers on the palm show it.

    Raises:
        InvalidInputError: If a marker is on no link, or fewer than three are on the palm.
    """

    markers: tuple[MarkerEntry, ...]
    wrist: None = None  # ty: ignore[incompatible-mutable-override]
    has_wrist = True

    def __post_init__(self) -> None:
        super().__post_init__()
        names = [entry.name for entry in self.markers]
        expect(len(set(names)) == len(names), "markers", "different names", value=names)
        markers = enumerate(self.markers)
        self._on_palm = [i for i, entry in markers if entry.link == "palm"]
        count = len(self._on_palm)
        expect(count >= 3, "markers", "three markers on the palm", value=count)
        self.shapes = ((len(names), 3),)
        self.columns = tuple(f"{name}_{axis}" for name in names for axis in "xyz")

    def rows(self) -> Rows:
        """Describe every marker."""
        return [
            {
                "index": i,
                "marker": entry.name,
                "link of the human model": entry.link,
                "place on it [mm]": ", ".join(f"{1e3 * v:g}" for v in entry.xyz),
            }
            for i, entry in enumerate(self.markers)
        ]

    def hands(
        self,
        values: Array,
        side: Side,
        wrists: Array | None,
        lengths: HumanLengths | None,
    ) -> Hands:
        """Fit the human model to the markers, sample by sample; see `Layout.hands`."""
        return self.follow(side, lengths)(values, wrists)

    def follow(self, side: Side, lengths: HumanLengths | None) -> HandsOf:
        """Return a fit that starts each sample at the one before; see `Layout.follow`."""
        human = sized_human(side, lengths, self._points(side))
        return _MarkerFit(human, self.world, self._on_palm)

    def check(self, parts: Iterable[Array]) -> None:
        """Reject markers that are too far away; see `Layout.check`."""
        farthest = max(
            (
                float(np.abs(transform_points(self.world, values)).max())
                for values in parts
            ),
            default=0.0,
        )
        expect(
            farthest <= FARTHEST,
            "values",
            f"coordinates within {FARTHEST:g} m",
            got=f"{farthest:.3g} m",
        )

    def write_posture(self, human: Hand, q: ArrayLike, wrist: Array) -> Array:
        """Return the markers on the human hand; see `Layout.write_posture`."""
        points = human.with_points(self._points(human.side)).points(q)
        return transform_points(np.linalg.inv(self.world) @ wrist, points)

    def _points(self, side: Side) -> tuple[PointSpec, ...]:
        """Return the markers as points; the links of a left hand are mirrored in x."""
        mirror = 1.0 if side == "right" else -1.0
        return tuple(
            PointSpec(f"marker {entry.name}", entry.link, (mirror * x, y, z))
            for entry in self.markers
            for x, y, z in [entry.xyz]
        )
