"""How fingers flex: straight posture, direction of flexion, and fingertip motion.

A joint *curls* a finger if it changes the distance from the finger's base to its tip. The finger is
straight where that distance is largest, and flexes towards the end of the joint's range where it
is smallest. A base joint rotates the finger as a whole: it flexes the finger if it moves the tip in
the direction of the curling joints, and spreads it otherwise. Fingers without curling joints (jaws)
flex towards the other tips.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from handmap_qp.onboarding.robot import Robot
from handmap_qp.onboarding.structure import Structure
from handmap_qp.transform import transform_points

# Samples of a joint's range.
_GRID = 41
# Least relative change of a finger's length over a joint's range that counts as curling.
_LEAST_CURL = 0.06
# Least cosine between the tip motions of a base joint and of the curling joints for flexion.
_FLEXING = 0.6
# Largest relative difference of a finger's lengths at both ends of a range that count as equally
# curled.
_EVEN = 0.08


@dataclass(frozen=True, slots=True, eq=False)
class FingerFlexion:
    """How a hand's fingers flex; F fingers, n active joints.

    Attributes:
        q_open: Straight fingers [rad or m], shape (n,).
        q_closed: The same with every flexing joint at the end of its range where the finger is
            closed, shape (n,).
        flexes: Which joints flex or close a finger, shape (n,).
        moves: Which joint moves which fingertip, shape (F, n).
        bases: Base of each finger in the palm link's frame [m], shape (F, 3).
        tips_open: Fingertips at `q_open` [m], shape (F, 3).
        tips_closed: Fingertips at `q_closed` [m], shape (F, 3).
        reach: Length of each finger at `q_open` [m], shape (F,).
        ways: Unit direction of each tip's motion at the start of flexion, shape (F, 3).
        certainty: Confidence in that direction, from 0 to 1, shape (F,).
    """

    q_open: np.ndarray
    q_closed: np.ndarray
    flexes: np.ndarray
    moves: np.ndarray
    bases: np.ndarray
    tips_open: np.ndarray
    tips_closed: np.ndarray
    reach: np.ndarray
    ways: np.ndarray
    certainty: np.ndarray

    @property
    def directions(self) -> np.ndarray:
        """Unit vectors from the fingers' bases to their tips at `q_open`, shape (F, 3)."""
        return (self.tips_open - self.bases) / np.maximum(self.reach, 1e-9)[:, None]


class FingertipKinematics:
    """Fingertips of a robot as a function of its active joints.

    Args:
        robot: The robot.
        structure: Its palm and fingers.
    """

    def __init__(self, robot: Robot, structure: Structure) -> None:
        self.robot = robot
        self.structure = structure
        count = len(structure.chains)
        robot.place(robot.zero)
        self.bases = np.array(
            [robot.pose_in(chain.links[0], structure.palm)[:3, 3] for chain in structure.chains]
        )
        self.moves = np.zeros((count, len(robot.active)), dtype=bool)
        for i, chain in enumerate(structure.chains):
            for joint in chain.joints:
                if (driver := robot.drivers(joint)) in robot.active:
                    self.moves[i, robot.active.index(driver)] = True

    def tips(self, q: np.ndarray) -> np.ndarray:
        """Return the fingertips in the palm link's frame [m], shape (F, 3)."""
        self.robot.place(q)
        palm = self.structure.palm
        return np.array(
            [
                transform_points(self.robot.pose_in(c.tip.link, palm), c.tip.xyz)
                for c in self.structure.chains
            ]
        )

    def lengths(self, q: np.ndarray) -> np.ndarray:
        """Return the distances of the tips from the fingers' bases [m], shape (F,)."""
        return np.linalg.norm(self.tips(q) - self.bases, axis=1)

    def slopes(self, q: np.ndarray, joint: int) -> np.ndarray:
        """Return the derivative of the tips by one joint, shape (F, 3)."""
        step = np.zeros(len(q))
        step[joint] = 1e-5
        return (self.tips(q + step) - self.tips(q - step)) / 2e-5


def find_flexion(robot: Robot, structure: Structure) -> FingerFlexion:
    """Find how the fingers of a hand flex.

    Args:
        robot: The robot.
        structure: Its palm and fingers.

    Returns:
        Open and closed posture, and the flexion of every finger.
    """
    fingers = FingertipKinematics(robot, structure)
    moves = fingers.moves
    q_open, curls, ends = _straighten(fingers)
    sign = np.zeros(len(q_open))
    certainty = np.zeros(len(moves))
    ways = np.zeros((len(moves), 3))
    for i in range(len(moves)):
        curling = [j for j in np.flatnonzero(curls).tolist() if moves[i, j] and ends[j] != 0.0]
        way = sum((ends[j] * fingers.slopes(q_open, j)[i] for j in curling), np.zeros(3))
        if np.linalg.norm(way) > 1e-6:
            ways[i], certainty[i] = way / np.linalg.norm(way), 0.95
            sign[curling] = ends[curling]
    _settle_even(fingers, q_open, curls & (ends == 0.0), sign, ways, certainty)
    _close_jaws(fingers, q_open, sign, ways, certainty)
    _sign_base_joints(fingers, q_open, sign, ways, certainty)
    flexes = sign != 0.0
    q_closed = np.where(sign > 0.0, robot.upper, np.where(sign < 0.0, robot.lower, q_open))
    # A jaw is open at one end of its range, which need not be zero.
    slides = flexes & ~curls & np.array([robot.kinds[name] == "prismatic" for name in robot.active])
    q_open = np.where(slides, np.where(sign > 0.0, robot.lower, robot.upper), q_open)
    tips_open = fingers.tips(q_open)
    return FingerFlexion(
        q_open=q_open,
        q_closed=q_closed,
        flexes=flexes,
        moves=moves,
        bases=fingers.bases,
        tips_open=tips_open,
        tips_closed=fingers.tips(q_closed),
        reach=np.linalg.norm(tips_open - fingers.bases, axis=1),
        ways=ways,
        certainty=certainty,
    )


