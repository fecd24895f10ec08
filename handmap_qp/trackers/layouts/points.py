"""Layouts of joints as points or poses: headsets, cameras, parametric hand models."""

import numpy as np
from numpy.typing import ArrayLike

from handmap_core.errors import expect
from handmap_core.se3 import (
    Array,
    QuatOrder,
    affine,
    inverse_pose,
    pose_from_xyz_quat,
    quat_wxyz_from_rotation,
    rigid_fit,
    transform_points,
)
from handmap_qp.hands import Document, Hand, HumanLengths, Side
from handmap_qp.human import (
    LANDMARK_COUNT,
    LANDMARK_NAMES,
    PALM,
    HumanSample,
    landmarks_at_rest,
)
from .base import Hands, Layout, Rows, sized_human

_FORMS = {3: (3,), 7: (7,), 16: (4, 4)}
"""Shapes of a joint, by how many numbers it has."""


class BetweenTable(Document, frozen=True):
    """A joint on the line through two landmarks, for writing: it is not read.

    Attributes:
        start: The first landmark.
        end: The second one.
        share: 0 at the first landmark and 1 at the second one.
    """

    start: str
    end: str
    share: float


class PointLayout(Layout, tag="points", kw_only=True):
    """A layout of joints as points or poses.

    Attributes:
        count: Number of joints.
        landmarks: Index of each of our 21 landmarks, in our order; of a left hand separately where
            it has other ones.
        left_landmarks: The same for a left hand; those of the right one if omitted.
        names: Names of the joints by index; `joint 0` and so on for those without.
        poses: Forms of a joint: its position (3), position and quaternion (7), a 4 x 4 matrix.
        quaternion: Order of the quaternions.
        is_relative: Whether joints are given in the frame of the wrist instead of in the world.
        between: Joints besides the landmarks, for writing.

    Raises:
        InvalidInputError: If the table contradicts itself.
    """

    count: int
    landmarks: tuple[int, ...]
    left_landmarks: tuple[int, ...] | None = None
    names: dict[int, str] = {}
    poses: tuple[int, ...] = (3,)
    quaternion: QuatOrder = "xyzw"
    is_relative: bool = False
    between: dict[int, BetweenTable] = {}
    is_costly = False

    def __post_init__(self) -> None:
        super().__post_init__()
        self._indices: dict[Side, Array] = {
            "right": _indices(self, "landmarks"),
            "left": _indices(self, "left_landmarks"),
        }
        expect(
            self.poses and set(self.poses) <= set(_FORMS),
            "poses",
            "some of 3, 7 and 16",
            value=self.poses,
        )
        joint = self.wrist and self.wrist.joint
        names = {name: index for index, name in self.names.items()}
        expect(
            joint is None or joint in names,
            "wrist.joint",
            "one of the names",
            value=joint,
        )
        self._wrist_index = names.get(joint)
        self.shapes = tuple((self.count, *_FORMS[size]) for size in self.poses)
        joints = map(self.joint_name, range(self.count))
        self.columns = tuple(f"{name}_{a}" for name in joints for a in "xyz")
        self.has_wrist = joint is not None and self.poses != (3,)

    def joint_name(self, index: int) -> str:
        """Return the name of a joint."""
        return self.names.get(index, f"joint {index}")

    def order(self, side: Side) -> Array:
        """Return the index of each of our landmarks, shape (21,)."""
        return self._indices[side]

    def rows(self) -> Rows:
        """Describe every joint."""
        titles: dict[Side, str] = {"right": "landmark"}
        if self.left_landmarks is not None:
            titles["left"] = "landmark of a left hand"
        landmarks = {
            title: dict(zip(self.order(side).tolist(), LANDMARK_NAMES, strict=True))
            for side, title in titles.items()
        }
        known = set().union(self.names, *landmarks.values())
        return [
            {"index": i, "joint": self.joint_name(i)}
            | {title: names.get(i, "") for title, names in landmarks.items()}
            for i in sorted(known)
        ]

    def hands(
        self,
        values: Array,
        side: Side,
        wrists: Array | None,
        lengths: HumanLengths | None,
    ) -> Hands:
        """Turn joints into landmarks and wrist poses; see `Layout.hands`."""
        form = values.shape[2:]
        positions = values[..., :3, 3] if form == (4, 4) else values[..., :3]
        frames = self.world
        if self.is_relative:
            # Joints are in the tracker's wrist frame; without its pose, that is the world.
            if wrists is not None:
                frames = wrists @ np.linalg.inv(self.wrist_axes(side))
        elif self._wrist_index is not None and form != (3,):
            poses = values[:, self._wrist_index]
            if form == (7,):
                poses = pose_from_xyz_quat(poses, self.quaternion)
            wrists = self.world @ poses @ self.wrist_axes(side)
        return transform_points(frames, positions[:, self.order(side)]), wrists

    def write(self, sample: HumanSample) -> Array:
        """Return the joints of a sample; those between landmarks are placed on lines."""
        expect(sample.valid, "sample", "a valid sample", got="another")
        wrist = sample.wrist
        if wrist is None:
            palm = landmarks_at_rest(sized_human(sample.side))[PALM]
            wrist = rigid_fit(palm, sample.landmarks[PALM])
        return self._write(sample.landmarks, wrist, sample.side)

    def write_posture(self, human: Hand, q: ArrayLike, wrist: Array) -> Array:
        """Return the joints of the human hand; see `Layout.write_posture`."""
        landmarks = human.with_points("landmarks").points(q, wrist)
        return self._write(landmarks, wrist, human.side)

    def _write(self, landmarks: Array, wrist: Array, side: Side) -> Array:
        joints = np.tile(landmarks[0], (self.count, 1))
        joints[self.order(side)] = landmarks
        places = dict(zip(LANDMARK_NAMES, landmarks, strict=True))
        for index, between in self.between.items():
            start = places[between.start]
            end = places[between.end]
            joints[index] = start + between.share * (end - start)
        axes = self.wrist_axes(side)
        frame = np.linalg.inv(self.world)
        if self.is_relative:
            frame = axes @ inverse_pose(wrist)
        joints = transform_points(frame, joints)
        # Every joint has the orientation of the wrist: only that one is read.
        turn = (frame @ wrist @ np.linalg.inv(axes))[:3, :3]
        size = self.poses[0]
        if size == 3:
            return joints
        if size == 16:
            return affine(np.tile(turn, (len(joints), 1, 1)), joints)
        quat = quat_wxyz_from_rotation(turn)
        if self.quaternion == "xyzw":
            quat = np.roll(quat, -1)
        return np.hstack([joints, np.tile(quat, (len(joints), 1))])


def _indices(table: PointLayout, key: str) -> Array:
    """Return the indices of our landmarks among all joints, which must differ."""
    given = getattr(table, key) or table.landmarks
    known = set(given) & set(range(table.count))
    expect(
        len(given) == len(known) == LANDMARK_COUNT,
        key,
        f"{LANDMARK_COUNT} different indices below count, {table.count}",
        value=given,
    )
    return np.array(given)
