"""Operators: people who were recorded, and do not look at the robot.

A replayed person is open loop. The recorded closing plays once, with the palm's recorded motion,
and then the hand is lifted. It is laid so that the *person's* pads close about the object, whatever
the robot's fingers do: it shows how far a mapping puts fingers where the person's are.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import pinocchio as pin

from handmap_qp.hands import THUMB, Hand
from handmap_qp.human import Recording
from handmap_qp.mapping import robot_fingers
from handmap_qp.se3 import (
    Array,
    affine,
    inverse_pose,
    smoothstep,
    transform_points,
    unit,
)
from handmap_qp.trackers import read_recording
from .operator import HumanHand
from .person import (
    LIFT,
    STANDOFF,
    TRACKER_NOISE,
    Closing,
    closing_of,
    closing_samples,
    levelled,
    recordings_of_people,
)
from .task import Scene

REPLAYED = "replay"
"""Name of the package's recording as an operator; others are `replay-NAME`."""
PAD_THICKNESS = 0.014
"""Distance of the middles of two pads whose surfaces touch [m]."""
_ARRIVES = 2.5  # time in which the hand goes to where the recording begins [s]
_RESTS = 0.4  # from the end of the closing until the hand is lifted [s]
_LIFTS = 1.0  # time of the lift [s]
_UP = np.array([0.0, 0.0, 1.0])


class Replay:
    """A recorded person.

    Args:
        robot: The robot hand, whose palm goes where the person's palm is.
        recording: A recording of a right hand with a pick; the package's `pinch` if omitted.
        name: Name of the operator.

    Raises:
        InvalidInputError: If the recording shows no pick.
    """

    def __init__(
        self, robot: Hand, recording: Recording | None = None, name: str = REPLAYED
    ) -> None:
        recording = recording or read_recording(Path("pinch"), "right")
        self._recording = recording
        self._name = name
        self._wrist_to_palm = robot.wrist_to_palm
        self.closing = closing_of(recording)
        take, samples = closing_samples(recording)
        palms = take.trace.palm[samples]
        # Relative to the palm at the end of the closing.
        self._palms = inverse_pose(palms[-1]) @ palms
        self.reset(0)

    @property
    def name(self) -> str:
        """Name of the operator."""
        return self._name

    @property
    def has_finished(self) -> bool:
        """Whether the recording has been played and the hand was lifted."""
        return self._time > _ARRIVES + self.closing.duration + _RESTS + _LIFTS

    def calibrate(self, seed: int) -> Recording:
        """Return the recording with further noise of a tracker."""
        random = np.random.default_rng(seed)
        landmarks = self._recording.landmarks
        return Recording(
            f"{self._name}_{seed}",
            self._recording.time,
            landmarks + TRACKER_NOISE * random.normal(size=landmarks.shape),
            self._recording.valid,
            self._recording.side,
        )

    def reset(self, seed: int) -> None:
        """Begin an attempt; the place of the object is read from its first scene alone."""
        self._random = np.random.default_rng(seed)
        self._closed: Array | None = None
        self._time = 0.0
        self._first = np.eye(4)

    def see(self, scene: Scene) -> HumanHand:
        """Return the hand at the scene's instant, of which only the time counts."""
        self._time = scene.time
        if self._closed is None:
            self._closed = self._palm_around(scene)
            self._first = scene.poses["wrist"] @ self._wrist_to_palm
        elapsed = min(max(scene.time - _ARRIVES, 0.0), self.closing.duration)
        palm = self._palm(scene.time, self._closed)
        noise = TRACKER_NOISE * self._random.normal(size=(21, 3))
        return HumanHand(
            transform_points(palm, self.closing.landmarks_at(elapsed)) + noise,
            palm @ inverse_pose(self._wrist_to_palm),
            self.closing.joints_at(elapsed),
        )

    def _palm_around(self, scene: Scene) -> Array:
        """Return the palm's pose in the end, so that the person's pads meet at the object.

        They meet where they are first as near as the object is wide.
        """
        first, second = scene.points["faces"]
        width = float(np.linalg.norm(second - first))
        every = np.array(
            [pads_on_palm(self.closing, i) for i in range(len(self.closing.time))]
        )
        gaps = np.linalg.norm(every[:, 1] - every[:, 0], axis=1) - PAD_THICKNESS
        is_met = gaps <= width
        at = int(np.argmax(is_met)) if is_met.any() else len(gaps) - 1
        pads = every[at]
        line = unit(pads[1] - pads[0])
        rotation = levelled(line, unit((second - first) * (1.0, 1.0, 0.0)))
        middle = (first + second) / 2.0
        meeting = affine(rotation, middle - rotation @ pads.mean(axis=0))
        return meeting @ inverse_pose(self._palms[at])

    def _palm(self, time: float, closed: Array) -> Array:
        """Return the palm's pose at an instant [s], by its pose at the end of the closing."""
        begin = closed @ self._palms[0]
        if time < _ARRIVES:
            # Over the object, then down. The orientation is the recording's from the start.
            above = begin[:3, 3] + STANDOFF * _UP
            over = smoothstep(2.0 * time / _ARRIVES)
            down = smoothstep(2.0 * time / _ARRIVES - 1.0)
            place = (1.0 - over) * self._first[:3, 3] + over * above
            return affine(begin[:3, :3], place - down * STANDOFF * _UP)
        elapsed = time - _ARRIVES
        at = int(np.searchsorted(self.closing.time, elapsed))
        palm = closed @ self._palms[min(at, len(self._palms) - 1)]
        risen = smoothstep((elapsed - self.closing.duration - _RESTS) / _LIFTS)
        palm[:3, 3] += LIFT * risen * _UP
        return palm


def pads_on_palm(closing: Closing, sample: int) -> Array:
    """Return the middles of the person's pads in a sample of a closing [m], shape (2, 3).

    They are those of thumb and index finger, in the palm's frame.
    """
    hand = closing.hand
    q = hand.configuration_vector(closing.q[sample], inverse_pose(hand.wrist_to_palm))
    data = hand.model.createData()
    pin.forwardKinematics(hand.model, data, q)
    pads = robot_fingers(hand).pads
    return np.array(
        [
            transform_points(data.oMi[pad.joint].homogeneous, pad.offset)
            for pad in (pads[THUMB], pads["index"])
        ]
    )


def _replayed(file: Path, robot: Hand) -> Replay:
    return Replay(robot, read_recording(file, "right"), f"{REPLAYED}-{file.stem}")


def replayed_people() -> dict[str, Callable[[Hand], Replay]]:
    """Return makers of replayed people by name: the package's and those of a folder."""
    recorded = {
        f"{REPLAYED}-{name}": partial(_replayed, file)
        for name, file in recordings_of_people().items()
    }
    return {REPLAYED: Replay, **recorded}