def _straighten(fingers: FingertipKinematics) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the straight posture, which joints curl, and the sign of their curled end."""
    robot = fingers.robot
    q = robot.zero.copy()
    curls, ends = np.zeros(len(q), dtype=bool), np.zeros(len(q))
    turning = [
        j
        for j in np.flatnonzero(fingers.moves.any(axis=0))
        if robot.kinds[robot.active[j]] != "prismatic"
    ]
    # Coordinate descent: the best value of a joint depends on the others; three rounds suffice.
    for _ in range(3):
        for j in turning:
            grid = np.append(np.linspace(robot.lower[j], robot.upper[j], _GRID), q[j])
            lengths = np.array(
                [
                    fingers.lengths(np.where(np.arange(len(q)) == j, value, q))[fingers.moves[:, j]]
                    for value in grid
                ]
            )
            total = lengths.sum(axis=1)
            curls[j] = bool((np.ptp(lengths, axis=0) > _LEAST_CURL * lengths.max(axis=0)).any())
            if curls[j]:
                # Several postures are equally straight: take the one nearest to zero.
                best = np.flatnonzero(total > total.max() - 1e-4 * total.max())
                q[j] = grid[best[np.argmin(np.abs(grid[best] - robot.zero[j]))]]
                low, high = total[0], total[_GRID - 1]
                ends[j] = (
                    0.0 if abs(high - low) < _EVEN * total.max() else float(np.sign(low - high))
                )
    return q, curls, ends


def _settle_even(
    fingers: FingertipKinematics,
    q: np.ndarray,
    even: np.ndarray,
    sign: np.ndarray,
    ways: np.ndarray,
    certainty: np.ndarray,
) -> None:
    """Choose the direction of joints that curl equally far both ways.

    Follow the finger's other joints, else the other fingers, else towards the other tips, else the
    upper limit.
    """
    for j in np.flatnonzero(even).tolist():
        mine = fingers.moves[:, j]
        slope = fingers.slopes(q, j)
        own = float((slope[mine] * ways[mine]).sum())
        others = float((slope[mine] @ ways[~mine].sum(axis=0)).sum()) if (~mine).any() else 0.0
        nearer = _nearness(fingers, q, j)
        clear = 0.1 * float(np.linalg.norm(slope[mine]))
        votes = ((own, 0.9), (0.5 * others, 0.6), (nearer, 0.4), (1.0, 0.1))
        vote, confidence = next(pair for pair in votes if abs(pair[0]) > min(clear, 0.5))
        sign[j] = np.sign(vote)
        for i in np.flatnonzero(mine & (certainty < confidence)):
            ways[i], certainty[i] = (
                sign[j] * slope[i] / max(float(np.linalg.norm(slope[i])), 1e-9),
                confidence,
            )


def _nearness(fingers: FingertipKinematics, q: np.ndarray, j: int) -> float:
    """Return how much a joint's motion from lower to upper limit brings tips together [m]."""
    robot = fingers.robot
    distances = []
    for value in (robot.lower[j], robot.upper[j]):
        tips = fingers.tips(np.where(np.arange(len(q)) == j, value, q))
        distances.append(
            np.linalg.norm(tips[fingers.moves[:, j]][:, None] - tips[None], axis=2).sum()
        )
    return float(distances[0] - distances[1]) / max(1, len(fingers.bases) - 1)


def _close_jaws(
    fingers: FingertipKinematics,
    q: np.ndarray,
    sign: np.ndarray,
    ways: np.ndarray,
    certainty: np.ndarray,
) -> None:
    """Flex fingers without curling joints towards the other tips."""
    for i in np.flatnonzero(certainty == 0.0):
        nearer = {j: _nearness(fingers, q, j) for j in np.flatnonzero(fingers.moves[i]).tolist()}
        if not nearer or max(map(abs, nearer.values())) < 1e-4:
            continue
        j = max(nearer, key=lambda one: abs(nearer[one]))
        sign[j] = np.sign(nearer[j])
        slope = sign[j] * fingers.slopes(q, j)[i]
        ways[i], certainty[i] = slope / max(float(np.linalg.norm(slope)), 1e-9), 0.7


def _sign_base_joints(
    fingers: FingertipKinematics,
    q: np.ndarray,
    sign: np.ndarray,
    ways: np.ndarray,
    certainty: np.ndarray,
) -> None:
    """Set the direction of base joints that move the tip as flexion does."""
    for j in np.flatnonzero((sign == 0.0) & fingers.moves.any(axis=0)).tolist():
        slope = fingers.slopes(q, j)
        speed = np.linalg.norm(slope, axis=1)
        mine = fingers.moves[:, j] & (speed > 1e-4) & (certainty > 0.0)
        cosines = (slope[mine] * ways[mine]).sum(axis=1) / speed[mine]
        if len(cosines) and abs(cosines.mean()) > _FLEXING:
            sign[j] = np.sign(cosines.mean())
