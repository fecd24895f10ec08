"""Couplings of a MuJoCo model: joint equalities as mimic rules, and notes on all others."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np

_EQUALITY = mujoco.mjtEq
# Postures at which a curved coupling is compared with its line.
_SAMPLES = 101
# Share of the leader's range that a tendon's rule must leave.
_LEAST_SHARE = 0.5


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


def read_couplings(model: Any, names: Mapping[int, str]) -> tuple[dict[int, Coupling], list[str]]:
    """Read the equality constraints and tendons of a model.

    A joint that is coupled twice keeps its first rule.

    Args:
        model: `mujoco.MjModel`.
        names: Names of the converted joints, by their indices in the model.

    Returns:
        The rules by follower, and a note on each coupling that URDF cannot express.
    """
    rules: dict[int, Coupling] = {}
    notes: list[str] = []
    welds = 0
    ruled: set[int] = set()
    for index in range(model.neq):
        kind = _EQUALITY(int(model.eq_type[index]))
        follower, leader = int(model.eq_obj1id[index]), int(model.eq_obj2id[index])
        welds += kind == _EQUALITY.mjEQ_WELD
        if kind == _EQUALITY.mjEQ_TENDON and (rule := _tendon_rule(model, index, names)):
            drawn, line = rule
            if drawn not in rules and not _leads_back(rules, drawn, line.leader or 0):
                rules[drawn] = line
                ruled.add(follower)
        if kind != _EQUALITY.mjEQ_JOINT or follower not in names:
            continue
        if leader >= 0 and leader not in names:
            what = model.joint(leader).name or f"joint {leader}"
            notes.append(f"{names[follower]} is coupled to {what}, which is left out")
        elif not model.eq_active0[index]:
            notes.append(f"the coupling of {names[follower]} is inactive in the MJCF: left out")
        elif follower in rules or _leads_back(rules, follower, leader):
            notes.append(f"{names[follower]} has a second coupling, which is left out")
        else:
            rules[follower], note = _linear_rule(model, index, follower, leader, names)
            notes += note
    if welds:
        notes.append(f"{welds} weld constraint(s) close loops, which a URDF cannot: left out")
    return rules, notes + _tendon_notes(model, names, rules, ruled)


def _leads_back(rules: Mapping[int, Coupling], follower: int, leader: int) -> bool:
    """Return whether a leader follows, through other rules, its would-be follower."""
    at: int | None = leader
    while at is not None and at in rules and at != follower:
        at = rules[at].leader
    return at == follower


def _linear_rule(
    model: Any, index: int, follower: int, leader: int, names: Mapping[int, str]
) -> tuple[Coupling, list[str]]:
    """Return one joint equality as a line, with a note if it is a curve.

    MuJoCo: `y - y0 = a0 + a1 (x - x0) + a2 (x - x0)^2 + ...`, with x0, y0 the positions in `qpos0`.
    """
    factors = np.array(model.eq_data[index, :5], dtype=float)
    y0 = float(model.qpos0[model.jnt_qposadr[follower]])
    if leader < 0:
        return Coupling(None, 0.0, y0 + float(factors[0])), []
    x0 = float(model.qpos0[model.jnt_qposadr[leader]])
    if not factors[2:].any():
        return Coupling(leader, float(factors[1]), y0 + float(factors[0] - factors[1] * x0)), []
    low, high = model.jnt_range[leader] if model.jnt_limited[leader] else (x0 - 1.0, x0 + 1.0)
    x = np.linspace(low, high, _SAMPLES)
    y = y0 + np.polyval(factors[::-1], x - x0)
    slope, offset = np.polyfit(x, y, 1)
    worst = float(np.abs(y - (slope * x + offset)).max())
    note = (
        f"{names[follower]} follows {names[leader]} along a curve: a line within {worst:.3g} of it "
        "is written"
    )
    return Coupling(leader, float(slope), float(offset)), [note]


def _tendon_rule(model: Any, index: int, names: Mapping[int, str]) -> tuple[int, Coupling] | None:
    """Return the rule of a tendon of two joints whose length is held; None for other tendons.

    MuJoCo: `c1 q1 + c2 q2 = L0 + a0`, with L0 the length in `qpos0`.
    """
    tendon = int(model.eq_obj1id[index])
    joints = _fixed_tendon(model, tendon)
    if model.eq_obj2id[index] >= 0 or not model.eq_active0[index] or joints is None:
        return None
    if len(joints) != 2 or not all(joint in names and factor for joint, factor in joints):
        return None
    (leader, lead), (follower, follow) = joints
    length = float(model.tendon_length0[tendon] + model.eq_data[index, 0])
    rule = Coupling(leader, -lead / follow, length / follow)
    return (follower, rule) if _fits(model, follower, rule) else None


def _fits(model: Any, follower: int, rule: Coupling) -> bool:
    """Return whether a rule leaves the joints a range; MuJoCo's soft tendons may contradict it."""
    if not (model.jnt_limited[follower] and model.jnt_limited[rule.leader]):
        return True
    image = np.sort(rule.multiplier * model.jnt_range[rule.leader] + rule.offset)
    low, high = (
        np.maximum(image[0], model.jnt_range[follower, 0]),
        np.minimum(image[1], model.jnt_range[follower, 1]),
    )
    return bool(high - low > _LEAST_SHARE * (image[1] - image[0]))


def _fixed_tendon(model: Any, tendon: int) -> list[tuple[int, float]] | None:
    """Return the joints of a fixed tendon with their factors; None for a spatial tendon."""
    first, count = int(model.tendon_adr[tendon]), int(model.tendon_num[tendon])
    wraps = slice(first, first + count)
    if not (model.wrap_type[wraps] == int(mujoco.mjtWrap.mjWRAP_JOINT)).all():
        return None
    factors = model.wrap_prm[wraps]
    return [(int(j), float(f)) for j, f in zip(model.wrap_objid[wraps], factors, strict=True)]


def _first(rules: Mapping[int, Coupling], joint: int) -> int:
    """Return the joint that moves a joint through all rules; itself if it is free or held."""
    while joint in rules and (leader := rules[joint].leader) is not None:
        joint = leader
    return joint


def _tendon_notes(
    model: Any, names: Mapping[int, str], rules: Mapping[int, Coupling], ruled: set[int]
) -> list[str]:
    """Name the independent joints that fixed tendons couple, and count the other tendons.

    Args:
        model: `mujoco.MjModel`.
        names: Names of the converted joints.
        rules: Rules of all couplings, by follower.
        ruled: Tendons that mimic rules express.
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
            coupled.append(f"{model.tendon(tendon).name or f'tendon {tendon}'} = {terms}")
    notes = []
    if coupled:
        notes.append(
            f"tendons couple joints that are independent here: {'; '.join(coupled)}. Where one "
            "motor drives them, couple them under `mimic` in the hand.yaml"
        )
    if spatial:
        notes.append(f"{spatial} spatial tendon(s) are left out")
    return notes
