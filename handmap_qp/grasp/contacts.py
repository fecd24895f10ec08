"""Grasps: contacts on the links of a hand, and the grasp as a value (Sec. IV of the paper).

`Grasp` knows its contacts in the world, its grasp matrix G and its contact Jacobian J, and answers
to synergies by `handmap_qp.grasp.statics`, whose conventions hold here too: hard fingers, world
axes, torques about the object's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.objects import Shape
from handmap_qp.grasp.statics import QuasiStatic, Stiffness, finite_array, grasp_matrix, quasistatic
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PointSpec, Vector
from handmap_qp.transform import check_pose, transform_points


@dataclass(frozen=True, slots=True)
class Contact:
    """A place on a link that touches the object; it moves with the link.

    Attributes:
        link: Link of the hand's URDF.
        xyz: Place in link coordinates [m].
        normal: Unit vector into the object, in link coordinates; normalised on the way in.
        finger: Anatomical name of the finger, as in `PointSpec`.

    Raises:
        InvalidInputError: If a number is not finite or the normal has no direction.
    """

    link: str
    xyz: Vector
    normal: Vector
    finger: str | None = None

    def __post_init__(self) -> None:
        xyz = finite_array(self.xyz, (3,), "xyz")
        normal = finite_array(self.normal, (3,), "normal")
        length = float(np.linalg.norm(normal))
        if not length > 1e-9:
            raise InvalidInputError(
                f"normal: expected a direction, got {self.normal}", value=self.normal
            )
        x, y, z = map(float, xyz)
        object.__setattr__(self, "xyz", (x, y, z))
        x, y, z = map(float, normal / length)
        object.__setattr__(self, "normal", (x, y, z))


@dataclass(frozen=True, slots=True, eq=False)
class Grasp:
    """A hand that holds an object.

    Attributes:
        hand: The hand.
        q: Joint angles in the order of `hand.joint_names` [rad], shape (n,).
        object_pose: The object in the world, shape (4, 4); wrenches are about its origin.
        contacts: Where they touch; n_c of them.
        wrist_pose: The wrist in the world, shape (4, 4); None is the identity, and all that a fixed
            hand takes.
        shape: The object's shape, where it is known.

    Raises:
        InvalidInputError: On a wrong shape, a pose that is none, or a link that the hand does not
            have.
    """

    hand: Hand
    q: np.ndarray
    object_pose: np.ndarray
    contacts: tuple[Contact, ...]
    wrist_pose: np.ndarray | None = None
    shape: Shape | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "q", finite_array(self.q, (len(self.hand.joint_names),), "q"))
        object.__setattr__(
            self,
            "object_pose",
            finite_array(check_pose(self.object_pose, "object_pose"), (4, 4), "object_pose"),
        )
        object.__setattr__(self, "contacts", tuple(self.contacts))
        if self.wrist_pose is not None:
            object.__setattr__(
                self,
                "wrist_pose",
                finite_array(check_pose(self.wrist_pose, "wrist_pose"), (4, 4), "wrist_pose"),
            )
        self._link_poses()

    @property
    def centre(self) -> np.ndarray:
        """The object's centre in the world [m], shape (3,)."""
        return self.object_pose[:3, 3].copy()

    @property
    def points(self) -> np.ndarray:
        """The contacts in the world [m], shape (n_c, 3)."""
        return contact_points(self.hand, self.contacts, self.q, self.wrist_pose)

    @property
    def normals(self) -> np.ndarray:
        """The contacts' unit normals into the object, in the world, shape (n_c, 3)."""
        normals = np.array([contact.normal for contact in self.contacts]).reshape(-1, 3)
        return np.einsum("cij,cj->ci", self._link_poses()[:, :3, :3], normals)

    @property
    def matrix(self) -> np.ndarray:
        """The grasp matrix G, shape (6, 3 n_c)."""
        return grasp_matrix(self.points, self.centre)

    @property
    def jacobian(self) -> np.ndarray:
        """The contact Jacobian J [m/rad], shape (3 n_c, n)."""
        return contact_jacobian(self.hand, self.contacts, self.q, self.wrist_pose)

    @property
    def point_specs(self) -> tuple[PointSpec, ...]:
        """The contacts as reference points, which is what the paper maps.

        `hand.with_points(grasp.point_specs)`.
        """
        return _point_specs(self.contacts)

    def moved(self, motion: npt.ArrayLike) -> Self:
        """The same grasp elsewhere: hand and object carried by one rigid motion.

        Args:
            motion: Rigid motion in the world, shape (4, 4).

        Returns:
            The moved grasp.

        Raises:
            InvalidInputError: If the motion is not rigid, or the hand's wrist is fixed.
        """
        if not self.hand.is_floating:
            raise InvalidInputError(f"{self.hand.name} has a fixed wrist and cannot be moved")
        rigid = check_pose(motion, "motion")
        wrist = np.eye(4) if self.wrist_pose is None else self.wrist_pose
        return type(self)(
            self.hand, self.q, rigid @ self.object_pose, self.contacts, rigid @ wrist, self.shape
        )

    def quasistatic(
        self,
        synergies: npt.ArrayLike,
        *,
        contact_stiffness: Stiffness,
        joint_stiffness: Stiffness,
        synergy_stiffness: Stiffness,
    ) -> QuasiStatic:
        """How this grasp answers to synergies.

        See `quasistatic`, here in newtons, metres and radians.
        """
        return quasistatic(
            self.jacobian,
            self.matrix,
            synergies,
            contact_stiffness=contact_stiffness,
            joint_stiffness=joint_stiffness,
            synergy_stiffness=synergy_stiffness,
        )

    def _link_poses(self) -> np.ndarray:
        return self.hand.link_poses(
            [contact.link for contact in self.contacts], self.q, self.wrist_pose
        )


