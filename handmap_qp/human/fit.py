"""Joint angles of the human hand from its landmarks: `LandmarkFitter` and `fit_recording`.

The palm is rigid, so its pose is the rigid fit of its five landmarks (Kabsch 1976). In its frame
the joints minimise

    sum_k w_k^2 |p_k(q) - y_k|^2  +  rest^2 |q - q_rest|^2      subject to   lower <= q <= upper

by Newton's method (`ik.nearest_posture`). The fingers are independent, so that each of them takes
the best of the minima that several starts lead to.
"""

from dataclasses import dataclass

import numpy as np

from handmap_core.errors import expect
from handmap_core.human.recording import Recording
from handmap_core.human.sample import LANDMARK_COUNT, PALM, PalmShape, human_name
from handmap_core.se3 import (
    Array,
    as_floats,
    inverse_pose,
    rigid_fit,
    transform_points,
)
from handmap_qp.hands import FINGERS, Hand, HumanLengths, Side, load_hand
from handmap_qp.ik import LENGTH_UNIT
from handmap_qp.ik.nearest_posture import nearest_posture
from .measure import measure_hand

_WEIGHTS = (0.0, 1.0, 1.0, 2.0)
"""Weights of a finger's landmarks, per 10 mm: its first joint is fixed on the palm, and the mapping
uses the tip most."""
_COSTS = np.array([0.0, *_WEIGHTS * len(FINGERS)]) / LENGTH_UNIT
"""Costs of the errors of all landmarks [1/m], shape (21,)."""
_REST_WEIGHT = 0.02
"""Pull of each joint to its rest angle, per rad: decides what the landmarks do not."""
_STUCK_COST = 2.0
"""Cost of a finger above which its abduction at a limit is not believed: errors of 5 mm."""
_FIRST_SHARES = (0.0, 0.4, 0.8, [0.0, 0.0, 0.0, 0.8])
"""Starts of a first fit: shares of the way of a finger's joints from rest to their upper limits."""
_SHAPE = (len(FINGERS), 4)
"""Fingers, and joints of each."""
_EACH = np.arange(len(FINGERS))
_Fit = tuple[Array, Array]
"""Joint angles of each finger [rad], shape (5, 4), and its cost, shape (5,)."""


@dataclass(frozen=True, slots=True, eq=False)
class HumanMotion:
    """A recording as joint angles.

    Attributes:
        human: The human hand, scaled to the person, its reference points the 21 landmarks.
        time: Instants [s], shape (T,).
        dt: Time from each sample's predecessor [s], shape (T,).
        q: Joint angles in the order of `human.joint_names` [rad], shape (T, 20).
        wrist: Wrist poses in the tracker's world, shape (T, 4, 4).
        valid: Samples that were fitted, shape (T,). The others hold the last fitted posture; those
            before the first fitted one hold that one.
    """

    human: Hand
    time: Array
    dt: Array
    q: Array
    wrist: Array
    valid: Array


