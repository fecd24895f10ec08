"""How fingers flex: straight posture, direction of flexion, and fingertip motion.

The joints of a finger are judged in groups of parallel axes. A group *curls* the finger if it
changes the distance from the group's first axis to the tip. The group that changes it most is the
finger's flexion. The finger is straight where that distance is largest, and flexes towards the end
of the group's range where it is smallest, or to which the range is longer. Other joints flex the
finger if they move the tip in the same direction, and spread it otherwise. Fingers without curling
joints (jaws) flex towards the other tips.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from handmap_qp.onboarding.robot import Robot
from handmap_qp.onboarding.structure import Structure
from handmap_qp.transform import transform_points

# Samples of a joint's range, and of a group's way from straight to one end of its range.
_GRID, _SWEEP = 25, 11
# Least relative change of a finger's length over a group's range that counts as curling.
_LEAST_CURL = 0.06
# Axes whose cosine exceeds this are parallel.
_PARALLEL = 0.85
# A joint of a parallelogram turns the tip by less than this per radian: a jaw that moves on a
# circle, and curls nothing.
_LEAST_TURN = 0.1
# Least cosine between the tip motions of a base joint and of the curling joints for flexion.
_FLEXING = 0.6
# Largest relative difference of a finger's lengths at both ends of a range, and of the ranges to
# both sides, that count as equal.
_EVEN_LENGTH, _EVEN_RANGE = 0.08, 0.25
# A finger that is this near to its full length at the zero position is straight there.
_STRAIGHT = 0.993
# Joints that are flexed by more than this at the zero position say that it is no straight one
# [rad].
_FLEXED_ZERO = 0.3
# A finger shorter than this share of its phalanges is bent; its first phalanx has a direction if it
# is longer than this share of them.
_STRETCHED, _PHALANX = 0.985, 0.2
# A thumb is this share of the fingers' reach in front of the palm.
_LEAST_HEIGHT = 0.05
# Score of a symmetric range relative to a one-sided one, and of a group without the last joint.
_SYMMETRIC, _NOT_LAST = 0.6, 0.7


@dataclass(frozen=True, slots=True, eq=False)
class FingerFlexion:
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


@dataclass(frozen=True, slots=True, eq=False)
class _Group:
    """Joints of one finger with parallel axes.

    Attributes:
        finger: Index of the finger.
        joints: Indices of the active joints, from the palm outwards.
        signs: Sense of each joint about `axis`, shape (k,).
        axis: Common axis in the palm link's frame, shape (3,).
        base: Point of the first axis nearest to the tip [m], shape (3,).
        share: Relative shortening of the finger towards either sense, shape (2,).
        travel: Sum of the ranges towards either sense [rad], shape (2,).
        score: How much it looks like the flexion of a finger.
        straight: Positions of its joints where the finger is straight [rad], shape (k,).
    """

    finger: int
    joints: np.ndarray
    signs: np.ndarray
    axis: np.ndarray
    base: np.ndarray
    share: np.ndarray
    travel: np.ndarray
    score: float
    straight: np.ndarray

    @property
    def way(self) -> tuple[float, float]:
        """Sense of the closed end about `axis` (0 if unknown), and the confidence in it."""
        by_share = float(self.share[0] - self.share[1])
        total = max(float(self.travel.sum()), 1e-9)
        by_range = float(self.travel[0] - self.travel[1]) / total
        has_share, has_range = abs(by_share) > _EVEN_LENGTH, abs(by_range) > _EVEN_RANGE
        if has_share and has_range:
            return (np.sign(by_share), 0.95 if by_share * by_range > 0.0 else 0.5)
        if has_share or has_range:
            return float(np.sign(by_share if has_share else by_range)), 0.75
        return 0.0, 0.0


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
        self.roots = np.array(
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
        return np.array([self._tip(i) for i in range(len(self.structure.chains))])

    def tip(self, q: np.ndarray, i: int) -> np.ndarray:
        """Return one fingertip in the palm link's frame [m], shape (3,)."""
        self.robot.place(q)
        return self._tip(i)

    def _tip(self, i: int) -> np.ndarray:
        tip = self.structure.chains[i].tip
        return transform_points(self.robot.pose_in(tip.link, self.structure.palm), tip.xyz)

    def slopes(self, q: np.ndarray, joint: int) -> np.ndarray:
        """Return the derivative of the tips by one joint, shape (F, 3)."""
        step = np.zeros(len(q))
        step[joint] = 1e-5
        return (self.tips(q + step) - self.tips(q - step)) / 2e-5

    def axes(self, q: np.ndarray, i: int, joint: int) -> list[tuple[np.ndarray, np.ndarray]]:
        """Return the axes of a finger's turning joints that an active joint moves.

        Returns:
            Vector along the axis, its length the angle per angle of the active joint, and a point
            on it [m], for each joint of the chain from the palm outwards, in the palm link's frame.
        """
        robot, palm, found = self.robot, self.structure.palm, []
        robot.place(q)
        chain = self.structure.chains[i]
        for name, link in zip(chain.joints, chain.links, strict=True):
            if robot.drivers(name) == robot.active[joint] and robot.kinds[name] != "prismatic":
                pose = robot.pose_in(link, palm)
                turn = robot.gear(name) * pose[:3, :3] @ robot.axes[name]
                found.append((turn, pose[:3, 3]))
        return found


