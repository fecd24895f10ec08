"""Sources of the rigid part T_rb: one class for each value of `MappingOptions.rigid_from`."""

from __future__ import annotations

from typing import Protocol, get_args

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError
from handmap_qp.mapping.options import RigidFrom

_IDENTITY = np.eye(3)
_IDENTITY.setflags(write=False)


class Displacement(msgspec.Struct, frozen=True, eq=False):
    """A rigid motion, by its rotation and the image of one point.

    Attributes:
        rotation: Shape (3, 3).
        image: Where it takes the pivot [m], shape (3,).
    """

    rotation: np.ndarray
    image: np.ndarray


class RigidPart(Protocol):
    """A choice of T_rb.

    Attributes:
        needs_wrist: True if it needs the wrist pose of every sample.
        moves_wrist: True if the robot's wrist has to move.
    """

    needs_wrist: bool
    moves_wrist: bool

    def prior(
        self, wrist_before: np.ndarray | None, wrist_now: np.ndarray | None
    ) -> np.ndarray | None:
        """Return the prior rotation of the estimate of T, shape (3, 3); None for Kabsch's."""
        ...

    def part(
        self,
        polar: Displacement,
        pivot: np.ndarray,
        wrist_before: np.ndarray | None,
        wrist_now: np.ndarray | None,
    ) -> Displacement:
        """Return T_rb.

        Args:
            polar: The polar rotation of T, and where T takes the pivot.
            pivot: c_h [m], shape (3,).
            wrist_before: Wrist pose at the reference, shape (4, 4).
            wrist_now: Wrist pose now, shape (4, 4).
        """
        ...


class FromPoints:
    """The polar factor of T: the paper."""

    needs_wrist, moves_wrist = False, True

    def prior(self, wrist_before: np.ndarray | None, wrist_now: np.ndarray | None) -> None:
        """Leave the prior to the points."""

    def part(
        self,
        polar: Displacement,
        pivot: np.ndarray,
        wrist_before: np.ndarray | None,
        wrist_now: np.ndarray | None,
    ) -> Displacement:
        """Return the polar rotation; the pivot goes where T takes it."""
        return polar


class FromWrist:
    """The measured displacement of the wrist; T_def is the rest of T."""

    needs_wrist, moves_wrist = True, True

    def prior(self, wrist_before: np.ndarray | None, wrist_now: np.ndarray | None) -> np.ndarray:
        """Return the wrist's rotation since the reference."""
        before, now = _both(wrist_before, wrist_now)
        return now[:3, :3].dot(before[:3, :3].T)

    def part(
        self,
        polar: Displacement,
        pivot: np.ndarray,
        wrist_before: np.ndarray | None,
        wrist_now: np.ndarray | None,
    ) -> Displacement:
        """Return the wrist's rotation, and where its rigid motion takes the pivot."""
        before, now = _both(wrist_before, wrist_now)
        rotation = now[:3, :3].dot(before[:3, :3].T)
        return Displacement(rotation, rotation.dot(pivot - before[:3, 3]) + now[:3, 3])


class Still:
    """The identity: the robot's wrist stays, and the fingers take all of T."""

    needs_wrist, moves_wrist = False, False

    def prior(self, wrist_before: np.ndarray | None, wrist_now: np.ndarray | None) -> None:
        """Leave the prior to the points."""

    def part(
        self,
        polar: Displacement,
        pivot: np.ndarray,
        wrist_before: np.ndarray | None,
        wrist_now: np.ndarray | None,
    ) -> Displacement:
        """Return the identity."""
        return Displacement(_IDENTITY, pivot)


RIGID_PARTS: dict[str, RigidPart] = dict(
    zip(get_args(RigidFrom), (FromPoints(), FromWrist(), Still()), strict=True)
)
"""The choices of `MappingOptions.rigid_from`, in the order of its type."""


def _both(before: np.ndarray | None, now: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    if before is None or now is None:
        raise InvalidInputError(argument="wrist_pose", problem="needed for rigid_from='wrist'")
    return before, now
