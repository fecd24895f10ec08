"""The box of limits, the step inside it, and wrists that float, stay fixed or follow an arm."""

from __future__ import annotations

from functools import cache
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from ik_cases import (
    ARM_JOINTS,
    HANDS,
    arm_hand,
    box_of,
    each_kind_of_hand,
    hand_of,
    problem_of,
    random_cases,
)
from marks import rotated
from strategies import generators

from handmap_core.ik.gate import Gate
from handmap_core.ik.limits import box_limits
from handmap_core.ik.motion import Motion
from handmap_qp import HandError, HandMapper, IkOptions, load_hand
from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.spec import PointSpec
from handmap_qp.ik.qp import PointIk
from handmap_qp.options import Option, options_of
from handmap_qp.reference.daqp_solver import solve_by_daqp
from handmap_qp.reference.solvers import make_solver

ARM = arm_hand()
HAND = load_hand("three_finger", mount="floating")
times = st.floats(min_value=-6, max_value=1).map(lambda exponent: 10.0**exponent)


def any_posture(
    hand: Hand, rng: np.random.Generator, outside: float = 0.5
) -> np.ndarray:
    angles = rng.uniform(hand.lower_limits - outside, hand.upper_limits + outside)
    return hand.configuration_vector(angles, np.eye(4) if hand.is_floating else None)


# Those that no test changes.
loaded = cache(load_hand)


# -- the box


@given(rng=generators, dt=times)
def test_the_box_never_contradicts_itself(rng: np.random.Generator, dt: float) -> None:
    hand = HAND
    velocity = rng.normal(size=len(hand.active_columns)) * 10.0 ** rng.uniform(-3, 3)
    for acceleration in (None, 10.0 ** rng.uniform(-2, 4), np.inf):
        for has_velocity_limits in (True, False):
            options = IkOptions(
                has_velocity_limits=has_velocity_limits, max_acceleration=acceleration
            )
            q = any_posture(hand, rng, outside=2.0)
            lower, upper = box_of(hand, q, dt, velocity, options)
            assert (lower <= upper).all()
            assert not np.isnan([lower, upper]).any()


@given(rng=generators, dt=times)
def test_inside_its_limits_the_box_is_position_and_speed_limits_together(
    rng: np.random.Generator, dt: float
) -> None:
    hand = HAND
    q = any_posture(hand, rng, outside=0.0)
    lower, upper = box_of(hand, q, dt)
    angles, reach = q[hand.q_indices], hand.velocity_limits * dt
    np.testing.assert_array_equal(
        upper[hand.joint_columns], np.minimum(hand.upper_limits - angles, reach)
    )
    np.testing.assert_array_equal(
        lower[hand.joint_columns], np.maximum(hand.lower_limits - angles, -reach)
    )
    wrist = hand.spec.wrist
    np.testing.assert_array_equal(
        upper[:6], np.repeat([wrist.max_linear_speed, wrist.max_angular_speed], 3) * dt
    )


@given(rng=generators)
def test_from_outside_a_joint_comes_back_as_fast_as_it_may(
    rng: np.random.Generator,
) -> None:
    hand, dt = HAND, 0.01
    angles = hand.upper_limits + rng.uniform(0.001, 1.0, len(hand.joint_names))
    lower, upper = box_of(hand, hand.configuration_vector(angles, np.eye(4)), dt)
    overshoot = angles - hand.upper_limits
    back = np.minimum(overshoot, hand.velocity_limits * dt)
    np.testing.assert_allclose(upper[hand.joint_columns], -back, atol=1e-15)
    assert (lower[hand.joint_columns] <= -back + 1e-15).all()


@given(rng=generators)
def test_from_rest_acceleration_never_stands_against_position(
    rng: np.random.Generator,
) -> None:
    # Both limits hold for all commands and sample times, because a joint is never too fast to
    # brake before its limit.
    hand = HAND
    acceleration = 10.0 ** rng.uniform(-1, 3)
    options = IkOptions(max_acceleration=acceleration)
    q = any_posture(hand, rng, outside=0.0)
    velocity = np.zeros(len(hand.active_columns))
    for _ in range(60):
        dt = 10.0 ** rng.uniform(-3, -1)
        lower, upper = box_of(hand, q, dt, velocity, options)
        # Mostly full speed into one corner: the hardest case for the brakes.
        dq = np.where(rng.random(len(lower)) < 0.9, upper, rng.uniform(lower, upper))
        assert (
            np.abs(dq / dt - velocity) <= acceleration * dt * (1.0 + 1e-9) + 1e-9
        ).all()
        q, velocity = pin.integrate(hand.model, q, dq), dq / dt
        angles = q[hand.q_indices]
        assert (angles <= hand.upper_limits + 1e-12).all()
        assert (angles >= hand.lower_limits - 1e-12).all()


