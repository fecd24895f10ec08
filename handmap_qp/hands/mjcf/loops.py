"""Closed loops of a MuJoCo model (`connect`) as mimic rules: `close_loops`.

A URDF is a tree. A loop of one degree of freedom, such as the four-bar linkage of a gripper's
finger, still fits: one joint leads, and every other joint of the loop follows it along a curve. The
curve is solved from the constraint, and its best line is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

from handmap_qp.hands.mjcf.couplings import Coupling

# Postures at which a loop is solved, Newton iterations of each, and residual of a closed loop [m].
_SAMPLES, _ITERATIONS, _CLOSED = 41, 20, 1e-6
# Singular values of the constraint's Jacobian below this share of the largest count as zero.
_RANK = 1e-4
# A larger difference between a curve and its line is not a mimic rule [rad or m].
_LARGEST_ERROR = 0.1
_STEP = 1e-6


class _Loop(NamedTuple):
    """A loop, or several that share joints.

    Attributes:
        joints: Indices of its joints in the model, sorted.
        ends: For each constraint two bodies, each with the anchor in its frame [m].
    """

    joints: tuple[int, ...]
    ends: tuple[tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]], ...]


def close_loops(
    model: Any, rules: Mapping[int, Coupling], names: Mapping[int, str]
) -> tuple[dict[int, Coupling], list[str], int]:
    """Describe the loops of a model by mimic rules.

    Args:
        model: `mujoco.MjModel`.
        rules: Rules of other couplings, by follower.
        names: Names of the converted joints, by their indices in the model.

    Returns:
        The rules of the loops by follower, notes on them, and the number of `connect` constraints
        that are left out.
    """
    found: dict[int, Coupling] = {}
    notes: list[str] = []
    omitted = 0
    for loop in _loops(model, names):
        solved = _solve(model, loop, rules)
        if solved is None:
            omitted += len(loop.ends)
            continue
        leader, lines, error = solved
        found.update(lines)
        followers = ", ".join(names[joint] for joint in lines)
        notes.append(
            f"a closed loop couples {followers} to {names[leader]}: lines within {error:.2g} rad "
            "of it are written"
        )
    return found, notes, omitted


def _loops(model: Any, names: Mapping[int, str]) -> list[_Loop]:
    """Return the loops that active `connect` constraints close, joined where they share joints."""
    loops: list[_Loop] = []
    for index in range(model.neq):
        if model.eq_type[index] != int(mujoco.mjtEq.mjEQ_CONNECT) or not model.eq_active0[index]:
            continue
        ends = _ends(model, index)
        joints = set(_path(model, ends[0][0])) ^ set(_path(model, ends[1][0]))
        if not joints <= set(names):
            continue
        merged = _Loop(tuple(sorted(joints)), (ends,))
        for other in [loop for loop in loops if joints & set(loop.joints)]:
            loops.remove(other)
            together = tuple(sorted({*merged.joints, *other.joints}))
            merged = _Loop(together, (*other.ends, *merged.ends))
        loops.append(merged)
    return loops


def _ends(model: Any, index: int) -> tuple[tuple[int, np.ndarray], tuple[int, np.ndarray]]:
    """Return the two bodies of a constraint with their anchors."""
    ids = (int(model.eq_obj1id[index]), int(model.eq_obj2id[index]))
    if int(model.eq_objtype[index]) == int(mujoco.mjtObj.mjOBJ_SITE):
        places = [(int(model.site_bodyid[i]), np.array(model.site_pos[i])) for i in ids]
    else:
        data = np.array(model.eq_data[index, :6], dtype=float)
        places = [(ids[0], data[:3]), (ids[1], data[3:])]
    return places[0], places[1]


def _path(model: Any, body: int) -> list[int]:
    """Return the joints between the world and a body."""
    found: list[int] = []
    while body > 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        found += range(first, first + count)
        body = int(model.body_parentid[body])
    return found


def _solve(
    model: Any, loop: _Loop, rules: Mapping[int, Coupling]
) -> tuple[int, dict[int, Coupling], float] | None:
    """Return the leader of a loop, its followers' lines, and the largest error of these.

    Returns None if the loop has not one degree of freedom, does not close, or is no line.
    """
    data = mujoco.MjData(model)
    at = np.array([int(model.jnt_qposadr[joint]) for joint in loop.joints])
    start = np.array(model.qpos0[at])
    jacobian = _jacobian(model, data, loop, at, start)
    sizes = np.linalg.svd(jacobian, compute_uv=False)
    freedom = len(at) - int((sizes > _RANK * sizes.max(initial=1e-12)).sum())
    leader = _leader(model, loop, rules)
    followers = [k for k, joint in enumerate(loop.joints) if joint != leader]
    if freedom != 1 or any(loop.joints[k] in rules for k in followers):
        return None
    lead = loop.joints.index(leader)
    curve = _curve(model, data, loop, at, start, lead, followers)
    if len(curve) < _SAMPLES // 2:
        return None
    own = rules.get(leader)
    lines: dict[int, Coupling] = {}
    worst = 0.0
    for k in followers:
        slope, offset = np.polyfit(curve[:, lead], curve[:, k], 1)
        error = np.abs(curve[:, k] - (slope * curve[:, lead] + offset)).max()
        worst = max(worst, float(error))
        if own is not None and own.leader is not None:
            offset, slope = offset + slope * own.offset, slope * own.multiplier
        first = leader if own is None or own.leader is None else own.leader
        lines[loop.joints[k]] = Coupling(first, float(slope), float(offset))
    return (leader, lines, worst) if worst < _LARGEST_ERROR else None


def _leader(model: Any, loop: _Loop, rules: Mapping[int, Coupling]) -> int:
    """Return the joint that a motor moves, else one that follows another joint, else the first."""
    driven = set()
    for index in range(model.nu):
        kind, target = int(model.actuator_trntype[index]), int(model.actuator_trnid[index, 0])
        if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
            driven.add(target)
        elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
            first, count = int(model.tendon_adr[target]), int(model.tendon_num[target])
            driven.update(int(joint) for joint in model.wrap_objid[first : first + count])
    ruled = [joint for joint in loop.joints if joint in rules]
    return next((joint for joint in loop.joints if joint in driven), (*ruled, *loop.joints)[0])


def _curve(
    model: Any,
    data: Any,
    loop: _Loop,
    at: np.ndarray,
    start: np.ndarray,
    lead: int,
    followers: list[int],
) -> np.ndarray:
    """Follow a closed loop over its leader's range; each row is one closed posture."""
    joint = loop.joints[lead]
    low, high = start[lead] - 1.0, start[lead] + 1.0
    if model.jnt_limited[joint]:
        low, high = (float(value) for value in model.jnt_range[joint])
    grid = np.linspace(low, high, _SAMPLES)
    first = int(np.argmin(np.abs(grid - start[lead])))
    rows: dict[int, np.ndarray] = {}
    for way in (range(first, _SAMPLES), range(first - 1, -1, -1)):
        q = start.copy()
        for number in way:
            q[lead] = grid[number]
            for _ in range(_ITERATIONS):
                gap = _gap(model, data, loop, at, q)
                if np.abs(gap).max() < 1e-3 * _CLOSED:
                    break
                slopes = _jacobian(model, data, loop, at, q)[:, followers]
                q[followers] -= np.linalg.lstsq(slopes, gap, rcond=_RANK)[0]
            if np.abs(_gap(model, data, loop, at, q)).max() > _CLOSED:
                break
            rows[number] = q.copy()
    return np.array([rows[number] for number in sorted(rows)])


def _gap(model: Any, data: Any, loop: _Loop, at: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the vectors between the anchors of all constraints [m], shape (3 k,)."""
    data.qpos[:] = model.qpos0
    data.qpos[at] = q
    mujoco.mj_kinematics(model, data)
    points = [
        [data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor for body, anchor in pair]
        for pair in loop.ends
    ]
    return np.concatenate([one - other for one, other in points])


def _jacobian(model: Any, data: Any, loop: _Loop, at: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return the derivative of the gaps by the joints, by central differences."""
    columns = []
    for k in range(len(q)):
        step = np.zeros(len(q))
        step[k] = _STEP
        plus, minus = (_gap(model, data, loop, at, q + s * step) for s in (1.0, -1.0))
        columns.append((plus - minus) / (2.0 * _STEP))
    return np.array(columns).T
