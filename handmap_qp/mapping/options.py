"""The choices of the homogeneous mapping that the paper leaves open, as one checked value."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, TypedDict, get_args

import numpy as np

from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.transform import as_floats

RigidFrom = Literal["points", "wrist", "none"]
Pivot = Literal["centroid", "palm", "point", "world"]
Alignment = Literal["world", "palm"]
ReferenceAt = Literal["first", "rest", "previous"]
Rotation = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class MappingOptions:
    """Choices of how T is estimated, split and carried to the robot.

    Attributes:
        ridge: Pull of the estimated linear motion towards a rotation (eq. 6 with a ridge). 0 is the
            paper's least squares.
        rigid_from: Where the rigid part T_rb comes from. `points`: the polar factor of T (the
            paper). `wrist`: the measured displacement of the wrist. `none`: the robot's wrist
            stays, and the fingers take all of T.
        pivot: The point about which rotation and deformation act: the `centroid` of each hand's
            reference points, each hand's `palm`, a given `point` common to both worlds, or the
            origin of the `world` (the paper's literal reading).
        pivot_point: The point of `pivot="point"` [m].
        alignment: Rotation from the human's world axes to the robot's. `world`: they agree (the
            paper). `palm`: lay the human's palm axes at the reference onto the robot's. Or a
            rotation matrix.
        scale: Factor on translations.
        reference: Configuration that T starts from. `first`: the sample that became the reference
            (the paper). `rest`: both hands' rest postures, placed at that sample's wrists, so that
            the posture of the first sample does not matter. `previous`: the sample before (Fig. 3).
        residual_gain: Part of each human point's residual to the imposed motion that its partner on
            the robot takes over, 0 (the paper) to 1.
        deformation_gain: Exponent g of the stretch, `U^g`, 10 at most. 1 is the paper; 0 leaves the
            fingers undeformed.
        stretch_min: Smallest stretch that is imposed.
        stretch_max: Largest stretch that is imposed.
    """

    ridge: float = 0.1
    rigid_from: RigidFrom = "points"
    pivot: Pivot = "centroid"
    pivot_point: tuple[float, float, float] | None = None
    alignment: Alignment | Rotation = "world"
    scale: float = 1.0
    reference: ReferenceAt = "first"
    residual_gain: float = 0.0
    deformation_gain: float = 1.0
    stretch_min: float = 0.2
    stretch_max: float = 3.0

    def __post_init__(self) -> None:
        """Reject values and combinations without a meaning.

        Raises:
            InvalidOptionsError: Names the option at fault.
        """
        for name, choices in _CHOICES.items():
            if getattr(self, name) not in choices:
                raise InvalidOptionsError(
                    option=name,
                    expected=f"one of {', '.join(choices)}",
                    value=getattr(self, name),
                )
        for name, (low, high) in _RANGES.items():
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and low <= value <= high
            if not is_number or (value == np.inf and name not in _MAY_BE_INFINITE):
                raise InvalidOptionsError(
                    option=name, expected=f"a number in [{low:g}, {high:g}]", value=value
                )
        if (self.pivot == "point") != (self.pivot_point is not None):
            raise InvalidOptionsError(
                option="pivot_point",
                problem="goes together with pivot='point'",
                value=self.pivot_point,
                advice="give both or neither",
            )
        if self.pivot_point is not None and not _is_point(self.pivot_point):
            raise InvalidOptionsError(
                option="pivot_point", expected="three finite numbers", value=self.pivot_point
            )
        if self.deformation_gain != 1.0 and self.stretch_min == 0.0:
            raise InvalidOptionsError(
                option="deformation_gain",
                problem="needs positive stretches",
                value=self.deformation_gain,
                advice="give stretch_min > 0",
            )
        self._check_alignment()

    def _check_alignment(self) -> None:
        if isinstance(self.alignment, str):
            if self.alignment not in get_args(Alignment):
                raise InvalidOptionsError(
                    option="alignment", expected="world, palm or a rotation", value=self.alignment
                )
            return
        try:
            rotation = as_floats(self.alignment, "alignment")
        except InvalidInputError:
            rotation = np.empty(0)
        is_finite = rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
        if not (is_finite and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6):
            raise InvalidOptionsError(
                option="alignment",
                expected="world, palm or a rotation of shape (3, 3)",
                value=self.alignment,
            )
        if np.linalg.det(rotation) < 0.0:
            raise InvalidOptionsError(
                option="alignment",
                problem="the matrix mirrors",
                value=self.alignment,
                advice="map a left hand with the URDF of a left hand",
            )


class MappingChanges(TypedDict, total=False):
    """The fields of `MappingOptions` as keyword arguments of `HandMapper`."""

    ridge: float
    rigid_from: RigidFrom
    pivot: Pivot
    pivot_point: tuple[float, float, float] | None
    alignment: Alignment | Rotation
    scale: float
    reference: ReferenceAt
    residual_gain: float
    deformation_gain: float
    stretch_min: float
    stretch_max: float


def _is_point(value: Any) -> bool:
    try:
        array = as_floats(value, "pivot_point")
    except InvalidInputError:
        return False
    return array.shape == (3,) and bool(np.isfinite(array).all())


_CHOICES = {
    "rigid_from": get_args(RigidFrom),
    "pivot": get_args(Pivot),
    "reference": get_args(ReferenceAt),
}
_RANGES = {
    "ridge": (0.0, np.inf),
    "scale": (0.0, np.inf),
    "residual_gain": (0.0, 1.0),
    # Bound chosen so that stretch**gain cannot overflow.
    "deformation_gain": (0.0, 10.0),
    "stretch_min": (0.0, 1.0),
    "stretch_max": (1.0, np.inf),
}
_MAY_BE_INFINITE = ("stretch_max",)

TELEMANIPULATION = MappingOptions(
    rigid_from="wrist", pivot="palm", residual_gain=1.0, deformation_gain=0.5
)
"""Choices for a tracked wrist and a robot whose points name partners: the wrist goes where the
human's does, and fingers follow fingers."""
