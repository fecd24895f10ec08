"""A way round: from a posture that holds fingers to one that is nearer to the targets.

A QP finds the nearest minimum. Where fingers are caught behind others, or folded, that is far from
the targets though another posture is near them. So where a point stays away, the hand looks ahead
by the same QPs: where does it end if it goes on, and where would it from rest? If the second is
clearly nearer, the joints are pulled to what was found there, straight or by rest, whichever was
seen to arrive. Every step passes the gate, and all limits hold.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from handmap_qp.ik.tasks import Goal
from handmap_qp.se3 import lengths

if TYPE_CHECKING:
    from handmap_qp.ik.qp import IkResult, PointIk

# A point whose weighted error is larger is away from its target [cost]: 30 mm for a fingertip.
_AWAY = 3.0
# To look ahead: time of a sample [s], their number, and the joint motion that ends them [rad or m].
_SAMPLE, _SAMPLES, _SETTLED = 0.05, 12, 1e-3
# Time until the hand looks ahead again: while it may get there, after a detour, and where none is
# known [s].
_AGAIN, _AFTER, _LATER = 0.05, 0.1, 0.2
# Shares of the error that is left of a point that was away, and of the sum of all squares, if a
# detour is worth it.
_OF_POINT, _OF_ALL = 0.75, 0.85
# Weight of the pull to a posture, which outweighs all targets; distance of its joints at which it is
# reached [rad or m], and the longest time for it, in samples.
_PULL, _REACHED, _LONGEST = 20.0, 0.15, 6
# Targets that move farther than this end a detour; those that move less, or this time, are the same
# as when none was known [m, s].
_MOVED, _SAME, _FORGOTTEN = 0.05, 0.02, 1.0


class Detour(NamedTuple):
    """What a hand is about to do in place of going to its targets.

    Attributes:
        via: Postures that it still has to pass, shape (k, n); none in most samples.
        points: Targets for which they were found, or none was [m], shape (m, 3).
        left: Time left for the first of them [s].
        wait: Time until it may look ahead again [s].
    """

    via: np.ndarray
    points: np.ndarray
    left: float
    wait: float


class Detours:
    """Solves each sample of a `PointIk`, by a detour where that leads nearer to the targets.

    Args:
        ik: Solves a sample, and moves the hand.
        detour: Of the solver that this one is a copy of; none if omitted.

    Attributes:
        detour: The one that the hand is on, if any.
    """

    def __init__(self, ik: PointIk, detour: Detour | None = None) -> None:
        hand = ik.hand
        model = hand.model
        self._ik = ik
        self._none = Detour(np.empty((0, len(hand.joint_names))), np.empty(0), 0.0, 0.0)
        self.detour = detour or self._none
        self._motion = ik.gate.motion
        self._costs = ik.options.point_costs(hand)
        # The joints of an arm follow the wrist at all times.
        arm = [*model.supports[model.frames[hand.wrist_frame_id].parentJoint]]
        joints = [model.getJointId(name) for name in hand.joint_names]
        self._is_finger = ~np.isin(joints, arm)

    def solve(
        self, goal: Goal, dt: float, margins: np.ndarray | None, speed: float
    ) -> IkResult:
        """Move the hand for one sample; arguments as of `PointIk.solve`."""
        ik = self._ik
        if ik.gate.motion is not self._motion:
            # Something else has moved the hand.
            self.detour = self._none
        via, points, left, wait = self.detour
        wait = wait - dt
        moved = lengths(goal.points - points).max() if len(points) else np.inf
        if moved > _MOVED:
            via = via[1:0]
        if len(via):
            result = ik.solve_once(self._pulled(goal, via[0]), dt, margins, speed)
            left = left - dt
            if left < 0.0 or self._is_at(via[0]):
                via = via[1:]
                left = _LONGEST * _SAMPLE
                wait = _AFTER
            self.detour = Detour(via, points, left, wait)
        else:
            result = ik.solve_once(goal, dt, margins, speed)
            self.detour = Detour(via, points, left, wait)
            is_due = wait <= (0.0 if moved > _SAME else -_FORGOTTEN)
            if is_due and self._errors(result).max() > _AWAY:
                self.detour = self._look_ahead(goal, margins)
        self._motion = ik.gate.motion
        return result

    def _look_ahead(self, goal: Goal, margins: np.ndarray | None) -> Detour:
        """Return the detour that leads nearer to the targets, or none."""
        ahead, _ = self._foresee(goal, margins, ())
        if ahead.max() <= _AWAY:
            return self._none._replace(wait=_AGAIN)
        rest = goal.postures[0][1]
        motion = self._ik.gate.motion
        self._start_from(rest)
        errors, found = self._foresee(goal, margins, ())
        self._ik.gate.motion = motion
        if _is_nearer(errors, ahead):
            for via in ((found,), (rest, found)):
                if _is_nearer(self._foresee(goal, margins, via)[0], ahead):
                    left = _LONGEST * _SAMPLE
                    return Detour(np.array(via), goal.points, left, 0.0)
        return self._none._replace(points=goal.points, wait=_LATER)

    def _foresee(
        self, goal: Goal, margins: np.ndarray | None, via: tuple[np.ndarray, ...]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return errors of the points, shape (m,), and joints, shape (n,), where the hand ends."""
        ik = self._ik
        gate = ik.gate
        motion = gate.motion
        goal = goal._replace(postures=goal.postures[:1])
        for posture in via:
            pulled = self._pulled(goal, posture)
            for _ in range(_LONGEST):
                ik.solve_once(pulled, _SAMPLE, margins, 1.0)
                if self._is_at(posture):
                    break
        for _ in range(_SAMPLES):
            result = ik.solve_once(goal, _SAMPLE, margins, 1.0)
            if np.abs(result.displacement).max() < _SETTLED:
                break
        reached = self._joints()
        gate.motion = motion
        return self._errors(result), reached

    def _start_from(self, posture: np.ndarray) -> None:
        """Put the fingers into a posture; the wrist stays."""
        ik = self._ik
        hand = ik.hand
        away = np.zeros(len(hand.active_columns))
        away[hand.joint_columns] = np.where(
            self._is_finger, posture - self._joints(), 0.0
        )
        placed = ik.configuration
        placed.displace(ik.gate.motion.q, away)
        ik.gate.place(placed.q)

    def _pulled(self, goal: Goal, posture: np.ndarray) -> Goal:
        """Return a goal that pulls the fingers to a posture."""
        return goal._replace(postures=[(_PULL * self._is_finger, posture)])

    def _is_at(self, posture: np.ndarray) -> bool:
        off = np.abs(self._joints() - posture)
        return bool(off.max(where=self._is_finger, initial=0.0) < _REACHED)

    def _joints(self) -> np.ndarray:
        return self._ik.gate.motion.q[self._ik.hand.q_indices]

    def _errors(self, result: IkResult) -> np.ndarray:
        return self._costs * lengths(result.errors)


def _is_nearer(errors: np.ndarray, ahead: np.ndarray) -> bool:
    """Return whether a way's errors are clearly smaller than those ahead, shape (m,) both."""
    is_nearer = errors[ahead > _AWAY] < _OF_POINT * ahead[ahead > _AWAY]
    return bool(is_nearer.any() and errors.dot(errors) < _OF_ALL * ahead.dot(ahead))
