"""Insert a peg into a hole with 2 mm of play: `PegTask`, and `Inserter`, who does it.

The peg is a round pin below a handle with flat sides: rigid fingertips squeeze a round peg out
where they meet it off its middle. The hole stands on the table, 40 mm high, with a chamfer of
10 mm. The peg counts as inserted when it stands on the ground of the hole, upright and let go.

Pin and hole are smooth (a friction of 0.2), so that the chamfer moves the pin sideways before it
slips out of the fingers.
"""

import math
from collections.abc import Sequence
from types import MappingProxyType

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.mapping import Box
from handmap_qp.se3 import Array
from .fixtures import STANDS, TOUCHED, add_ring, ring
from .household import Household
from .person import DEAD_ZONE, Look, PalmMotion, Person, Phase
from .table import FIXTURE, TableTask
from .task import Signals
from .touch import cause_of_lost_grip, cause_of_no_grip

PEG = "peg"
"""Name of the task."""
PLAY = 0.002
"""Diameter of the hole less that of the peg [m]."""
DEPTH = 0.04
"""Depth of the hole [m]."""
INSERTED = 0.02
"""An inserted peg is lower than this above the hole's ground [m]."""
_RADIUS, _LENGTH = 0.01, 0.05  # of the pin [m]
_HANDLE = (0.024, 0.03, 0.03)  # sides of the handle [m]
_CHAMFER = 0.01  # catches what the person's dead zone and noise leave over [m]
_NEAR = DEPTH + 0.015  # height at which the person looks again before going down [m]
_SIDES = 16
_SMOOTH = [
    0.2,
    1e-5,
    1e-5,
]  # of pin and hole: at the handle's .6 the chamfer would hold the pin
_THIN = 0.004  # thickness of the chamfer's boxes [m]
_UPRIGHT = math.cos(math.radians(10.0))


class PegTask(TableTask):
    """Insert a peg into a hole."""

    name = PEG
    things = MappingProxyType({"peg": Household(Box(_HANDLE), 0.03, 0.6)})
    raised = _LENGTH

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the peg is not in the hole."""
        lost = cause_of_lost_grip(self.course).replace("put down", "inserted")
        return lost or cause_of_no_grip(self.course)

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the pin, and the hole: a wall of boxes, and a chamfer on it."""
        spec.body(OBJECT).add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[_RADIUS, _LENGTH / 2.0, 0.0],
            pos=[0.0, 0.0, -(_HANDLE[2] + _LENGTH) / 2.0],
            mass=0.01,
            friction=_SMOOTH,
            **TOUCHED,
        )
        body = spec.worldbody.add_body(name=FIXTURE)
        straight = DEPTH - _CHAMFER
        hole = _RADIUS + PLAY / 2.0
        wall = ring(hole, straight, 0.012, _SIDES)
        add_ring(body, wall, straight / 2.0, STANDS)
        # Boxes that lean outward by 45 degrees, with their inner edge on the wall's.
        slant = ring(
            hole + _CHAMFER / 2.0,
            _CHAMFER * math.sqrt(2.0),
            _THIN,
            _SIDES,
            tilt=math.pi / 4.0,
        )
        add_ring(
            body,
            slant,
            straight + _CHAMFER / 2.0 - 0.5 * math.sqrt(0.5) * _THIN,
            STANDS,
        )
        for geom in body.geoms:
            geom.friction = _SMOOTH

    def _bottom(self, pose: Array) -> Array:
        return pose[:3, 3] - (_HANDLE[2] / 2.0 + _LENGTH) * pose[:3, 2]

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        off = float(np.linalg.norm(pose[:2, 3] - self._target[:2, 3]))
        is_in = off < _RADIUS and touch.height < INSERTED
        is_upright = abs(pose[2, 2]) > _UPRIGHT
        return is_in and is_upright and self._has_lifted and not touch.is_touched


class Inserter(Person):
    """A person who brings the peg's end closely above the hole, looks, and goes down.

    What is over the hole is the end of the pin, not the handle. The peg is let go when its end is
    seen to be down, wherever the handle is: a tilted pin in its hole cannot be moved sideways.
    """

    def _guided(self, look: Look) -> Array:
        return look.bottom

    def _is_down(self, look: Look) -> bool:
        return float(look.bottom[2] - look.target[2]) < DEAD_ZONE

    def _arrived(self, motion: PalmMotion) -> None:
        if self._hover == _NEAR:
            self._phase = Phase.LOWER
        self._hover = _NEAR


OPERATORS = MappingProxyType({"person": Inserter})
"""Makers of operators by name."""
