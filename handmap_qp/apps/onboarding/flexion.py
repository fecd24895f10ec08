"""How the fingers of a hand flex together: open and closed posture, and fingertip motion.

Each finger by itself is analysed by `handmap_qp.hands.fingers`. Here, fingers that curl equally far
both ways follow the others, fingers without curling joints (jaws) flex towards the other tips, and
base joints flex if they move the tip in the same direction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.hands.fingers import (
    PARALLEL,
    Finger,
    Flexion,
    PalmKinematics,
    ends_of,
    joint_motion,
    nearing,
)

# Least cosine between the tip motions of a base joint and of the curling joints for flexion.
_FLEXING = 0.6
# A finger shorter than this share of its phalanges is bent; its first phalanx has a direction if it
# is longer than this share of them.
_STRETCHED, _PHALANX = 0.985, 0.2
# A thumb is this share of the fingers' reach in front of the palm.
_LEAST_HEIGHT = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class HandFlexion:
    """How a hand's fingers flex; F fingers, n active joints.

    Attributes:
        q_open: Straight fingers [rad or m], shape (n,).
        q_closed: The same with every flexing joint at the end of its range where the finger is
            closed, shape (n,).
        flexes: Which joints flex or close a finger, shape (n,).
        moves: Which joint moves which fingertip, shape (F, n).
        roots: Origin of each finger's first joint in the palm link's frame [m], shape (F, 3).
        bases: Knuckle of each finger: the point of the first flexing axis nearest to the tip, or
            the root of a finger without one, in the palm link's frame [m], shape (F, 3).
        tips_open: Fingertips at `q_open` [m], shape (F, 3).
        tips_closed: Fingertips at `q_closed` [m], shape (F, 3).
        reach: Length of each finger at `q_open`, from its base [m], shape (F,).
        ways: Unit direction of each tip's motion at the start of flexion, shape (F, 3).
        axes: Unit axis about which each finger curls, right-handed; zero if none, shape (F, 3).
        certainty: Confidence in the direction of flexion, from 0 to 1, shape (F,).
        directions: Unit vectors from the fingers' bases to their tips at `q_open`, or along the
            first phalanx of fingers that cannot stretch, shape (F, 3).
    """

    q_open: np.ndarray
    q_closed: np.ndarray
    flexes: np.ndarray
    moves: np.ndarray
    roots: np.ndarray
    bases: np.ndarray
    tips_open: np.ndarray
    tips_closed: np.ndarray
    reach: np.ndarray
    ways: np.ndarray
    axes: np.ndarray
    certainty: np.ndarray
    directions: np.ndarray


def find_flexion(
    robot: Robot, fingers: list[Finger], palmar: np.ndarray | None = None
) -> HandFlexion:
    """Find how the fingers of a hand flex.

    Args:
        robot: The robot.
        fingers: Its fingers.
        palmar: Direction out of the palm in the palm link's frame, if known: the way of fingers
            that curl equally far both ways, shape (3,).

    Returns:
        Open and closed posture, and the flexion of every finger.
    """
    hand = _Closing(robot, fingers)
    hand.settle_even(palmar)
    hand.close_jaws()
    hand.sign_base_joints()
    sign, q_open = hand.sign, hand.q_open
    lower, upper = robot.lower_limits, robot.upper_limits
    # A jaw is open at one end of its range, which need not be zero.
    slides = (sign != 0.0) & ~hand.curls & robot.slides
    open_jaws = np.where(slides, np.where(sign > 0.0, lower, upper), q_open)
    q_closed = np.where(sign > 0.0, upper, np.where(sign < 0.0, lower, q_open))
    tips_open, tips_closed = hand.view.points(
        np.array([open_jaws, q_closed]), hand.tips
    )
    bases = hand.roots.copy()
    for i, group in hand.groups.items():
        bases[i] = group.knuckle
    moves = np.zeros((len(fingers), len(sign)), dtype=bool)
    for i, finger in enumerate(fingers):
        moves[i, finger.columns] = True
    lines = [hand.line(i, bases[i], tip) for i, tip in enumerate(tips_open)]
    return HandFlexion(
        q_open=open_jaws,
        q_closed=q_closed,
        flexes=sign != 0.0,
        moves=moves,
        roots=hand.roots,
        bases=bases,
        tips_open=tips_open,
        tips_closed=tips_closed,
        reach=np.linalg.norm(tips_open - bases, axis=1),
        ways=hand.ways,
        axes=hand.axes,
        certainty=hand.certainty,
        directions=np.array([_unit(line) for line in lines]),
    )


class _Closing:
    """Which joints close a hand's fingers, and in which sense.

    Attributes:
        groups: Flexion of every finger that curls, in the open posture, by its index.
        curls: Which joints curl a finger, shape (n,).
        sign: Sense in which each joint closes a finger, 0 if unknown, shape (n,).
    """

    def __init__(self, robot: Robot, fingers: list[Finger]) -> None:
        self.robot, self.fingers, self.view = robot, fingers, PalmKinematics(robot)
        self.tips = [finger.tip for finger in fingers]
        self.roots = np.array(
            [self.view.axes(robot.zero, finger.joints[:1])[1][0] for finger in fingers]
        )
        curling = {
            i: finger.flexion
            for i, finger in enumerate(fingers)
            if finger.flexion is not None and finger.flexion.curls
        }
        # A joint that moves several fingers takes the mean of their straight positions.
        sums, counts = np.zeros(len(robot.zero)), np.zeros(len(robot.zero))
        for group in curling.values():
            sums[group.columns] += group.straight
            counts[group.columns] += 1.0
        self.curls = counts > 0.0
        self.q_open = np.where(self.curls, sums / np.maximum(counts, 1.0), robot.zero)
        self.groups: dict[int, Flexion] = {}
        self.sign = np.zeros(len(robot.zero))
        self.certainty = np.zeros(len(fingers))
        self.ways, self.axes = np.zeros((2, len(fingers), 3))
        self.motions = np.array(
            [self.view.motion(self.q_open, tip) for tip in self.tips]
        )
        for i, group in curling.items():
            axis, knuckle, signs = fingers[i].flexion_at(self.q_open)
            self.groups[i] = replace(group, axis=axis, knuckle=knuckle, signs=signs)
            self.sign[group.columns] += group.certainty * group.sense * signs
        self.sign = np.sign(self.sign)
        for i, group in self.groups.items():
            if group.certainty > 0.0:
                self._settle(i, group.certainty)

    def _settle(self, i: int, certainty: float) -> None:
        """Set the tip's motion at the start of flexion, the flexion's axis, and the confidence."""
        group = self.groups[i]
        sign = self.sign[group.columns]
        self.ways[i] = _unit(self.motions[i, :3, group.columns].T @ sign)
        self.axes[i] = np.sign((sign * group.signs).sum()) * group.axis
        self.certainty[i] = certainty

    def settle_even(self, palmar: np.ndarray | None) -> None:
        """Choose the direction of groups that curl equally far both ways.

        Follow the palm if it is known, else the other fingers, else towards the other tips, else
        the positive sense.
        """
        known = self.ways[self.certainty > 0.0].sum(axis=0)
        slopes = {
            i: self.motions[i, :3, group.columns].T @ group.signs
            for i, group in self.groups.items()
            if self.certainty[i] == 0.0
        }
        for alike in _alike(slopes):
            senses = [np.sign(slopes[i] @ slopes[alike[0]]) or 1.0 for i in alike]
            slope = np.sum(
                [s * slopes[i] for s, i in zip(senses, alike, strict=True)], axis=0
            )
            nearer = sum(
                self._nearing(i, self.groups[i].columns, s * self.groups[i].signs)
                for s, i in zip(senses, alike, strict=True)
            )
            votes = (
                (0.0 if palmar is None else float(slope @ palmar), 0.7),
                (0.5 * float(slope @ known), 0.6),
                (self._side_of_others(alike, slope), 0.5),
                (nearer, 0.4),
                (1.0, 0.1),
            )
            clear = min(0.1 * float(np.linalg.norm(slope)), 0.5)
            vote, confidence = next(pair for pair in votes if abs(pair[0]) > clear)
            for sense, i in zip(senses, alike, strict=True):
                columns, signs = self.groups[i].columns, self.groups[i].signs
                given = self.sign[columns]
                self.sign[columns] = np.where(
                    given == 0.0, np.sign(vote) * sense * signs, given
                )
                self._settle(i, confidence)

    def close_jaws(self) -> None:
        """Flex fingers without curling joints towards the other tips."""
        for i in np.flatnonzero(self.certainty == 0.0).tolist():
            nearer = {
                j: self._nearing(i, [j]) for j in self.fingers[i].columns.tolist()
            }
            j = max(nearer, key=lambda one: abs(nearer[one]), default=-1)
            if j >= 0 and abs(nearer[j]) >= 1e-4:
                self.sign[j] = np.sign(nearer[j])
                self.ways[i] = _unit(self.sign[j] * self.motions[i, :3, j])
                self.certainty[i] = 0.7

    def sign_base_joints(self) -> None:
        """Set the direction of base joints that move the tip as flexion does."""
        speeds = np.linalg.norm(self.motions[:, :3], axis=1)
        along = np.einsum("fkn,fk->fn", self.motions[:, :3], self.ways)
        for j in np.flatnonzero(self.sign == 0.0).tolist():
            mine = (speeds[:, j] > 1e-4) & (self.certainty > 0.0)
            cosine = (along[mine, j] / speeds[mine, j]).mean() if mine.any() else 0.0
            if abs(cosine) > _FLEXING:
                self.sign[j] = np.sign(cosine)

    def line(self, i: int, base: np.ndarray, tip: np.ndarray) -> np.ndarray:
        """Return a straight finger's line; that of its first phalanx if it stays bent."""
        line = tip - base
        if i in self.groups:
            axis, columns = self.groups[i].axis, self.groups[i].columns
            model, joints = self.robot.model, self.fingers[i].joints
            rows = joint_motion(self.robot)[[model.joints[j].idx_v for j in joints]]
            turns, points = self.view.axes(self.q_open, joints)
            points = points[rows[:, columns].any(axis=1) & turns.any(axis=1)] - base
            flat = points - np.outer(points @ axis, axis)
            order = np.argsort(np.linalg.norm(flat, axis=1), kind="stable")[1:]
            parts = np.diff([np.zeros(3), *flat[order], line], axis=0)
            lengths = np.linalg.norm(parts, axis=1)
            is_bent = np.linalg.norm(line) < _STRETCHED * lengths.sum()
            if is_bent and lengths[0] > _PHALANX * lengths.sum():
                return parts[0]
        return line

    def _side_of_others(self, mine: list[int], slope: np.ndarray) -> float:
        """Return whether the other fingers are in the direction `slope` of two or more alike ones.

        A thumb is on the palm's side of the fingers. The answer is 1 or -1, and 0 if unclear.
        """
        others = [i for i in range(len(self.roots)) if i not in mine]
        length = float(np.linalg.norm(slope))
        if len(mine) < 2 or not others or length < 1e-9:
            return 0.0
        tips = self.view.points(self.q_open, self.tips)
        places = 0.5 * (self.roots + tips)
        height = (
            float((places[others].mean(axis=0) - places[mine].mean(axis=0)) @ slope)
            / length
        )
        reach = float(np.linalg.norm(tips[mine] - self.roots[mine], axis=1).mean())
        return 0.0 if abs(height) < _LEAST_HEIGHT * reach else float(np.sign(height))

    def _nearing(
        self, i: int, columns: np.ndarray | list[int], signs: np.ndarray | float = 1.0
    ) -> float:
        """Return how much joints bring a tip to another on average from end to end [m]."""
        ends = ends_of(self.robot, self.q_open, columns, signs)
        return nearing(self.view, ends, self.tips, i) / max(1, len(self.tips) - 1)


def _alike(slopes: dict[int, np.ndarray]) -> list[list[int]]:
    """Return the fingers that move in parallel together: they close to the same side."""
    found: list[list[int]] = []
    for i, slope in slopes.items():
        for alike in found:
            if abs(float(_unit(slope) @ _unit(slopes[alike[0]]))) > PARALLEL:
                alike.append(i)
                break
        else:
            found.append([i])
    return sorted(found, key=len, reverse=True)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / max(float(np.linalg.norm(vector)), 1e-9)
