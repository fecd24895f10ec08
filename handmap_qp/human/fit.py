"""Joint angles of the human hand from its landmarks: `LandmarkFitter` and `fit_recording`.

The palm is rigid, so its pose is the rigid fit of its five landmarks (Kabsch 1976). In its frame
the five fingers are independent chains of four joints each. Each finger minimises

    sum_k w_k^2 |p_k(q) - y_k|^2  +  rest^2 |q - q_rest|^2      subject to   lower <= q <= upper

by Newton steps with Levenberg-Marquardt damping, all fingers at once. The second derivatives count:
on noisy video, where lengths of bones change, Gauss-Newton steps take five times as many
iterations. Joints at a limit that the gradient pushes further out are held there (projected
Newton, Bertsekas 1982).
"""

from __future__ import annotations

import numpy as np

from handmap_qp.errors import expect
from handmap_qp.hands.configuration import moved_by
from handmap_qp.hands.human import FINGERS, HumanLengths
from handmap_qp.hands.library import load_hand
from handmap_qp.hands.spec import Side
from handmap_qp.human.measure import measure_hand
from handmap_qp.human.recording import HumanMotion, Recording
from handmap_qp.human.sample import LANDMARK_COUNT, PALM, PalmShape, human_name
from handmap_qp.ik.options import LENGTH_UNIT
from handmap_qp.se3 import as_floats, rigid_fit
from handmap_qp.se3 import lengths as norms

MOST_ITERATIONS = 12
"""Most steps for one sample; a hand that moves takes two to four, the next sample goes on."""
_FIRST_ITERATIONS = 40
"""Most steps from each start of a first sample."""
TOLERANCE = 1e-3
"""A step that turns no joint by more ends the iterations [rad]."""
_TIP_WEIGHT = 2.0
"""Weight of a fingertip, which the mapping uses most; other landmarks have 1, per 10 mm."""
_REST_WEIGHT = 0.02
"""Pull of each joint to its rest angle, per rad: decides what the landmarks do not."""
_DAMPING = 1e-3
_LEAST_DAMPING = 1e-6
_MOST_DAMPING = 1e6
"""Levenberg-Marquardt damping at the start of a sample, and its bounds."""
_BETTER, _WORSE = 0.1, 10.0
"""Change of the damping after a step that lowers the cost, and after one that does not."""
_LONGEST = 0.6
"""Longest turn of a joint in one step [rad]."""
_STUCK_COST = 2.0
"""Cost of a finger above which its abduction at a limit is not believed: errors of 5 mm."""
_JOINTS = 4
"""Joints of a finger."""
_SHAPE = (len(FINGERS), _JOINTS)
_Fit = tuple[np.ndarray, np.ndarray]
"""Joint angles of each finger [rad], shape (5, 4), and its cost, shape (5,)."""


