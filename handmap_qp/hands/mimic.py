"""Mimic joints: followers that copy a leader, `q_follower = multiplier * q_leader + offset`.

Pinocchio's model stays plain, every movable joint a variable of its own, and the rules become one
linear map on top of it,

    q_all = S q_active + offset,        v_all = S v_active,

so followers are not variables of the QP, and their motion is in the Jacobian: `J_active = J_all S`.
Rules are resolved to joints that follow no other joint, in whatever order the URDF has them; a
leader may follow another joint itself.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf.elements import get_numbers

# A follower's limits count as a mistake if they would leave less than this share of its leader's
# range.
_LEAST_SHARE = 0.01


@dataclass(frozen=True, slots=True)
class MimicRule:
    """One follower: `q[follower] = multiplier * q[leader] + offset`.

    Attributes:
        follower: Name of the joint that copies.
        leader: Name of the joint that it copies.
        multiplier: Its motion per motion of the leader.
        offset: Its position where the leader's is zero [rad or m].
    """

    follower: str
    leader: str
    multiplier: float = 1.0
    offset: float = 0.0


class JointRange(NamedTuple):
    """Limits of one joint.

    Attributes:
        lower: Lower position limit [rad or m].
        upper: Upper position limit [rad or m].
        velocity: Speed limit [rad/s or m/s].
    """

    lower: float
    upper: float
    velocity: float


class Expansion(NamedTuple):
    """From the active joints to all joints: `q_all = matrix @ q_active + offset`.

    Attributes:
        matrix: S, shape (n_all, n_active).
        offset: Position of every joint where the active ones are zero [rad or m], shape (n_all,).
    """

    matrix: np.ndarray
    offset: np.ndarray


def read_mimic_rules(robot: ET.Element) -> tuple[MimicRule, ...]:
    """Read the mimic rules of a URDF, resolved to leaders that follow no other joint.

    Args:
        robot: The `<robot>` element.

    Returns:
        One rule per follower, in the order of the file, without those of fixed joints.

    Raises:
        HandError: If a leader is missing or fixed, a joint follows itself through others, or a rule
            does not hold finite numbers.
    """
    joints = {joint.get("name", ""): joint for joint in robot.iterfind("joint")}
    direct = {name: _read_rule(name, joint) for name, joint in joints.items() if _follows(joint)}
    for rule in direct.values():
        leader = joints.get(rule.leader)
        if leader is None or leader.get("type") == "fixed":
            what = "does not exist in this part of the robot" if leader is None else "cannot move"
            message = (
                f"it mimics {rule.leader!r}, which {what}: "
                "give its rule in `mimic`, or hold it still in `locked`"
            )
            raise HandError(message, key=f"mimic.{rule.follower}", value=rule.leader)
    return tuple(_resolve(rule, direct) for rule in direct.values())


def expansion_matrix(
    names: Iterable[str], active: Iterable[str], rules: Iterable[MimicRule]
) -> Expansion:
    """Compose S and offset for given orders of the joints.

    Args:
        names: All joints, in the order of the rows.
        active: The joints that follow no other, in the order of the columns.
        rules: Resolved rules, one for each of the others.

    Returns:
        The map from the active joints to all.
    """
    rows = {name: i for i, name in enumerate(names)}
    columns = {name: i for i, name in enumerate(active)}
    matrix, offset = np.zeros((len(rows), len(columns))), np.zeros(len(rows))
    for name, column in columns.items():
        matrix[rows[name], column] = 1.0
    for rule in rules:
        matrix[rows[rule.follower], columns[rule.leader]] = rule.multiplier
        offset[rows[rule.follower]] = rule.offset
    return Expansion(matrix, offset)


def tighten_limits(
    rules: Iterable[MimicRule], ranges: Mapping[str, JointRange]
) -> tuple[dict[str, JointRange], tuple[str, ...]]:
    """Tighten the limits of leaders so that their followers stay inside theirs.

    If a follower's limits would leave its leader almost no range, they contradict its own rule (a
    wrong sign, say). They are then dropped, with a note. A follower without a speed limit passes
    none on.

    Args:
        rules: Resolved rules.
        ranges: Limits of every joint by name.

    Returns:
        The limits of the leaders by name, and a sentence for each follower whose limits were
        dropped.
    """
    tightened: dict[str, JointRange] = {}
    dropped = []
    for rule in rules:
        own, leader = ranges[rule.follower], tightened.get(rule.leader, ranges[rule.leader])
        if rule.multiplier == 0.0:
            tightened[rule.leader] = leader
            continue
        ends = sorted((limit - rule.offset) / rule.multiplier for limit in (own.lower, own.upper))
        lower, upper = max(leader.lower, ends[0]), min(leader.upper, ends[1])
        # `not a > b` also drops NaN limits.
        if not upper - lower > _LEAST_SHARE * (leader.upper - leader.lower):
            dropped.append(
                f"the limits [{own.lower:.4g}, {own.upper:.4g}] of {rule.follower!r} are ignored: "
                f"with its rule {rule.multiplier:.4g} * {rule.leader} + {rule.offset:.4g} they "
                f"would leave the leader no range in [{leader.lower:.4g}, {leader.upper:.4g}]"
            )
            lower, upper = leader.lower, leader.upper
        speed = leader.velocity
        if math.isfinite(own.velocity) and own.velocity > 0.0:
            speed = min(speed, own.velocity / abs(rule.multiplier))
        tightened[rule.leader] = JointRange(lower, upper, speed)
    return tightened, tuple(dropped)


def tighten_model(model: Any, rules: Iterable[MimicRule]) -> tuple[str, ...]:
    """Tighten the limits of leaders in a Pinocchio model, as `tighten_limits` does.

    Args:
        model: A `pinocchio.Model`, changed in place.
        rules: Resolved rules.

    Returns:
        A sentence for each follower whose limits were dropped.
    """
    lower, upper, velocity = model.lowerPositionLimit, model.upperPositionLimit, model.velocityLimit
    joints = {
        name: joint for name, joint in zip(model.names, model.joints, strict=True) if joint.nq == 1
    }
    ranges = {
        name: JointRange(lower[joint.idx_q], upper[joint.idx_q], velocity[joint.idx_v])
        for name, joint in joints.items()
    }
    tightened, dropped = tighten_limits(rules, ranges)
    for name, limits in tightened.items():
        q, v = joints[name].idx_q, joints[name].idx_v
        lower[q], upper[q], velocity[v] = limits
    return dropped


def _follows(joint: ET.Element) -> bool:
    return joint.find("mimic") is not None and joint.get("type") != "fixed"


def _read_rule(name: str, joint: ET.Element) -> MimicRule:
    mimic = joint.find("mimic")
    assert mimic is not None
    try:
        (multiplier,) = get_numbers(mimic, "multiplier", 1, "1")
        (offset,) = get_numbers(mimic, "offset", 1, "0")
    except HandError as error:
        message = f"{error.key}: {error.problem}"
        raise HandError(message, key=f"mimic.{name}", value=error.value) from error
    if not (math.isfinite(multiplier) and math.isfinite(offset)):
        raise HandError(
            f"expected finite numbers, got {multiplier} and {offset}", key=f"mimic.{name}"
        )
    return MimicRule(name, mimic.get("joint", ""), multiplier, offset)


def _resolve(rule: MimicRule, direct: Mapping[str, MimicRule]) -> MimicRule:
    """Follow the leaders to one that follows no other: a (b q + c) + d = (a b) q + (a c + d)."""
    passed = [rule.follower]
    while rule.leader in direct:
        if rule.leader in passed:
            circle = " -> ".join([*passed[passed.index(rule.leader) :], rule.leader])
            raise HandError(
                f"joints mimic each other in a circle: {circle}",
                key=f"mimic.{rule.follower}",
                value=rule.leader,
            )
        passed.append(rule.leader)
        above = direct[rule.leader]
        multiplier, offset = (
            rule.multiplier * above.multiplier,
            rule.multiplier * above.offset + rule.offset,
        )
        rule = MimicRule(rule.follower, above.leader, multiplier, offset)
    return rule
