"""Lift a bottle, eggs and a pen, without breaking them: `LiftTask`.

The object must be held in the air for a second. An egg breaks where one link presses it harder than
its shell bears, and then falls out of the hand.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType

import mujoco
import numpy as np

from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.apps.simulation.model import OBJECT, TABLE
from handmap_qp.mapping import Cylinder
from handmap_qp.se3 import Array
from .household import HOUSEHOLD, Household, egg, rings
from .table import TableTask
from .task import Scene, Signals
from .touch import cause_of_lost_grip, cause_of_no_grip

LIFT = "lift"
"""Name of the task."""
HEIGHT = 0.05
"""Height above its place at which an object must be held [m]."""
STRENGTH: Mapping[str, float] = MappingProxyType({"egg": 30.0, "quail egg": 10.0})
"""Force of one link at which an egg breaks [N]: common values of hens' and quails' eggs that are
pressed between plates, by memory and without a source."""
_BROKEN = "broken"
# Bits of `contype` and `conaffinity`: objects have the simulator's, what is broken has its own.
_SOLID = {"contype": 2, "conaffinity": 1}
_SHELLS = {"contype": 0, "conaffinity": 4}


class LiftTask(TableTask):
    """Hold one of the objects in the air, in one piece."""

    name = LIFT
    hold = 60
    things = MappingProxyType(
        {
            "full bottle": Household(
                rings((-0.1, 0.024), (0.01, 0.024), (0.05, 0.013)),
                0.3,
                0.6,
                is_round=True,
            ),
            "egg": Household(egg(0.057, 0.044), 0.06, 0.5, is_round=True),
            "quail egg": Household(egg(0.033, 0.026), 0.011, 0.5, is_round=True),
            "pen": HOUSEHOLD["pen"],
            "marker": Household(Cylinder(0.009, 0.12), 0.016, 0.6, is_round=True),
        }
    )

    def reset(self, seed: int) -> Scene:
        """Begin an attempt with an object in one piece."""
        self._is_broken = False
        for bench in self._benches.values():
            _set_solid(bench.simulator.model, is_solid=True)
        return super().reset(seed)

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the object is not in the air."""
        if self._is_broken:
            return _BROKEN
        lost = cause_of_lost_grip(self.course)
        return lost.replace("put down", "held for long") or cause_of_no_grip(
            self.course
        )

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Let the table carry what is broken too."""
        spec.geom(TABLE).contype |= _SHELLS["conaffinity"]

    def _signals(self, pose: Array, pads: Array) -> Signals:
        signals = super()._signals(pose, pads)
        if signals.force > STRENGTH.get(self.object_name, np.inf):
            self._is_broken = True
            _set_solid(self.model, is_solid=False)
        return signals

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        return touch.height > HEIGHT and not self._is_broken


def _set_solid(model: mujoco.MjModel, *, is_solid: bool) -> None:
    """Let the hand touch the object, or not: what is broken falls out of it onto the table."""
    geom = model.geom(OBJECT)
    bits = _SOLID if is_solid else _SHELLS
    geom.contype = bits["contype"]
    geom.conaffinity = bits["conaffinity"]