@given(rng=generators)
def test_position_and_speed_go_before_acceleration(rng: np.random.Generator) -> None:
    # A joint approaches its limit far too fast: the box gives the bound nearest to the range that
    # its acceleration allows.
    hand, dt = HAND, 0.01
    options = IkOptions(max_acceleration=1e-3)
    q = any_posture(hand, rng)
    direction = rng.choice([-1.0, 1.0], len(hand.active_columns))
    lower, upper = box_of(hand, q, dt, 1e4 * direction, options)
    least, most = box_of(hand, q, dt)
    np.testing.assert_array_equal(lower, np.where(direction > 0.0, most, least))
    np.testing.assert_array_equal(upper, lower)


def test_an_infinite_acceleration_limit_limits_nothing() -> None:
    q = any_posture(HAND, np.random.default_rng(0))
    bounds = box_of(HAND, q, 0.01, options=IkOptions(max_acceleration=np.inf))
    np.testing.assert_allclose(bounds, box_of(HAND, q, 0.01), atol=1e-15)


@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, [1.0, 2.0]])
def test_acceleration_limits_are_checked(value: object) -> None:
    with pytest.raises(InvalidOptionsError, match="max_acceleration"):
        IkOptions(max_acceleration=value)  # ty: ignore[invalid-argument-type]


# -- the step


@each_kind_of_hand
def test_the_solver_leaves_nothing_to_clip(which: tuple[str, str, str | None]) -> None:
    hand, ik = hand_of(which), PointIk(hand_of(which), IkOptions())
    for case in random_cases(hand, 30, seed=8):
        ik.place(case.q)
        H, c, lower, upper = problem_of(
            ik, case.point_targets, case.wrist_target, case.dt
        )
        dq = solve_by_daqp(H, c, lower, upper)
        assert dq is not None
        # The solver's tolerance; measured: 2e-16.
        assert max((dq - upper).max(), (lower - dq).max()) < 1e-9


@each_kind_of_hand
def test_the_hessian_is_near_one(which: tuple[str, str, str | None]) -> None:
    # In metres it would be 1e4 times smaller, and damping a guess. The wrist's translation is the
    # largest: it moves all points. Rotations of a hand's own size: a prismatic finger moves its
    # point by as much as itself, an arm has levers of half a metre.
    hand, ik = hand_of(which), PointIk(hand_of(which), IkOptions())
    for case in random_cases(hand, 30, seed=9):
        ik.place(case.q)
        near = ik.configuration.points + 0.005
        wrist = (
            ik.configuration.wrist.homogeneous
            if case.wrist_target is not None
            else None
        )
        H = problem_of(ik, near, wrist, case.dt)[0]
        if (
            not (hand.has_moving_wrist and not hand.is_floating)
            and hand.name != "panda_gripper"
        ):
            assert 0.1 < np.median(np.diag(H)[hand.joint_columns]) < 3e3
        assert np.diag(H).max() < 1e6
        assert np.linalg.cond(H) < 1e7


@each_kind_of_hand
def test_limits_hold_from_anywhere_to_anywhere(
    which: tuple[str, str, str | None],
) -> None:
    hand, ik = hand_of(which), PointIk(hand_of(which), IkOptions())
    for case in random_cases(hand, 30, seed=10):
        ik.place(case.q)
        ik.solve(case.point_targets, case.wrist_target, case.dt)
        lower, upper = box_of(hand, case.q, case.dt)
        dq = pin.difference(hand.model, case.q, ik.configuration.q)[hand.active_columns]
        assert (dq <= upper + 1e-9).all()
        assert (dq >= lower - 1e-9).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    "solver", rotated(["daqp", "osqp", "quadprog", "clarabel", "piqp"], 3)
)
def test_a_joint_that_the_box_holds_is_said_to_be_held(solver: str) -> None:
    # At convergence the gradient is zero for free joints and points outwards for joints at a
    # bound.
    hand, rng, held = load_hand("allegro_right"), np.random.default_rng(12), 0
    ik = PointIk(
        hand, IkOptions(solver=solver, max_iterations=100, step_tolerance=1e-8)
    )
    for _ in range(12):
        ik.place(any_posture(hand, rng, outside=0.0))
        targets, wrist = (
            ik.configuration.points + 0.02 * rng.normal(size=(4, 3)),
            ik.configuration.wrist.homogeneous,
        )
        result = ik.solve(targets, wrist, 1.0 / 60.0)
        if result.last_step < 1e-8:
            H, c, *_ = problem_of(ik, targets, wrist, 1.0 / 60.0)
            slope = c / np.diag(H)
            # Measured: 2e-8 for free joints, at least 1.7e-4 for joints at a bound.
            np.testing.assert_array_equal(
                result.active, -np.sign(slope) * (np.abs(slope) > 1e-6)
            )
            held += np.count_nonzero(result.active)
    assert held > 40


