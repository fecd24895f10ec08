"""Layouts of joints as points or poses: headsets, cameras, parametric hand models."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.spec import Side
from handmap_qp.human.landmarks import PALM
from handmap_qp.human.sample import LANDMARK_COUNT, LANDMARK_NAMES, HumanSample
from handmap_qp.se3 import affine, inverse_pose, quat_wxyz_from_rotation, rigid_fit
from handmap_qp.trackers.layouts.base import (
    UNITS,
    AxesTable,
    Hands,
    Layout,
    LayoutTable,
    QuatOrder,
    WristTable,
    from_own_axes,
    poses_of_sevens,
    sized_human,
    to_own_axes,
)

_OUR_AXES = AxesTable("+y", "+z")
_FORMS = {3: (3,), 7: (7,), 16: (4, 4)}
"""Shapes of a joint, by how many numbers it has."""


class BetweenTable(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A joint on the line through two landmarks, for writing: it is not read.

    Attributes:
        start: The first landmark.
        end: The second one.
        share: 0 at the first landmark and 1 at the second one.
    """

    start: str
    end: str
    share: float


class PointTable(
    LayoutTable, frozen=True, forbid_unknown_fields=True, tag="points", kw_only=True
):
    """A layout of joints.

    Attributes:
        count: Number of joints.
        landmarks: Index of each of our 21 landmarks, in our order; of a left hand separately where
            it has other ones.
        left_landmarks: The same for a left hand; those of the right one if omitted.
        names: Names of the joints by index; `joint 0` and so on for those without.
        poses: Forms of a joint: its position (3), position and quaternion (7), a 4 x 4 matrix.
        quaternion: Order of the quaternions.
        wrist: How a wrist pose is obtained; None if it cannot be.
        is_relative: Whether joints are given in the frame of the wrist instead of in the world.
        between: Joints besides the landmarks, for writing.
    """

    count: int
    landmarks: tuple[int, ...]
    left_landmarks: tuple[int, ...] | None = None
    names: dict[int, str] = msgspec.field(default_factory=dict)
    poses: tuple[int, ...] = (3,)
    quaternion: QuatOrder = "xyzw"
    wrist: WristTable | None = None
    is_relative: bool = False
    between: dict[int, BetweenTable] = msgspec.field(default_factory=dict)


