"""How the fingers of a hand flex together: open and closed posture, and fingertip motion.

Each finger by itself is analysed by `handmap_qp.hands.fingers`. Here, fingers that curl equally far
both ways follow the others, and base joints flex if they move the tip in the same direction. A
finger whose range says nothing flexes as its copy does, if it has one (`copies`).

A finger with a single flexing joint has the same length everywhere, so it shows no curling. What it
is, a finger that is straight at zero or a jaw that flexes towards the other tips, is found by
`single_joints`.
"""

from collections.abc import Sequence

import numpy as np

from handmap_core.se3 import Array, lengths, unit
from handmap_qp.hands import (
    PARALLEL,
    Finger,
    Hand,
    PalmKinematics,
    ends_of,
    nearing,
)
from .copies import find_copies
from .vectors import UNKNOWN

# Least cosine between the tip motions of a base joint and of the curling joints for flexion.
_FLEXING = 0.6
# Shares of its phalanges: a shorter finger is bent, a longer first phalanx has a direction.
_STRETCHED = 0.985
_PHALANX = 0.2
# A thumb is this share of the fingers' reach in front of the palm.
_LEAST_HEIGHT = 0.05


class HandFlexion:
    """How a hand's fingers flex; F fingers, n active joints.

    Args:
        robot: The robot, or a hand.
        fingers: Fingers of it.
        palmar: Direction out of the palm in the palm link's frame, zero if unknown: the way of
            fingers that curl equally far both ways, shape (3,).
        straight: Confidence in fingers with one flexing joint that zero is straight, 0 of jaws,
            shape (F,); all are jaws if omitted.

    Attributes:
        q_open: Straight fingers [rad or m], shape (n,).
        q_closed: The same with every flexing joint at the end of its range where the finger is
            closed, shape (n,).
        sign: Sense in which each joint flexes or closes a finger, 0 if it does not, shape (n,).
        slides: Which joints are those of jaws, or turn no fingertip, shape (n,).
        shortens: Which fingers curl, so that they are shorter when they are closed, shape (F,).
        moves: Which joint moves which fingertip, shape (F, n).
        hinges: Axis of each finger's first joint, in the palm link's frame, shape (F, 3).
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

    def __init__(
        self,
        robot: Hand,
        fingers: Sequence[Finger],
        palmar: Array = UNKNOWN,
        *,
        straight: Array | None = None,
    ) -> None:
        self._fingers = fingers
        self._view = PalmKinematics(robot)
        self._tips = [finger.tip for finger in fingers]
        zero = robot.zero
        # A fixed jaw starts where the moving one does, which comes first.
        self.hinges, self.roots = self._view.axes(
            zero, [(each.joints or fingers[0].joints)[0] for each in fingers]
        )
        self.bases = self.roots.copy()
        positions = np.zeros((len(fingers), len(zero)))
        # Sense in which each joint turns a tip about the axis of the finger's curling.
        self._curls = np.zeros_like(positions)
        self.axes = np.zeros_like(self.bases)
        senses = np.zeros(len(fingers))
        unfolded = np.zeros(len(fingers)) if straight is None else straight
        groups = [finger.flexion for finger in fingers]
        copies = find_copies(self._view, fingers, groups)
        self.shortens = np.array([bool(group and group.curls) for group in groups])
        for i, group in enumerate(groups):
            if group and (group.curls or unfolded[i]):
                self._curls[i] = group.signs
                self.axes[i] = group.axis
                self.bases[i] = group.knuckle
                positions[i] = group.straight
                senses[i] = group.sense * (unfolded[i] or group.certainty)
        for i, copy in copies.items():
            original, column = copy.columns
            positions[i, column] = copy.position(positions[copy.original])
            closing = copy.sense * senses[copy.original]
            senses[i] = (
                closing * self._curls[copy.original, original] * self._curls[i, column]
            )
        self.certainty = np.abs(senses)
        self.sign = np.sign(senses @ self._curls)
        # A joint that moves several fingers takes the mean of their straight positions.
        curling = np.ma.array(positions, mask=self._curls == 0.0)
        self.q_open = curling.mean(axis=0).filled(zero)
        motions = np.array([self._view.motion(self.q_open, tip) for tip in self._tips])
        self.moves = np.any(motions, axis=1)
        self._motions = motions[:, :3]
        self.slides = ~motions[:, 3:].any(axis=(0, 1))
        self._settle_even(palmar)
        self.ways = self._ways()
        self.axes *= np.sign(self._curls @ self.sign)[:, None]
        self._close_jaws()
        self.slides |= (self.sign != 0.0) & ~self._curls.any(axis=0)
        self._sign_base_joints()
        start, self.q_closed = ends_of(robot, self.q_open, self.sign)
        for copy in copies.values():
            self.q_closed[copy.columns[1]] = copy.position(self.q_closed)
        # A jaw is open at one end of its range, which need not be zero.
        self.q_open = np.where(self.slides, start, self.q_open)
        self.tips_open = self.tips(self.q_open)
        self.tips_closed = self.tips(self.q_closed)
        lines = self.tips_open - self.bases
        self.reach = lengths(lines)
        for i in np.flatnonzero(self._curls.any(axis=1)):
            lines[i] = self._line(i)
        self.directions = unit(lines)

    def tips(self, q: Array) -> Array:
        """Return the fingertips in postures of shape (..., n) [m], shape (..., F, 3)."""
        return self._view.points(q, self._tips)

    def _ways(self) -> Array:
        """Return the directions in which the curling joints move the tips, shape (F, 3)."""
        signs = np.abs(self._curls) * self.sign
        return unit(np.matvec(self._motions, signs))

    def _settle_even(self, palmar: Array) -> None:
        """Choose the direction of fingers that curl equally far both ways.

        Follow the palm, else the other fingers, else towards the other tips, else the positive one.
        """
        known = self._ways()[self.certainty > 0.0].sum(axis=0)
        slopes = np.matvec(self._motions, self._curls)
        even = self._curls.any(axis=1) & (self.certainty == 0.0)
        # Fingers that move in parallel close to the same side.
        units = unit(slopes)
        is_parallel = np.abs(units @ units.T) > PARALLEL
        groups: dict[int, list[int]] = {}
        for i in np.flatnonzero(even):
            first = next((k for k in groups if is_parallel[i, k]), i)
            groups.setdefault(first, []).append(i)
        for alike in sorted(groups.values(), key=len, reverse=True):
            senses = np.copysign(1.0, slopes[alike] @ slopes[alike[0]])
            signs = senses[:, None] * self._curls[alike]
            slope = senses @ slopes[alike]
            votes = (
                (slope @ palmar, 0.7),
                (0.5 * slope @ known, 0.6),
                (self._side_of_others(alike, slope), 0.5),
                (sum(map(self._nearing, alike, signs)), 0.4),
                (1.0, 0.1),
            )
            clear = min(0.1 * lengths(slope), 0.5)
            vote, confidence = next(pair for pair in votes if abs(pair[0]) > clear)
            self.certainty[alike] = confidence
            for own in np.sign(vote) * signs:
                self.sign += own * (self.sign == 0.0)

    def _close_jaws(self) -> None:
        """Flex fingers without curling joints towards the other tips."""
        for i in np.flatnonzero(self.certainty == 0.0):
            each = np.diag(self.moves[i])
            nearer = np.array([self._nearing(i, signs) for signs in each])
            j = np.abs(nearer).argmax()
            if abs(nearer[j]) >= 1e-4:
                self.sign[j] = np.sign(nearer[j])
                self.ways[i] = unit(self.sign[j] * self._motions[i, :, j])
                self.certainty[i] = 0.7

    def _sign_base_joints(self) -> None:
        """Set the direction of base joints that move the tip as flexion does."""
        speeds = np.linalg.norm(self._motions, axis=1)
        along = np.vecmat(self.ways, self._motions)
        mine = (speeds > 1e-4) & (self.certainty[:, None] > 0.0)
        ratios = np.ma.array(along, mask=~mine) / speeds
        cosines = ratios.mean(axis=0).filled(0.0)
        flexes = (self.sign == 0.0) & (np.abs(cosines) > _FLEXING)
        self.sign[flexes] = np.sign(cosines[flexes])

    def _line(self, i: int) -> Array:
        """Return a straight finger's line; that of its first phalanx if it stays bent."""
        finger = self._fingers[i]
        tip = self.tips_open[i]
        _, points = self._view.axes(self.q_open, finger.bending, finger.tip)
        parts = np.diff([*points, tip], axis=0)
        sizes = lengths(parts)
        is_bent = lengths(tip - points[0]) < _STRETCHED * sizes.sum()
        is_long = sizes[0] > _PHALANX * sizes.sum()
        return parts[0] if is_bent and is_long else tip - self.bases[i]

    def _side_of_others(self, mine: list[int], slope: Array) -> float:
        """Return whether the other fingers are in the direction `slope` of two or more alike ones.

        A thumb is on the palm's side of the fingers. The answer is 1 or -1, and 0 if unclear.
        """
        if len(mine) < 2 or len(mine) == len(self.roots):
            return 0.0
        tips = self.tips(self.q_open)
        heights = 0.5 * (self.roots + tips) @ unit(slope)
        height = np.delete(heights, mine).mean() - heights[mine].mean()
        least = _LEAST_HEIGHT * lengths(tips[mine] - self.roots[mine]).mean()
        return 0.0 if abs(height) < least else np.sign(height)

    def _nearing(self, i: int, signs: Array) -> float:
        """Return how much joints bring a tip to another on average from end to end [m]."""
        others = max(1, len(self._tips) - 1)
        ends = ends_of(self._view.hand, self.q_open, signs)
        return nearing(self._view, ends, self._tips, i) / others
