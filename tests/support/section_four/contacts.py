"""A grasp as a value: a hand, an object and their contacts (Sec. IV of the paper).

Conventions are those of `statics`: hard-finger contacts, world axes, torques about
the object's centre.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from checks import finite_array

from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PointSpec, Vector
from handmap_qp.mapping.objects import Shape
from handmap_qp.se3 import check_pose
from section_four.statics import grasp_matrix


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
                argument="normal",
                expected="a vector of non-zero length",
                value=self.normal,
            )
        object.__setattr__(self, "xyz", tuple(xyz.tolist()))
        object.__setattr__(self, "normal", tuple((normal / length).tolist()))


@dataclass(frozen=True, eq=False)
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
        object.__setattr__(
            self, "q", finite_array(self.q, (len(self.hand.joint_names),), "q")
        )
        for name in ("object_pose", "wrist_pose"):
            if name == "object_pose" or self.wrist_pose is not None:
                pose = check_pose(getattr(self, name), name)
                object.__setattr__(self, name, finite_array(pose, (4, 4), name))
        is_sequence = isinstance(self.contacts, list | tuple)
        if not is_sequence or not all(
            isinstance(one, Contact) for one in self.contacts
        ):
            raise InvalidInputError(
                argument="contacts", expected="a tuple of Contact", value=self.contacts
            )
        object.__setattr__(self, "contacts", tuple(self.contacts))
        self._link_poses()

    @property
    def wrist(self) -> np.ndarray:
        """Pose of the wrist in the world, shape (4, 4)."""
        return np.eye(4) if self.wrist_pose is None else self.wrist_pose

    @property
    def centre(self) -> np.ndarray:
        """The object's centre in the world [m], shape (3,)."""
        return self.object_pose[:3, 3].copy()

    @cached_property
    def contact_hand(self) -> Hand:
        """The hand with its contacts as reference points (the paper's choice)."""
        if not self.contacts:
            raise InvalidInputError(
                argument="contacts", expected="at least one contact", got="none"
            )
        return self.hand.with_points(
            tuple(
                PointSpec(f"contact_{i}", contact.link, contact.xyz, contact.finger)
                for i, contact in enumerate(self.contacts, 1)
            )
        )

    @property
    def points(self) -> np.ndarray:
        """Positions of the contacts in the world [m], shape (n_c, 3)."""
        if not self.contacts:
            return np.zeros((0, 3))
        return self.contact_hand.points(self.q, self.wrist_pose)

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
        """Velocities of the contacts, fixed to their links, per joint velocity: J (3 n_c, n)."""
        return self.contact_hand.point_jacobian(self.q, self.wrist_pose)

    def _link_poses(self) -> np.ndarray:
        return self.hand.link_poses(
            [contact.link for contact in self.contacts], self.q, self.wrist_pose
        )
