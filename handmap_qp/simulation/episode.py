"""What happened in a simulation: `Episode`, and the `Recorder` that collects it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.hands.hand import Hand
from handmap_qp.se3 import inverse_pose
from handmap_qp.simulation.physics import Body
from handmap_qp.simulation.simulator import Simulator


@dataclass(frozen=True, slots=True, eq=False)
class Episode:
    """A simulation as columns of T instants.

    Attributes:
        hand: The hand.
        body: The object.
        time: Simulated time [s], shape (T,).
        q: Joint angles in the order of `hand.joint_names` [rad], shape (T, n).
        command: Commanded joint angles [rad], shape (T, n).
        wrist: Poses of the wrist, shape (T, 4, 4).
        object_pose: Poses of the object, shape (T, 4, 4).
        force: Sum of the normal forces of the hand on the object [N], shape (T,).
        sliding: Sum of the tangential forces' lengths over what friction allows, shape (T,); NaN
            without contact.
        touching: Number of joints whose links touch the object, shape (T,).
    """

    hand: Hand
    body: Body
    time: np.ndarray
    q: np.ndarray
    command: np.ndarray
    wrist: np.ndarray
    object_pose: np.ndarray
    force: np.ndarray
    sliding: np.ndarray
    touching: np.ndarray

    @property
    def object_in_wrist(self) -> np.ndarray:
        """Poses of the object in the wrist's frame, shape (T, 4, 4)."""
        return np.array(
            [inverse_pose(w) @ o for w, o in zip(self.wrist, self.object_pose, strict=True)]
        )

    @property
    def columns(self) -> dict[str, np.ndarray]:
        """Plain arrays by name, as written to a file."""
        return {
            "time": self.time,
            "joint_names": np.array(self.hand.joint_names),
            "q": self.q,
            "command": self.command,
            "wrist": self.wrist,
            "object_pose": self.object_pose,
            "normal_force": self.force,
            "friction_use": self.sliding,
            "links_touching": self.touching,
            "robot": np.array(self.hand.name),
            "object_mass": np.array(self.body.mass),
        }


class Recorder:
    """Collects instants of a simulation.

    Args:
        simulator: The simulation.
    """

    def __init__(self, simulator: Simulator) -> None:
        self._simulator = simulator
        self._rows: list[tuple] = []

    def sample(self) -> None:
        """Add the present instant."""
        simulator = self._simulator
        contacts = simulator.contacts()
        normal = np.einsum("ci,ci->c", contacts.forces, contacts.normals)
        tangential = np.linalg.norm(contacts.forces - normal[:, None] * contacts.normals, axis=1)
        allowed = simulator.physics.friction * normal.sum()
        self._rows.append(
            (
                simulator.time,
                simulator.q,
                simulator.command,
                simulator.wrist,
                simulator.object_pose,
                normal.sum(),
                tangential.sum() / allowed if allowed > 0.0 else np.nan,
                len(set(contacts.joints)),
            )
        )

    def episode(self) -> Episode:
        """Return everything collected so far."""
        columns = [np.array(column) for column in zip(*self._rows, strict=True)]
        return Episode(self._simulator.hand, self._simulator.body, *columns)
