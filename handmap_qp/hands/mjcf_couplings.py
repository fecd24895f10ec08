"""Couplings of a MuJoCo model as mimic rules: joint equalities, tendons and closed loops.

Constraints couple joints, such as the four bars of a gripper's finger or the cranks and rods that
push one. Some of the joints lead, and the others follow. A URDF has lines for that: the loops are
closed for positions of what leads, with MuJoCo's own constraints, and each follower gets the line
that fits best. What follows no line is held. Limits of followers bound their leader, or their line
is clipped to them: see `follower_limits`.
"""

import math
from collections import Counter
from collections.abc import Mapping
from copy import copy
from functools import partial
from itertools import chain
from typing import NamedTuple

import mujoco
import numpy as np
from scipy.sparse.csgraph import connected_components

from handmap_core.se3 import Array, lengths
from .closed_loops import ClosedLoop, Line, best_line
from .follower_limits import (
    LEAST_SHARE,
    MOST_SHARE,
    Interval,
    error_within,
    leaves,
    range_left,
    rule_within,
)
from .spec import MimicSpec, Rules
from .urdf import HeldReason

_DISABLE = mujoco.mjtDisableBit
_SITE = int(mujoco.mjtObj.mjOBJ_SITE)
# Kinds of constraints that join two bodies.
_JOINING = ("connect", "weld")
# A joint takes part in a constraint if it moves it by more than this in `qpos0`, where loops are
# closed [m/rad, or without unit].
_LEAST_EFFECT = 1e-4
# Least share of a leader's range in which a loop of bodies closes: bars are stiff.
_LEAST_CLOSED = 0.1
# A joint is held if it is farther from its line than this [rad or m], and a finger's also than this
# share of its own range; one that is nearer than the last needs no note.
_LARGEST_ERROR = 0.1
_LARGEST_SHARE = 0.25
_NO_ERROR = 1e-4
# A leader's range that loses less than this share of it needs no note.
_SMALL_SHARE = 0.01


class Couplings(NamedTuple):
    """What the constraints of a model say about its joints and bodies.

    Attributes:
        rules: Rules by follower. A joint that is held has one without a leader.
        ranges: Limits of leaders [rad or m] that are narrower than their own, by their names.
        bars: Bodies that end a loop on another body, and are no end of a finger.
        fits: How well each follower is fitted, of those that are not exact.
        held: What is held because no line describes it, by what leads.
        notes: Sentences on what a URDF cannot express exactly.
        reasons: Why each joint is held, by its name; the URDF has them, so no note repeats them.
    """

    rules: dict[str, MimicSpec]
    ranges: dict[str, tuple[float, float]]
    bars: set[int]
    fits: list[str]
    held: list[str]
    notes: list[str]
    reasons: dict[str, HeldReason]


def read_couplings(model: mujoco.MjModel, names: Mapping[int, str]) -> Couplings:
    """Read the equality constraints and tendons of a model.

    Args:
        model: The model.
        names: Names of the converted joints, by their indices in the model.
    """
    constraints = _Constraints(model, names)
    omitted = Counter[str]()
    solutions: list[Couplings | None] = [None]
    while None in solutions:
        groups = constraints.groups()
        solutions = [constraints.solve(*group) for group in groups]
        for (_, rows), found in zip(groups, solutions, strict=True):
            if found is None:
                omitted.update(constraints.drop(rows))
    solved = [*filter(None, solutions)]
    found = Couplings({}, {}, constraints.bars(), [], [], [], {})
    for each in solved:
        found.rules.update(each.rules)
        found.reasons.update(each.reasons)
        found.ranges.update(each.ranges)
    notes = [*chain.from_iterable(each.notes for each in solved)]
    if fits := [*chain.from_iterable(each.fits for each in solved)]:
        notes.append(f"loops as mimic rules: {', '.join(fits)}")
    if held := [*chain.from_iterable(each.held for each in solved)]:
        what = (
            f"no line describes the joints of a loop that are held: {'; '.join(held)}"
        )
        notes.append(what + constraints.advice(found.rules))
    if found.ranges:
        ends = (
            f"{n} [{low:.4g}, {high:.4g}]" for n, (low, high) in found.ranges.items()
        )
        notes.append(
            "loops close, and followers keep their limits, in a part of a leader's range only: "
            + ", ".join(ends)
        )
    notes += [
        f"{count} {kind} constraint(s) that a URDF cannot express are left out"
        for kind, count in omitted.items()
    ]
    return found._replace(notes=notes + _tendon_notes(model, names, found.rules))


