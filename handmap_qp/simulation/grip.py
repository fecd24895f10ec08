"""A squeeze term: keep the force of a pinch where it is wanted (`GripForce`).

The mapped command closes the pads on an object that it does not know, so the force is what the
actuators' stiffness makes of the overlap. The term replaces that force, along the line between the
pads, by a wanted one. All other directions of the command stay as mapped.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.grasp.checks import positive_number
from handmap_qp.simulation.pads import PadFinder

# Step of the numerical Jacobian [rad].
_STEP = 1e-6


@dataclass(frozen=True, slots=True)
class GripForce:
    """A wanted force between the pads of thumb and finger.

    Attributes:
        force: The force [N].
    """

    force: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "force", positive_number(self.force, "force"))

    def command(
        self,
        pads: PadFinder,
        q: np.ndarray,
        command: np.ndarray,
        wrist: np.ndarray,
        stiffness: float,
    ) -> np.ndarray:
        """Return a command that presses the pads together with the wanted force.

        With the row `r = d(gap)/dq`, springs of stiffness k at `command` press with
        `f = -r k (command - q) / (r r)`. The result is `command + (f - f_0) r / k`.

        Args:
            pads: The pads.
            q: Joint angles now [rad], shape (n,).
            command: Mapped command [rad], shape (n,).
            wrist: Pose of the wrist, shape (4, 4).
            stiffness: Stiffness of the actuators [N m/rad].
        """
        gap = pads.gap(q, wrist)
        row = np.array(
            [(pads.gap(q + _STEP * unit, wrist) - gap) / _STEP for unit in np.eye(len(q))]
        )
        square = float(row @ row)
        if square < 1e-9:
            return command
        pressing = -stiffness * float(row @ (command - q)) / square
        return command + (pressing - self.force) / stiffness * row
