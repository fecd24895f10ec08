"""Where a robot's pads come together when nothing is between them: `Closing`.

The mapped motion is simulated without an object. Actuators lag behind their commands by some 50 ms,
so the pads meet later and, as the wrist moves meanwhile, elsewhere than commanded.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from handmap_qp.grasp.objects import Sphere
from handmap_qp.se3 import affine
from handmap_qp.simulation.actuators import Actuators
from handmap_qp.simulation.commands import Commands, between_poses
from handmap_qp.simulation.pads import PadFinder
from handmap_qp.simulation.physics import Body, Physics
from handmap_qp.simulation.pinch_window import PinchWindow
from handmap_qp.simulation.simulator import Simulator

# The robot's pads meet this long after the human's, at the latest [s]; filters make some late.
_LAG = 1.0
# Instants between two samples at which the closing is looked at.
_PARTS = 4
# The object of this simulation, far from the hand.
_NOTHING, _FAR = Body(Sphere(0.01), 0.01), affine(np.eye(3), np.array([0.0, 0.0, 100.0]))


class Meeting(NamedTuple):
    """The robot when its pads are as near as an object is wide.

    Attributes:
        time: The instant [s].
        q: Joint angles [rad], shape (n,).
        wrist: Wrist pose, shape (4, 4).
    """

    time: float
    q: np.ndarray
    wrist: np.ndarray


class Closing:
    """The robot's own motion while the human's pinch closes, without an object.

    Args:
        pads: The pads of the robot.
        commands: Commands of the mapping for the whole recording.
        window: When the human pinches.
        physics: Stiffness, gravity and time steps.
        actuators: What moves the joints; servos if omitted.
    """

    def __init__(
        self,
        pads: PadFinder,
        commands: Commands,
        window: PinchWindow,
        physics: Physics,
        actuators: Actuators | None = None,
    ) -> None:
        hand = commands.hand
        simulator = Simulator(hand, _NOTHING, physics, actuators)
        wrist = commands.wrist[window.start] if hand.is_floating else None
        simulator.reset(commands.q[window.start], wrist, _FAR)
        simulator.set_stand(holds=True)
        last = int(np.searchsorted(commands.time, commands.time[window.closed] + _LAG))
        self._instants: list[Meeting] = []
        for i in range(window.start + 1, min(last, window.end)):
            before, after = commands.time[i - 1], commands.time[i]
            for share in np.arange(1, _PARTS + 1) / _PARTS:
                q, place = commands.between(i, float(share))
                simulator.follow(q, place if hand.is_floating else None, (after - before) / _PARTS)
                time = float(before + share * (after - before))
                self._instants.append(Meeting(time, simulator.q, simulator.wrist))
        self._gaps = np.array([pads.gap(at.q, at.wrist) for at in self._instants])

    def meeting(self, size: float) -> Meeting:
        """Return the first instant at which the pads are as near as an object is wide.

        Args:
            size: Width of the object [m].

        Returns:
            The instant, or that of the smallest gap if the pads do not come near enough.
        """
        near = np.flatnonzero(self._gaps <= size)
        k = int(near[0]) if len(near) else int(np.argmin(self._gaps))
        at = self._instants[k]
        if not len(near) or k == 0:
            return at
        before = self._instants[k - 1]
        wide, narrow = self._gaps[k - 1], self._gaps[k]
        share = float((wide - size) / (wide - narrow))
        return Meeting(
            before.time + share * (at.time - before.time),
            before.q + share * (at.q - before.q),
            between_poses(before.wrist, at.wrist, share),
        )