def test_limits_hold_exactly_with_a_solver_that_stops_at_a_tolerance() -> None:
    # OSQP leaves violations of 1e-3; the displacement is clipped into the box afterwards.
    hand = load_hand("three_finger")
    ik = PointIk(hand, IkOptions(solver="osqp", max_iterations=1))
    violations = []
    for case in random_cases(hand, 60, seed=14):
        ik.place(case.q)
        H, c, lower, upper = problem_of(
            ik, case.point_targets, case.wrist_target, case.dt
        )
        raw = make_solver("osqp")(H, c, lower, upper)
        assert raw is not None
        violations.append(max((raw - upper).max(), (lower - raw).max()))
        displacement = ik.solve(
            case.point_targets, case.wrist_target, case.dt
        ).displacement
        assert (lower <= displacement).all()
        assert (displacement <= upper).all()
    # Without the clipping this test would fail.
    assert max(violations) > 1e-9


def test_a_hand_comes_back_into_its_limits_and_stays() -> None:
    hand = load_hand("allegro_right")
    ik, rng = PointIk(hand, IkOptions()), np.random.default_rng(0)
    ik.place(any_posture(hand, rng))
    for _ in range(60):
        ik.solve(
            ik.configuration.points + 0.05 * rng.normal(size=(4, 3)), None, 1.0 / 60.0
        )
    q = ik.configuration.q[hand.q_indices]
    assert (q >= hand.lower_limits).all()
    assert (q <= hand.upper_limits).all()


