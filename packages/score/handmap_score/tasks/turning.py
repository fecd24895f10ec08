"""Turn a cap by 90 degrees: `CapTask`, and `Turner`, who does it.

The cap is held at its side, turned by 100 degrees with the wrist, and gripped again if that was not
enough. It rubs, and does not turn back by itself.

Straight fingers of the person's own hand are 34 mm apart, enclose the cap of 32 mm, and turn it
without closing, so the control on that hand is `open`. Those of robots are 97 mm apart or more.
"""

import math
from collections.abc import Sequence
from types import MappingProxyType

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.mapping import Cylinder
from handmap_qp.se3 import Array
from .fixtures import SHOWN, add_mover, forward, moved
from .household import Household
from .person import LARGEST_STEP, Look, PalmMotion, Person, Phase
from .table import FIXTURE, TableTask
from .task import Scene, Signals
from .touch import cause_of_no_grip

CAP = "cap"
"""Name of the task."""
TURNED = math.radians(90.0)
"""Angle by which the cap is to be turned [rad]."""
_FRICTION = 0.05  # of the cap in its thread [N m]
_RADIUS, _HEIGHT = 0.016, 0.02  # of the cap [m]
_AT = 0.08  # height of its lower side above the table [m]
_FROM = math.radians(-50.0)  # direction at which it is gripped, from forward
_BY = math.radians(100.0)  # turn of the wrist with the cap in the hand
_BEGUN = 0.1  # angle from which the cap counts as turned at all [rad]
_UP = np.array([0.0, 0.0, 1.0])


class CapTask(TableTask):
    """Turn the cap of a bottle."""

    name = CAP
    raised = _AT
    yaw = 0.0
    things = MappingProxyType(
        {"cap": Household(Cylinder(_RADIUS, _HEIGHT), 0.01, 0.6, is_round=True)}
    )

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the cap is where it is."""
        if not any(one.is_pinched for one in self.course):
            return cause_of_no_grip(self.course)
        if self._pads_turned >= TURNED:
            return "the pads slipped about it"
        if moved(self.data) > _BEGUN:
            return "turned, not far enough"
        return "gripped, not turned"

    def reset(self, seed: int) -> Scene:
        """Begin an attempt; see `TableTask.reset`."""
        self._pads_turned = 0.0
        self._direction: float | None = None
        return super().reset(seed)

    def _signals(self, pose: Array, pads: Array) -> Signals:
        """Add up by how much the line of the pads turns while they press on the cap."""
        signals = super()._signals(pose, pads)
        line = pads[1] - pads[0]
        direction = math.atan2(line[1], line[0])
        if not self.course[-1].is_pinched:
            self._direction = None
            return signals
        if self._direction is not None:
            self._pads_turned += math.remainder(direction - self._direction, math.tau)
        self._direction = direction
        return signals

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the thread that the cap turns on, and the bottle as it is seen."""
        body = spec.worldbody.add_body(name=FIXTURE)
        forward(body)
        neck = _AT + _HEIGHT / 2.0
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_CYLINDER,
            size=[0.025, _AT / 2.0, 0.0],
            pos=[0.0, 0.0, -neck + _AT / 2.0],
            mass=0.0,
            **SHOWN,
        )
        add_mover(
            spec,
            body,
            mujoco.mjtJoint.mjJNT_HINGE,
            friction=_FRICTION,
            damping=1e-3,
            limits=(0.0, math.pi),
        )

    def _place_furniture(self) -> None:
        self.model.body(FIXTURE).pos = self._start[:3, 3]

    def _is_gripped(self, touch: Touch) -> bool:
        return touch.is_pinched and moved(self.data) > _BEGUN

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        return moved(self.data) >= TURNED

    def _faces(self, pose: Array) -> Array:
        line = Rotation.from_rotvec(_FROM * _UP).apply([0.0, 1.0, 0.0])
        return pose[:3, 3] + np.outer((-_RADIUS, _RADIUS), line)


class Turner(Person):
    """A person who turns what is gripped, about the vertical through the pads."""

    def _grasped(self, motion: PalmMotion) -> None:
        self._turned = 0.0
        self._start(Phase.USE, closes=True)

    def _use(self, look: Look, motion: PalmMotion) -> None:
        if motion.is_moving(self._time):
            return
        if self._turned >= _BY:
            self._start(Phase.REOPEN, closes=False)
            return
        step = min(LARGEST_STEP, _BY - self._turned)
        self._turned += step
        self._turn_about_pads(look, motion, _UP, step)


OPERATORS = MappingProxyType({"person": Turner})
"""Makers of operators by name."""
