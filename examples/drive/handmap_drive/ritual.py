"""Finds what a hand makes of its commands, by moving it: the ritual of `handmap tune`."""

from collections import defaultdict
from collections.abc import Callable, Iterator

import numpy as np
from msgspec.structs import replace

from handmap_qp.apps.offline.comparison import (
    compare_methods,
    own_method,
    prepare_take,
)
from handmap_qp.apps.offline.fidelity import CLOSED, OPEN
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.errors import HandError, expect
from handmap_qp.hands import THUMB, Hand, all_pairs, find_fingers
from handmap_qp.ik.collision import CollisionLimit
from handmap_qp.mapping import default_preset
from handmap_qp.trackers import DEMO, read_recording
from .drive import APPROACH, HOTTEST, UNANSWERED
from .driver import Driver, DriverError
from .fit import FULL, TORQUE, Log, fit_encoders, fit_joint
from .tuning import Compensated, Joint, Tuning, tuned

_SMALL = 0.15
"""Amplitude of small motions [rad]."""
_HOME = 0.15
"""Share of a joint's range that home keeps from its ends."""
_BACK = 0.2
"""How far slow motions go beyond home, a share of the amplitude."""
_SLOW, _WIDE, _FAST = 0.08, 1.0, 2.0
"""Speeds of the motions: through the play, over the range, and for the delay [rad/s]."""
_REST = 0.25
"""Time to come to rest [s]."""
_MOVES = 0.04
"""A joint that moves less does not move [rad]."""
_JAM = 0.2
"""Share of its range that a joint may lack at each end."""
_GAINS = 0.5, 1.6
"""Gains of a joint that is that of the description."""
_SHARES = 1.0, 0.8, 0.6, 0.4, 0.2
"""Shares of the way to a limit that are tried, the longest that is free of touches first."""
_APART, _TUNED = 0.1, 0.03
"""How much a joint may be ahead of others on their way, at first and once tuned, a share of it."""
_KEPT = 2.2
"""Bands that pinches keep from the ends of ranges."""
_WAYS, _TRIES = 4, 40
"""Ways to close each pinch, and shifts of its joints that are tried for them."""
_SHIFT = 0.12
"""Standard deviation of the shifts [rad]."""
_DEEP = 0.008
"""How deep tips must be in each other at the end of a way by the model, to meet for sure [m]."""
_NEAR = 0.008
"""Gap from which on fingers close slowly [m]."""
_BEYOND = 0.8
"""How much farther than to the closed pinch fingers go until they meet, a share of the way."""
_MEETS = 0.02
"""Torque beyond friction that says that fingers meet."""
_CLOSING = 0.2
"""Speed of fingers that are going to meet [rad/s]."""
_NEARLY = 0.98
"""Share of the way to the end of the range that joints go."""
_INSIDE = 0.005
"""How far from its stops a joint keeps [rad]."""