def fixed_tendon(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
    """Return the joints of a fixed tendon with their factors; empty for a spatial tendon."""
    first = model.tendon_adr[tendon]
    wraps = slice(first, first + model.tendon_num[tendon])
    if (model.wrap_type[wraps] != int(mujoco.mjtWrap.mjWRAP_JOINT)).any():
        return {}
    factors = model.wrap_prm[wraps].tolist()
    return dict(zip(model.wrap_objid[wraps].tolist(), factors, strict=True))


def _tendon_notes(
    model: mujoco.MjModel, names: Mapping[int, str], rules: Rules
) -> list[str]:
    """Name the independent joints that fixed tendons couple, and count the other tendons."""
    notes = []
    tendons = [fixed_tendon(model, i) for i in range(model.ntendon)]
    coupled = []
    for i, factors in enumerate(tendons):
        if factors.keys() <= names.keys():
            own = {names[j]: factor for j, factor in factors.items()}
            leads = {rules[n].joint if n in rules else n for n in own}
            # Joints that are held have no leader.
            if len(leads - {""}) > 1:
                terms = [f"{factor:g} {joint}" for joint, factor in own.items()]
                name = model.tendon(i).name or f"tendon {i}"
                coupled.append(f"{name} = {' + '.join(terms)}")
    if coupled:
        notes.append(
            f"tendons couple joints that are independent here: {'; '.join(coupled)}. Where one "
            "motor drives them, couple them under `mimic` in the hand.yaml"
        )
    if spatial := tendons.count({}):
        notes.append(f"{spatial} spatial tendon(s) are left out")
    return notes


class _Constraints:
    """The active equality constraints of a model, as MuJoCo computes them; see `read_couplings`."""

    def __init__(self, model: mujoco.MjModel, names: Mapping[int, str]) -> None:
        self._names = names
        self._model = model = copy(model)
        model.opt.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
        model.opt.disableflags |= (
            _DISABLE.mjDSBL_CONTACT
            | _DISABLE.mjDSBL_LIMIT
            | _DISABLE.mjDSBL_FRICTIONLOSS
        )
        self._data = mujoco.MjData(model)
        # As MJCF names them.
        kinds = [mujoco.mjtEq(kind).name for kind in model.eq_type.tolist()]
        self._kinds = [kind.removeprefix("mjEQ_").lower() for kind in kinds]

    def groups(self) -> list[tuple[set[int], list[int]]]:
        """Return the joints that constraints couple to each other, and these, for `solve`."""
        model = self._model
        data = self._data
        data.qpos[:] = model.qpos0
        mujoco.mj_fwdPosition(model, data)
        is_moved = np.abs(data.efc_J.reshape(-1, model.nv)) > _LEAST_EFFECT
        rows, dofs = np.nonzero(is_moved)
        touches = np.zeros((model.neq, model.njnt))
        touches[data.efc_id[rows], model.dof_jntid[dofs]] = 1.0
        count, labels = connected_components(touches.T @ touches)
        groups = []
        for label in range(count):
            joints = np.flatnonzero(labels == label)
            constraints = np.flatnonzero(touches[:, joints].any(axis=1)).tolist()
            if constraints:
                groups.append((set(joints.tolist()), constraints))
        return groups

    def drop(self, constraints: list[int]) -> list[str]:
        """Leave out those of a group that are no joint equalities, else all; return their kinds."""
        others = [i for i in constraints if self._kinds[i] != "joint"] or constraints
        self._data.eq_active[others] = False
        return [self._kinds[i] for i in others]

    def solve(self, coupled: set[int], constraints: list[int]) -> Couplings | None:
        """Solve a group; None with joints that a URDF does not have, or if it does not close."""
        if not coupled <= self._names.keys():
            return None
        joints = sorted(coupled)
        loop = self._loop(joints, constraints)
        idle = [joints[k] for k in self._undriven(loop, joints)]
        if idle:
            joints = [joint for joint in joints if joint not in idle]
            loop = self._loop(joints, constraints)
        if not loop.is_closed:
            return None
        traits = self._traits(joints)
        has_bars = any(self._kinds[i] in _JOINING for i in constraints)
        # What drives leads; or what moves a finger, because a rule has one leader only.
        preferred = self._preference(joints, constraints)
        orders = [preferred, sorted(preferred, key=lambda k: not traits.moves_tip[k])]
        every = [loop.leaders(order) for order in orders[: max(1, loop.freedom)]]
        best = min(
            (_Fit(loop, leaders, traits, has_bars=has_bars) for leaders in every),
            key=lambda fit: fit.badness,
        )
        if not best.is_wide:
            return None
        found = best.couplings()
        for joint in idle:
            name = self._names[joint]
            at = float(self._model.qpos0[self._model.jnt_qposadr[joint]])
            found.rules[name] = MimicSpec("", 0.0, at)
            found.reasons[name] = HeldReason("motor", "no motor moves it")
        return found

    def _loop(self, joints: list[int], constraints: list[int]) -> ClosedLoop:
        model = self._model
        is_limited = model.jnt_limited[joints] != 0
        limits = np.where(is_limited, model.jnt_range[joints].T, [[-np.inf], [np.inf]])
        start = np.array(model.qpos0[model.jnt_qposadr[joints]])
        return ClosedLoop(partial(self._residual, joints, constraints), start, limits)

    def _undriven(self, loop: ClosedLoop, joints: list[int]) -> list[int]:
        """Return places of joints that can move while all motors stand; none without motors."""
        model = self._model
        motors = model.actuator_trntype
        joint, tendon = int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_TENDON)
        is_known = all(
            kind == joint or (kind == tendon and fixed_tendon(model, target))
            for kind, target in zip(motors, model.actuator_trnid[:, 0], strict=True)
        )
        driven = self._driven()
        # From the last one on, so that what is nearer to the palm can lead.
        order = sorted(
            range(len(joints)), key=lambda k: (joints[k] not in driven, -joints[k])
        )
        leaders = loop.leaders(order)
        moved = [k for k in leaders if joints[k] in driven]
        return [k for k in leaders if k not in moved] if moved and is_known else []

    def _preference(self, joints: list[int], constraints: list[int]) -> list[int]:
        """Return places of joints: leaders of joint equalities, those of motors, the others."""
        model = self._model
        equal = [i for i in constraints if self._kinds[i] == "joint"]
        leading = {*model.eq_obj2id[equal]} - {*model.eq_obj1id[equal]}
        driven = self._driven()

        def is_last(place: int) -> tuple[bool, bool]:
            return joints[place] not in leading, joints[place] not in driven

        return sorted(range(len(joints)), key=is_last)

    def _driven(self) -> set[int]:
        """Return the joints of motors, and of tendons that motors pull."""
        model = self._model
        motors = model.actuator_trntype
        targets = model.actuator_trnid[:, 0]
        driven = {*targets[motors == int(mujoco.mjtTrn.mjTRN_JOINT)].tolist()}
        for tendon in targets[motors == int(mujoco.mjtTrn.mjTRN_TENDON)]:
            driven.update(fixed_tendon(model, tendon))
        return driven

    def advice(self, rules: Rules) -> str:
        """Return what to do about motors whose joints are held; empty if there are none."""
        names = (self._names.get(joint, "") for joint in sorted(self._driven()))
        held = [name for name in names if name in rules and not rules[name].joint]
        if not held:
            return ""
        return f"; motors turn {', '.join(held)}: compute their positions from the commands"

    # -- bars: bodies that a constraint joins to another one, and that carry no fingertip

    def bars(self) -> set[int]:
        """Return the bodies that end a loop on another body, and are no end of a finger."""
        model = self._model
        data = self._data
        data.qpos[:] = model.qpos0
        mujoco.mj_kinematics(model, data)
        found = set[int]()
        for i, kind in enumerate(self._kinds):
            if kind in _JOINING and data.eq_active[i]:
                ends = self._joined(i)
                leaves = [self._is_last(body) for body, _ in ends]
                if all(leaves):
                    beyond = [self._beyond(*end) for end in ends]
                    # Of two halves that are alike, the first is the finger's.
                    leaves = [beyond[0] < beyond[1] - _LEAST_EFFECT]
                    leaves.append(not leaves[0])
                found |= {
                    body
                    for (body, _), is_bar in zip(ends, leaves, strict=True)
                    if is_bar
                }
        return found - {0}

    def _joined(self, constraint: int) -> list[tuple[int, Array]]:
        """Return the bodies that a constraint joins, and where [m], in the world, in `qpos0`."""
        model = self._model
        data = self._data
        ids = model.eq_obj1id[constraint], model.eq_obj2id[constraint]
        if model.eq_objtype[constraint] == _SITE:
            return [(int(model.site_bodyid[k]), data.site_xpos[k]) for k in ids]
        first, second = map(int, ids)
        place = model.eq_data[constraint, :3]
        # The anchor of a weld is one of its second body.
        carrier = first if self._kinds[constraint] == "connect" else second
        anchor = data.xpos[carrier] + data.xmat[carrier].reshape(3, 3) @ place
        return [(first, anchor), (second, anchor)]

    def _is_last(self, body: int) -> bool:
        """Return whether no joint moves anything on a body."""
        on_it = [int(k) for k in self._model.jnt_bodyid if body in self._above(int(k))]
        return not {*on_it} - {body}

    def _beyond(self, body: int, anchor: Array) -> float:
        """Return how far the shapes on a body reach beyond a place on it, from its origin [m]."""
        model = self._model
        origin = self._data.xpos[body]
        own = [body in self._above(int(k)) for k in model.geom_bodyid]
        away = lengths(self._data.geom_xpos[own] - origin) + model.geom_rbound[own]
        return float(away.max(initial=0.0) - math.dist(anchor, origin))

    def _traits(self, joints: list[int]) -> "_Traits":
        """Return what joints are and carry."""
        model = self._model
        bars = self.bars()
        inner = {*model.body_parentid.tolist()}
        ends = [self._above(k) for k in range(model.nbody) if k not in inner]
        carried = set[int]().union(*(end for end in ends if bars.isdisjoint(end)))
        bodies = model.jnt_bodyid[joints].tolist()
        moves_tip = [body in carried for body in bodies]
        above = [self._above(body) for body in bodies]
        is_slide = model.jnt_type[joints] == int(mujoco.mjtJoint.mjJNT_SLIDE)
        return _Traits(
            [self._names[joint] for joint in joints],
            is_slide.tolist(),
            moves_tip,
            [
                {
                    i
                    for i, other in enumerate(bodies)
                    if not (moves_tip[k] or moves_tip[i])
                    and (other in above[k] or body in above[i])
                }
                for k, body in enumerate(bodies)
            ],
        )

    def _above(self, body: int) -> set[int]:
        """Return a body and those that carry it, without the world."""
        found = set[int]()
        while body:
            found.add(body)
            body = int(self._model.body_parentid[body])
        return found

    def _residual(
        self, joints: list[int], constraints: list[int], q: Array
    ) -> tuple[Array, Array]:
        """Return residuals of constraints, m and rad alike, and their derivatives by joints."""
        model = self._model
        data = self._data
        data.qpos[:] = model.qpos0
        data.qpos[model.jnt_qposadr[joints]] = q
        mujoco.mj_fwdPosition(model, data)
        slopes = data.efc_J.reshape(-1, model.nv)[:, model.jnt_dofadr[joints]]
        rows = np.column_stack([data.efc_pos, slopes])
        blocks = []
        for constraint in constraints:
            block = rows[data.efc_id == constraint]
            blocks.append(block / max(np.linalg.norm(block[:, 1:]), _LEAST_EFFECT))
        rows = np.vstack(blocks)
        return rows[:, 0], rows[:, 1:]