def find_flexion(
    robot: Robot, structure: Structure, palmar: np.ndarray | None = None
) -> FingerFlexion:
    """Find how the fingers of a hand flex.

    Args:
        robot: The robot.
        structure: Its palm and fingers.
        palmar: Direction out of the palm in the palm link's frame, if known: the way of fingers
            that curl equally far both ways, shape (3,).

    Returns:
        Open and closed posture, and the flexion of every finger.
    """
    fingers = FingertipKinematics(robot, structure)
    moves, count = fingers.moves, len(fingers.moves)
    groups = [_flexing_group(fingers, i) for i in range(count)]
    groups = [group if group is None else _with_knuckle(fingers, group) for group in groups]
    curls, q_open = _straighten(fingers, groups)
    groups = [group if group is None else _turned(fingers, group, q_open) for group in groups]
    sign = np.zeros(len(q_open))
    certainty, ways, axes = np.zeros(count), np.zeros((count, 3)), np.zeros((count, 3))
    for group in groups:
        if group is not None:
            sense, confidence = group.way
            sign[group.joints] += confidence * sense * group.signs
            certainty[group.finger] = confidence
    sign = np.sign(sign)
    for group in groups:
        if group is not None and certainty[group.finger] > 0.0:
            ways[group.finger], axes[group.finger] = _motion(fingers, group, q_open, sign)
    _settle_even(fingers, q_open, groups, sign, ways, axes, certainty, palmar)
    _close_jaws(fingers, q_open, sign, ways, certainty)
    _sign_base_joints(fingers, q_open, sign, ways, certainty)
    flexes = sign != 0.0
    q_closed = np.where(sign > 0.0, robot.upper, np.where(sign < 0.0, robot.lower, q_open))
    # A jaw is open at one end of its range, which need not be zero.
    slides = flexes & ~curls & np.array([robot.kinds[name] == "prismatic" for name in robot.active])
    q_open = np.where(slides, np.where(sign > 0.0, robot.lower, robot.upper), q_open)
    tips_open = fingers.tips(q_open)
    bases = np.array(
        [fingers.roots[i] if group is None else group.base for i, group in enumerate(groups)]
    )
    return FingerFlexion(
        q_open=q_open,
        q_closed=q_closed,
        flexes=flexes,
        moves=moves,
        roots=fingers.roots,
        bases=bases,
        tips_open=tips_open,
        tips_closed=fingers.tips(q_closed),
        reach=np.linalg.norm(tips_open - bases, axis=1),
        ways=ways,
        axes=axes,
        certainty=certainty,
        directions=np.array(
            [
                _direction(fingers, i, groups[i], q_open, bases[i], tips_open[i])
                for i in range(count)
            ]
        ),
    )


def _flexing_group(fingers: FingertipKinematics, i: int) -> _Group | None:
    """Return the group of parallel joints that curls a finger most; None if none does."""
    groups = [_measured(fingers, i, joints) for joints in _parallel_joints(fingers, i)]
    curling = [group for group in groups if group.share.max() > _LEAST_CURL]
    return max(curling, key=lambda group: group.score) if curling else None


