"""A hand in one posture: the workspace of everything that runs sample by sample.

It holds Pinocchio's data, the reference points and their Jacobian; all memory is allocated once. It
also offers what `mink.build_ik` reads from a configuration (`model.nv`, `nv`, `q`).
"""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from handmap_qp.errors import InvalidInputError, StaleJacobianError
from handmap_qp.hands.placements import moved_by, placement_views

CROSS = np.zeros((3, 9))
"""Rows of -[p]x, flattened, are linear in p: `p @ CROSS == (-skew(p)).ravel()`."""
CROSS[0, [5, 7]] = 1.0, -1.0
CROSS[1, [2, 6]] = -1.0, 1.0
CROSS[2, [1, 3]] = 1.0, -1.0
_IDENTITY_6 = np.eye(6)


class Configuration:
    """One posture of a model, with its reference points.

    `place_frames` and `place_with_jacobians` put it somewhere else. Jacobians can be read only
    after the second one; after the first one they raise `StaleJacobianError`.

    Args:
        model: Pinocchio model whose last frames are the reference points.
        wrist_frame: Index of the wrist frame.
        first_point: Index of the first reference point's frame.
        expansion: From the active coordinates to the model's tangent space, shape (model.nv, k);
            None if all are active.

    Attributes:
        model: The model.
        data: Its Pinocchio data. Read the joint Jacobian from `joint_jacobian`, not from here.
        q: Configuration last placed, shape (nq,); a read-only view that follows every placement.
        points: Reference points in the world [m], shape (m, 3); a read-only view that follows
            every placement.
        wrist: Wrist frame, a `pinocchio.SE3` view that follows every placement.
        joints: Placements of the model's joints in the world, views that follow every placement.
        support: 1 where a velocity coordinate of the model moves a point's row or the wrist's,
            shape (3 m + 6, model.nv); read-only.
    """

    def __init__(
        self,
        model: pin.Model,
        *,
        wrist_frame: int,
        first_point: int,
        expansion: np.ndarray | None = None,
    ) -> None:
        self.model = model
        self.expansion = expansion
        self.data = model.createData()
        self._q = pin.neutral(model)
        self.q = self._q.view()
        self.q.setflags(write=False)
        self.points = placement_views(self.data.oMf, first_point).translations
        self.wrist = self.data.oMf[wrist_frame]
        self.joints = placement_views(self.data.oMi)
        self._has_jacobians = False
        self._joint_columns = self.data.J
        count = len(self.points)
        # data.J holds the spatial velocity of each joint at the world's origin: [I, -[p]x] takes it
        # to the point p.
        self._rows = np.zeros((3 * count + 6, 6))
        self._rows[: 3 * count, :3] = np.tile(np.eye(3), (count, 1))
        self._wrist_rows = self._rows[-6:]
        self._crosses = np.empty((count, 9))
        self._crosses_3 = self._crosses.reshape(count, 3, 3)
        self._angular = self._rows[: 3 * count].reshape(count, 3, 6)[:, :, 3:]
        self._jacobian = np.empty((3 * count + 6, model.nv))
        frames = [*range(first_point, len(model.frames)), wrist_frame]
        joints = [model.frames[frame].parentJoint for frame in frames]
        self.support = np.repeat(moved_by(model, joints), [3] * count + [6], axis=0)
        self.support.setflags(write=False)
        self.place_frames(self._q)

    @property
    def nv(self) -> int:
        """Number of active velocity coordinates, k: the wrist's and those of joints that lead."""
        return self.model.nv if self.expansion is None else self.expansion.shape[1]

    def place_frames(self, q: np.ndarray) -> None:
        """Put the model at a configuration and place its frames; Jacobians become invalid.

        Args:
            q: Pinocchio configuration, shape (nq,); its values are not checked.

        Raises:
            InvalidInputError: On a wrong shape or type.
        """
        try:
            pin.framesForwardKinematics(self.model, self.data, q)
        except (TypeError, ValueError) as error:
            raise self._wrong(q) from error
        self._has_jacobians = False
        self._q[:] = q

    def place_with_jacobians(self, q: np.ndarray) -> None:
        """Put the model at a configuration, place its frames and make Jacobians valid.

        Args:
            q: Pinocchio configuration, shape (nq,); its values are not checked.

        Raises:
            InvalidInputError: On a wrong shape or type.
        """
        try:
            pin.computeJointJacobians(self.model, self.data, q)
        except (TypeError, ValueError) as error:
            raise self._wrong(q) from error
        pin.updateFramePlacements(self.model, self.data)
        self._has_jacobians = True
        self._q[:] = q

    def displace(self, start: np.ndarray, displacement: np.ndarray) -> None:
        """Go from a configuration by a displacement; Jacobians become valid.

        Args:
            start: Pinocchio configuration, shape (nq,).
            displacement: Displacement in the active coordinates [rad or m], shape (k,).
        """
        step = displacement if self.expansion is None else self.expansion.dot(displacement)
        self.place_with_jacobians(pin.integrate(self.model, start, step))

    def joint_jacobian(self) -> np.ndarray:
        """Spatial velocity at the world's origin per velocity of the model.

        Returns:
            Jacobian, linear rows first, shape (6, model.nv); Pinocchio's own array: do not write
            to it.

        Raises:
            StaleJacobianError: If the model was placed without Jacobians.
        """
        if not self._has_jacobians:
            raise StaleJacobianError
        return self._joint_columns

    def point_jacobian(self) -> np.ndarray:
        """Jacobian of the points in the active coordinates, in world axes [m per unit].

        Returns:
            Jacobian, rows x, y, z of each point in turn, shape (3 m, k); a new array.

        Raises:
            StaleJacobianError: If the model was placed without Jacobians.
        """
        jacobian = self.stacked_jacobian(_IDENTITY_6) * self.support
        return self.contracted(jacobian[: 3 * len(self.points)])

    def wrist_jacobian(self, error_jacobian: np.ndarray) -> np.ndarray:
        """Body Jacobian of the wrist in the active coordinates.

        Args:
            error_jacobian: Factor on its left, shape (6, 6).

        Returns:
            `error_jacobian @ J_wrist`, shape (6, k); a new array.

        Raises:
            StaleJacobianError: If the model was placed without Jacobians.
        """
        return self.contracted((self.stacked_jacobian(error_jacobian) * self.support)[-6:])

    def contracted(self, jacobian: np.ndarray) -> np.ndarray:
        """Take a Jacobian over the model's tangent space to the active coordinates.

        Args:
            jacobian: Shape (r, model.nv).

        Returns:
            Jacobian, shape (r, k); the same array if all coordinates are active.
        """
        return jacobian if self.expansion is None else jacobian @ self.expansion

    def stacked_jacobian(self, error_jacobian: np.ndarray) -> np.ndarray:
        """Rows of all points and of the wrist as one product, to be masked by `support`.

        Args:
            error_jacobian: Derivative of the wrist task's error with respect to the wrist's body
                displacement, shape (6, 6).

        Returns:
            Unmasked Jacobian, shape (3 m + 6, model.nv); an internal buffer, overwritten by the
            next call.

        Raises:
            StaleJacobianError: If the model was placed without Jacobians.
        """
        if not self._has_jacobians:
            raise StaleJacobianError
        self.points.dot(CROSS, out=self._crosses)
        self._angular[:] = self._crosses_3
        error_jacobian.dot(self.wrist.toActionMatrixInverse(), out=self._wrist_rows)
        return self._rows.dot(self._joint_columns, out=self._jacobian)

    def _wrong(self, q: object) -> InvalidInputError:
        expected = f"a Pinocchio configuration of shape ({self.model.nq},)"
        return InvalidInputError(argument="q", expected=expected, value=q)
