"""Press a button and nothing beside it: `ButtonTask`, and `Presser`.

The button has 30 mm a side and stands in a frame that is a button too: a hand that does not point
presses both, which does not count.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from types import MappingProxyType

import mujoco
import numpy as np

from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.apps.simulation.losses import Touch
from handmap_qp.hands import Hand
from handmap_qp.human import Recording
from handmap_qp.mapping import Box
from handmap_qp.se3 import Array, inverse_pose, transform_points
from handmap_qp.trackers import read_recording
from .fixtures import SHOWN, TOUCHED, add_mover, forward, moved
from .household import Household
from .person import (
    DEAD_ZONE,
    ROUGH,
    STANDOFF,
    Closing,
    Look,
    PadModel,
    PadPlace,
    PalmMotion,
    Person,
    Phase,
    home,
)
from .table import FIXTURE, TableTask
from .task import Signals

BUTTON = "button"
"""Name of the task."""
PRESSED = 0.004
"""Way of the button from which it counts as pressed [m]."""
UNTOUCHED = 0.002
"""Way of the frame up to which it does not count as pressed [m]."""
_SIDE, _THICK = 0.03, 0.01  # of the button [m]
_AT = 0.05  # height of its lower side above the table [m]
_TRAVEL = 0.006  # [m]
_STIFFNESS, _DAMPING = 200.0, 2.0  # of button and frame [N/m, N s/m]
_GAP, _FRAME = 0.004, 0.08  # from the button to the frame, and the frame's width [m]
_FRAME_BODY = "/frame"
_MARK, _WIDE = 0.005, 0.015  # half widths of what is aimed at, and of what aims [m]
_DEEP = 0.012  # the finger goes down so far below the button's upper side [m]
_POINTS = 0.04  # the index finger reaches farther than the middle finger by this [m]
_UP = np.array([0.0, 0.0, 1.0])
_INDEX, _MIDDLE = 8, 12  # landmarks of their tips


class ButtonTask(TableTask):
    """Press a button, and not the frame around it."""

    name = BUTTON
    hold = 6
    raised = _AT
    yaw = 0.0
    things = MappingProxyType(
        {"button": Household(Box((_SIDE, _SIDE, _THICK)), 0.01, 0.6)}
    )

    def cause(self, course: Sequence[Signals]) -> str:
        """Return why the button was not pressed, or not alone."""
        if self._has_pressed_frame:
            return "pressed beside the button too"
        if any(one.is_touched for one in self.course):
            return "touched, not pressed far enough"
        return "never touched"

    def _furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the guide of the button, and the frame: four plates on a spring."""
        guide = spec.worldbody.add_body(name=FIXTURE)
        forward(guide)
        limits = (-_TRAVEL, 0.0)
        slide = mujoco.mjtJoint.mjJNT_SLIDE
        add_mover(
            spec, guide, slide, stiffness=_STIFFNESS, damping=_DAMPING, limits=limits
        )
        frame = guide.add_body(name=_FRAME_BODY, gravcomp=1.0)
        frame.add_joint(
            name=_FRAME_BODY,
            type=slide,
            axis=[0.0, 0.0, 1.0],
            stiffness=_STIFFNESS,
            damping=_DAMPING,
            range=limits,
        )
        inner = _SIDE / 2.0 + _GAP
        half = _FRAME / 2.0
        for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            frame.add_geom(
                type=mujoco.mjtGeom.mjGEOM_BOX,
                pos=[x * (inner + half), y * (inner + half), 0.0],
                size=[
                    half if x else inner + _FRAME,
                    half if y else inner,
                    _THICK / 2.0,
                ],
                mass=0.02,
                **TOUCHED,
            )
        guide.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            pos=[0.0, 0.0, -_AT / 2.0 - _THICK],
            size=[0.06, 0.06, _AT / 2.0 - _THICK],
            mass=0.0,
            **SHOWN,
        )

    def _place_furniture(self) -> None:
        self.model.body(FIXTURE).pos = self._start[:3, 3]
        self._has_pressed_frame = False

    @property
    def _frame_way(self) -> float:
        """How far the frame is pressed [m]."""
        return -float(self.data.joint(_FRAME_BODY).qpos[0])

    def _is_gripped(self, touch: Touch) -> bool:
        return False

    def _is_reached(self, touch: Touch, pose: Array) -> bool:
        is_pressed = -moved(self.data) >= PRESSED
        is_alone = self._frame_way < UNTOUCHED
        self._has_pressed_frame |= not is_alone
        return is_pressed and is_alone

    def _faces(self, pose: Array) -> Array:
        """Return the middle of the button's upper side, as the two ends of a mark."""
        top = pose[:3, 3] + (0.0, 0.0, _THICK / 2.0)
        return top + np.outer((-_MARK, _MARK), (1.0, 0.0, 0.0))

    def _surfaces(self, pads: Array) -> Array:
        """Return the lowest point of the index finger's pad, as the two ends of a mark."""
        tip = pads[1] - (0.0, 0.0, self._pads.pair.finger.radius)
        palm = self._simulator.wrist @ self._robot.wrist_to_palm
        side = _WIDE * palm[:3, 0]
        return np.array([tip - side, tip + side])


