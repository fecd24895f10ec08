"""QPs of the mapping for `bench_solvers`: recorded, random and hostile ones.

A `PosedProblem` knows where it was posed, so that it can be posed there again in other ways.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import hostile
import numpy as np
import pinocchio as pin

from handmap_core.ik.gate import Rows
from handmap_core.ik.motion import Motion
from handmap_core.ik.tasks import Goal
from handmap_core.se3 import Array
from handmap_qp import HandMapper, IkOptions, hand_names, load_hand
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.human import HumanMotion
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.reference import ReferenceIk
from handmap_qp.reference.problem import direct_cost
from handmap_qp.se3 import affine

_HOSTILE = ("allegro_right", "three_finger", "shadow_right", "ability_right", "g1_left")
_ROBOTS = ("allegro_right", "three_finger")
_ACTIVE = 1e-9
"""A row with less slack than this at the answer is active [m]."""


class Problem(NamedTuple):
    """`min 1/2 x' H x + c' x  s.t.  lower <= x <= upper,  G x <= h`.

    Attributes:
        H: Hessian, symmetric and positive definite, shape (n, n).
        c: Slope at zero, shape (n,).
        lower: Lower bounds [rad or m], shape (n,).
        upper: Upper bounds [rad or m], shape (n,).
        rows: G, shape (r, n), and h [m], shape (r,); None for none.
    """

    H: Array
    c: Array
    lower: Array
    upper: Array
    rows: Rows | None = None


class PosedProblem(NamedTuple):
    """A problem, and the robot and targets that it was posed for.

    Attributes:
        problem: The problem, as `direct_cost` posed it.
        ik: Poses it.
        motion: How the robot moved there.
        q: Pinocchio configuration where it was posed, shape (nq,).
        goal: What the cost asks for.
    """

    problem: Problem
    ik: ReferenceIk
    motion: Motion
    q: Array
    goal: Goal

    def restore(self) -> None:
        """Put the robot back to where the problem was posed."""
        self.ik.gate.motion = self.motion
        self.ik.configuration.place(self.q)


Keep = Callable[[Problem, Array | None], bool]
"""Whether to record a problem, given its answer."""


def any_problem(problem: Problem, answer: Array | None) -> bool:
    """Record every problem."""
    del problem, answer
    return True


def has_active_row(problem: Problem, answer: Array | None) -> bool:
    """Record the problems whose answer is pressed against a row."""
    if answer is None or problem.rows is None:
        return False
    G, h = problem.rows
    return bool((h - G @ answer < _ACTIVE).any())


class RecordingIk(ReferenceIk):
    """Poses and solves the QPs of a hand, and records them.

    Args:
        ik: The solver of the hand, which must pose its QPs in Python.
        count: Number of problems after which it is full.
        keep: Which problems to record.

    Attributes:
        problems: What it has recorded.
    """

    def __init__(self, ik: PointIk, count: int, keep: Keep = any_problem) -> None:
        super().__init__(ik.hand, ik.gate)
        self.problems: list[PosedProblem] = []
        self._count = count
        self._keep = keep
        ik.reference = self

    @property
    def is_full(self) -> bool:
        """Whether it has all problems that it wants."""
        return len(self.problems) >= self._count

    def step(
        self, goal: Goal, lower: Array, upper: Array, rows: Rows | None
    ) -> tuple[Array | None, Array]:
        """Pose, solve and record a QP; see `ReferenceIk.step`."""
        H, c = direct_cost(self.gate, self.configuration, goal)
        # Copy before the answer is found: buffers of the core may be written to again.
        problem = Problem(H, c, lower.copy(), upper.copy(), _copied(rows))
        motion = self.gate.motion
        q = self.configuration.q.copy()
        answer, slope = super().step(goal, lower, upper, rows)
        if not self.is_full and self._keep(problem, answer):
            self.problems.append(PosedProblem(problem, self, motion, q, goal))
        return answer, slope


def _copied(rows: Rows | None) -> Rows | None:
    return None if rows is None else (rows[0].copy(), rows[1].copy())


def mapped_problems(
    motions: Sequence[HumanMotion],
    robots: Sequence[str],
    preset: str,
    count: int,
    *,
    keeps_links_apart: bool | None = None,
    keep: Keep = any_problem,
    rounds: int = 1,
) -> list[PosedProblem]:
    """Record the problems of mapping motions to robots, in order; the same number of each.

    Args:
        motions: The motions.
        robots: Names of the robots.
        preset: Name of the preset.
        count: Most problems. There are fewer if the motions have fewer.
        keeps_links_apart: Whether rows keep the robot's links apart; as in the preset if omitted.
        keep: Which problems to record.
        rounds: How often each motion is repeated at most.
    """
    options = get_preset(preset).ik.replaced(formulation="direct")
    if keeps_links_apart is not None:
        options = options.replaced(avoids_self_collision=keeps_links_apart)
    pairs = list(product(motions, robots))
    problems: list[PosedProblem] = []
    for k, (motion, name) in enumerate(pairs):
        human = motion.human.with_points("landmarks")
        mapper = HandMapper(human, load_hand(name), preset, ik=options)
        share = -(-(count - len(problems)) // (len(pairs) - k))
        recorder = RecordingIk(mapper.point_ik, share, keep)
        for i in [*range(len(motion.time))] * rounds:
            if recorder.is_full:
                break
            landmarks = human.points(motion.q[i], motion.wrist[i])
            mapper.map_landmarks(landmarks, dt=motion.dt[i])
        problems += recorder.problems
    return problems


def hard_problems(count: int, seed: int = 0) -> list[Problem]:
    """Generate hard random problems, for two hands in turn."""
    rng = np.random.default_rng(seed)
    iks = [PointIk(load_hand(name), IkOptions()) for name in _ROBOTS]
    return [
        _hard_problem(iks[i % len(iks)], i // len(iks) % 4, rng) for i in range(count)
    ]


def _hard_problem(ik: PointIk, kind: int, rng: np.random.Generator) -> Problem:
    hand: Hand = ik.hand
    q = rng.uniform(hand.lower_limits, hand.upper_limits)
    if kind == 1:  # half of the joints at a limit
        q = np.where(
            rng.random(len(q)) < 0.5,
            np.where(rng.random(len(q)) < 0.5, hand.lower_limits, hand.upper_limits),
            q,
        )
    elif kind == 2:  # stretched: singular
        q = np.clip(np.zeros(len(q)), hand.lower_limits, hand.upper_limits)
    elif kind == 3:  # outside the limits
        q = q + rng.uniform(-0.5, 0.5, len(q))
    ik.place(hand.configuration_vector(q))
    targets = ik.configuration.points + rng.normal(
        scale=10.0 ** rng.uniform(-3.0, 0.0), size=ik.configuration.points.shape
    )
    wrist = affine(pin.exp3(rng.normal(size=3)), rng.normal(scale=0.3, size=3))
    dt = 10.0 ** rng.uniform(-3.0, -1.0)
    goal = Goal(targets, wrist[None], hand.rest, (), dt)
    cost = direct_cost(ik.gate, ik.configuration, goal)
    return Problem(*cost, *ik.gate.bounds(dt))


def hostile_problems(count: int, seed: int = 0) -> list[Problem]:
    """Record the problems of hostile targets, times, limits and margins on the hands there are."""
    problems: list[Problem] = []
    hands = [name for name in _HOSTILE if name in hand_names()]
    kinds = list(product(hands, (False, True)))
    for k, (name, has_contacts) in enumerate(kinds):
        share = -(-(count - len(problems)) // (len(kinds) - k))
        recorded: list[Problem] = []
        hand, rng = load_hand(name), np.random.default_rng(seed + k)
        shapes = all_pairs(hand) if has_contacts else None
        while len(recorded) < share:
            options = hostile.wild_options(rng).replaced(
                formulation="direct", max_acceleration=rng.choice([None, 40.0])
            )
            run = hostile.IkRun(hand, options, seed + k, shapes)
            recorder = RecordingIk(run.ik, share - len(recorded))
            run.checker.meter = None
            run.advance(min(500, count), hostile.Tally())
            recorded += [posed.problem for posed in recorder.problems]
        problems += recorded
    return problems