class _Traits(NamedTuple):
    """Joints of a loop.

    Attributes:
        names: Their names.
        slides: Whether each is a slide.
        moves_tip: Whether each carries the end of a finger.
        mates: Places of those of the same bar as each.
    """

    names: list[str]
    slides: list[bool]
    moves_tip: list[bool]
    mates: list[set[int]]


class _Fit:
    """The lines of a loop for one choice of what leads.

    Args:
        loop: The loop.
        leaders: Places of the joints that lead.
        traits: The joints.
        has_bars: Whether bodies close the loop, so that a follower's limit stops its leader.

    Attributes:
        is_wide: Whether the loop closes in a part of each leader's range.
    """

    def __init__(
        self,
        loop: ClosedLoop,
        leaders: list[int],
        traits: _Traits,
        *,
        has_bars: bool,
    ) -> None:
        self._leaders = leaders
        self._least = LEAST_SHARE if has_bars else MOST_SHARE
        self._start = loop.start
        self._traits = traits
        self._limits = loop.limits
        own_limits = loop.limits[:, leaders]
        around = loop.start[leaders] + np.array([[-1.0], [1.0]])
        # Of joints without limits, one radian to both sides.
        wanted = np.where(np.isfinite(own_limits), own_limits, around)
        self._wanted = wanted
        # Where limits leave too little of a range, the loop is closed without them.
        bounded = _LEAST_CLOSED if has_bars else MOST_SHARE
        for is_bounded, share in ((True, bounded), (False, _LEAST_CLOSED)):
            postures = loop.postures(leaders, wanted, is_bounded=is_bounded)
            own = postures[:, leaders]
            self._reached = np.array([own.min(axis=0), own.max(axis=0)]).clip(*wanted)
            left = np.ptp(self._reached, axis=0)
            self.is_wide = bool((left >= share * np.ptp(wanted, axis=0)).all())
            if self.is_wide:
                break
        self._lines: dict[int, Line] = {
            k: best_line(own, postures[:, k])
            for k in range(len(loop.start))
            if k not in leaders
        }
        bad = {*filter(self._is_far, self._lines)}
        # A bar of which one joint is held moves no other one either.
        self._held = {
            k for k in self._lines if k in bad or not bad.isdisjoint(traits.mates[k])
        }

    def _is_far(self, k: int) -> bool:
        """Return whether a follower is too far from its line."""
        line = self._lines[k]
        share = _LARGEST_SHARE if self._traits.moves_tip[k] else 0.0
        return line.error > max(_LARGEST_ERROR, share * line.width)

    @property
    def badness(self) -> tuple[bool, int, int]:
        """How much is lost: ranges, followers that move a fingertip, and others."""
        fingers = sum(self._traits.moves_tip[k] for k in self._held)
        return not self.is_wide, fingers, len(self._held)

    def couplings(self) -> Couplings:
        """Return rules, ranges and notes."""
        names = self._traits.names
        heads = [names[k] for k in self._leaders]
        found = Couplings({}, {}, set(), [], [], [], {})
        ends = [Interval(*end) for end in self._reached.T.tolist()]
        clipped = self._clipped(ends)
        for k, line in self._lines.items():
            # Without freedom, nothing leads, and nothing moves.
            if not heads or k in self._held:
                found.rules[names[k]] = MimicSpec("", 0.0, float(self._start[k]))
                why = "its constraints leave it no motion"
                if heads:
                    why = f"no line describes how it follows {' and '.join(heads)}"
                found.reasons[names[k]] = HeldReason("loop", why)
                continue
            rule = MimicSpec(heads[line.leader], line.multiplier, line.offset)
            if k in clipped:
                self._clip(k, rule, ends[line.leader], found)
                continue
            found.rules[names[k]] = rule
            if line.error > _NO_ERROR:
                error = self._length(k, line.error)
                found.fits.append(f"{names[k]} follows {rule.joint} within {error}")
        if heads and self._held:
            held = ", ".join(names[k] for k in sorted(self._held))
            found.held.append(f"{held}, which follow {' and '.join(heads)}")
        for head, wanted, (low, high) in zip(heads, self._wanted.T, ends, strict=True):
            lost = np.abs(wanted - (low, high)).max()
            if lost > _SMALL_SHARE * np.ptp(wanted):
                found.ranges[head] = low, high
        return found

    def _clipped(self, ends: list[Interval]) -> set[int]:
        """Return followers whose limits leave their leader too little of its range.

        Limits of the others bound it.

        Args:
            ends: Ranges of the leaders, which are bounded in place.
        """
        wanted = [*ends]
        clipped = set[int]()
        for k, line in self._lines.items():
            if k in self._held:
                continue
            own = Interval(*self._limits[:, k].tolist())
            if line.multiplier == 0.0:
                if abs(line.offset - own.clip(line.offset)) > _LARGEST_ERROR:
                    clipped.add(k)
                continue
            rule = MimicSpec("", line.multiplier, line.offset)
            left = range_left(rule, own, ends[line.leader])
            if leaves(self._least, left, wanted[line.leader]):
                ends[line.leader] = left
            else:
                clipped.add(k)
        return clipped

    def _clip(
        self, k: int, rule: MimicSpec, leader: Interval, found: Couplings
    ) -> None:
        """Add the rule of a follower as far as its limits allow; with none left, it is held."""
        name = self._traits.names[k]
        own = Interval(*self._limits[:, k].tolist())
        how = f"{rule.multiplier:.4g} * {rule.joint} + {rule.offset:.4g}, as constraints couple it"
        inside = f"its limits [{own.low:.4g}, {own.high:.4g}]"
        is_bent = rule.multiplier != 0.0
        if is_bent and leaves(LEAST_SHARE, range_left(rule, own, leader), leader):
            found.rules[name] = rule_within(rule, own, leader)
            error = self._length(k, error_within(rule, own, leader))
            found.notes.append(
                f"{name} stops at {inside} on the way along {how}: it follows on a line between "
                f"both ends, within {error}, so that {rule.joint} keeps its range"
            )
            return
        at = own.clip(rule.multiplier * (leader.low + leader.high) / 2.0 + rule.offset)
        found.rules[name] = MimicSpec("", 0.0, at)
        found.reasons[name] = HeldReason("limits", f"{how}, is outside of {inside}")

    def _length(self, k: int, error: float) -> str:
        """Return a distance of a joint in words."""
        if self._traits.slides[k]:
            return f"{1e3 * error:.2g} mm"
        return f"{math.degrees(error):.2g} deg"
