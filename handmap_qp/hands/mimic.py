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
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.urdf import get_numbers, joints_by_name

# A follower's limits count as a mistake if they would leave less than this share of its leader's
# range.
_LEAST_SHARE = 0.01


class MimicRule(NamedTuple):
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


class Expansion(NamedTuple):
    """From the active joints to all joints: `q_all = matrix @ q_active + offset`.

    Attributes:
        matrix: S, shape (n_all, n_active).
        offset: Position of every joint where the active ones are zero [rad or m], shape (n_all,).
    """

    matrix: np.ndarray
    offset: np.ndarray

    def all_joints(self, q: np.ndarray) -> np.ndarray:
        """Return the positions of all joints [rad or m], shape (..., n_all), of (..., n_active)."""
        return q @ self.matrix.T + self.offset


def read_mimic_rules(robot: ET.Element) -> tuple[MimicRule, ...]:
    """Read the mimic rules of a URDF, resolved to leaders that follow no other joint.

    Returns:
        One rule per follower, in the order of the file, without those of fixed joints.

    Raises:
        HandError: If a leader is missing or fixed, a joint follows itself through others, or a rule
            does not hold finite numbers.
    """
    joints = {
        n: j for n, j in joints_by_name(robot).items() if j.get("type") != "fixed"
    }
    direct = {
        name: _read_rule(name, mimic)
        for name, joint in joints.items()
        if (mimic := joint.find("mimic")) is not None
    }
    for rule in direct.values():
        if rule.leader not in joints:
            is_fixed = rule.leader in joints_by_name(robot)
            what = (
                "cannot move"
                if is_fixed
                else "does not exist in this part of the robot"
            )
            message = (
                f"it mimics {rule.leader!r}, which {what}: "
                "give its rule in `mimic`, or hold it still in `locked`"
            )
            raise HandError(message, key=f"mimic.{rule.follower}", value=rule.leader)
    return tuple(_resolve(rule, direct) for rule in direct.values())


def _read_rule(name: str, mimic: ET.Element) -> MimicRule:
    key = f"mimic.{name}"
    try:
        (multiplier,) = get_numbers(mimic, "multiplier", 1, "1")
        (offset,) = get_numbers(mimic, "offset", 1, "0")
    except HandError as error:
        raise HandError(
            f"{error.key}: {error.problem}", key=key, value=error.value
        ) from error
    if not (math.isfinite(multiplier) and math.isfinite(offset)):
        raise HandError(
            f"expected finite numbers, got {multiplier} and {offset}", key=key
        )
    return MimicRule(name, mimic.get("joint", ""), multiplier, offset)


def _resolve(rule: MimicRule, direct: Mapping[str, MimicRule]) -> MimicRule:
    """Follow the leaders to one that follows no other: a (b q + c) + d = (a b) q + (a c + d)."""
    passed = [rule.follower]
    while rule.leader in direct:
        if rule.leader in passed:
            circle = " -> ".join([*passed[passed.index(rule.leader) :], rule.leader])
            message = f"joints mimic each other in a circle: {circle}"
            raise HandError(message, key=f"mimic.{rule.follower}", value=rule.leader)
        passed.append(rule.leader)
        _, leader, factor, shift = direct[rule.leader]
        offset = rule.multiplier * shift + rule.offset
        rule = MimicRule(rule.follower, leader, rule.multiplier * factor, offset)
    return rule


def expansion_matrix(
    names: Iterable[str], active: Iterable[str], rules: Iterable[MimicRule]
) -> Expansion:
    """Compose S and offset.

    Args:
        names: All joints, in the order of the rows.
        active: The joints that follow no other, in the order of the columns.
        rules: Resolved rules, one for each of the others.
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


def tighten_model(model: pin.Model, rules: Iterable[MimicRule]) -> tuple[str, ...]:
    """Tighten the limits of leaders in a model so that their followers stay inside theirs.

    If a follower's limits would leave its leader almost no range, they contradict its own rule (a
    wrong sign, say). They are then dropped. A follower without a speed limit passes none on.

    Returns:
        A sentence for each follower whose limits were dropped.
    """
    lower, upper, velocity = (
        model.lowerPositionLimit,
        model.upperPositionLimit,
        model.velocityLimit,
    )
    notes = []
    for name, leader_name, multiplier, offset in rules:
        if multiplier == 0.0:
            continue
        leader, own = (
            model.joints[model.getJointId(each)] for each in (leader_name, name)
        )
        q, limits = leader.idx_q, (lower[own.idx_q], upper[own.idx_q])
        ends = sorted((limit - offset) / multiplier for limit in limits)
        low, high = max(lower[q], ends[0]), min(upper[q], ends[1])
        # `not a > b` also drops NaN limits.
        if not high - low > _LEAST_SHARE * (upper[q] - lower[q]):
            notes.append(
                f"the limits [{limits[0]:.4g}, {limits[1]:.4g}] of {name!r} are ignored: "
                f"with its rule {multiplier:.4g} * {leader_name} + {offset:.4g} they "
                f"would leave the leader no range in [{lower[q]:.4g}, {upper[q]:.4g}]"
            )
        else:
            lower[q], upper[q] = low, high
        speed = velocity[own.idx_v]
        if math.isfinite(speed) and speed > 0.0:
            velocity[leader.idx_v] = min(
                velocity[leader.idx_v], speed / abs(multiplier)
            )
    return tuple(notes)