def test_what_the_gate_may_shorten_is_the_first_iteration(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Its rows are exact at the start of the sample; the sum of all is farther from there."""
    hand = load_hand("allegro_right", mount="fixed")
    offered = []
    for most in (1, 4):
        options = IkOptions(
            max_iterations=most, step_tolerance=0.0, formulation="direct"
        )
        ik = PointIk(hand, options)
        ik.place(hand.configuration_vector(hand.rest))
        admit = ik.gate.admit

        def recording(*given: Any, admit: Any = admit) -> np.ndarray:
            """Note what is wanted, and what comes first."""
            offered.append(given[:2])
            return admit(*given)

        monkeypatch.setattr(ik.gate, "admit", recording)
        ik.solve(hand.points(0.7 * hand.upper_limits), None, 0.1)
    (once, first_of_one), (total, first_of_four) = offered
    np.testing.assert_array_equal(first_of_one, once)
    np.testing.assert_array_equal(first_of_four, once)
    assert np.abs(total - once).max() > 1e-3


def test_a_step_does_not_depend_on_the_steps_before_it() -> None:
    # The warm start changes the time, not the result.
    hand = hand_of(HANDS[0])
    warm, cases = PointIk(hand, IkOptions()), list(random_cases(hand, 20, seed=11))
    for case in cases:
        cold = PointIk(hand, IkOptions())
        for ik in (warm, cold):
            ik.place(case.q)
            ik.solve(case.point_targets, case.wrist_target, case.dt)
        np.testing.assert_allclose(
            warm.configuration.q, cold.configuration.q, atol=1e-9
        )


@pytest.mark.parametrize("name", ["three_finger", "allegro_right"])
def test_a_point_of_weight_4_counts_as_four_equal_points(name: str) -> None:
    # The weight counts squared errors, as in the estimation of T: sum_j w_j |J_j dq - e_j|^2.
    spec = load_hand(name).spec
    first, *others = load_hand(name).reference_points

    def hand_with(*points: PointSpec) -> Hand:
        sets = {spec.reference: tuple(point.name for point in points)}
        return Hand(
            msgspec.structs.replace(spec, points=points, sets=sets), mount="floating"
        )

    heavy = hand_with(msgspec.structs.replace(first, weight=4.0), *others)
    copies = (msgspec.structs.replace(first, name=f"copy_{i}") for i in range(4))
    fourfold = hand_with(*copies, *others)
    for case in random_cases(heavy, 10, seed=13):
        displacements = []
        for one, targets in (
            (heavy, case.point_targets),
            (
                fourfold,
                np.vstack([np.tile(case.point_targets[0], (3, 1)), case.point_targets]),
            ),
        ):
            ik = PointIk(one, IkOptions(max_iterations=1))
            ik.place(case.q)
            displacements.append(
                ik.solve(targets, case.wrist_target, case.dt).displacement
            )
        np.testing.assert_allclose(*displacements, atol=1e-9)  # ty: ignore[no-matching-overload]
        assert np.abs(displacements[0]).max() > 1e-6


@pytest.mark.parametrize(
    ("weight", "unit", "columns", "rows"),
    [
        ("point_weight", 0.01, [0, 1, 2], 4),
        ("wrist_position_weight", 0.01, [0, 1, 2], 1),
        ("wrist_orientation_weight", 0.1, [3, 4, 5], 1),
    ],
)
def test_a_weight_of_1_costs_1_for_10_mm_or_a_tenth_of_a_radian(
    weight: str, unit: float, columns: list[int], rows: int
) -> None:
    # At the targets the error is zero, so the QP's cost is that of the displacement alone.
    hand = load_hand("allegro_right", mount="floating")
    costs = []
    for value in (1.0, 3.0):
        ik = PointIk(hand, IkOptions(**{weight: value}))  # ty: ignore[invalid-argument-type]
        ik.place(hand.configuration_vector(hand.rest, np.eye(4)))
        H = problem_of(ik, ik.configuration.points, np.eye(4), 0.01)[0]
        costs.append(unit**2 * np.diag(H)[columns])
    # The difference of two weights cancels all other terms.
    np.testing.assert_allclose(costs[1] - costs[0], rows * (3.0**2 - 1.0**2), rtol=1e-9)


def test_a_failed_step_brings_joints_back_into_their_limits_and_moves_no_other() -> (
    None
):
    hand, dt = load_hand("three_finger"), 0.01
    ik = PointIk(hand, IkOptions())
    q = hand.rest.copy()
    q[2] = hand.upper_limits[2] + 0.5
    ik.place(hand.configuration_vector(q))
    targets = ik.configuration.points + 1e300
    with np.errstate(all="ignore"):
        result = ik.solve(targets, ik.configuration.wrist.homogeneous, dt)
    assert result.status == "failed"
    expected = q.copy()
    expected[2] -= hand.velocity_limits[2] * dt
    np.testing.assert_allclose(ik.configuration.q[hand.q_indices], expected, atol=1e-12)


# -- on an arm


def test_an_arm_moves_the_wrist_and_carries_the_palm() -> None:
    assert ARM.has_moving_wrist
    assert not load_hand("three_finger", mount="fixed").has_moving_wrist
    assert load_hand("three_finger", mount="floating").has_moving_wrist
    q = ARM.rest.copy()
    before = ARM.frame_pose("wrist", q)
    q[: len(ARM_JOINTS)] += [0.2, -0.3, 0.4]
    after = ARM.frame_pose("wrist", q)
    assert np.abs(after - before).max() > 0.05
    np.testing.assert_allclose(
        ARM.frame_pose("palm", q), after @ ARM.wrist_to_palm, atol=1e-12
    )


def test_an_arm_reaches_a_wrist_pose_while_the_fingers_keep_their_shape() -> None:
    hand = load_hand("three_finger", mount="fixed")
    ik = PointIk(
        ARM, IkOptions(max_iterations=100, step_tolerance=1e-9, rest_weight=0.0)
    )
    start, goal = ARM.rest.copy(), ARM.rest.copy()
    goal[: len(ARM_JOINTS)] += [0.25, 0.2, -0.3]
    ik.place(ARM.configuration_vector(start))
    pose = ARM.frame_pose("wrist", goal)
    points = hand.points(hand.rest) @ pose[:3, :3].T + pose[:3, 3]
    result = ik.solve(points, pose, 1.0)
    assert result.status == "converged"
    np.testing.assert_allclose(ik.configuration.q[ARM.q_indices], goal, atol=1e-4)


def test_points_out_of_the_fingers_reach_are_had_by_the_arm() -> None:
    goal = ARM.rest.copy()
    goal[: len(ARM_JOINTS)] += [0.25, 0.2, -0.3]
    ik = PointIk(
        ARM, IkOptions(max_iterations=100, step_tolerance=1e-9, rest_weight=0.01)
    )
    ik.place(ARM.configuration_vector(ARM.rest))
    assert ik.solve(ARM.points(goal), None, 1.0).status == "converged"
    q = ik.configuration.q[ARM.q_indices]
    assert np.abs(q - ARM.rest)[: len(ARM_JOINTS)].max() > 0.1
    assert (q >= ARM.lower_limits).all()
    assert (q <= ARM.upper_limits).all()


def test_a_hand_on_an_arm_can_be_mapped_to() -> None:
    mapper = HandMapper(load_hand("human"), ARM, rigid_from="none")
    first = mapper.map_step(mapper.human.rest, np.eye(4))
    np.testing.assert_allclose(
        first.command.wrist, ARM.frame_pose("wrist", ARM.rest), atol=1e-3
    )
    step = mapper.map_step(mapper.human.rest + 0.05, np.eye(4))
    assert np.isfinite(step.command.q).all()


@pytest.mark.parametrize(
    ("mount", "link"),
    [("floating", "palm"), ("fixed", "finger1_distal"), ("fixed", "base")],
)
def test_a_wrist_must_be_where_the_arm_ends(mount: str, link: str) -> None:
    changed = msgspec.structs.replace(ARM.spec.wrist, link=link)
    with pytest.raises(HandError, match=r"wrist\.link|palm\.link"):
        Hand(
            msgspec.structs.replace(ARM.spec, wrist=changed),
            mount="floating" if mount == "floating" else "fixed",
            urdf_text=ARM.urdf_text,
        )


@given(generator=generators, share=st.floats(0.0, 1.0), dt=st.floats(1e-4, 0.1))
def test_a_slower_box_is_in_the_box_and_keeps_the_share_where_braking_allows(
    generator: np.random.Generator, share: float, dt: float
) -> None:
    hand = HAND
    q = any_posture(hand, generator, outside=0.2)
    velocity = generator.uniform(-3.0, 3.0, len(hand.active_columns))
    motion = Motion(q, velocity, 1.0, np.zeros_like(velocity))
    gate = Gate(hand, motion, IkOptions(max_acceleration=10.0))
    full, (lower, upper) = gate.bounds(dt), gate.bounds(dt, share)
    farthest = share * dt * box_limits(hand).speeds
    assert (full[0] <= lower).all()
    assert (lower <= upper).all()
    assert (upper <= full[1]).all()
    # Beyond the share only as far as the full box makes it go.
    np.testing.assert_array_equal(upper[upper > farthest], full[0][upper > farthest])
    np.testing.assert_array_equal(lower[lower < -farthest], full[1][lower < -farthest])


WEIGHTS = [
    option
    for option in options_of(IkOptions)
    if option.name.endswith(("weight", "damping"))
]


@pytest.mark.parametrize("option", WEIGHTS, ids=lambda option: option.name)
@pytest.mark.parametrize("formulation", ["compiled", "direct"])
def test_the_largest_weight_is_solved_and_a_larger_one_named(
    option: Option, formulation: str
) -> None:
    human, robot = loaded("human"), loaded("three_finger")
    assert option.range
    changes: dict[str, Any] = {option.name: option.range[1], "formulation": formulation}
    mapper = HandMapper(human, robot, ik=IkOptions(**changes))
    fist = human.rest + 0.5 * (human.upper_limits - human.rest)
    for _ in range(3):
        step = mapper.map_step(fist, np.eye(4))
        assert step.status != "failed"
    with pytest.raises(InvalidOptionsError, match=f"{option.name}: expected"):
        IkOptions().replaced(**{option.name: 1e200})


def test_weights_of_another_kind_are_named() -> None:
    human, robot = load_hand("human"), load_hand("three_finger")
    mapper = HandMapper(human, robot)
    for wrong in ({"damping": 1.0}, 3.0):
        with pytest.raises(InvalidInputError, match="ik: expected an IkOptions"):
            HandMapper(human, robot, ik=wrong)  # ty: ignore[invalid-argument-type]
        with pytest.raises(InvalidInputError, match="ik: expected an IkOptions"):
            mapper.configure(ik=wrong)  # ty: ignore[invalid-argument-type]