def _parallel_joints(fingers: FingertipKinematics, i: int) -> list[list[int]]:
    """Return the active turning joints of a finger, grouped by axis, the last joint's first."""
    robot, q = fingers.robot, fingers.robot.zero
    groups: list[tuple[np.ndarray, list[int]]] = []
    chain = fingers.structure.chains[i]
    drivers = dict.fromkeys(robot.drivers(joint) for joint in reversed(chain.joints))
    for driver in drivers:
        if driver not in robot.active:
            continue
        j = robot.active.index(driver)
        turns = [turn for turn, _ in fingers.axes(q, i, j)]
        if not turns:
            continue
        turn = np.sum(turns, axis=0)
        size = float(np.linalg.norm(turn))
        if size < _LEAST_TURN:
            continue
        axis = turn / size
        for other, joints in groups:
            if abs(axis @ other) > _PARALLEL:
                joints.insert(0, j)
                break
        else:
            groups.append((axis, [j]))
    return [joints for _, joints in groups]


def _measured(fingers: FingertipKinematics, i: int, joints: list[int]) -> _Group:
    """Measure how far a group of joints curls a finger towards either end of its range."""
    robot = fingers.robot
    axis, base, signs, gears = _axis_of(fingers, i, joints, robot.zero)
    q = _longest(fingers, i, joints, base, robot.zero)
    length = float(np.linalg.norm(fingers.tip(q, i) - base))
    share, travel = np.zeros(2), np.zeros(2)
    for k, sense in enumerate((1.0, -1.0)):
        ends = np.where(sense * signs > 0.0, robot.upper[joints], robot.lower[joints])
        travel[k] = float(np.abs(gears * (ends - q[joints])).sum())
        lengths = []
        for part in np.linspace(0.0, 1.0, _SWEEP):
            bent = q.copy()
            bent[joints] += part * (ends - q[joints])
            lengths.append(float(np.linalg.norm(fingers.tip(bent, i) - base)))
        share[k] = 1.0 - min(lengths) / max(length, 1e-9)
    sidedness = abs(travel[0] - travel[1]) / max(float(travel.sum()), 1e-9)
    last = robot.drivers(fingers.structure.chains[i].joints[-1])
    is_last = last in robot.active and robot.active.index(last) in joints
    score = float(share.max()) * (_SYMMETRIC + (1.0 - _SYMMETRIC) * sidedness)
    return _Group(
        i,
        np.array(joints),
        signs,
        axis,
        base,
        share,
        travel,
        score * (1.0 if is_last else _NOT_LAST),
        q[joints],
    )