class PointLayout(Layout[PointTable]):
    """A layout of joints as points or poses.

    Args:
        table: The table.

    Raises:
        InvalidInputError: If the table contradicts itself.
    """

    def __init__(self, table: PointTable) -> None:
        super().__init__(table)
        self._indices = {
            "right": np.array(table.landmarks, dtype=int),
            "left": np.array(table.left_landmarks or table.landmarks, dtype=int),
        }
        for name, indices in self._indices.items():
            if (
                len(indices) != LANDMARK_COUNT
                or len(set(indices.tolist())) != LANDMARK_COUNT
            ):
                expected = f"{LANDMARK_COUNT} different indices"
                key = "landmarks" if name == "right" else "left_landmarks"
                raise InvalidInputError(
                    argument=key, expected=expected, got=f"{len(indices)}"
                )
            if indices.min() < 0 or indices.max() >= table.count:
                expected = f"indices below count, {table.count}"
                raise InvalidInputError(
                    argument="landmarks", expected=expected, value=indices
                )
        if not table.poses or not set(table.poses) <= set(_FORMS):
            raise InvalidInputError(
                argument="poses", expected="some of 3, 7 and 16", value=table.poses
            )
        self._scale = UNITS[table.unit]
        joint = None if table.wrist is None else table.wrist.joint
        names = {name: index for index, name in table.names.items()}
        if joint is not None and joint not in names:
            raise InvalidInputError(
                argument="wrist.joint", expected="one of the names", value=joint
            )
        self._wrist_index = None if joint is None else names[joint]
        self.shapes = tuple((table.count, *_FORMS[size]) for size in table.poses)
        self.columns = tuple(
            f"{self.joint_name(i)}_{a}" for i in range(table.count) for a in "xyz"
        )
        self.has_wrist = joint is not None and table.poses != (3,)

    def joint_name(self, index: int) -> str:
        """Return the name of a joint."""
        return self.table.names.get(index, f"joint {index}")

    def order(self, side: Side) -> np.ndarray:
        """Return the index of each of our landmarks, shape (21,)."""
        return self._indices[side]

    def rows(self) -> list[dict[str, Any]]:
        """Describe every joint."""
        ours = {
            side: {
                int(i): name for i, name in zip(indices, LANDMARK_NAMES, strict=True)
            }
            for side, indices in self._indices.items()
        }
        is_one = self.table.left_landmarks is None
        rows: list[dict[str, Any]] = []
        for index in range(self.table.count):
            found = {"landmark": ours["right"].get(index, "")}
            if not is_one:
                found["landmark of a left hand"] = ours["left"].get(index, "")
            if index in self.table.names or any(found.values()):
                rows.append({"index": index, "joint": self.joint_name(index), **found})
        return rows

    def hands(
        self,
        values: np.ndarray,
        side: Side,
        wrists: np.ndarray | None = None,
        lengths: HumanLengths | None = None,
    ) -> Hands:
        """Turn joints into landmarks and wrist poses; see `Layout.hands`."""
        reflection = self.table.reflection
        positions = (
            values[..., :3, 3] if values.shape[2:] == (4, 4) else values[..., :3]
        )
        landmarks = positions[:, self.order(side)] * (self._scale * reflection)
        if self.table.is_relative:
            # Joints are in the tracker's wrist frame; without its pose, that is the world.
            if wrists is not None:
                frames = wrists @ self._axes_in_own_frame(side)
                landmarks = landmarks @ frames[:, :3, :3].transpose(0, 2, 1)
                landmarks = landmarks + frames[:, None, :3, 3]
            return Hands(landmarks, wrists)
        if self._wrist_index is not None and values.shape[2:] != (3,):
            assert self.table.wrist is not None  # it names the joint
            poses = values[:, self._wrist_index]
            if poses.shape[1:] == (7,):
                poses = poses_of_sevens(poses, self.table.quaternion, "values")
            axes = self.table.wrist.axes(side)
            wrists = to_own_axes(poses, axes, reflection, self._scale)
        return Hands(landmarks, wrists)

    def write(self, sample: HumanSample) -> np.ndarray:
        """Return the joints of a sample; those between landmarks are placed on lines."""
        if not sample.valid:
            raise InvalidInputError(
                argument="sample", expected="a valid sample", got="another"
            )
        wrist = sample.wrist
        if wrist is None:
            model = sized_human(sample.side)
            wrist = rigid_fit(model.points(model.rest)[PALM], sample.landmarks[PALM])
        return self._write(sample.landmarks, wrist, sample.side)

    def write_posture(
        self, human: Hand, q: npt.ArrayLike, wrist: np.ndarray
    ) -> np.ndarray:
        """Return the joints of the human hand; see `Layout.write_posture`."""
        names = tuple(point.name for point in human.reference_points)
        model = human if names == LANDMARK_NAMES else human.with_points("landmarks")
        landmarks = model.points(q)
        side = human.spec.side
        return self._write(landmarks @ wrist[:3, :3].T + wrist[:3, 3], wrist, side)

    def _write(
        self, landmarks: np.ndarray, wrist: np.ndarray, side: Side
    ) -> np.ndarray:
        joints = np.tile(landmarks[0], (self.table.count, 1))
        joints[self.order(side)] = landmarks
        places = dict(zip(LANDMARK_NAMES, landmarks, strict=True))
        for index, between in self.table.between.items():
            start, end = places[between.start], places[between.end]
            joints[index] = start + between.share * (end - start)
        size = self.table.poses[0]
        if self.table.is_relative:
            frame = inverse_pose(wrist @ self._axes_in_own_frame(side))
            joints = joints @ frame[:3, :3].T + frame[:3, 3]
            wrist = inverse_pose(self._axes_in_own_frame(side))
        if size == 3:
            return joints * self.table.reflection / self._scale
        # Every joint has the orientation of the wrist: only that one is read.
        poses = np.array([affine(wrist[:3, :3], joint) for joint in joints])
        axes = _OUR_AXES if self.table.wrist is None else self.table.wrist.axes(side)
        theirs = from_own_axes(poses, axes, self.table.reflection, self._scale)
        return theirs if size == 16 else self._as_sevens(theirs)

    def _as_sevens(self, poses: np.ndarray) -> np.ndarray:
        quats = np.array([quat_wxyz_from_rotation(pose[:3, :3]) for pose in poses])
        order = [0, 1, 2, 3] if self.table.quaternion == "wxyz" else [1, 2, 3, 0]
        return np.concatenate([poses[:, :3, 3], quats[:, order]], axis=1)

    def _axes_in_own_frame(self, side: Side) -> np.ndarray:
        """Return the pose of the tracker's wrist axes in our wrist frame, shape (4, 4)."""
        if self.table.wrist is None:
            return np.eye(4)
        rotation = self.table.wrist.axes(side).rotation(self.table.reflection)
        return affine(rotation, np.zeros(3))
