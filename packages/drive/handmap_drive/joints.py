"""How joints respond to commands: the first part of `handmap calibrate-actuators`."""

from collections.abc import Callable
from itertools import compress

import numpy as np

from handmap_qp.se3 import Array
from .driver import DriverError
from .fit import FULL, fit_joint
from .gate import APPROACH
from .motion import Motion
from .space import Space
from .tuning import BOUNDS, SIDES, TORQUE, Joints

_WIDE = 1.0
"""Speed of motions over the range [rad/s]."""
_SLOW = 0.08
"""Speed of motions through the play [rad/s]."""
_FAST = 2.0
"""Speed of motions for the delay [rad/s]."""
_SMALL = 0.15
"""Amplitude of small motions [rad]."""
_BACK = 0.2
"""How far slow motions go beyond home, a share of the amplitude."""
_MOVES = 0.04
"""A joint that moves less does not move [rad]."""
_NEARLY = 0.98
"""Share of the line to the end of the range that joints go."""
_INSIDE = 0.005
"""How far from its stops a joint keeps [rad]."""
_JAM = 0.2
"""Share of its range that a joint may lack at each end."""
_PERFECT = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
"""As in `fit_joint`, of a joint that is not moved."""

Progress = Callable[[float, str], object]
"""Called with how much is done [%], and what is."""


def measure_joints(
    motion: Motion, space: Space, spans: Array, groups: list[Array], progress: Progress
) -> Joints:
    """Move each joint a little, then groups of them over their ranges; return what they do.

    Args:
        motion: The motors.
        space: Where the hand can go.
        spans: See `free_spans`.
        groups: See `free_groups`.
        progress: Called with how much is done.

    Raises:
        DriverError: If a joint does not do what joints do.
    """
    names = motion.driver.joint_names
    motion.go(space.home, APPROACH)
    for i, name in enumerate(names):
        progress(10.0 * i / len(names), name)
        _check(motion, space, i)
    found = np.zeros((len(Joints._fields), len(names)))
    for k, group in enumerate(groups):
        progress(10.0 + 60.0 * k / len(groups), ", ".join(compress(names, group)))
        found = np.where(group, _measure(motion, space, spans, group), found)
    return Joints(*found)


def free_spans(space: Space) -> Array:
    """Return how far each joint alone can go from home to both sides [rad], shape (2, n)."""
    home = space.home
    lines = space.limits - home
    ends = home + lines[..., None] * np.eye(len(home))
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
    follows = np.cov(log.commanded[:, i], log.q[:, i])[0, 1]
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


def _measure(motion: Motion, space: Space, spans: Array, group: Array) -> Joints:
    """Move a group of joints together; return what they do."""
    home = space.home
    small = _SMALL * group
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
    rough = _fit(motion, space, start, group)
    ends = []
    for span in _NEARLY * spans * group:
        goal = home + span
        commanded = rough.command(goal, np.sign(span), space.weights(goal))
        motion.go(np.clip(commanded, *space.limits), _WIDE)
        ends.append(motion.rest())
        motion.go(home, _WIDE)
    final = _fit(motion, space, start, group)
    q, torque = np.array(ends).swapaxes(0, 1)
    load = space.weights(q)
    at_stop = group & final.meet(torque, load)
    limits = space.limits
    missing = np.abs(limits - q) / np.ptp(limits, axis=0)
    for side, i in np.argwhere(at_stop & (missing > _JAM)):
        name = motion.driver.joint_names[i]
        way = f"at {q[side, i]:.3g} rad on its way to {limits[side, i]:.3g}"
        advice = "it jams, or this is another hand"
        raise DriverError(f"{name}: it stops {way}: {advice}")
    # To stops, limits, or where commands bring them.
    reached = final.gain * limits + final.zero - final.lag(SIDES, load)
    reached = np.where(at_stop, q - SIDES * _INSIDE, reached)
    lower, upper = np.clip(reached, *limits)
    return final._replace(lower=lower, upper=upper)


def _fit(motion: Motion, space: Space, start: int, group: Array) -> Joints:
    """Return what `fit_joint` finds of joints that were moved since a turn; ranges are limits."""
    log = motion.log(start)
    weights = space.weights(log.q)
    found = np.tile(_PERFECT, (len(group), 1))
    least, most = BOUNDS["gain"]
    for i in np.flatnonzero(group):
        gain, *_ = found[i] = fit_joint(log, i, motion.effort, weights[:, i])
        if not least <= gain <= most:
            name = motion.driver.joint_names[i]
            problem = f"{name}: it moves {gain:.2g} times as far as it is commanded"
            advice = "see its ratio, or whether this is another hand"
            raise DriverError(f"{problem}: {advice}")
    *first, weight = found.T
    return Joints(*first, *space.limits, np.zeros(len(group)), weight)
