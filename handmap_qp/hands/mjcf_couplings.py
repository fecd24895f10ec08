"""Couplings of a MuJoCo model as mimic rules: joint equalities, tendons and closed loops.

A URDF is a tree. A loop of one degree of freedom (`connect`), such as the four-bar linkage of a
gripper's finger, still fits: one joint leads, and every other joint of the loop follows it along a
curve. The curve is solved from the constraint, and its best line is written.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np

_EQUALITY = mujoco.mjtEq
# Postures at which a curved coupling is compared with its line.
_SAMPLES = 101
# Share of the leader's range that a tendon's rule must leave.
_LEAST_SHARE = 0.5
# Postures at which a loop is solved, Newton iterations of each, and residual of a closed loop [m].
_LOOP_SAMPLES, _ITERATIONS, _CLOSED = 41, 20, 1e-6
# Singular values of the constraint's Jacobian below this share of the largest count as zero.
_RANK = 1e-4
# A larger difference between a curve and its line is not a mimic rule [rad or m].
_LARGEST_ERROR = 0.1
_STEP = 1e-6
_LEFT_OUT = "constraint(s) close loops, which a URDF cannot: left out"


class Coupling(NamedTuple):
    """A linear rule for a joint: `q = multiplier * q[leader] + offset`.

    Attributes:
        leader: Index of the leading joint; None if the joint is held at `offset`.
        multiplier: Motion of the follower per motion of the leader.
        offset: Position where the leader's is zero [rad or m].
    """

    leader: int | None
    multiplier: float
    offset: float


_Rules = dict[int, Coupling]


def read_couplings(
    model: mujoco.MjModel, names: Mapping[int, str]
) -> tuple[dict[int, Coupling], list[str]]:
    """Read the equality constraints and tendons of a model.

    A joint that is coupled twice keeps its first rule.

    Args:
        model: The model.
        names: Names of the converted joints, by their indices in the model.

    Returns:
        The rules by follower, and a note on each coupling that a URDF cannot express exactly.
    """
    rules: _Rules = {}
    notes: list[str] = []
    ruled: set[int] = set()
    kinds = [_EQUALITY(int(kind)) for kind in model.eq_type]
    for index, kind in enumerate(kinds):
        if kind == _EQUALITY.mjEQ_JOINT:
            notes += _add_equality(model, index, names, rules)
        elif kind == _EQUALITY.mjEQ_TENDON and (
            rule := _tendon_rule(model, index, names)
        ):
            follower, line = rule
            if follower not in rules and not _leads_back(rules, follower, line.leader):
                rules[follower] = line
                ruled.add(int(model.eq_obj1id[index]))
    if welds := kinds.count(_EQUALITY.mjEQ_WELD):
        notes.append(f"{welds} weld {_LEFT_OUT}")
    notes += _tendon_notes(model, names, rules, ruled)
    loops, more = _close_loops(model, names, rules)
    return rules | loops, notes + more


def _close_loops(
    model: mujoco.MjModel, names: Mapping[int, str], rules: _Rules
) -> tuple[_Rules, list[str]]:
    """Return the rules of closed loops by follower, and notes on them."""
    omitted, found, notes = 0, dict[int, Coupling](), []
    for loop in _loops(model, names):
        solved = loop.lines(rules)
        if solved is None:
            omitted += len(loop.pairs)
            continue
        leader, lines, error = solved
        found |= lines
        followers = ", ".join(names[joint] for joint in lines)
        notes.append(
            f"a closed loop couples {followers} to {names[leader]}: lines within {error:.2g} rad "
            "of it are written"
        )
    if omitted:
        notes.append(f"{omitted} connect {_LEFT_OUT}")
    return found, notes


def _leads_back(rules: _Rules, follower: int, leader: int | None) -> bool:
    """Return whether a leader follows, through other rules, its would-be follower."""
    while leader is not None and leader in rules and leader != follower:
        leader = rules[leader].leader
    return leader == follower


def _start(model: mujoco.MjModel, joint: int) -> float:
    """Return the position of a joint in `qpos0` [rad or m]."""
    return float(model.qpos0[model.jnt_qposadr[joint]])


def _range(model: mujoco.MjModel, joint: int) -> tuple[float, float]:
    """Return the limits of a joint, or 1 to both sides of `qpos0` [rad or m]."""
    low, high = model.jnt_range[joint].tolist()
    at = _start(model, joint)
    return (low, high) if model.jnt_limited[joint] else (at - 1.0, at + 1.0)


def _add_equality(
    model: mujoco.MjModel, index: int, names: Mapping[int, str], rules: _Rules
) -> list[str]:
    """Add the rule of a joint equality, as a line; return a note where it does not fit.

    MuJoCo: `y - y0 = a0 + a1 (x - x0) + a2 (x - x0)^2 + ...`, with x0, y0 the positions in `qpos0`.
    """
    follower, leader = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if follower not in names:
        return []
    if leader >= 0 and leader not in names:
        what = model.joint(leader).name or f"joint {leader}"
        return [f"{names[follower]} is coupled to {what}, which is left out"]
    if not model.eq_active0[index]:
        return [f"the coupling of {names[follower]} is inactive in the MJCF: left out"]
    if follower in rules or _leads_back(rules, follower, leader):
        return [f"{names[follower]} has a second coupling, which is left out"]
    factors, y0 = (
        np.array(model.eq_data[index, :5], dtype=float),
        _start(model, follower),
    )
    if leader < 0:
        rules[follower] = Coupling(None, 0.0, y0 + float(factors[0]))
        return []
    x0 = _start(model, leader)
    if not factors[2:].any():
        offset = y0 + float(factors[0] - factors[1] * x0)
        rules[follower] = Coupling(leader, float(factors[1]), offset)
        return []
    x = np.linspace(*_range(model, leader), _SAMPLES)
    y = y0 + np.polyval(factors[::-1], x - x0)
    slope, offset = np.polyfit(x, y, 1)
    rules[follower] = Coupling(leader, float(slope), float(offset))
    worst = float(np.abs(y - (slope * x + offset)).max())
    return [
        f"{names[follower]} follows {names[leader]} along a curve: a line within {worst:.3g} of it "
        "is written"
    ]


def _tendon_rule(
    model: mujoco.MjModel, index: int, names: Mapping[int, str]
) -> tuple[int, Coupling] | None:
    """Return the rule of a tendon of two joints whose length is held; None for other tendons.

    MuJoCo: `c1 q1 + c2 q2 = L0 + a0`, with L0 the length in `qpos0`.
    """
    tendon = int(model.eq_obj1id[index])
    joints = _fixed_tendon(model, tendon)
    if model.eq_obj2id[index] >= 0 or not model.eq_active0[index] or joints is None:
        return None
    if len(joints) != 2 or not all(
        joint in names and factor for joint, factor in joints
    ):
        return None
    (leader, lead), (follower, follow) = joints
    length = float(model.tendon_length0[tendon] + model.eq_data[index, 0])
    rule = Coupling(leader, -lead / follow, length / follow)
    return (follower, rule) if _fits(model, follower, rule) else None


def _fits(model: mujoco.MjModel, follower: int, rule: Coupling) -> bool:
    """Return whether a rule leaves the joints a range; MuJoCo's soft tendons may contradict it."""
    if not (model.jnt_limited[follower] and model.jnt_limited[rule.leader]):
        return True
    low, high = np.sort(rule.multiplier * model.jnt_range[rule.leader] + rule.offset)
    least, most = model.jnt_range[follower]
    return bool(min(high, most) - max(low, least) > _LEAST_SHARE * (high - low))


