"""Couplings of a MuJoCo model as mimic rules: joint equalities, tendons and closed loops.

Joints that constraints couple to one degree of freedom, such as the four bars of a gripper's
finger, fit into a URDF: one of them leads, and each of the others follows it along a curve. The
curve is solved from MuJoCo's own constraints, and its best line is written.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from copy import copy
from functools import partial

import mujoco
import numpy as np
from scipy.sparse.csgraph import connected_components

from handmap_core.se3 import Array
from .spec import MimicSpec, Rules

_DISABLE = mujoco.mjtDisableBit
# Postures at which a curve is solved, Newton iterations of each, and the residual of a solution
# [rad or m].
_SAMPLES = 41
_ITERATIONS = 20
_CLOSED = 1e-6
# Least share of the postures that must have one.
_LEAST_CLOSED = 0.48
# A joint takes part in a constraint if it moves it by more than this in `qpos0`, where loops are
# closed [m/rad, or without unit]. Singular values below this share of the largest count as zero.
_LEAST_EFFECT = 1e-4
_RANK = 1e-4
# A line that is farther from its curve is not written, and a nearer one needs no note [rad or m].
_LARGEST_ERROR = 0.1
_NO_ERROR = 1e-9


_Residual = Callable[[Array], tuple[Array, Array]]
"""Residuals of constraints and their derivatives at positions of joints."""
_Solution = tuple[dict[str, MimicSpec], list[str]]
"""Rules of followers by name, of those that are held without a leader, and notes on them."""


def read_couplings(model: mujoco.MjModel, names: Mapping[int, str]) -> _Solution:
    """Read the equality constraints and tendons of a model.

    Args:
        model: The model.
        names: Names of the converted joints, by their indices in the model.

    Returns:
        The rules by follower, and a note on each coupling that a URDF cannot express exactly.
        A joint that is held has a rule without a leader.
    """
    constraints = _Constraints(model, names)
    omitted = Counter[str]()
    solutions: list[_Solution | None] = [None]
    while None in solutions:
        groups = constraints.groups()
        solutions = [constraints.solve(*group) for group in groups]
        for (_, rows), found in zip(groups, solutions, strict=True):
            if found is None:
                omitted.update(constraints.drop(rows))
    rules: dict[str, MimicSpec] = {}
    notes: list[str] = []
    for found, more in filter(None, solutions):
        rules |= found
        notes += more
    notes += [
        f"{count} {kind} constraint(s) that a URDF cannot express are left out"
        for kind, count in omitted.items()
    ]
    return rules, notes + _tendon_notes(model, names, rules)


def _fixed_tendon(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
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
    tendons = [_fixed_tendon(model, i) for i in range(model.ntendon)]
    coupled = []
    for i, factors in enumerate(tendons):
        if factors.keys() <= names.keys():
            own = {names[j]: factor for j, factor in factors.items()}
            if len({rules[n].joint if n in rules else n for n in own}) > 1:
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

    def solve(self, coupled: set[int], constraints: list[int]) -> _Solution | None:
        """Solve a group; None with other joints or freedoms, or if it is open or not near lines."""
        if not coupled <= self._names.keys():
            return None
        leader = self._leader(coupled, constraints)
        joints = [leader, *sorted(coupled - {leader})]
        start = np.array(self._model.qpos0[self._model.jnt_qposadr[joints]])
        residual = partial(self._residual, joints, constraints)
        slopes = residual(start)[1]
        freedom = len(joints) - np.linalg.matrix_rank(slopes, rtol=_RANK)
        if freedom > 1:
            return None
        ends = self._model.jnt_range[leader]
        if not self._model.jnt_limited[leader]:
            ends = start[0] + (-1.0, 1.0)
        # Without freedom, one posture in which nothing leads.
        grid = np.linspace(*ends, _SAMPLES) if freedom else start[:1]
        curve = [*_followed(residual, start, grid, freedom)]
        if len(curve) < _LEAST_CLOSED * len(grid):
            return None
        postures = np.array(curve)
        powers = np.vander(freedom * postures[:, 0], 2)
        followers = postures[:, freedom:]
        # Digits beyond these are noise of the fit.
        lines = np.linalg.lstsq(powers, followers, rcond=None)[0].round(14)
        worst = float(np.abs(followers - powers @ lines).max())
        if worst > _LARGEST_ERROR:
            return None
        named = [self._names[joint] for joint in joints]
        head = named[0] if freedom else ""
        others = named[freedom:]
        rules = [MimicSpec(head, *line) for line in lines.T.tolist()]
        note = (
            f"curves couple {', '.join(others)} to {head}: lines within {worst:.2g} "
            "rad or m of them are written"
        )
        return dict(zip(others, rules, strict=True)), [note] * (worst > _NO_ERROR)

    def _leader(self, coupled: set[int], constraints: list[int]) -> int:
        """Return the joint that leads in joint equalities, else one of a motor, else the first."""
        model = self._model
        motors = model.actuator_trntype
        equal = [i for i in constraints if self._kinds[i] == "joint"]
        leading = {*model.eq_obj2id[equal]} - {*model.eq_obj1id[equal]}
        targets = model.actuator_trnid[:, 0]
        driven = {*targets[motors == int(mujoco.mjtTrn.mjTRN_JOINT)]}
        for tendon in targets[motors == int(mujoco.mjtTrn.mjTRN_TENDON)]:
            driven.update(_fixed_tendon(model, tendon))
        return max(sorted(coupled), key=lambda j: (j in leading, j in driven))

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


def _followed(
    residual: _Residual, start: Array, grid: Array, freedom: int
) -> Iterator[Array]:
    """Iterate over closed postures, both ways from the place on the grid that is nearest."""
    nearest = np.abs(grid - start[0]).argmin()
    for way in (grid[nearest:], grid[:nearest][::-1]):
        q = start
        for position in way:
            near = np.array([position, *q[1:]])
            closed = _closed(residual, near, freedom)
            if closed is None:
                break
            q = closed
            yield q


def _closed(residual: _Residual, q: Array, first: int) -> Array | None:
    """Find a posture near another that satisfies constraints by the joints from `first`."""
    q = q.copy()
    for _ in range(_ITERATIONS):
        gap, slopes = residual(q)
        # A model with NaN in its numbers, or one that ran away.
        if not (np.isfinite(gap).all() and np.isfinite(slopes).all()):
            return None
        if np.abs(gap).max() < 1e-6 * _CLOSED:
            break
        q[first:] -= np.linalg.lstsq(slopes[:, first:], gap, rcond=_RANK)[0]
    return q if np.abs(gap).max() < _CLOSED else None
