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
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from handmap_qp.errors import HandError
from handmap_qp.hands.spec import MimicSpec
from handmap_qp.hands.urdf import joints_by_name, mimics_of

# A follower's limits count as a mistake if they would leave less than this share of its leader's
# range.
_LEAST_SHARE = 0.01


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


def read_mimic_rules(robot: ET.Element) -> dict[str, MimicSpec]:
    """Read the mimic rules of a URDF, resolved to leaders that follow no other joint.

    Returns:
        Rules by follower, in the order of the file, without those of fixed joints.

    Raises:
        HandError: If a leader is missing or fixed, a joint follows itself through others, or a rule
            does not hold finite numbers.
    """
    joints = joints_by_name(robot)
    movable = {n: j for n, j in joints.items() if j.get("type") != "fixed"}
    direct = {n: rule for n, rule in mimics_of(robot).items() if n in movable}
    for follower, rule in direct.items():
        if rule.joint not in movable:
            absent = "does not exist in this part of the robot"
            what = "cannot move" if rule.joint in joints else absent
            message = (
                f"it mimics {rule.joint!r}, which {what}: "
                "give its rule in `mimic`, or hold it still in `locked`"
            )
            raise HandError(message, key=f"mimic.{follower}", value=rule.joint)
    return {follower: _resolve(follower, direct) for follower in direct}


def _resolve(follower: str, direct: Mapping[str, MimicSpec]) -> MimicSpec:
    """Follow the leaders to one that follows no other: a (b q + c) + d = (a b) q + (a c + d)."""
    passed = [follower]
    rule = direct[follower]
    while rule.joint in direct:
        if rule.joint in passed:
            circle = " -> ".join([*passed[passed.index(rule.joint) :], rule.joint])
            raise HandError(
                f"joints mimic each other in a circle: {circle}",
                key=f"mimic.{follower}",
                value=rule.joint,
            )
        passed.append(rule.joint)
        leader = direct[rule.joint]
        factor = rule.multiplier
        offset = factor * leader.offset + rule.offset
        rule = MimicSpec(leader.joint, factor * leader.multiplier, offset)
    return rule


def expansion_matrix(
    names: Sequence[str], active: Sequence[str], rules: Mapping[str, MimicSpec]
) -> Expansion:
    """Compose S and offset.

    Args:
        names: All joints, in the order of the rows.
        active: The joints that follow no other, in the order of the columns.
        rules: Resolved rules of the others.
    """
    rules = {name: MimicSpec(name) for name in active} | dict(rules)
    matrix = np.zeros((len(names), len(active)))
    offset = np.zeros(len(names))
    for row, rule in enumerate(rules[name] for name in names):
        matrix[row, active.index(rule.joint)] = rule.multiplier
        offset[row] = rule.offset
    return Expansion(matrix, offset)


def tighten_model(model: pin.Model, rules: Mapping[str, MimicSpec]) -> tuple[str, ...]:
    """Tighten the limits of leaders in a model so that their followers stay inside theirs.

    If a follower's limits would leave its leader almost no range, they contradict its own rule (a
    wrong sign, say). They are then dropped. A follower without a speed limit passes none on.

    Returns:
        A sentence for each follower whose limits were dropped.
    """
    lower = model.lowerPositionLimit
    upper = model.upperPositionLimit
    velocity = model.velocityLimit
    notes = []
    for name, rule in rules.items():
        if rule.multiplier == 0.0:
            continue
        leader, own = (model.joints[model.getJointId(n)] for n in (rule.joint, name))
        q = leader.idx_q
        limits = (lower[own.idx_q], upper[own.idx_q])
        ends = sorted((limit - rule.offset) / rule.multiplier for limit in limits)
        low = max(lower[q], ends[0])
        high = min(upper[q], ends[1])
        # `not a > b` also drops NaN limits.
        if not high - low > _LEAST_SHARE * (upper[q] - lower[q]):
            notes.append(
                f"the limits [{limits[0]:.4g}, {limits[1]:.4g}] of {name!r} are ignored: with "
                f"its rule {rule.multiplier:.4g} * {rule.joint} + {rule.offset:.4g} they "
                f"would leave the leader no range in [{lower[q]:.4g}, {upper[q]:.4g}]"
            )
        else:
            lower[q] = low
            upper[q] = high
        speed = velocity[own.idx_v] / abs(rule.multiplier)
        if 0.0 < speed < math.inf:
            velocity[leader.idx_v] = min(velocity[leader.idx_v], speed)
    return tuple(notes)
