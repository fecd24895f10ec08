"""A hand in one posture.

Pinocchio's data, the reference points and their Jacobian, with all memory allocated once.

This is the workspace of everything that runs sample by sample. It also offers what `mink.build_ik`
reads from a configuration (`model.nv`, `nv`, `q`).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pinocchio as pin

# Rows of -[p]x, flattened, are linear in p: p @ _CROSS == (-skew(p)).ravel().
_CROSS = np.zeros((3, 9))
_CROSS[0, [5, 7]] = 1.0, -1.0
_CROSS[1, [2, 6]] = -1.0, 1.0
_CROSS[2, [1, 3]] = 1.0, -1.0


class Configuration:
    """One posture of a model, with its reference points.

    Args:
        model: Pinocchio model whose last frames are the reference points.
        wrist_frame: Index of the wrist frame.
        first_point: Index of the first reference point's frame.
        expansion: From the active coordinates to the model's tangent space, shape (model.nv, k);
            None if all are active.

    Attributes:
        model: The model.
        data: Its Pinocchio data.
        q: Configuration last placed, shape (nq,).
        points: Reference points in the world [m], shape (m, 3); a view that follows every
            placement.
        wrist: Wrist frame, a `pinocchio.SE3` view that follows every placement.
        support: 1 where a velocity coordinate of the model moves a point's row or the wrist's,
            shape (3 m + 6, model.nv).
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
        self.q = pin.neutral(model)
        self.points = _translation_view(self.data, first_point, len(model.frames))
        self.wrist = self.data.oMf[wrist_frame]
        self._joint_columns = self.data.J
        count = len(self.points)
        # data.J holds the spatial velocity of each joint at the world's origin: [I, -[p]x] takes it
        # to the point p.
        self._rows = np.zeros((3 * count + 6, 6))
        self._rows[: 3 * count, :3] = np.tile(np.eye(3), (count, 1))
        self._crosses = np.empty((count, 9))
        self._crosses_3 = self._crosses.reshape(count, 3, 3)
        self._angular = self._rows[: 3 * count].reshape(count, 3, 6)[:, :, 3:]
        self._jacobian = np.empty((3 * count + 6, model.nv))
        frames = [*range(first_point, len(model.frames)), wrist_frame]
        joints = [model.frames[frame].parentJoint for frame in frames]
        self.support = np.repeat(
            [_support(model, joint) for joint in joints], [3] * count + [6], axis=0
        )

    @property
    def nv(self) -> int:
        """Number of active velocity coordinates, k.

        Those of the wrist and of the joints that follow no other.
        """
        return self.model.nv if self.expansion is None else self.expansion.shape[1]

    def place(self, q: np.ndarray) -> None:
        """Put the model at `q` and place its frames, without Jacobians."""
        pin.framesForwardKinematics(self.model, self.data, q)
        self.q[:] = q

    def update(self, q: np.ndarray) -> None:
        """Put the model at `q`, place its frames and compute what the Jacobians need."""
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)
        self.q[:] = q

    def displace(self, start: np.ndarray, displacement: np.ndarray) -> None:
        """Update to where a displacement in the active coordinates, shape (k,), leads from a configuration."""
        step = displacement if self.expansion is None else self.expansion.dot(displacement)
        self.update(pin.integrate(self.model, start, step))

    def point_jacobian(self) -> np.ndarray:
        """Jacobian of the points in the active coordinates, world axes [m per unit], shape (3 m, k)."""
        return self.contracted(
            (self.stacked_jacobian(np.eye(6)) * self.support)[: 3 * len(self.points)]
        )

    def wrist_jacobian(self, error_jacobian: np.ndarray) -> np.ndarray:
        """Body Jacobian of the wrist in the active coordinates, with `error_jacobian` (6, 6) on its left, shape (6, k)."""
        return self.contracted((self.stacked_jacobian(error_jacobian) * self.support)[-6:])

    def contracted(self, jacobian: np.ndarray) -> np.ndarray:
        """A Jacobian over the model's tangent space, shape (r, model.nv), over the active coordinates, shape (r, k)."""
        return jacobian if self.expansion is None else jacobian @ self.expansion

    def stacked_jacobian(self, error_jacobian: np.ndarray) -> np.ndarray:
        """Rows of all points and of the wrist as one product, to be masked by `support`.

        Args:
            error_jacobian: Derivative of the wrist task's error with respect to the wrist's body
                displacement, shape (6, 6).

        Returns:
            Unmasked Jacobian, shape (3 m + 6, model.nv); an internal buffer, overwritten by the
            next call.
        """
        np.dot(self.points, _CROSS, out=self._crosses)
        self._angular[:] = self._crosses_3
        np.dot(error_jacobian, self.wrist.toActionMatrixInverse(), out=self._rows[-6:])
        return np.dot(self._rows, self._joint_columns, out=self._jacobian)


def _support(model: pin.Model, joint: int) -> np.ndarray:
    """1 for every velocity coordinate that moves a joint's frame, shape (nv,)."""
    moved = np.zeros(model.nv)
    for ancestor in model.supports[joint]:
        start = model.joints[ancestor].idx_v
        moved[start : start + model.joints[ancestor].nv] = ancestor > 0
    return moved


def _translation_view(data: pin.Data, first: int, stop: int) -> np.ndarray:
    """All translations of consecutive frames as one array that shares Pinocchio's memory.

    `data.oMf` is a vector of SE3, each twelve doubles in one block, so consecutive translations lie
    a fixed stride apart. That is checked here rather than believed.
    """
    placements = data.oMf
    views = [placements[frame].translation for frame in range(first, stop)]
    if len(views) == 1:
        return views[0].reshape(1, 3)
    addresses = [view.__array_interface__["data"][0] for view in views]
    stride = addresses[1] - addresses[0]
    if any(after - before != stride for before, after in pairwise(addresses)):
        raise RuntimeError("Pinocchio's frame placements are not evenly spaced in memory")
    return np.lib.stride_tricks.as_strided(views[0], (len(views), 3), (stride, 8))