class Ritual:
    """Moves a hand for two minutes, and finds what it makes of its commands.

    Args:
        driver: Its motors, connected.
        hand: The hand, with a fixed wrist.
        effort: Limit of the torque, a share of the largest.
        times: Yields the time of each turn [s].
        tell: Is told how much is done [%], and what is.
    """

    def __init__(
        self,
        driver: Driver,
        hand: Hand,
        effort: float,
        times: Iterator[float],
        tell: Callable[[float, str], object] = lambda *_: None,
    ) -> None:
        self._driver, self._effort = driver, effort
        self._hand, self._times, self._tell = hand, times, tell
        self._names = driver.joint_names
        self._own = [*map(hand.joint_names.index, self._names)]
        self._limits = np.clip(hand.limits[:, self._own], *driver.range)
        low, high = self._limits
        kept = np.clip(_HOME * (high - low), 1.35 * _SMALL, 0.5 * (high - low))
        self._home = np.clip(hand.zero[self._own], low + kept, high - kept)
        self._touch = CollisionLimit(hand, all_pairs(hand))
        self._rows: list[tuple[float, np.ndarray, np.ndarray, np.ndarray]] = []
        self._told, *_ = driver.read()

    @property
    def log(self) -> Log:
        """What happened up to now."""
        return Log(*map(np.array, zip(*self._rows, strict=True)))

    def run(self) -> Tuning:
        """Move the hand, and return what was found.

        Raises:
            InvalidInputError: If fingers are in the way of each other.
            DriverError: If motors do not answer or report a fault, or a joint does not do what
                joints do.
        """
        start = np.clip(self._told, *self._limits)
        expect(
            self._is_free(start, self._home - start, apart=0.0),
            "HAND",
            "fingers whose way to the open hand is free",
            advice="open the hand while it has no torque",
        )
        self._go(self._home, APPROACH)
        for i in range(len(self._names)):
            self._tell(10.0 * i / len(self._names), self._names[i])
            self._try(i)
        spans = self._spans()
        groups = self._groups(spans)
        joints: dict[str, Joint] = {}
        for k, group in enumerate(groups):
            names = [self._names[i] for i in group]
            self._tell(10.0 + 60.0 * k / len(groups), ", ".join(names))
            joints |= zip(names, self._measure(group, spans), strict=True)
        tuning = Tuning(joints)
        return self._meet(tuning)

    def _turn(self, goal: np.ndarray) -> None:
        """Tell the motors a goal [rad], and write down what they do.

        Raises:
            DriverError: As `run`.
        """
        now = next(self._times)
        self._told = np.clip(goal, *self._driver.range)
        self._driver.write(self._told, self._effort)
        try:
            q, torque, health = self._driver.read()
        except DriverError:
            if self._rows and now - self._rows[-1][0] > UNANSWERED:
                raise
            return
        health.check(self._names, HOTTEST)
        self._rows.append((now, self._told, q, torque))

    def _go(self, goal: np.ndarray, speed: float) -> None:
        """Go straight to a goal [rad], the farthest joint at a speed [rad/s]."""
        away = goal - self._told
        count = np.ceil(np.abs(away).max() / speed * self._driver.rate)
        for share in np.arange(1.0, count + 1.0) / count:
            self._turn(goal - (1.0 - share) * away)

    def _rest(self) -> None:
        for _ in range(round(_REST * self._driver.rate)):
            self._turn(self._told)

    def _try(self, i: int) -> None:
        """Move one joint a little, and reject a hand in which something else happens."""
        start = len(self._rows)
        only = _SMALL * (np.arange(len(self._names)) == i)
        for side in (1.0, -1.0, 0.0):
            self._go(self._home + side * only, _FAST)
            self._rest()
        _, told, q, torque = (rows[start:] for rows in self.log)
        moved, pulled = np.ptp(q, axis=0), np.abs(torque[:, i]).max()
        name, j = self._names[i], moved.argmax()
        problem = ""
        if moved[j] < _MOVES and pulled < TORQUE:
            problem = "its motor has no torque: see its cable and its id"
        elif moved[j] < _MOVES and pulled > FULL * self._effort:
            problem = "it does not move with the torque of --effort: it is blocked"
        elif moved[j] < _MOVES:
            problem = "its motor pulls, but its encoder does not move"
        elif j != i:
            problem = f"{self._names[j]} moves in its place: ids are swapped"
        elif np.corrcoef(told[:, i], q[:, i])[0, 1] < 0.0:
            problem = "it turns the other way: see its ratio"
        elif pulled < TORQUE:
            problem = "its torque is not measured, and play cannot be found without"
        if problem:
            raise DriverError(f"{name}: {problem}")

    def _posture(self, q: np.ndarray) -> np.ndarray:
        """Return all joints of the hand, those without a motor at rest [rad]."""
        posture = self._hand.rest.copy()
        posture[self._own] = q
        return posture

    def _is_free(
        self, start: np.ndarray, way: np.ndarray, apart: float = _APART
    ) -> bool:
        """Return whether nothing touches on a way, even if some joints are ahead by a share."""
        ahead = apart * np.random.default_rng(0).choice([-1.0, 0.0, 1.0], (4, len(way)))
        ahead[0] = 0.0
        at = self._hand.configuration_vector(self._posture(start))
        full = np.zeros(self._hand.model.nv)[self._hand.active_columns]
        for shares in ahead:
            end = np.clip(start + (1.0 + shares) * way, *self._limits)
            full[self._hand.joint_columns[self._own]] = end - start
            if self._touch.met_on(at, full):
                return False
        return True

    def _way(self, start: np.ndarray, goal: np.ndarray) -> list[np.ndarray]:
        """Return a free way, straight or with the thumb first or last; empty if there is none."""
        is_thumb = np.isin(self._own, find_fingers(self._hand)[THUMB].columns)
        for via in (
            goal,
            np.where(is_thumb, start, goal),
            np.where(is_thumb, goal, start),
        ):
            ways = (start, via - start), (via, goal - via)
            if all(self._is_free(*way, apart=_TUNED) for way in ways):
                return [via, goal]
        return []

    def _spans(self) -> np.ndarray:
        """Return how far each joint alone can go from home to both sides [rad], shape (2, n)."""
        return np.array(
            [
                [self._span(way) for way in np.diag(limit - self._home)]
                for limit in self._limits
            ]
        )

    def _span(self, way: np.ndarray) -> float:
        """Return how far the joint that moves on a way can go [rad]."""
        free = (share for share in _SHARES if self._is_free(self._home, share * way))
        return float(next(free, 0.0) * way.sum())

    def _groups(self, spans: np.ndarray) -> list[list[int]]:
        """Return joints that can move at the same time."""
        groups: list[list[int]] = []
        for i in range(len(self._names)):
            for group in groups:
                among = np.isin(np.arange(len(self._names)), [*group, i])
                if all(self._is_free(self._home, among * span) for span in spans):
                    group.append(i)
                    break
            else:
                groups.append([i])
        return groups

    def _measure(self, group: list[int], spans: np.ndarray) -> list[Joint]:
        """Move joints together over their ranges, and find their parameters."""
        among = np.isin(np.arange(len(self._names)), group)
        home, small = self._home, _SMALL * among
        self._go(home + small, APPROACH)
        self._rest()
        start = len(self._rows)
        # An encoder rounds: at other places, it rounds other angles.
        for side in (1.0, -1.0, 0.8, -0.8):
            self._go(home + side * small, APPROACH)
            self._go(home - side * _BACK * small, _SLOW)
        for side in (1.0, -1.0, 1.0, -1.0, 1.0, -1.0):
            self._go(home + side * small, _FAST)
        self._go(home, APPROACH)
        self._rest()
        found = self._fit(start, group)
        ends = [self._end(found, span) for span in spans]
        found = self._fit(start, group)
        return [
            replace(found[i], range=self._range(i, found[i], np.array(ends)[..., i]))
            for i in group
        ]

    def _fit(self, start: int, group: list[int]) -> dict[int, Joint]:
        """Find the parameters of joints that were moved since a turn."""
        log, joints = self.log, {}
        for i in group:
            gain, *rest = fit_joint(log, i, self._effort, slice(start, None))
            least, most = _GAINS
            if not least < gain < most:
                problem = f"it moves {gain:.2g} times as far as it is told"
                advice = "see its ratio, or whether this is another hand"
                raise DriverError(f"{self._names[i]}: {problem}: {advice}")
            joints[i] = Joint(gain, *rest, range=(*self._limits[:, i],))
        return joints

    def _end(self, found: dict[int, Joint], span: np.ndarray) -> np.ndarray:
        """Go to one end of the ranges; return where joints are there, and their torques."""
        goal = self._home.copy()
        for i, joint in found.items():
            away = _NEARLY * span[i]
            pulled = goal[i] + away - joint.zero + np.sign(away) * joint.band
            goal[i] = np.clip(pulled / joint.gain, *self._limits[:, i])
        self._go(goal, _WIDE)
        self._rest()
        end = np.mean([row[2:] for row in self._rows[-9:]], axis=0)
        self._go(self._home, _WIDE)
        return end

    def _range(self, i: int, joint: Joint, ends: np.ndarray) -> tuple[float, float]:
        """Return how far a joint can go: to its stops, its limits, or where commands bring it."""
        limits = self._limits[:, i]
        found = []
        for limit, (q, torque), sign in zip(limits, ends, (-1.0, 1.0), strict=True):
            end = joint.gain * limit + joint.zero - sign * joint.band
            if sign * torque > joint.friction + _MEETS:
                end = q - sign * _INSIDE
                if abs(limit - q) > _JAM * np.ptp(limits):
                    problem = f"it stops at {q:.3g} rad on its way to {limit:.3g}"
                    advice = "it jams, or this is another hand"
                    raise DriverError(f"{self._names[i]}: {problem}: {advice}")
            found.append(float(np.clip(end, *limits)))
        low, high = found
        return low, high

    def _meet(self, tuning: Tuning) -> Tuning:
        """Bring fingertips to the thumb's, and find the encoders' errors from where they meet."""
        driver = self._driver
        self._driver = Compensated(driver, tuning)
        self._told = self._rows[-1][2]
        friction = np.array([tuning.joints[name].friction for name in self._names])
        met: list[tuple[str, np.ndarray]] = []
        ways = self._pinch_ways(tuning)
        for k, (finger, opened, near, beyond) in enumerate(ways):
            self._tell(70.0 + 30.0 * k / len(ways), f"thumb and {finger}")
            if not (way := self._way(self._told, opened)):
                for goal in self._way(self._home, self._told)[-2::-1]:
                    self._go(goal, _WIDE)
                self._go(self._home, _WIDE)
                way = self._way(self._home, opened)
            for goal in (*way, near):
                self._go(goal, _WIDE)
            self._rest()
            chains = [
                np.isin(self._own, find_fingers(self._hand)[name].columns)
                for name in (THUMB, finger)
            ]
            count = np.ceil(np.abs(beyond - near).max() / _CLOSING * driver.rate)
            for share in np.arange(count) / count:
                self._turn(near + share * (beyond - near))
                torques = np.mean([row[3] for row in self._rows[-5:]], axis=0)
                is_pressed = np.abs(torques) > friction + _MEETS
                # The thumb may meet another finger.
                if all(is_pressed[chain].any() for chain in chains):
                    self._rest()
                    met.append((finger, self._posture(self._rows[-1][2])))
                    break
            self._go(opened, _WIDE)
        for goal in (*self._way(self._home, self._told)[-2::-1], self._home):
            self._go(goal, _WIDE)
        self._driver = driver
        return self._corrected(tuning, met)

    def _corrected(self, tuning: Tuning, met: list[tuple[str, np.ndarray]]) -> Tuning:
        """Return the tuning with the encoders' errors, and the gap at each pinch."""
        errors, gaps = fit_encoders(self._hand, met)
        joints = {}
        for name, error in zip(self._names, errors[self._own].tolist(), strict=True):
            low, high = (joint := tuning.joints[name]).range
            # In the limits by the encoder, and by its error too.
            ends = low + max(error, 0.0), high + min(error, 0.0)
            joints[name] = replace(joint, encoder=error, range=ends)
        found = defaultdict[str, list[float]](list)
        for (finger, _), gap in zip(met, gaps.tolist(), strict=True):
            found[finger].append(gap)
        pinches = {finger: float(np.mean(each)) for finger, each in found.items()}
        return Tuning(joints, pinches)

    def _pinch_ways(
        self, tuning: Tuning
    ) -> list[tuple[str, np.ndarray, np.ndarray, np.ndarray]]:
        """Return pinches of the package's recording, as they are mapped to the hand.

        Returns:
            Of each: the finger, and the joints where it is open, where it is nearly closed and
            beyond where it is closed [rad]. Those whose way from home is not free are left out.
        """
        # A finger that is pushed goes through its play, which must not lead out of its range.
        hand = Hand(tuned(self._hand.spec, tuning, kept=_KEPT), mount="fixed")
        meter, own, ways = GapMeter(hand), self._own, []
        take = prepare_take(read_recording(DEMO, hand.side), hand.side)
        method = own_method(default_preset(take.human, hand))
        (run,) = compare_methods([take], hand, [method]).runs
        if run.motion is None:
            raise HandError(run.problem)
        q, random = run.motion.q, np.random.default_rng(0)
        for finger, gaps in meter.pinches(q).items():
            if not (closed := np.flatnonzero(gaps < CLOSED)).size:
                continue
            k = closed[closed.size // 2]
            columns = [find_fingers(hand)[name].columns for name in (THUMB, finger)]
            moves = np.isin(np.arange(q.shape[1]), np.concatenate(columns))
            start = np.append(0, np.flatnonzero(gaps[:k] > OPEN))[-1]
            # Other fingers stay out of the way.
            opened, shut = np.where(moves, q[[start, k]], self._posture(self._home))
            share = np.linspace(0.0, 1.0 + _BEYOND, 200)[:, None]
            found = 0
            for shift in moves * random.normal(0.0, _SHIFT, (_TRIES, q.shape[1])):
                way = np.clip(opened + share * (shut - opened) + shift, *hand.limits)
                ahead = meter.pinches(way)[finger]
                near = way[np.argmax(ahead < _NEAR)][own]
                first, last = way[0, own], way[-1, own]
                if (
                    ahead.min() < -_DEEP
                    and self._way(self._home, first)
                    and self._is_free(first, near - first, apart=0.0)
                ):
                    ways.append((finger, first, near, last))
                    found += 1
                if found == _WAYS:
                    break
        return ways
