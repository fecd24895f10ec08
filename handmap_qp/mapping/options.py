"""The choices of the mapping that the paper leaves open, as one value with names, defaults and checks."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from handmap_qp.errors import InvalidOptionsError

RigidFrom = Literal["points", "wrist", "none"]
Pivot = Literal["centroid", "palm", "point", "world"]
Alignment = Literal["world", "palm"]
Reference = Literal["initial", "previous"]
Rotation = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]


@dataclass(frozen=True, slots=True)
class MappingOptions:
    """How the human's motion becomes the robot's.

    Attributes:
        ridge: Pull of the estimated linear motion towards a rotation (eq. 6 with a ridge); 0 is the
            paper's least squares.
        rigid_from: Where the rigid part T_rb comes from: `points`, the polar factor of T (the
            paper); `wrist`, the measured displacement of the wrist; `none`, the robot's wrist stays
            and the fingers take all of T.
        pivot: The point about which rotation and deformation act: the `centroid` of each hand's
            reference points, each hand's `palm`, a given `point` common to both worlds, or the
            `world`'s origin (the paper's literal reading).
        pivot_point: The point of `pivot="point"` [m].
        alignment: Rotation from the human's world axes to the robot's: `world`, they agree (the
            paper); `palm`, the one that lays the human's palm axes at the reference onto the
            robot's; or a rotation matrix.
        scale: Factor on translations.
        reference: Configuration that T starts from: `initial`, the reference; `previous`, the
            sample before (Fig. 3).
        residual_gain: Part of each human point's misfit to T that its partner on the robot takes
            over, 0 (the paper) to 1.
        deformation_gain: Exponent g of the stretch, `U^g`, 10 at most; 1 is the paper, 0 leaves the
            fingers undeformed.
        stretch_min: Smallest stretch that is passed on.
        stretch_max: Largest stretch that is passed on.
        joint_tolerance: How far a human joint may be outside its limits before the sample is
            refused [rad].
    """

    ridge: float = 0.1
    rigid_from: RigidFrom = "points"
    pivot: Pivot = "centroid"
    pivot_point: tuple[float, float, float] | None = None
    alignment: Alignment | Rotation = "world"
    scale: float = 1.0
    reference: Reference = "initial"
    residual_gain: float = 0.0
    deformation_gain: float = 1.0
    stretch_min: float = 0.2
    stretch_max: float = 3.0
    joint_tolerance: float = 0.25

    def __post_init__(self) -> None:
        """Refuse values and combinations that mean nothing.

        Raises:
            InvalidOptionsError: Saying which option, what is wrong, and what to do.
        """
        choices = {
            "rigid_from": ("points", "wrist", "none"),
            "pivot": ("centroid", "palm", "point", "world"),
            "reference": ("initial", "previous"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InvalidOptionsError(
                    f"{name}: expected one of {', '.join(allowed)}; got {getattr(self, name)!r}"
                )
        ranges = {
            "ridge": (0.0, np.inf),
            "scale": (0.0, np.inf),
            "residual_gain": (0.0, 1.0),
            # Far more than makes sense, and a power that no stretch overflows.
            "deformation_gain": (0.0, 10.0),
            "stretch_min": (0.0, 1.0),
            "stretch_max": (1.0, np.inf),
            "joint_tolerance": (0.0, np.inf),
        }
        for name, (low, high) in ranges.items():
            value = getattr(self, name)
            is_number = isinstance(value, int | float) and low <= value <= high
            if not is_number or (value == np.inf and name not in _MAY_BE_INFINITE):
                raise InvalidOptionsError(
                    f"{name}: expected a number in [{low:g}, {high:g}], got {value!r}"
                )
        if (self.pivot == "point") != (self.pivot_point is not None):
            raise InvalidOptionsError(
                "pivot='point' and pivot_point go together: give both or neither"
            )
        if self.pivot_point is not None and not _is_point(self.pivot_point):
            raise InvalidOptionsError(
                f"pivot_point: expected three finite numbers, got {self.pivot_point}"
            )
        if self.deformation_gain != 1.0 and self.stretch_min == 0.0:
            raise InvalidOptionsError(
                "deformation_gain needs positive stretches: give stretch_min > 0"
            )
        self._check_alignment()

    def _check_alignment(self) -> None:
        if isinstance(self.alignment, str):
            if self.alignment not in ("world", "palm"):
                raise InvalidOptionsError(
                    f"alignment: expected world, palm or a rotation; got {self.alignment!r}"
                )
            return
        try:
            rotation = np.asarray(self.alignment, dtype=float)
        except (TypeError, ValueError):
            rotation = np.empty(0)
        is_finite = rotation.shape == (3, 3) and bool(np.isfinite(rotation).all())
        if not (is_finite and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6):
            raise InvalidOptionsError(
                f"alignment: expected world, palm or a rotation (3, 3); got {self.alignment}"
            )
        if np.linalg.det(rotation) < 0.0:
            raise InvalidOptionsError(
                "alignment: the matrix mirrors; map a left hand with a left hand's URDF instead"
            )


def _is_point(value: Any) -> bool:
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        return False
    return array.shape == (3,) and bool(np.isfinite(array).all())


_MAY_BE_INFINITE = ("stretch_max", "joint_tolerance")

TELEMANIPULATION = MappingOptions(
    rigid_from="wrist", pivot="palm", residual_gain=1.0, deformation_gain=0.5
)
"""Choices for a tracked wrist and a robot whose points name partners: the wrist goes where the
human's does, and fingers follow fingers. The defaults are the paper's, which need neither."""