class LandmarkFitter:
    """Fits a human hand to landmarks, sample by sample.

    Args:
        side: Which hand.
        lengths: The person's segment lengths; the model's own if omitted.

    Attributes:
        human: The human hand, its reference points the 21 landmarks.
        iterations: Steps that the last fit took.

    Raises:
        InvalidInputError: If the side is unknown, or `lengths` is something else.
    """

    def __init__(
        self, side: Side = "right", lengths: HumanLengths | None = None
    ) -> None:
        self.human = human = load_hand(
            human_name(side), points="landmarks", lengths=lengths
        )
        self.iterations = 0
        self._palm = PalmShape(human)
        self._configuration = human.configuration()
        # Joints are in the order of `HUMAN_JOINTS`: by finger, from its base outwards.
        limits = human.lower_limits, human.upper_limits, human.rest
        self._lower, self._upper, self._rest = (q.reshape(_SHAPE) for q in limits)
        weights = np.array([1.0, 1.0, _TIP_WEIGHT]) / LENGTH_UNIT
        self._weights = np.repeat(weights, 3)
        # A joint moves the landmarks beyond it.
        joints = [frame.parentJoint for frame in human.point_frames[1:]]
        support = moved_by(human.model, joints)
        moves = support[:, human.joint_columns].reshape(len(FINGERS), -1, *_SHAPE)
        self._scale = weights[:, None, None] * moves[_EACH, 1:, _EACH][:, :, None]
        self._vector = human.configuration_vector(human.rest, np.eye(4))
        self._q: np.ndarray | None = None

    def fit(self, landmarks: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Fit one sample, starting from the one before.

        Args:
            landmarks: Measured landmarks [m], shape (21, 3), finite.

        Returns:
            Joint angles [rad], shape (20,); wrist pose, shape (4, 4); distance of every landmark
            [m], shape (21,).

        Raises:
            InvalidInputError: On a wrong shape, anything but finite numbers, or a palm less than
                half or more than twice as large as the hand's.
        """
        shape = (LANDMARK_COUNT, 3)
        landmarks = as_floats(landmarks, "landmarks", shape=shape, is_finite=True)
        self._palm.check(landmarks)
        wrist = rigid_fit(self._palm.points, landmarks[PALM])
        # In wrist axes the fingers alone move.
        local = (landmarks - wrist[:3, 3]).dot(wrist[:3, :3])
        targets = _beyond_base(local)
        postures, costs = map(np.array, zip(*self._fits(targets), strict=True))
        self._q = postures[costs.argmin(axis=0), _EACH]
        self._place(self._q)
        errors = norms(self._configuration.points - local)
        return self._q.flatten(), wrist, errors

    def _fits(self, targets: np.ndarray) -> list[_Fit]:
        """Fit a first sample from several postures, any other from the one before.

        At 90 degrees of flexion, abduction does not move the bones before the next joint, and a
        finger can come back on the wrong side. Such fingers start from their rest abduction too.
        """
        if self._q is None:
            low, high = self._lower - self._rest, self._upper - self._rest
            starts = [
                self._rest + s * (high if s > 0.0 else low) for s in _FIRST_SHARES
            ]
            return [self._solve(q, targets, _FIRST_ITERATIONS) for q in starts]
        q, cost = self._solve(self._q, targets, MOST_ITERATIONS)
        is_at_limit = (q <= self._lower) | (q >= self._upper)
        is_stuck = (cost > _STUCK_COST) & is_at_limit[:, 0]
        done = self.iterations
        if not is_stuck.any() or done >= MOST_ITERATIONS:
            return [(q, cost)]
        start = q.copy()
        start[is_stuck, 0] = self._rest[is_stuck, 0]
        other = self._solve(start, targets, MOST_ITERATIONS - done)
        self.iterations += done
        return [(q, cost), other]

    def _solve(
        self,
        q: np.ndarray,
        targets: np.ndarray,
        most: int,
    ) -> _Fit:
        """Minimise the cost of every finger from a posture, shape (5, 4).

        Args:
            q: Joint angles of each finger, inside their limits [rad].
            targets: Landmarks in wrist axes [m], shape (5, 3, 3).
            most: Most iterations.

        Returns:
            Joint angles [rad], shape (5, 4), and the cost of each finger, shape (5,).
        """
        q = q.copy()
        damping = np.full(len(FINGERS), _DAMPING)
        is_better = np.ones(len(FINGERS), dtype=bool)
        residual, cost = self._cost(q, targets)
        for self.iterations in range(1, most + 1):
            # Second derivatives mislead far from the optimum.
            step = self._step(q, residual, damping, is_newton=is_better)
            step = np.clip(step, -_LONGEST, _LONGEST)
            tried = np.clip(q + step, self._lower, self._upper)
            largest = np.abs(tried - q).max()
            tried_residual, tried_cost = self._cost(tried, targets)
            is_better = tried_cost <= cost
            q[is_better] = tried[is_better]
            residual[is_better] = tried_residual[is_better]
            cost[is_better] = tried_cost[is_better]
            if largest <= TOLERANCE:
                break
            damping *= np.where(is_better, _BETTER, _WORSE)
            damping = np.clip(damping, _LEAST_DAMPING, _MOST_DAMPING)
            if not is_better.all():
                # Jacobians are those of the fingers as tried.
                self._place(q)
        return q, cost

    def _place(self, q: np.ndarray) -> None:
        """Put the hand at joint angles, shape (5, 4), with its wrist at the origin."""
        self._vector[self.human.q_indices] = q.ravel()
        self._configuration.place(self._vector)

    def _cost(
        self, q: np.ndarray, targets: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return weighted errors, shape (5, 9), and costs, shape (5,); places the hand there."""
        self._place(q)
        errors = _beyond_base(self._configuration.points) - targets
        residual = errors.reshape(len(FINGERS), -1) * self._weights
        pull = _REST_WEIGHT * (q - self._rest)
        return residual, np.square(np.hstack([residual, pull])).sum(axis=1)

    def _step(
        self,
        q: np.ndarray,
        residual: np.ndarray,
        damping: np.ndarray,
        *,
        is_newton: np.ndarray,
    ) -> np.ndarray:
        """Return the damped step of the joints that are free to move, shape (5, 4).

        The normal equations have H, shape (5, 4, 4), and g, shape (5, 4), where the hand is placed.
        """
        # Spatial velocities of each finger's joints at the origin; w x p takes them to the points.
        joints = self._configuration.joint_jacobian()[:, self.human.joint_columns]
        joints = joints.reshape(2, 3, *_SHAPE).transpose(0, 2, 1, 3)
        linear, angular = joints[:, :, None]
        points = _beyond_base(self._configuration.points)
        turning = np.cross(angular, points[..., None], axis=2)
        moved = (turning + linear) * self._scale
        jacobian = moved.reshape(len(FINGERS), -1, _JOINTS)
        H = jacobian.transpose(0, 2, 1) @ jacobian
        H += _REST_WEIGHT**2 * _EYE
        # Second derivatives: joint i before joint j turns the column of j, w_i x J_j.
        pulls = np.cross(moved, residual.reshape(*points.shape, 1), axis=2)
        bend = angular[:, 0].transpose(0, 2, 1) @ pulls.sum(axis=1)
        bend *= is_newton[:, None, None]
        H += np.where(_UPPER, bend, bend.transpose(0, 2, 1))
        g = (residual[:, None] @ jacobian)[:, 0] + _REST_WEIGHT**2 * (q - self._rest)
        free = ((q > self._lower) | (g <= 0.0)) & ((q < self._upper) | (g >= 0.0))
        H *= 1.0 + damping[:, None, None] * _EYE
        system = np.where(free[:, :, None] & free[:, None, :], H, _EYE)
        return -np.linalg.solve(system, np.where(free, g, 0.0)[:, :, None])[:, :, 0]


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
    valid = recording.valid.copy()
    valid[valid] = PalmShape(fitter.human).fits(recording.landmarks[valid])
    expect(
        valid.any(),
        "landmarks",
        "a hand that keeps its size",
        got="no sample as large as the median of all",
    )
    fits = zip(*map(fitter.fit, recording.landmarks[valid]), strict=True)
    # The samples before the first fit take it too.
    last = np.maximum(np.cumsum(valid) - 1, 0)
    q, wrist, error = (np.array(column)[last] for column in fits)
    error[~valid] = np.nan
    return HumanMotion(
        fitter.human, recording.time, recording.steps, q, wrist, valid, error
    )


def _beyond_base(landmarks: np.ndarray) -> np.ndarray:
    """Return the landmarks that joints move, by finger, shape (5, 3, 3)."""
    return landmarks[1:].reshape(len(FINGERS), -1, 3)[:, 1:]


_EACH = np.arange(len(FINGERS))
_EYE = np.eye(_JOINTS)
_UPPER = np.triu(np.ones((_JOINTS, _JOINTS), dtype=bool))
_FIRST_SHARES = (0.0, 0.4, 0.8, -0.4)
"""Starts of a first fit: shares of the way from rest to the upper (or lower) limits."""
