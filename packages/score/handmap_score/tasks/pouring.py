"""Pour balls from a cup into a bowl: `PourTask`, and `Pourer`, who does it.

The cup has seven balls of 14 mm. Six of them must lie in the bowl.
"""

import math
from collections.abc import Sequence
from types import MappingProxyType

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.apps.simulation.model import OBJECT
from handmap_qp.mapping import Cylinder
from handmap_qp.se3 import Array
from .fixtures import LOOSE, STANDS, TOUCHED, add_ring, ring
from .household import Household
from .person import LARGEST_STEP, Look, PalmMotion, Person, Phase
from .table import FIXTURE, TableTask
from .task import Signals
from .touch import cause_of_lost_grip, cause_of_no_grip

POUR = "pour"
"""Name of the task."""
BALLS = 7
ENOUGH = 6
"""Balls that must lie in the bowl."""
BOWL_RADIUS, BOWL_HEIGHT = 0.1, 0.05
_BALL, _BALL_MASS = 0.007, 0.003
_RADIUS, _HEIGHT, _BASE, _WALL = 0.024, 0.06, 0.004, 0.002
_HELD = 0.03  # height on the cup at which it is held [m]
_TILT = math.radians(150.0)
_WAITS = 1.5  # time for which the cup stays tilted [s]


class PourTask(TableTask):
    """Pour the balls of a cup into a bowl."""

    name = POUR
    things = MappingProxyType(
        {"cup": Household(Cylinder(_RADIUS, _BASE), 0.02, 0.6, is_round=True)}
    )

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the balls are not in the bowl."""
        lost = cause_of_lost_grip(self.course)
        if lost and self._count_in_bowl() + self._count_in_cup() < ENOUGH:
            return "spilled"
        return lost.replace("put down", "poured") or cause_of_no_grip(self.course)

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the bowl, the wall of the cup, and the balls."""
        bowl = spec.worldbody.add_body(name=FIXTURE)
        wall = ring(BOWL_RADIUS, BOWL_HEIGHT, 0.004, 20)
        add_ring(bowl, wall, BOWL_HEIGHT / 2.0, STANDS)
        cup = spec.body(OBJECT)
        wall = ring(_RADIUS - _WALL, _HEIGHT, _WALL, 12)
        add_ring(cup, wall, (_HEIGHT - _BASE) / 2.0, TOUCHED, mass=0.001)
        for i in range(BALLS):
            ball = spec.worldbody.add_body(name=_ball(i))
            ball.add_freejoint(name=_ball(i))
            ball.add_geom(
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                size=[_BALL, 0.0, 0.0],
                mass=_BALL_MASS,
                **LOOSE,
            )

    def _set_further(self) -> None:
        """Put the balls into the cup: one in the middle, six around it."""
        middle = self._start[:3, 3] + (0.0, 0.0, _BASE / 2.0 + _BALL)
        for i in range(BALLS):
            turn = i * math.pi / 3.0
            far = 0.0 if i == BALLS - 1 else 2.0 * _BALL
            place = middle + far * np.array([math.cos(turn), math.sin(turn), 0.0])
            self.data.joint(_ball(i)).qpos = [*place, 1.0, 0.0, 0.0, 0.0]
        mujoco.mj_forward(self.model, self.data)

    def _middle(self, pose: Array) -> Array:
        return pose[:3, 3] + _HELD * pose[:3, 2]

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        return self._count_in_bowl() >= ENOUGH

    def _balls(self) -> Array:
        """Return the places of the balls [m], shape (BALLS, 3)."""
        return np.array([self.data.body(_ball(i)).xpos for i in range(BALLS)])

    def _count_in_bowl(self) -> int:
        off = self._balls() - self.model.body(FIXTURE).pos
        is_in = np.linalg.norm(off[:, :2], axis=1) < BOWL_RADIUS
        return int((is_in & (off[:, 2] < BOWL_HEIGHT)).sum())

    def _count_in_cup(self) -> int:
        pose = self._simulator.object_pose
        off = (self._balls() - pose[:3, 3]) @ pose[:3, :3]
        is_in = np.linalg.norm(off[:, :2], axis=1) < _RADIUS
        return int((is_in & (abs(off[:, 2] - _HELD) < _HEIGHT / 2.0 + _BALL)).sum())


class Pourer(Person):
    """A person who tilts what is held over the target about the line of the pads, and back."""

    def _arrived(self, motion: PalmMotion) -> None:
        self._tilted = 0.0
        self._has_poured = False
        self._start(Phase.USE, closes=True)

    def _use(self, look: Look, motion: PalmMotion) -> None:
        if motion.is_moving(self._time):
            return
        if self._tilted >= _TILT and not self._has_poured:
            self._has_poured = self._time > self._since + _WAITS
            return
        if self._has_poured and self._tilted <= 0.0:
            self._start(Phase.DONE, closes=True)
            return
        # Tilt, and set upright again: balls that lie on the hand then roll off it.
        left = -self._tilted if self._has_poured else _TILT - self._tilted
        step = math.copysign(min(LARGEST_STEP, abs(left)), left)
        self._tilted += step
        # Outward, as the right forearm turns: the thumb's side up.
        line = look.pads.line
        axis = line if line[1] > 0.0 else -line
        self._turn_about_pads(look, motion, axis, step)
        self._since = self._time


def _ball(number: int) -> str:
    """Return the name of a ball's body and joint."""
    return f"/ball{number}"


OPERATORS = MappingProxyType({"person": Pourer})
"""Makers of operators by name."""
