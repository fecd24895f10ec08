"""What joints make of their commands: the first part of the ritual of `handmap tune`."""

from collections.abc import Callable

import numpy as np

from handmap_qp.se3 import Array
from .drive import APPROACH
from .driver import DriverError
from .fit import FULL, fit_joint
from .motion import Motion
from .space import Space
from .tuning import TORQUE, Joints

_WIDE = 1.0
"""Speed of motions over the range [rad/s]."""
_SLOW, _FAST = 0.08, 2.0
"""Speeds of the motions through the play, and for the delay [rad/s]."""
_SMALL = 0.15
"""Amplitude of small motions [rad]."""
_BACK = 0.2
"""How far slow motions go beyond home, a share of the amplitude."""
_MOVES = 0.04
"""A joint that moves less does not move [rad]."""
_GAINS = 0.5, 1.6
"""Gains of a joint that is that of the description."""
_NEARLY = 0.98
"""Share of the line to the end of the range that joints go."""
_INSIDE = 0.005
"""How far from its stops a joint keeps [rad]."""
_JAM = 0.2
"""Share of its range that a joint may lack at each end."""
_SIDES = np.array([[-1.0], [1.0]])

Tell = Callable[[float, str], object]
"""Is told how much is done [%], and what is."""


def measure_joints(
    motion: Motion, space: Space, spans: Array, groups: list[Array], tell: Tell
) -> Joints:
    """Move each joint a little, then groups of them over their ranges; return what they do.

    Args:
        motion: The motors.
        space: Where the hand can go.
        spans: As of `free_spans`.
        groups: As of `free_groups`.
        tell: Is told how much is done.

    Raises:
        DriverError: If a joint does not do what joints do.
    """
    names = motion.driver.joint_names
    motion.go(space.home, APPROACH)
    for i, name in enumerate(names):
        tell(10.0 * i / len(names), name)
        _check(motion, space, i)
    found = np.zeros((len(Joints._fields), len(names)))
    for k, group in enumerate(groups):
        joints = np.flatnonzero(group)
        moved = ", ".join(names[i] for i in joints)
        tell(10.0 + 60.0 * k / len(groups), moved)
        found[:, joints] = _measure(motion, space, joints, spans)
    return Joints(*found)


def free_spans(space: Space) -> Array:
    """Return how far each joint alone can go from home to both sides [rad], shape (2, n)."""
    home = space.home
    lines = space.limits - home
    ends = home + np.apply_along_axis(np.diag, 1, lines)
    return lines * [[space.is_free(home, end) for end in side] for side in ends]


def free_groups(space: Space, spans: Array) -> list[Array]:
    """Return joints that can move at the same time, as masks of shape (n,)."""
    home = space.home
    groups: list[Array] = []
    for joint in np.eye(len(home), dtype=bool):
        for group in groups:
            ends = home + (group | joint) * spans
            if all(space.is_free(home, end) for end in ends):
                group |= joint
                break
        else:
            groups.append(joint)
    return groups


def _check(motion: Motion, space: Space, i: int) -> None:
    """Move one joint a little, and reject a hand in which something else happens."""
    names = motion.driver.joint_names
    start = motion.count
    small = _SMALL * np.eye(len(names))[i]
    for side in (1.0, -1.0, 0.0):
        motion.go(space.home + side * small, _FAST)
        motion.rest()
    log = motion.log(start)
    moved = np.ptp(log.q, axis=0)
    pulled = np.abs(log.torque[:, i]).max()
    told, q = log.told[:, i], log.q[:, i]
    follows = np.cov(told, q)[0, 1]
    most = moved.argmax()
    is_still = moved[most] < _MOVES
    is_weak = pulled < TORQUE
    is_full = pulled > FULL * motion.effort
    problems = {
        "its motor has no torque: see its cable and its id": is_still and is_weak,
        "it does not move with the torque of --effort: it is blocked": is_still
        and is_full,
        "its motor pulls, but its encoder does not move": is_still,
        f"{names[most]} moves in its place: ids are swapped": most != i,
        "it turns the other way: see its ratio": follows < 0.0,
        "its torque is not measured, and play cannot be found without": is_weak,
    }
    for problem, is_so in problems.items():
        if is_so:
            raise DriverError(f"{names[i]}: {problem}")


def _measure(motion: Motion, space: Space, joints: Array, spans: Array) -> Joints:
    """Move joints together; return what they do."""
    home = space.home
    small = _SMALL * np.isin(np.arange(len(home)), joints)
    motion.go(home + small, APPROACH)
    motion.rest()
    start = motion.count - 1
    # An encoder rounds: at other places, it rounds other angles.
    for side in (1.0, -1.0, 0.8, -0.8):
        motion.go(home + side * small, APPROACH)
        motion.go(home - side * _BACK * small, _SLOW)
    for side in (1.0, -1.0) * 3:
        motion.go(home + side * small, _FAST)
    motion.go(home, APPROACH)
    motion.rest()
    rough = _fit(motion, space, start, joints)
    ends = []
    for span in _NEARLY * spans[:, joints]:
        goal = home.copy()
        goal[joints] += span
        load = space.weights(goal[None])[0, joints]
        pulled = rough.command(goal[joints], np.sign(span), load)
        goal[joints] = np.clip(pulled, *rough.range)
        motion.go(goal, _WIDE)
        ends.append(motion.rest())
        motion.go(home, _WIDE)
    final = _fit(motion, space, start, joints)
    q, torque = np.array(ends).swapaxes(0, 1)
    load = space.weights(q)
    names = [motion.driver.joint_names[i] for i in joints]
    lower, upper = _ranges(
        names, final, q[:, joints], torque[:, joints], load[:, joints]
    )
    return final._replace(lower=lower, upper=upper)


def _fit(motion: Motion, space: Space, start: int, joints: Array) -> Joints:
    """Return what `fit_joint` finds of joints that were moved since a turn; ranges are limits."""
    log = motion.log(start)
    weights = space.weights(log.q)
    found = [fit_joint(log, i, motion.effort, weights[:, i]) for i in joints]
    *first, weight = np.transpose(found)
    least, most = _GAINS
    for i, gain in zip(joints, first[0], strict=True):
        if not least < gain < most:
            name = motion.driver.joint_names[i]
            problem = f"{name}: it moves {gain:.2g} times as far as it is told"
            advice = "see its ratio, or whether this is another hand"
            raise DriverError(f"{problem}: {advice}")
    no_error = np.zeros(len(joints))
    return Joints(*first, *space.limits[:, joints], no_error, weight)


def _ranges(
    names: list[str], found: Joints, q: Array, torque: Array, load: Array
) -> Array:
    """Return how far joints can go: to stops, limits, or where commands bring them [rad].

    Args:
        names: Their names.
        found: What was found of them, with their limits as ranges.
        q: Where they were at both ends [rad], shape (2, m).
        torque: Their torques there, shape (2, m).
        load: Torques that hold their links there [N m], shape (2, m).
    """
    limits = found.range
    at_stop = found.meet(torque, load)
    width = np.ptp(limits, axis=0)
    missing = np.abs(limits - q) / width
    for side, i in np.argwhere(at_stop & (missing > _JAM)):
        stop, limit = q[side, i], limits[side, i]
        problem = f"{names[i]}: it stops at {stop:.3g} rad on its way to {limit:.3g}"
        raise DriverError(f"{problem}: it jams, or this is another hand")
    reached = found.gain * limits + found.zero - found.lag(_SIDES, load)
    ends = np.where(at_stop, q - _SIDES * _INSIDE, reached)
    return np.clip(ends, *limits)
