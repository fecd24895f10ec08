"""Contacts of a simulated hand with its object, with their places and directions: `contacts`."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.apps.simulation.simulator import Simulator


class Contacts(NamedTuple):
    """Contacts between the hand and the object at one instant.

    Attributes:
        points: Places in the world [m], shape (n, 3).
        normals: Unit normals into the object, shape (n, 3).
        forces: Forces of the hand on the object, world axes [N], shape (n, 3).
        bodies: Name of the joint that carries the touching link, for each contact; `world` for
            the root of a hand that does not float.
    """

    points: np.ndarray
    normals: np.ndarray
    forces: np.ndarray
    bodies: tuple[str, ...]

    @property
    def normal_forces(self) -> np.ndarray:
        """Shares of the forces along the normals [N], shape (n,)."""
        return np.einsum("ci,ci->c", self.forces, self.normals)


def contacts(simulator: Simulator) -> Contacts:
    """Return the contacts between the hand and the object."""
    model = simulator.model
    data = simulator.data
    contact = data.contact
    is_object = contact.geom == model.geom(OBJECT).id
    rows = np.flatnonzero(is_object.any(axis=1) & (contact.efc_address >= 0))
    forces = np.zeros((len(rows), 6))
    for row, force in zip(rows, forces, strict=True):
        mujoco.mj_contactForce(model, data, row, force)
    # A frame's x axis points from the first geom to the second, on which the force acts.
    signs = np.where(is_object[rows, 1], 1.0, -1.0)
    frames = signs[:, None, None] * contact.frame[rows].reshape(-1, 3, 3)
    touching = model.geom_bodyid[contact.geom[rows][~is_object[rows]]]
    return Contacts(
        points=contact.pos[rows],
        normals=frames[:, 0],
        forces=np.einsum("cij,ci->cj", frames, forces[:, :3]),
        bodies=tuple(model.body(body).name for body in touching),
    )