def contact_points(
    hand: Hand,
    contacts: tuple[Contact, ...],
    q: npt.ArrayLike,
    wrist_pose: np.ndarray | None = None,
) -> np.ndarray:
    """Where contacts are.

    Args:
        hand: The hand.
        contacts: The contacts.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted.

    Returns:
        Points in the world [m], shape (n_c, 3).

    Raises:
        InvalidInputError: On a wrong shape, or a link that the hand does not have.
    """
    poses = hand.link_poses([contact.link for contact in contacts], q, wrist_pose)
    placed = zip(poses, contacts, strict=True)
    return np.array(
        [transform_points(pose, np.array(contact.xyz)) for pose, contact in placed]
    ).reshape(-1, 3)


def contact_jacobian(
    hand: Hand,
    contacts: tuple[Contact, ...],
    q: npt.ArrayLike,
    wrist_pose: np.ndarray | None = None,
) -> np.ndarray:
    """The hand's Jacobian at the contacts.

    Their velocities, as places on their links, per joint velocity.

    Args:
        hand: The hand.
        contacts: The contacts.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Wrist in the world, shape (4, 4); the identity if omitted. It stands still.

    Returns:
        J [m/rad], world axes, x, y, z of each contact in turn, columns in the order of
        `hand.joint_names`, shape (3 n_c, n).

    Raises:
        InvalidInputError: On a wrong shape, or if there is no contact.
    """
    if not contacts:
        raise InvalidInputError("contacts: expected at least one", value=contacts)
    places = contact_points(hand, contacts, q, wrist_pose)
    data = hand.model.createData()
    pin.computeJointJacobians(hand.model, data, hand.configuration_vector(q, wrist_pose))
    pin.updateFramePlacements(hand.model, data)
    rows = []
    for contact, place in zip(contacts, places, strict=True):
        frame = hand.model.getFrameId(contact.link, pin.FrameType.BODY)
        velocity = pin.getFrameJacobian(
            hand.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        # The link's own velocity, and what its rotation adds at the contact.
        rows.append(
            velocity[:3]
            + np.cross(velocity[3:], place - data.oMf[frame].translation, axisa=0, axisc=0)
        )
    J = np.vstack(rows)
    # Where joints follow others, what they add belongs to their leaders.
    return (J if hand.expansion is None else J @ hand.expansion.matrix)[:, hand.joint_columns]


def _point_specs(contacts: tuple[Contact, ...]) -> tuple[PointSpec, ...]:
    return tuple(
        PointSpec(f"contact_{i}", contact.link, contact.xyz, contact.finger)
        for i, contact in enumerate(contacts, 1)
    )
