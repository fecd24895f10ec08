"""A grasp as a value: a hand, an object and their contacts (Sec. IV of the paper).

`Grasp` gives its contacts in the world, its grasp matrix G and its contact Jacobian J. Conventions
are those of `handmap_qp.grasp.statics`: hard-finger contacts, world axes, torques about the
object's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.errors import InvalidInputError
from handmap_qp.grasp.checks import finite_array
from handmap_qp.grasp.objects import Shape
from handmap_qp.grasp.statics import QuasiStatic, Stiffness, grasp_matrix, quasistatic
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PointSpec, Vector
from handmap_qp.se3 import check_pose, transform_points


@dataclass(frozen=True, slots=True)
class Contact:
    """A contact point, fixed to a link of the hand.

    Attributes:
        link: Link of the hand's URDF.
        xyz: Position in link coordinates [m].
        normal: Unit vector into the object, in link coordinates; normalised at construction.
        finger: Anatomical name of the finger, as in `PointSpec`.

    Raises:
        InvalidInputError: If a number is not finite or the normal is zero.
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
                argument="normal", expected="a vector of non-zero length", value=self.normal
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
        object_pose: Pose of the object in the world, shape (4, 4); wrenches are about its origin.
        contacts: The n_c contacts.
        wrist_pose: Pose of the wrist in the world, shape (4, 4); None is the identity. It must be
            None for a hand with a fixed wrist.
        shape: Shape of the object, if known.

    Raises:
        InvalidInputError: On a wrong shape, an invalid pose, or a link that the hand does not have.
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
        object.__setattr__(self, "contacts", _check_contacts(self.contacts))
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
        """Positions of the contacts in the world [m], shape (n_c, 3)."""
        return contact_points(self.hand, self.contacts, self.q, self.wrist_pose)

    @property
    def normals(self) -> np.ndarray:
        """Unit normals of the contacts into the object, world axes, shape (n_c, 3)."""
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
        """The contacts as reference points (the paper's choice): `hand.with_points(...)`."""
        return _point_specs(self.contacts)

    def moved(self, motion: npt.ArrayLike) -> Self:
        """Return the same grasp after one rigid motion of hand and object.

        Args:
            motion: Rigid motion in world axes, shape (4, 4).

        Returns:
            The moved grasp.

        Raises:
            InvalidInputError: If the motion is not rigid, or the hand's wrist is fixed.
        """
        if not self.hand.is_floating:
            raise InvalidInputError(
                problem=f"the wrist of {self.hand.name} is fixed, so the grasp cannot be moved",
                advice="load the hand with mount='floating'",
            )
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
        """Response of this grasp to synergies; see `handmap_qp.grasp.statics.quasistatic`.

        Args:
            synergies: S, shape (n, n_z).
            contact_stiffness: K_c [N/m].
            joint_stiffness: K_q [N m/rad].
            synergy_stiffness: K_z [N m per unit].

        Returns:
            The response per unit of each synergy.

        Raises:
            InvalidInputError: As `quasistatic`, and if there is no contact.
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
    """Positions of contacts in the world.

    Args:
        hand: The hand.
        contacts: The contacts.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Pose of the wrist in the world, shape (4, 4); the identity if omitted.

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
    """Contact Jacobian: velocities of the contacts, fixed to their links, per joint velocity.

    Args:
        hand: The hand.
        contacts: The contacts.
        q: Joint angles [rad], shape (n,).
        wrist_pose: Pose of the wrist in the world, shape (4, 4); the identity if omitted. The
            wrist does not move.

    Returns:
        J [m/rad], shape (3 n_c, n). Rows are x, y, z of each contact in world axes; columns are in
        the order of `hand.joint_names`.

    Raises:
        InvalidInputError: On a wrong shape, or if there is no contact.
    """
    if not contacts:
        raise InvalidInputError(argument="contacts", expected="at least one contact", got="none")
    points = contact_points(hand, contacts, q, wrist_pose)
    data = hand.model.createData()
    pin.computeJointJacobians(hand.model, data, hand.configuration_vector(q, wrist_pose))
    pin.updateFramePlacements(hand.model, data)
    rows = []
    for contact, point in zip(contacts, points, strict=True):
        frame = hand.model.getFrameId(contact.link, pin.FrameType.BODY)
        velocity = pin.getFrameJacobian(
            hand.model, data, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED
        )
        # Velocity of the link's origin plus angular velocity times lever.
        rows.append(
            velocity[:3]
            + np.cross(velocity[3:], point - data.oMf[frame].translation, axisa=0, axisc=0)
        )
    J = np.vstack(rows)
    # Chain rule: add the mimic columns to the leader's.
    return (J if hand.expansion is None else J @ hand.expansion.matrix)[:, hand.joint_columns]


def _check_contacts(contacts: Any) -> tuple[Contact, ...]:
    is_sequence = isinstance(contacts, list | tuple)
    if not is_sequence or not all(isinstance(contact, Contact) for contact in contacts):
        raise InvalidInputError(argument="contacts", expected="a tuple of Contact", value=contacts)
    return tuple(contacts)


def _point_specs(contacts: tuple[Contact, ...]) -> tuple[PointSpec, ...]:
    return tuple(
        PointSpec(f"contact_{i}", contact.link, contact.xyz, contact.finger)
        for i, contact in enumerate(contacts, 1)
    )