def _axis_of(
    fingers: FingertipKinematics, i: int, joints: list[int] | np.ndarray, q: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return a group's axis, the base on it, and each joint's sense and gear about it."""
    found = [fingers.axes(q, i, int(j)) for j in joints]
    turns = [np.sum([turn for turn, _ in axes], axis=0) for axes in found]
    axis = turns[-1] / np.linalg.norm(turns[-1])
    along = np.array([float(turn @ axis) for turn in turns])
    first, point = found[0][0]
    first = first / np.linalg.norm(first)
    base = point + ((fingers.tip(q, i) - point) @ first) * first
    return axis, base, np.sign(along), np.abs(along)


def _longest(
    fingers: FingertipKinematics, i: int, joints: list[int], base: np.ndarray, q: np.ndarray
) -> np.ndarray:
    """Return the posture of a group of joints at which the finger is longest, else `q`."""
    robot, start = fingers.robot, q
    best, q = 0.0, q.copy()
    # Coordinate descent: the best value of a joint depends on the others; three rounds suffice.
    for _ in range(3):
        for j in joints:
            grid = np.append(np.linspace(robot.lower[j], robot.upper[j], _GRID), q[j])
            lengths = np.array(
                [
                    np.linalg.norm(
                        fingers.tip(np.where(np.arange(len(q)) == j, value, q), i) - base
                    )
                    for value in grid
                ]
            )
            # Several postures are equally straight: take the one nearest to zero.
            near = np.flatnonzero(lengths >= (1.0 - 1e-4) * lengths.max())
            q[j] = grid[near[np.argmin(np.abs(grid[near] - robot.zero[j]))]]
            best = float(lengths.max())
    is_straight = np.linalg.norm(fingers.tip(start, i) - base) > _STRAIGHT * best
    return start if is_straight else q


def _with_knuckle(fingers: FingertipKinematics, group: _Group) -> _Group:
    """Return a group whose knuckle is stretched too, if the zero position is half a fist.

    The knuckle's angle does not change the finger's length, so that its zero position counts as
    straight. If the joints beyond it are flexed at zero, the knuckle is too: it is put at the same
    share of its range as they are at when straight.
    """
    robot, sense = fingers.robot, group.way[0] * group.signs
    joints, first = group.joints[1:], int(group.joints[0])
    if sense[0] == 0.0 or not len(joints):
        return group
    flexed = float(np.mean(sense[1:] * (robot.zero[joints] - group.straight[1:])))
    if flexed < _FLEXED_ZERO:
        return group
    widths = robot.upper - robot.lower
    stretched = np.where(sense > 0.0, robot.lower[group.joints], robot.upper[group.joints])
    shares = np.abs(group.straight[1:] - stretched[1:]) / widths[joints]
    straight = group.straight.copy()
    straight[0] = stretched[0] + sense[0] * float(shares.mean()) * widths[first]
    return replace(group, straight=straight)


def _straighten(
    fingers: FingertipKinematics, groups: list[_Group | None]
) -> tuple[np.ndarray, np.ndarray]:
    """Return which joints curl, and the posture with all fingers straight.

    A joint that moves several fingers takes the mean of their straight positions.
    """
    robot = fingers.robot
    places: dict[int, list[float]] = {}
    for group in groups:
        if group is not None:
            for j, value in zip(group.joints.tolist(), group.straight, strict=True):
                places.setdefault(j, []).append(float(value))
    q, curls = robot.zero.copy(), np.zeros(len(robot.zero), dtype=bool)
    for j, values in places.items():
        q[j], curls[j] = float(np.mean(values)), True
    return curls, q


def _turned(fingers: FingertipKinematics, group: _Group, q: np.ndarray) -> _Group:
    """Return a group with axis and base in another posture."""
    axis, base, signs, _ = _axis_of(fingers, group.finger, group.joints, q)
    # The sense of the axis is that of the last joint, in every posture.
    return replace(group, axis=axis, base=base, signs=signs)


def _motion(
    fingers: FingertipKinematics, group: _Group, q: np.ndarray, sign: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors: the tip's motion at the start of flexion, and the flexion's axis."""
    way = sum(
        (sign[j] * fingers.slopes(q, j)[group.finger] for j in group.joints.tolist()), np.zeros(3)
    )
    sense = float(np.sign((sign[group.joints] * group.signs).sum()))
    return way / max(float(np.linalg.norm(way)), 1e-9), sense * group.axis


def _direction(
    fingers: FingertipKinematics,
    i: int,
    group: _Group | None,
    q: np.ndarray,
    base: np.ndarray,
    tip: np.ndarray,
) -> np.ndarray:
    """Return a straight finger's direction; that of its first phalanx if it stays bent."""
    line = tip - base
    if group is not None:
        points = [point for j in group.joints.tolist() for _, point in fingers.axes(q, i, j)]
        flat = np.eye(3) - np.outer(group.axis, group.axis)
        places = [base, *sorted(
            (base + flat @ (point - base) for point in points),
            key=lambda place: float(np.linalg.norm(place - base)),
        )[1:], tip]  # fmt: skip
        parts = np.diff(places, axis=0)
        lengths = np.linalg.norm(parts, axis=1)
        is_bent = np.linalg.norm(line) < _STRETCHED * lengths.sum()
        if is_bent and lengths[0] > _PHALANX * lengths.sum():
            line = parts[0]
    return line / max(float(np.linalg.norm(line)), 1e-9)


def _settle_even(
    fingers: FingertipKinematics,
    q: np.ndarray,
    groups: list[_Group | None],
    sign: np.ndarray,
    ways: np.ndarray,
    axes: np.ndarray,
    certainty: np.ndarray,
    palmar: np.ndarray | None,
) -> None:
    """Choose the direction of groups that curl equally far both ways.

    Follow the palm if it is known, else the other fingers, else towards the other tips, else the
    positive sense.
    """
    known = ways[certainty > 0.0].sum(axis=0) if (certainty > 0.0).any() else np.zeros(3)
    even = [group for group in groups if group is not None and certainty[group.finger] == 0.0]
    slopes = {group.finger: _slope(fingers, group, q) for group in even}
    for alike in _alike(even, slopes):
        senses = [np.sign(slopes[g.finger] @ slopes[alike[0].finger]) or 1.0 for g in alike]
        slope = sum((s * slopes[g.finger] for s, g in zip(senses, alike, strict=True)), np.zeros(3))
        clear = 0.1 * float(np.linalg.norm(slope))
        given = 0.0 if palmar is None else float(slope @ palmar)
        nearer = sum(
            _nearness(fingers, q, g.finger, g.joints.tolist(), s * g.signs)
            for s, g in zip(senses, alike, strict=True)
        )
        opposite = _side_of_others(fingers, q, alike, slope)
        votes = (
            (given, 0.7),
            (0.5 * float(slope @ known), 0.6),
            (opposite, 0.5),
            (nearer, 0.4),
            (1.0, 0.1),
        )
        vote, confidence = next(pair for pair in votes if abs(pair[0]) > min(clear, 0.5))
        for sense, group in zip(senses, alike, strict=True):
            for j, own in zip(group.joints.tolist(), group.signs, strict=True):
                sign[j] = sign[j] or np.sign(vote) * sense * own
            ways[group.finger], axes[group.finger] = _motion(fingers, group, q, sign)
            certainty[group.finger] = confidence


def _slope(fingers: FingertipKinematics, group: _Group, q: np.ndarray) -> np.ndarray:
    """Return the tip's motion as all joints of a group turn about its axis, shape (3,)."""
    joints = zip(group.signs, group.joints.tolist(), strict=True)
    return sum((s * fingers.slopes(q, j)[group.finger] for s, j in joints), np.zeros(3))


def _side_of_others(
    fingers: FingertipKinematics, q: np.ndarray, alike: list[_Group], slope: np.ndarray
) -> float:
    """Return whether the other fingers are in the direction `slope` of two or more alike ones.

    A thumb is on the palm's side of the fingers. The answer is 1 or -1, and 0 if unclear.
    """
    mine = [group.finger for group in alike]
    others = [i for i in range(len(fingers.roots)) if i not in mine]
    length = float(np.linalg.norm(slope))
    if len(mine) < 2 or not others or length < 1e-9:
        return 0.0
    tips = fingers.tips(q)
    places = 0.5 * (fingers.roots + tips)
    height = float((places[others].mean(axis=0) - places[mine].mean(axis=0)) @ slope) / length
    reach = float(np.linalg.norm(tips[mine] - fingers.roots[mine], axis=1).mean())
    return 0.0 if abs(height) < _LEAST_HEIGHT * reach else float(np.sign(height))


def _alike(groups: list[_Group], slopes: dict[int, np.ndarray]) -> list[list[_Group]]:
    """Return the fingers that move in parallel together: they close to the same side."""
    found: list[list[_Group]] = []
    for group in groups:
        slope = slopes[group.finger]
        for alike in found:
            other = slopes[alike[0].finger]
            length = float(np.linalg.norm(slope) * np.linalg.norm(other))
            if abs(float(slope @ other)) > _PARALLEL * length:
                alike.append(group)
                break
        else:
            found.append([group])
    return sorted(found, key=len, reverse=True)


def _nearness(
    fingers: FingertipKinematics,
    q: np.ndarray,
    i: int,
    joints: list[int],
    signs: np.ndarray,
) -> float:
    """Return how much a finger's motion from end to end of joints brings it to other tips [m]."""
    robot = fingers.robot
    distances = []
    for sense in (-1.0, 1.0):
        at = q.copy()
        at[joints] = np.where(sense * signs > 0.0, robot.upper[joints], robot.lower[joints])
        tips = fingers.tips(at)
        distances.append(float(np.linalg.norm(tips - tips[i], axis=1).sum()))
    return (distances[0] - distances[1]) / max(1, len(fingers.roots) - 1)


def _close_jaws(
    fingers: FingertipKinematics,
    q: np.ndarray,
    sign: np.ndarray,
    ways: np.ndarray,
    certainty: np.ndarray,
) -> None:
    """Flex fingers without curling joints towards the other tips."""
    for i in np.flatnonzero(certainty == 0.0).tolist():
        nearer = {
            j: _nearness(fingers, q, i, [j], np.ones(1))
            for j in np.flatnonzero(fingers.moves[i]).tolist()
        }
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
