"""An independent judge of streams of commands: no code of the QP, limits, gate or core is in it.

Positions are judged exactly; a robot that starts outside its limits must not go farther out.
Only the time stamps of commands say how much time has passed, and never the time that was granted
to them: a command that is not later than the one before counts as 1 us later. The velocity of a
step is the difference of its two configurations over that of their stamps. Its acceleration is the
difference from the velocity of the step before, over the time of the later step, in which a motor
has to change its speed; so |v_k - v_(k-1)| <= a (t_k - t_(k-1)), for steps of any lengths. Both
have the tolerance that rounding of configurations and stamps gives them. The acceleration limit in
force is the largest one since the robot last stood still.
Overlaps are looked for by coal, and those that it finds are measured by `overlap.py`; for every
2000th command that measures all pairs, whatever coal says.
"""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt
import pinocchio as pin
from overlap import OverlapMeter

from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs

OVERLAP = 1e-4
"""Largest overlap that counts as none [m]."""
SHORTEST = 1e-6
"""A command that is not later than the one before counts as later by this [s]."""
_JOINT, _POSE, _SHARE = 1e-12, 1e-9, 1e-6
_STEP = 0.04
_SURE = 2000
_SMALL = 1e-4


class Checker:
    """Judges the commands of one robot.

    Args:
        hand: The robot.
        shapes: Pairs of shapes that must not overlap, at or between commands; none if omitted.
        paths: Overlaps between commands are looked for before every command of this many; with 1,
            before each.

    Attributes:
        commands: Number of commands judged.
        violations: Number of commands by what they violate.
        worst: Position beyond its limit [rad]; speed and acceleration over their limits; overlap
            [m].
        first: Number of the first command that violates something, by what.
        postures: Number of postures that were examined for overlaps.
        meter: Measures the overlaps; None without shapes.
    """

    def __init__(
        self, hand: Hand, shapes: ShapePairs | None = None, paths: int = 1
    ) -> None:
        self._hand, self.commands, self.postures = hand, 0, 0
        self.meter = None if shapes is None else OverlapMeter(hand, shapes)
        self.violations, self.worst = Counter[str](), dict[str, float]()
        self.first, self._paths = dict[str, int](), paths
        self._time = -np.inf
        wrist = hand.spec.wrist
        self._free = free = 6 if hand.is_floating else 0
        twist = np.repeat([wrist.max_linear_speed, wrist.max_angular_speed], 3)[:free]
        self._turn = wrist.max_angular_speed * np.sqrt(3.0) if free else 0.0
        self._speed = np.concatenate([twist, hand.velocity_limits])
        self._rounding = np.repeat([_POSE, _JOINT], [free, len(hand.joint_names)])

    def start(self, q: np.ndarray, time: float = 0.0) -> None:
        """Begin at a Pinocchio configuration, at rest, at an instant [s]."""
        self._q = q.copy()
        self._last = np.zeros(len(self._speed))
        self._dt, self._force = 1.0, 0.0
        self._time = time

    @property
    def time(self) -> float:
        """Time stamp of the last command, as it counts [s]; -inf before the first."""
        return self._time

    def take(
        self, q: np.ndarray, time: npt.ArrayLike, limit: float | None = None
    ) -> None:
        """Judge one command, or many in their order.

        Args:
            q: Configuration of each command, shape (nq,) or (T, nq).
            time: Time stamp of each [s], one number or shape (T,).
            limit: The limit of acceleration configured [rad/s^2]; None for none.
        """
        hand, q = self._hand, np.atleast_2d(q)
        instants = [self._time]
        for stamp in np.broadcast_to(time, len(q)):
            instants.append(counted(float(stamp), instants[-1]))
        self._time = instants[-1]
        dt = np.diff(instants)
        # The sums and differences of stamps are rounded.
        slack = 2.0 * np.spacing(np.abs(instants[1:]))
        before = np.vstack([self._q, q[:-1]])
        joints, start = q[:, hand.q_indices], before[:, hand.q_indices]
        low = np.minimum(hand.lower_limits, start)
        high = np.maximum(hand.upper_limits, start)
        beyond = np.maximum(low - joints, joints - high)
        self._note("position", beyond.max(axis=1), 0.0)
        moved = joints - start
        is_ambiguous = self._turn * dt >= np.pi  # half a turn or more
        if self._free:
            moved = np.hstack([twists(before[:, :7], q[:, :7]), moved])
            moved[is_ambiguous, :6] = 0.0
        rounding = np.tile(self._rounding, (len(q), 1))
        # A wrist at 1e9 m has no place between two numbers, which are 1e-7 m apart there.
        rounding[:, : self._free // 2] += np.spacing(
            np.abs(q[:, : self._free // 2]).max(axis=1, initial=0.0, keepdims=True)
        )
        speed = (np.abs(moved) - rounding) / (self._speed * (dt + slack)[:, None])
        self._note("speed", speed.max(axis=1), 1.0 + _SHARE)
        self._judge_acceleration(moved, rounding, is_ambiguous, dt, slack, limit)
        if self.meter is not None:
            self._judge_overlaps(self.meter, before, q, np.abs(moved).max(axis=1))
        self._q = q[-1].copy()
        self.commands += len(q)

    def _judge_acceleration(
        self,
        moved: np.ndarray,
        rounding: np.ndarray,
        is_ambiguous: np.ndarray,
        dt: np.ndarray,
        slack: np.ndarray,
        limit: float | None,
    ) -> None:
        limit = np.inf if limit is None else limit
        # A wrist whose turn is ambiguous is not known to be still.
        is_still = np.all(np.abs(moved) <= rounding, axis=1) & ~is_ambiguous
        has_stood = np.logical_or.accumulate(np.concatenate([[False], is_still]))
        force = np.where(has_stood[:-1], limit, max(self._force, limit))
        velocity = moved / dt[:, None]
        velocity[is_ambiguous, : self._free] = np.nan
        last = np.vstack([self._last, velocity[:-1]])
        last_dt = np.concatenate([[self._dt], dt[:-1]])
        noise = rounding * (1.0 / dt + 1.0 / last_dt)[:, None]
        noise += np.abs(velocity) * (slack / dt)[:, None]
        noise += np.abs(last) * (slack / last_dt)[:, None]
        change = (np.abs(velocity - last) - noise) / (force * dt)[:, None]
        self._note("acceleration", np.fmax.reduce(change, axis=1), 1.0 + _SHARE)
        self._last, self._dt = velocity[-1], float(dt[-1])
        self._force = 0.0 if is_still[-1] else float(force[-1])

    def _judge_overlaps(
        self,
        meter: OverlapMeter,
        before: np.ndarray,
        q: np.ndarray,
        moved: np.ndarray,
    ) -> None:
        depths = np.zeros(len(q))
        for i in np.flatnonzero(moved):
            number = self.commands + int(i)
            depths[i] = meter.depth(q[i], checks_all=number % _SURE == 0)
            postures = []
            if number % self._paths == 0:
                count = int(moved[i] / _STEP) + 2
                postures = [
                    pin.interpolate(self._hand.model, before[i], q[i], share)
                    for share in np.arange(1, count) / count
                ]
            depths[i] = max(depths[i], *map(meter.depth, postures), 0.0)
            self.postures += 1 + len(postures)
        self._note("overlap", depths, OVERLAP)

    def _note(self, what: str, values: np.ndarray, most: float) -> None:
        # A NaN is a violation, and hides no other figure of its batch.
        worst = float(np.fmax.reduce(values))
        self.worst[what] = max(self.worst.get(what, -np.inf), worst)
        wrong = np.flatnonzero(~(values <= most))
        self.violations[what] += len(wrong)
        if len(wrong):
            self.first.setdefault(what, self.commands + int(wrong[0]))


def counted(stamp: float, last: float) -> float:
    """Return the instant of a command as it counts [s].

    Args:
        stamp: The time stamp of the command [s].
        last: The instant of the command before, as it counts [s].
    """
    return max(stamp, last + SHORTEST)


def twists(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """Return the twists of poses, linear first, in the frame before: the logarithm of SE(3).

    Args:
        before: Positions [m] and quaternions (xyzw), shape (T, 7).
        after: Likewise.

    Returns:
        Shape (T, 6) [m, rad]; turns are at most half a turn.
    """
    a, b = (
        each[:, 3:] / np.linalg.norm(each[:, 3:], axis=1)[:, None]
        for each in (before, after)
    )
    u, w = a[:, :3], a[:, 3:]
    # The product of the first's conjugate and the second, with a real part that is not negative.
    vector = w * b[:, :3] - b[:, 3:] * u - np.cross(u, b[:, :3])
    real = w[:, 0] * b[:, 3] + np.einsum("ij,ij->i", u, b[:, :3])
    vector *= np.where(real < 0.0, -1.0, 1.0)[:, None]
    sine = np.linalg.norm(vector, axis=1)
    angle = 2.0 * np.arctan2(sine, np.abs(real))
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = vector * np.where(sine > 0.0, angle / sine, 2.0)[:, None]
        half = 0.5 * angle
        bend = np.where(
            angle > _SMALL, (1.0 - half / np.tan(half)) / angle**2, 1.0 / 12.0
        )
    # The translation, turned back by the first pose.
    moved = after[:, :3] - before[:, :3]
    across = np.cross(u, moved)
    moved = moved - 2.0 * w * across + 2.0 * np.cross(u, across)
    across = np.cross(turn, moved)
    moved = moved - 0.5 * across + bend[:, None] * np.cross(turn, across)
    return np.hstack([moved, turn])