def _fixed_tendon(model: mujoco.MjModel, tendon: int) -> list[tuple[int, float]] | None:
    """Return the joints of a fixed tendon with their factors; None for a spatial tendon."""
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    wraps = slice(first, first + count)
    if not (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all():
        return None
    factors = model.wrap_prm[wraps]
    return [
        (int(j), float(f))
        for j, f in zip(model.wrap_objid[wraps], factors, strict=True)
    ]


def _first(rules: _Rules, joint: int) -> int:
    """Return the joint that moves a joint through all rules; itself if it is free or held."""
    while joint in rules and (leader := rules[joint].leader) is not None:
        joint = leader
    return joint


def _tendon_notes(
    model: mujoco.MjModel, names: Mapping[int, str], rules: _Rules, ruled: set[int]
) -> list[str]:
    """Name the independent joints that fixed tendons couple, and count the other tendons.

    `ruled` are the tendons that mimic rules express.
    """
    coupled, spatial = [], 0
    for tendon in set(range(model.ntendon)) - ruled:
        joints = _fixed_tendon(model, tendon)
        if joints is None:
            spatial += 1
        elif len({_first(rules, joint) for joint, _ in joints}) == 1:
            continue
        elif all(joint in names for joint, _ in joints):
            terms = " + ".join(f"{factor:g} {names[joint]}" for joint, factor in joints)
            coupled.append(
                f"{model.tendon(tendon).name or f'tendon {tendon}'} = {terms}"
            )
    notes = []
    if coupled:
        notes.append(
            f"tendons couple joints that are independent here: {'; '.join(coupled)}. Where one "
            "motor drives them, couple them under `mimic` in the hand.yaml"
        )
    if spatial:
        notes.append(f"{spatial} spatial tendon(s) are left out")
    return notes


_End = tuple[int, np.ndarray]
"""A body, and an anchor in its frame [m]."""


def _loops(model: mujoco.MjModel, names: Mapping[int, str]) -> list[_Loop]:
    """Return the loops that active `connect` constraints close, joined where they share joints."""
    loops: list[tuple[set[int], list[tuple[_End, _End]]]] = []
    is_connect = model.eq_type == int(_EQUALITY.mjEQ_CONNECT)
    for index in np.flatnonzero(is_connect & (model.eq_active0 != 0)):
        ends = _ends(model, int(index))
        joints = _path(model, ends[0][0]) ^ _path(model, ends[1][0])
        if not joints <= names.keys():
            continue
        pairs = [ends]
        for other in [loop for loop in loops if joints & loop[0]]:
            loops.remove(other)
            joints, pairs = joints | other[0], other[1] + pairs
        loops.append((joints, pairs))
    return [_Loop(model, sorted(joints), pairs) for joints, pairs in loops]


def _ends(model: mujoco.MjModel, index: int) -> tuple[_End, _End]:
    """Return the two bodies of a constraint with their anchors."""
    one, other = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
    if int(model.eq_objtype[index]) == int(mujoco.mjtObj.mjOBJ_SITE):
        places = [
            (int(model.site_bodyid[i]), np.array(model.site_pos[i]))
            for i in (one, other)
        ]
        return places[0], places[1]
    data = np.array(model.eq_data[index, :6], dtype=float)
    return (one, data[:3]), (other, data[3:])


def _path(model: mujoco.MjModel, body: int) -> set[int]:
    """Return the joints between the world and a body."""
    found: set[int] = set()
    while body > 0:
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        found.update(range(first, first + count))
        body = int(model.body_parentid[body])
    return found


class _Loop:
    """A loop, or several that share joints.

    Args:
        model: The model.
        joints: Indices of its joints, sorted.
        pairs: The ends of each constraint.
    """

    def __init__(
        self, model: mujoco.MjModel, joints: list[int], pairs: list[tuple[_End, _End]]
    ) -> None:
        self.joints, self.pairs = joints, pairs
        self._model, self._data = model, mujoco.MjData(model)
        self._at = model.jnt_qposadr[joints]
        self._start = np.array(model.qpos0[self._at])

    def lines(self, rules: _Rules) -> tuple[int, _Rules, float] | None:
        """Return the leader, the followers' lines, and the largest error of these.

        Returns None if the loop has not one degree of freedom, does not close, or is no line.
        """
        sizes = np.linalg.svd(self._jacobian(self._start), compute_uv=False)
        freedom = len(self.joints) - (sizes > _RANK * sizes.max(initial=1e-12)).sum()
        leader = self._leader(rules)
        followers = [k for k, joint in enumerate(self.joints) if joint != leader]
        if freedom != 1 or any(self.joints[k] in rules for k in followers):
            return None
        lead = self.joints.index(leader)
        curve = self._curve(lead, followers)
        if len(curve) < _LOOP_SAMPLES // 2:
            return None
        first, factor, shift = leader, 1.0, 0.0
        if leader in rules and rules[leader].leader is not None:
            first, factor, shift = rules[leader]
        found, errors = {}, []
        for k in followers:
            slope, offset = np.polyfit(curve[:, lead], curve[:, k], 1)
            errors.append(np.abs(curve[:, k] - (slope * curve[:, lead] + offset)).max())
            line = Coupling(first, float(slope * factor), float(offset + slope * shift))
            found[self.joints[k]] = line
        worst = float(max(errors))
        return (leader, found, worst) if worst < _LARGEST_ERROR else None

    def _leader(self, rules: _Rules) -> int:
        """Return the joint that a motor moves, else one that follows another, else the first."""
        model, driven = self._model, set()
        for kind, target in zip(
            model.actuator_trntype, model.actuator_trnid[:, 0], strict=True
        ):
            if kind == int(mujoco.mjtTrn.mjTRN_JOINT):
                driven.add(int(target))
            elif kind == int(mujoco.mjtTrn.mjTRN_TENDON):
                first, count = (
                    int(model.tendon_adr[target]),
                    int(model.tendon_num[target]),
                )
                driven.update(model.wrap_objid[first : first + count].tolist())
        by_preference = (driven, rules, self.joints)
        return next(
            joint for among in by_preference for joint in self.joints if joint in among
        )

    def _curve(self, lead: int, followers: list[int]) -> np.ndarray:
        """Follow the closed loop over its leader's range; each row is one closed posture."""
        grid = np.linspace(*_range(self._model, self.joints[lead]), _LOOP_SAMPLES)
        first = int(np.argmin(np.abs(grid - self._start[lead])))
        rows: dict[int, np.ndarray] = {}
        for way in (range(first, _LOOP_SAMPLES), range(first - 1, -1, -1)):
            q = self._start.copy()
            for number in way:
                q[lead] = grid[number]
                for _ in range(_ITERATIONS):
                    gap = self._gap(q)
                    if np.abs(gap).max() < 1e-3 * _CLOSED:
                        break
                    slopes = self._jacobian(q)[:, followers]
                    q[followers] -= np.linalg.lstsq(slopes, gap, rcond=_RANK)[0]
                if np.abs(self._gap(q)).max() > _CLOSED:
                    break
                rows[number] = q.copy()
        return np.array([rows[number] for number in sorted(rows)])

    def _gap(self, q: np.ndarray) -> np.ndarray:
        """Return the vectors between the anchors of all constraints [m], shape (3 k,)."""
        data = self._data
        data.qpos[:] = self._model.qpos0
        data.qpos[self._at] = q
        mujoco.mj_kinematics(self._model, data)
        points = [
            [
                data.xpos[body] + data.xmat[body].reshape(3, 3) @ anchor
                for body, anchor in pair
            ]
            for pair in self.pairs
        ]
        return np.concatenate([one - other for one, other in points])

    def _jacobian(self, q: np.ndarray) -> np.ndarray:
        """Return the derivative of the gaps by the joints, by central differences."""
        steps = _STEP * np.eye(len(q))
        return np.array([self._gap(q + s) - self._gap(q - s) for s in steps]).T / (
            2.0 * _STEP
        )