class LandmarkFitter:
    """Fits a human hand to landmarks, sample by sample.

    Args:
        side: Which hand.
        lengths: The person's segment lengths; the model's own if omitted.

    Attributes:
        human: The human hand, its reference points the 21 landmarks.
        palm: Its palm.

    Raises:
        InvalidInputError: If the side is unknown, or `lengths` is something else.
    """

    def __init__(
        self, side: Side = "right", lengths: HumanLengths | None = None
    ) -> None:
        self.human = human = load_hand(
            human_name(side), points="landmarks", lengths=lengths
        )
        self.palm = PalmShape(human)
        self._tree = human.tree
        # Joints are in the order of `HUMAN_JOINTS`: by finger, from its base outwards.
        limits = *human.limits, human.rest
        self._lower, self._upper, self._rest = (q.reshape(_SHAPE) for q in limits)
        self._q: Array | None = None

    def fit(self, landmarks: Array) -> tuple[Array, Array]:
        """Fit one sample, starting from the one before.

        Args:
            landmarks: Measured landmarks [m], shape (21, 3), finite.

        Returns:
            Joint angles [rad], shape (20,); wrist pose, shape (4, 4).

        Raises:
            InvalidInputError: On a wrong shape, anything but finite numbers, or a palm less than
                half or more than twice as large as the hand's.
        """
        shape = (LANDMARK_COUNT, 3)
        landmarks = as_floats(landmarks, "landmarks", shape=shape, is_finite=True)
        self.palm.check(landmarks)
        wrist = rigid_fit(self.palm.points, landmarks[PALM], self.palm.weights)
        # In wrist axes the fingers alone move.
        local = transform_points(inverse_pose(wrist), landmarks)
        postures, costs = map(np.array, zip(*self._fits(local), strict=True))
        self._q = postures[costs.argmin(axis=0), _EACH]
        return self._q.flatten(), wrist

    def fitting(self, recording: Recording) -> Array:
        """Tell which samples `fit` takes: valid ones whose palm is of the hand's size, (T,)."""
        valid = recording.valid.copy()
        valid[valid] = self.palm.fits(recording.landmarks[valid])
        return valid

    def _fits(self, local: Array) -> list[_Fit]:
        """Fit a first sample from several postures, any other from the one before.

        At 90 degrees of flexion, abduction does not move the bones before the next joint, and a
        finger can come back on the wrong side. Such fingers start from their rest abduction too.
        """
        if self._q is None:
            way = self._upper - self._rest
            starts = [self._rest + way * share for share in _FIRST_SHARES]
            return [self._nearest(start, local) for start in starts]
        q, cost = self._nearest(self._q, local)
        is_at_limit = (q <= self._lower) | (q >= self._upper)
        is_stuck = (cost > _STUCK_COST) & is_at_limit[:, 0]
        if not is_stuck.any():
            return [(q, cost)]
        start = q.copy()
        start[is_stuck, 0] = self._rest[is_stuck, 0]
        return [(q, cost), self._nearest(start, local)]

    def _nearest(self, start: Array, local: Array) -> _Fit:
        """Fit landmarks in wrist axes (21, 3) [m], from a posture (5, 4) [rad]."""
        q = nearest_posture(self.human, local, _COSTS, _REST_WEIGHT, start.ravel())
        errors = _COSTS[:, None] * (self._tree.points(q) - local)
        posture = q.reshape(_SHAPE)
        pull = _REST_WEIGHT * (posture - self._rest)
        residuals = np.hstack([errors[1:].reshape(len(FINGERS), -1), pull])
        return posture, np.vecdot(residuals, residuals)


def expect_fitted(*, is_any: bool) -> None:
    """Reject a recording of which `LandmarkFitter.fitting` takes no sample.

    Raises:
        InvalidInputError: If `is_any` is False.
    """
    expect(
        is_any,
        "landmarks",
        "a hand that keeps its size",
        got="no sample as large as the median of all",
    )


def fit_recording(
    recording: Recording, *, lengths: HumanLengths | None = None
) -> HumanMotion:
    """Fit joint angles and wrist poses of a hand scaled to the person to a recording.

    Args:
        recording: The recording.
        lengths: The person's lengths; measured in the recording if omitted.

    Returns:
        The motion; samples that are not valid, or whose palm is not of the hand's size, hold the
        posture before them.

    Raises:
        InvalidInputError: If the landmarks are not a plausible hand in metres, or no sample's palm
            is of the hand's size.
    """
    lengths = lengths or measure_hand(recording)
    fitter = LandmarkFitter(recording.side, lengths)
    valid = fitter.fitting(recording)
    expect_fitted(is_any=bool(valid.any()))
    fits = zip(*map(fitter.fit, recording.landmarks[valid]), strict=True)
    # The samples before the first fit take it too.
    last = np.maximum(np.cumsum(valid) - 1, 0)
    q, wrist = (np.array(column)[last] for column in fits)
    return HumanMotion(fitter.human, recording.time, recording.steps, q, wrist, valid)