def pointing_of(recording: Recording) -> Closing:
    """Return the motion of a recording of a right hand from open to its longest pointing."""
    take = prepare_take(recording, "right")
    palms = inverse_pose(take.trace.palm)
    landmarks = transform_points(palms, recording.landmarks)
    reach = np.linalg.norm(landmarks[:, [_INDEX, _MIDDLE]], axis=2)
    points = reach[:, 0] - reach[:, 1] > _POINTS
    edges = np.flatnonzero(np.diff(np.concatenate(([0], points.astype(int), [0]))))
    starts, ends = edges[::2], edges[1::2]
    longest = int(np.argmax(ends - starts))
    last = int(ends[longest] - 1)
    # The hand is open where the middle finger was last as long as it ever is.
    is_open = reach[: starts[longest], 1] > 0.97 * np.nanmax(reach[:, 1])
    first = int(np.flatnonzero(is_open)[-1])
    deepest = first + int(np.argmax((reach[:, 0] - reach[:, 1])[first : last + 1]))
    samples = np.arange(first, deepest + 1)
    samples = samples[recording.valid[samples]]
    time = recording.time[samples]
    return Closing(time - time[0], landmarks[samples], take.human, take.q[samples])


class Presser(Person):
    """A person who points, and presses with the tip of the index finger.

    Args:
        robot: The robot hand that the person watches.
    """

    def __init__(self, robot: Hand) -> None:
        recording = read_recording(Path("demo"), "right")
        super().__init__(robot, recording, closing=_pointing())

    def _own_model(self, look: Look) -> PadModel:
        """Return where the own fingertip is in the open hand, and where it points."""
        first, last = (self.closing.landmarks[i, _INDEX] for i in (0, -1))
        side = np.array([1.0, 0.0, 0.0])
        return PadModel(
            PadPlace(first, side, 2.0 * _WIDE), PadPlace(last, side, 2.0 * _WIDE)
        )

    def _begin_try(self) -> None:
        """Point, and approach meanwhile."""
        self._start(Phase.APPROACH, closes=True)

    def _reach(self, look: Look, model: PadModel, motion: PalmMotion) -> None:
        """Move the fingertip over the button, closer, and down."""
        height = STANDOFF if self._phase is Phase.APPROACH else ROUGH
        goal = look.middle - home() @ model.met.middle
        bias = look.palm - motion.believed(look.followed)
        shift = goal + height * _UP - motion.believed_end - bias
        tolerance = ROUGH if self._phase is Phase.APPROACH else DEAD_ZONE
        if not self._correct(look, motion, shift, tolerance):
            return
        if self._phase is Phase.APPROACH:
            self._start(Phase.ENTER, closes=True)
            return
        if not self._is_judged:
            return
        # The tip is where it is seen: learn it on the way down too.
        self._opened = self._opened or look.pads_on_palm
        self._learn(look)
        self._tries += 1
        off = look.middle - look.pads.middle
        down = off - _DEEP * _UP
        motion.begin(self._time, down, np.zeros(3))
        self._start(Phase.USE, closes=True)

    def _use(self, look: Look, motion: PalmMotion) -> None:
        """Go up again when the finger is down."""
        if motion.is_moving(self._time):
            return
        motion.begin(self._time, STANDOFF * _UP, np.zeros(3))
        self._try_again()


@cache
def _pointing() -> Closing:
    return pointing_of(read_recording(Path("demo"), "right"))


OPERATORS: Mapping[str, Callable[[Hand], Person]] = MappingProxyType(
    {"person": Presser}
)
"""Makers of operators by name."""
