"""Robots with two hands: one QP for all, and each hand as if alone where nothing is shared."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Mapping
from dataclasses import replace
from operator import attrgetter
from types import MappingProxyType
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from oracles.shape_distances import MeasuredPairs

from handmap_core.human.sample import HumanSample, Verdict, human_name
from handmap_core.ik.motion import Motion
from handmap_core.ik.tasks import AttachedPoints, PointDistances, PointOffset
from handmap_core.mapping.robot_step import RobotStep
from handmap_core.stream.smoothing import SMOOTH_IK
from handmap_qp import Hand, HandMapper, load_hand
from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.hands import Side
from handmap_qp.hands.robot import joined, load_robot, load_whole
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.presets import get_preset
from handmap_qp.mapping.robot_mapper import RobotMapper
from handmap_qp.stream.robot_follower import RobotFollower

SIDES: tuple[Side, ...] = ("left", "right")
HUMANS = {side: load_hand(human_name(side), points="landmarks") for side in SIDES}
DT = 1.0 / 60.0
FORMULATIONS = ("compiled", "direct")
PRESET = get_preset("teleoperation")

Samples = tuple[dict[Side, np.ndarray], dict[Side, np.ndarray]]


@pytest.fixture(scope="module")
def g1() -> Hand:
    return load_robot("g1")


@pytest.fixture(scope="module")
def pair() -> Hand:
    return load_robot("ur5_pair")


def motion(i: int, apart: float = 0.5, nearing: float = 0.0) -> Samples:
    """Both hands open and close; their wrists are apart [m], and nearer by so much at the end."""
    q, wrists = {}, {}
    for k, (side, human) in enumerate(HUMANS.items()):
        share = 0.5 - 0.5 * np.cos(0.05 * i + k)
        angles = human.rest + share * (0.6 * human.upper_limits - human.rest)
        q[side] = np.clip(angles, human.lower_limits, human.upper_limits)
        sign = 1.0 if side == "left" else -1.0
        y = 0.5 * apart - 0.5 * nearing * min(i / 100.0, 1.0)
        wrists[side] = np.eye(4)
        wrists[side][:3, 3] = 0.05 * share, sign * y, 0.03 * share
    return q, wrists


def palms(step: RobotStep, robot: Hand) -> np.ndarray:
    """The robot's palms, shape (2, 4, 4)."""
    q = step.command.q
    return np.array([hand.frame_pose("palm", q) for hand in robot.by_side.values()])


def persons(mapper: RobotMapper) -> list[Any]:
    """Palms of the person in the robot's world, shape (4, 4) each."""
    requests: list[Any] = [hand.request for hand in mapper.hands.values()]
    return [request.map.person_at(request.pose) for request in requests]


def knuckle_distance(mapper: RobotMapper, step: RobotStep) -> float:
    """Distance of the points of both palms that correspond to the person's knuckles [m]."""
    ends = []
    for side, hand in mapper.hands.items():
        palm = step.hands[side].command.wrist @ hand.robot.wrist_to_palm
        target_map: Any = hand.request.map
        anchor = target_map.robot_anchor
        ends.append(palm[:3, :3] @ anchor + palm[:3, 3])
    return float(np.linalg.norm(ends[1] - ends[0]))


def together_and_alone(
    pair: Hand, formulation: str, takes_detours: bool = True
) -> tuple[RobotMapper, dict[Side, HandMapper]]:
    """Return what maps both hands to one robot, and what maps each to its arm alone."""
    # With more iterations, both hands would take those that one of them needs.
    ik = PRESET.ik.replaced(
        formulation=formulation, max_iterations=1, takes_detours=takes_detours
    )
    mapper = RobotMapper(pair, HUMANS, "teleoperation", ik=ik, turns_in=np.inf)
    alone = {
        side: HandMapper(HUMANS[side], pair.by_side[side], "teleoperation", ik=ik)
        for side in SIDES
    }
    return mapper, alone


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_hands_on_arms_of_their_own_move_as_if_alone(
    pair: Hand, formulation: str
) -> None:
    # Hands of one robot share what they may foresee, so their detours begin later.
    mapper, alone = together_and_alone(pair, formulation, takes_detours=False)
    names = mapper.robot.joint_names
    apart = []
    for i in range(0, 60, 2):
        q, wrists = motion(i, apart=1.0)
        step = mapper.map_step(q, wrists, dt=DT)
        for side, other in alone.items():
            single = other.map_step(q[side], wrists[side], dt=DT)
            own = [k for k, name in enumerate(names) if name.startswith(side)]
            apart.append(np.abs(step.command.q[own] - single.command.q[own]).max())
    assert max(apart) < 1e-6
    assert len(names) == 44


def on_detours(mapper: HandMapper | RobotMapper) -> list[bool]:
    """Return whether each hand is on a detour."""
    return [via is not None for via, *_ in mapper.point_ik.__reduce__()[1][-1]]


def test_each_hand_takes_detours_as_it_does_alone(pair: Hand) -> None:
    # The second posture of these takes each hand on a detour, one before the other.
    mapper, alone = together_and_alone(pair, "compiled")
    _, wrists = motion(0, apart=1.0)
    randoms = {"left": np.random.default_rng(24), "right": np.random.default_rng(4)}
    taken, taken_alone = np.zeros(2, dtype=int), np.zeros(2, dtype=int)
    q: dict[Side, np.ndarray] = {}
    for i in range(200):
        if i % 25 == 0:
            q = {
                side: randoms[side].uniform(human.lower_limits, human.upper_limits)
                for side, human in HUMANS.items()
            }
        mapper.map_step(q, wrists, dt=DT)
        for k, (side, other) in enumerate(alone.items()):
            other.map_step(q[side], wrists[side], dt=DT)
            taken_alone[k] += on_detours(other)[0]
        is_on = on_detours(mapper)
        if any(is_on) and not taken.any():
            # The other hand goes on by itself, and a copy goes on with the detour.
            assert not all(is_on)
            assert on_detours(copy.deepcopy(mapper)) == is_on
        taken += is_on
    assert taken_alone.all()
    assert taken.all()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_hand_does_not_stop_for_what_the_other_one_meets(
    pair: Hand, formulation: str
) -> None:
    # The left hand of the first ones is stopped, and the right one of the others.
    for seed in (25, 49):
        mapper, alone = together_and_alone(pair, formulation)
        _, wrists = motion(0, apart=1.0)
        rng = np.random.default_rng(seed)
        for _ in range(6):
            q = {
                side: rng.uniform(human.lower_limits, human.upper_limits)
                for side, human in HUMANS.items()
            }
            step = mapper.map_step(q, wrists, dt=DT)
            for side, other in alone.items():
                single = other.map_step(q[side], wrists[side], dt=DT)
                own = [name.startswith(side) for name in mapper.robot.joint_names]
                np.testing.assert_allclose(
                    step.command.q[own], single.command.q[own], rtol=0.0, atol=1e-6
                )


def test_a_robot_with_one_hand_is_a_hand_on_an_arm(g1: Hand) -> None:
    hand = g1.by_side["left"]
    robot = joined("one", hand)
    mapper = RobotMapper(robot, HUMANS, "teleoperation", turns_in=np.inf)
    single = HandMapper(HUMANS["left"], hand, "teleoperation")
    # A hand of its own is put where it is at rest, too.
    for i in range(40):
        q, wrists = motion(i)
        step = mapper.map_step({"left": q["left"]}, {"left": wrists["left"]}, dt=DT)
        other = single.map_step(q["left"], wrists["left"], dt=DT)
        np.testing.assert_allclose(step.command.q, other.command.q, atol=1e-9)
        assert step.status == other.status


def test_all_ways_to_solve_agree(g1: Hand) -> None:
    kinds = ("direct", "mink", *FORMULATIONS[:-1])
    mappers = [
        RobotMapper(
            g1, HUMANS, "teleoperation", ik=PRESET.ik.replaced(formulation=kind)
        )
        for kind in kinds
    ]
    for i in range(0, 120, 3):
        # At .4, rounding decides which links a step goes round.
        q, wrists = motion(i, nearing=0.42)
        steps = [mapper.map_step(q, wrists, dt=DT) for mapper in mappers]
        for step in steps[1:]:
            np.testing.assert_allclose(step.command.q, steps[0].command.q, atol=1e-7)
            assert step.status == steps[0].status
            for side in SIDES:
                ours, other = step.hands[side], steps[0].hands[side]
                np.testing.assert_allclose(ours.targets, other.targets, atol=1e-7)


def test_one_call_for_all_hands_is_a_call_for_each(g1: Hand) -> None:
    at_once, in_turn = (RobotMapper(g1, HUMANS, "teleoperation") for _ in range(2))
    base = pin.exp6(np.array([0.02, -0.03, 0.0, 0.0, 0.0, 0.2])).homogeneous
    for i in range(40):
        q, wrists = motion(i, apart=0.3)
        if i == 20:
            at_once.base_pose = in_turn.base_pose = base
        given = MappingProxyType(q) if i == 10 else q
        step = at_once.map_step(given, wrists, dt=DT)
        other = in_turn.step(
            SIDES,
            lambda side, q=q, wrists=wrists: in_turn.hands[side].read(
                in_turn.sources[side].joints, q[side], wrists[side], DT
            ),
        )
        np.testing.assert_array_equal(step.command.q, other.command.q)
        for side, hand in at_once.hands.items():
            part = step.hands[side]
            np.testing.assert_array_equal(part.ik.points, other.hands[side].ik.points)
            np.testing.assert_array_equal(hand.request.pose.wrist, wrists[side])
            assert hand.state.since == in_turn.hands[side].state.since
    given = attrgetter("joints"), q, wrists, DT
    assert isinstance(at_once._mapped_in_core(*given), RobotStep)
    # Python says what is wrong with the others.
    others: list[Any] = [{"left": q["left"]}, q | {"left": q["left"][1:]}]
    for wrong in others:
        assert at_once._mapped_in_core(given[0], wrong, *given[2:]) is None


def test_smoothing_counts_from_where_the_robot_is(g1: Hand) -> None:
    ik = PRESET.ik.replaced(**SMOOTH_IK)
    kinds = ("direct", *FORMULATIONS[:-1])
    mappers = [
        RobotMapper(g1, HUMANS, "teleoperation", ik=ik.replaced(formulation=kind))
        for kind in kinds
    ]
    for i in range(60):
        steps = [mapper.map_step(*motion(i), dt=DT) for mapper in mappers]
        q = steps[0].command.q
        for step in steps[1:]:
            np.testing.assert_allclose(step.command.q, q, atol=1e-6)
        if i % 20 == 10:
            # Something else has stopped the robot.
            still = Motion.at_rest(mappers[0].motion.q, len(g1.active_columns))
            for mapper in mappers:
                mapper.motion = still


def test_near_palms_are_seen_from_each_other_as_the_persons(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    step = mapper.map_step(*motion(0, apart=0.7), dt=DT)
    far = knuckle_distance(mapper, step)
    start = palms(step, g1)
    for i in range(200):
        step = mapper.map_step(*motion(i, apart=0.7, nearing=0.55), dt=DT)
    here = persons(mapper)
    wanted = np.linalg.norm((here[0] - here[1])[:3, 3])
    assert wanted < 0.2
    # By displacements alone, they would have come nearer by 0.55 m.
    assert abs(far - 0.55 - wanted) > 0.05
    assert abs(knuckle_distance(mapper, step) - wanted) < 2e-3
    turned = zip(here, palms(step, g1), start, strict=True)
    for person, own, before in turned:
        off = [pin.log3(person[:3, :3].T @ palm[:3, :3]) for palm in (own, before)]
        # The wrists come near their limits.
        assert np.linalg.norm(off[0]) < 0.15
        assert np.linalg.norm(off[1]) > 1.0


@pytest.mark.parametrize("turns_in", [0.5, np.inf])
def test_palms_turn_to_the_persons_soon_after_a_reference(
    pair: Hand, turns_in: float
) -> None:
    mapper = RobotMapper(pair, HUMANS, "teleoperation", turns_in=turns_in)
    first = palms(mapper.map_step(*motion(0, apart=1.0), dt=DT), pair)
    for _ in range(120):
        step = mapper.map_step(*motion(0, apart=1.0), dt=DT)
    for hand, person, own, before in zip(
        mapper.hands.values(), persons(mapper), palms(step, pair), first, strict=True
    ):
        wanted = person if turns_in < 1.0 else before
        np.testing.assert_allclose(own[:3, :3], wanted[:3, :3], atol=1e-2)
        # They turn about the point that follows the person's.
        target_map: Any = hand.request.map
        anchor = target_map.robot_anchor
        ends = [palm[:3, :3] @ anchor + palm[:3, 3] for palm in (own, before)]
        np.testing.assert_allclose(*ends, atol=2e-3)
        assert np.abs(person[:3, :3] - before[:3, :3]).max() > 0.5
        if turns_in < 1.0:
            assert hand.state.since > 1.0
    mapper.clutch()
    again = palms(mapper.map_step(*motion(0, apart=1.0), dt=DT), pair)
    np.testing.assert_allclose(again, palms(step, pair), atol=1e-2)
    assert all(hand.state.since == DT for hand in mapper.hands.values())


def test_crossing_hands_do_not_overlap(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    limit = MeasuredPairs.of(mapper.point_ik)
    nearest = np.inf
    placed = mapper.robot.configuration()
    for i in range(0, 220, 2):
        # The right hand ends to the left of the left one.
        step = mapper.map_step(*motion(i, apart=0.4, nearing=0.6), dt=DT)
        placed.place(mapper.robot.configuration_vector(step.command.q))
        nearest = min(nearest, limit.nearest(placed.q))
    assert nearest > -1e-6
    assert nearest < 0.01


def test_a_shared_waist_moves_both_palms(g1: Hand) -> None:
    whole = joined("g1", *g1.by_side.values())
    q = whole.rest.copy()
    q[whole.joint_names.index("waist_yaw_joint")] = 0.3
    for hand in g1.by_side.values():
        moved = hand.frame_pose("palm", q) - hand.frame_pose("palm", hand.rest)
        assert np.abs(moved[:3, 3]).max() > 0.05
    moving = whole.moves_wrist
    assert moving.sum() == 3 + 7 + 7
    np.testing.assert_array_equal(
        moving, np.logical_or(*(hand.moves_wrist for hand in g1.by_side.values()))
    )


def test_offsets_are_derivatives(g1: Hand) -> None:
    whole = joined("g1", *g1.by_side.values())
    places = [
        (hand.wrist_frame.parentJoint, np.array([0.1, 0.0, 0.1]))
        for hand in whole.hands
    ]
    task = PointOffset(AttachedPoints(whole, places), np.array([0.1, 0.2, 0.3]), 5.0)
    placed = whole.configuration()
    rng = np.random.default_rng(0)
    q = whole.configuration_vector(rng.uniform(whole.lower_limits, whole.upper_limits))
    placed.place(q)
    residual, jacobian, _ = task.linearise(placed)
    assert residual.shape == (3,)
    for column in range(placed.nv):
        ends = []
        for sign in (1.0, -1.0):
            step = np.zeros(placed.nv)
            step[column] = sign * 1e-6
            placed.displace(q, step)
            ends.append(task.linearise(placed).residual)
        slope = (ends[0] - ends[1]) / 2e-6
        np.testing.assert_allclose(slope, jacobian[:, column], atol=1e-4)


def test_the_core_keeps_offsets_as_python_does(pair: Hand) -> None:
    places = [(hand.wrist_frame.parentJoint, np.zeros(3)) for hand in pair.hands]
    ends = []
    for formulation in FORMULATIONS:
        ik = PRESET.ik.replaced(formulation=formulation)
        solver = PointIk(pair, ik)
        at = solver.configuration
        first, other = (wrist.translation for wrist in at.wrists)
        aim = other - first + 0.05
        task = PointOffset(AttachedPoints(pair, places), aim, 20.0)
        wrists = np.array([wrist.homogeneous for wrist in at.wrists])
        result = solver.solve(at.points, wrists, DT, tasks=[task])
        apart = result.wrists[1] - result.wrists[0]
        before = np.linalg.norm(aim - (other - first))
        assert np.linalg.norm(aim - apart[:3, 3]) < 0.95 * before
        ends.append(result.q)
    np.testing.assert_allclose(ends[0], ends[-1], atol=1e-9)


def samples_of(i: int, lost: Side | None = None) -> dict[Side, HumanSample]:
    q, wrists = motion(i)
    found: dict[Side, HumanSample] = {}
    for side, human in HUMANS.items():
        landmarks = human.points(q[side], wrists[side])
        found[side] = HumanSample(i * DT, side, landmarks, None, side != lost, 1.0)
    return found


@pytest.mark.parametrize("is_silent", [False, True])
def test_a_hand_that_is_lost_holds_its_side_only(pair: Hand, is_silent: bool) -> None:
    follower = RobotFollower(RobotMapper(pair, HUMANS, "teleoperation"), smoothing=None)
    for i in range(60):
        step = follower.map_samples(samples_of(i))
    steps = []
    for i in range(60, 150):
        samples = samples_of(i, "right")
        if is_silent:
            del samples["right"]
        steps.append(follower.map_samples(samples))
    step = steps[-1]
    assert step.hands["right"].status == "held"
    assert step.hands["right"].rule == "missing"
    assert step.hands["left"].status != "held"
    assert step.status != "held"
    later = np.array([palms(each, pair) for each in steps[30:]])
    moved = np.ptp(later[:, :, :3, 3], axis=0).max(axis=1)
    assert moved[0] > 0.01
    assert moved[1] < 1e-4
    names = step.command.joint_names
    q = np.array([each.command.q for each in steps[30:]])
    right = [name.startswith("right") for name in names]
    assert np.ptp(q[:, right], axis=0).max() < 1e-3
    back = follower.map_samples(samples_of(150))
    assert back.hands["right"].status in (
        "gliding",
        "limited",
        "unsettled",
        "converged",
    )


def test_time_since_a_reference_begins_there(g1: Hand) -> None:
    follower = RobotFollower(RobotMapper(g1, HUMANS, "teleoperation"))
    for i in range(150):
        follower.map_samples(samples_of(i, "right"))
    hands = follower.mapper.hands
    assert hands["left"].state.since > 2.0
    assert hands["right"].state.since == 0.0
    base = np.eye(4)
    base[0, 3] = 0.5
    follower.mapper.base_pose = base
    follower.map_samples(samples_of(150))
    assert 0.0 < hands["right"].state.since < 0.1
    np.testing.assert_array_equal(hands["right"].state.base, base)


def test_a_step_takes_the_time_of_the_samples_that_it_has(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    for i in range(3):
        q, wrists = motion(i)
        mapper.map_step(q, wrists, dt=0.1)
    mapper.map_step({"left": q["left"]}, {"left": wrists["left"]}, dt=DT)
    assert mapper.motion.dt == DT


def test_an_error_leaves_both_hands_as_they_were(g1: Hand) -> None:
    follower = RobotFollower(RobotMapper(g1, HUMANS, "teleoperation"))
    for i in range(20):
        follower.map_samples(samples_of(i))
    twin = copy.deepcopy(follower)
    good = samples_of(20)
    bad: dict[Side, HumanSample] = {"left": good["left"], "right": good["left"]}
    with pytest.raises(InvalidInputError):
        follower.map_samples(bad)
    for i in range(20, 40):
        ours = follower.map_samples(samples_of(i))
        other = twin.map_samples(samples_of(i))
        np.testing.assert_array_equal(ours.command.q, other.command.q)


def test_a_release_stops_all_joints(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    for i in range(30):
        mapper.map_step(*motion(i), dt=DT)
    mapper.release()
    for i in range(30, 80):
        step = mapper.map_step(*motion(i), dt=DT)
        assert step.status == "released"
    before = step.command.q
    step = mapper.map_step(*motion(90), dt=DT)
    np.testing.assert_array_equal(step.command.q, before)
    mapper.clutch()
    step = mapper.map_step(*motion(91), dt=DT)
    # Counted from here: the palms stay where they are.
    assert max(each.wrist_error[0] for each in step.hands.values()) < 5e-3
    mapper.reset()
    step = mapper.map_step(*motion(0), dt=DT)
    assert np.abs(step.command.q - mapper.robot.rest).max() < 0.3


def test_copies_continue_alike(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    for i in range(10):
        mapper.map_step(*motion(i), dt=DT)
    twins = [copy.copy(mapper), pickle.loads(pickle.dumps(mapper))]
    for i in range(10, 20):
        q = mapper.map_step(*motion(i), dt=DT).command.q
        for twin in twins:
            np.testing.assert_array_equal(twin.map_step(*motion(i), dt=DT).command.q, q)


def test_options_change_between_samples(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    for i in range(30):
        before = mapper.map_step(*motion(i), dt=DT)
    mapper.configure(PRESET.method.replaced(pinch_weight=0.0))
    after = mapper.map_step(*motion(30), dt=DT)
    limits = mapper.robot.velocity_limits * DT + 1e-9
    assert (np.abs(after.command.q - before.command.q) <= limits).all()
    (task,) = mapper.hands["left"].request.targets.tasks
    assert isinstance(task, PointDistances)
    assert task.weights[-1] == 0.0
    with pytest.raises(InvalidOptionsError):
        mapper.configure("no-such-preset")
    mapper.map_step(*motion(31), dt=DT)


@pytest.mark.parametrize("preset", ["paper", "object", "finger-vectors"])
def test_every_method_moves_both_hands(g1: Hand, preset: str) -> None:
    mapper = RobotMapper(g1, HUMANS, preset)
    first = mapper.map_step(*motion(0), dt=DT).command.q
    for i in range(40):
        step = mapper.map_step(*motion(i), dt=DT)
    moved = np.abs(step.command.q - first)
    for hand in g1.by_side.values():
        fingers = hand.moves_points.any(axis=0) & ~mapper.robot.moves_wrist
        assert moved[fingers].max() > 0.05


def test_one_error_for_what_cannot_be_used(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    q, wrists = motion(0)
    cases: list[tuple[Mapping, Mapping]] = [
        ({}, {}),
        ({"left": q["left"]}, {}),
        ({"middle": q["left"]}, {"middle": wrists["left"]}),
        (q | {"right": np.full(20, np.nan)}, wrists),
    ]
    for angles, poses in cases:
        with pytest.raises(InvalidInputError):
            mapper.map_step(angles, poses, dt=DT)
    with pytest.raises(InvalidInputError):
        RobotMapper(g1, {"left": HUMANS["left"]})
    with pytest.raises(InvalidInputError):
        mapper.reset(mapper.robot.upper_limits + 1.0)
    np.testing.assert_array_equal(
        mapper.motion.q[mapper.robot.q_indices], mapper.robot.rest
    )


def test_the_points_of_a_hand_go_with_its_own_wrist(g1: Hand) -> None:
    whole = joined("g1", *g1.by_side.values())
    ik = PointIk(whole, PRESET.ik)
    ik.place(whole.configuration_vector(whole.rest))
    placed = ik.configuration
    points = placed.points.copy()
    wrists = np.array([wrist.homogeneous for wrist in placed.wrists])
    # The right wrist is asked to be far away: its points stay on the hand.
    moved = wrists.copy()
    moved[1] = (
        pin.SE3(wrists[1]) * pin.exp6(np.array([0, 0, 2.0, 0, 0, 0]))
    ).homogeneous
    points[3:] += (moved[1] - wrists[1])[:3, 3]
    result = ik.solve(points, moved, DT)
    assert np.linalg.norm(result.errors, axis=1).max() < 0.01
    assert result.status != "converged"
    assert result.wrists.shape == (2, 4, 4)


@pytest.mark.parametrize("turns_in", [0.0, -1.0, np.nan])
def test_palms_need_a_time_to_turn_in(g1: Hand, turns_in: float) -> None:
    with pytest.raises(InvalidInputError, match="turns_in"):
        RobotMapper(g1, HUMANS, turns_in=turns_in)


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_palms_stay_in_the_world_while_the_base_walks(
    g1: Hand, formulation: str
) -> None:
    ik = PRESET.ik.replaced(formulation=formulation)
    mapper = RobotMapper(g1, HUMANS, "teleoperation", ik=ik)
    still = RobotMapper(g1, HUMANS, "teleoperation", ik=ik)
    # One that began elsewhere in the world is no different.
    begun = pin.SE3(pin.exp3(np.array([0.0, 0.0, 2.0])), np.array([5.0, -3.0, 1.0]))
    base = np.eye(4)
    for i in range(150):
        turn = pin.exp3(np.array([0.0, 0.0, 0.003 * min(i, 60)]))
        way = np.array([4e-4, 2e-4, -2e-4]) * min(i, 60)
        base = pin.SE3(turn, way).homogeneous
        mapper.base_pose = begun.homogeneous @ base
        step = mapper.map_step(*motion(0), dt=DT)
        other = still.map_step(*motion(0), dt=DT)
    for side in SIDES:
        ours = base @ step.hands[side].command.wrist
        np.testing.assert_allclose(
            ours, other.hands[side].command.wrist, atol=5e-3, err_msg=side
        )
        np.testing.assert_allclose(
            base @ step.hands[side].wrist_target,
            other.hands[side].wrist_target,
            atol=1e-9,
        )
    assert np.abs(step.command.wrist - other.command.wrist).max() > 0.02
    mapper.clutch()
    again = mapper.map_step(*motion(0), dt=DT)
    # Counted from here.
    assert max(each.wrist_error[0] for each in again.hands.values()) < 5e-3


def test_only_a_floating_base_is_elsewhere(g1: Hand, pair: Hand) -> None:
    mapper = RobotMapper(pair, HUMANS, "teleoperation")
    with pytest.raises(InvalidOptionsError, match="base: floating"):
        mapper.base_pose = np.eye(4)
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    with pytest.raises(InvalidInputError, match="base_pose"):
        mapper.base_pose = 2.0 * np.eye(4)
    np.testing.assert_array_equal(mapper.base_pose, np.eye(4))


def test_hands_that_stay_go_with_the_base(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    begun = pin.SE3(pin.exp3(np.array([0.0, 0.0, 2.0])), np.array([5.0, -3.0, 1.0]))
    mapper.base_pose = begun
    q, wrists = motion(0)
    before = palms(mapper.map_step(*motion(0), dt=DT), g1)
    mapper.clutch()
    for _ in range(60):
        step = mapper.map_step({"left": q["left"]}, {"left": wrists["left"]}, dt=DT)
    assert np.abs(palms(step, g1)[1] - before[1]).max() < 2e-3
    # Both are led from here; one stays where the base is elsewhere.
    for _ in range(60):
        mapper.map_step(q, wrists, dt=DT)
    moved = begun.homogeneous
    moved[0, 3] += 0.05
    mapper.base_pose = moved
    mapper.stay("right", Verdict("missing", True, False, 0.0, np.nan))
    still = palms(mapper.map_step({"left": q["left"]}, wrists, dt=DT), g1)[1]
    for _ in range(60):
        step = mapper.map_step({"left": q["left"]}, wrists, dt=DT)
    np.testing.assert_allclose(palms(step, g1)[1], still, atol=5e-3)


def test_a_base_is_not_the_array_that_said_where_it_is(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    base = np.eye(4)
    mapper.base_pose = base
    mapper.map_step(*motion(0), dt=DT)
    base[0, 3] = 0.1
    step = mapper.map_step(*motion(0), dt=DT)
    assert mapper.base_pose[0, 3] == 0.0
    assert step.hands["left"].wrist_error[0] < 0.02


def test_a_chain_of_references_stays_in_the_world_too(g1: Hand) -> None:
    mapper = RobotMapper(g1, HUMANS, reference="previous")
    base = np.eye(4)
    first = palms(mapper.map_step(*motion(0), dt=DT), g1)
    for i in range(60):
        base[0, 3] = 3e-4 * i
        mapper.base_pose = base
        step = mapper.map_step(*motion(0), dt=DT)
    shift = (palms(step, g1) - first)[:, :3, 3]
    # A chain gives up what it does not reach within a sample.
    assert (-base[0, 3] <= shift[:, 0]).all()
    assert (shift[:, 0] <= -0.3 * base[0, 3]).all()
    assert np.abs(shift[:, 1:]).max() < 1e-3


@pytest.mark.parametrize("preset", ["paper", "object", "finger-vectors"])
def test_another_method_lets_hands_stay_until_their_next_sample(
    g1: Hand, preset: str
) -> None:
    mapper = RobotMapper(g1, HUMANS, "teleoperation")
    q, wrists = motion(0)
    for _ in range(5):
        before = mapper.map_step(q, wrists, dt=DT)
    mapper.configure(preset)
    for _ in range(5):
        step = mapper.map_step({"left": q["left"]}, wrists, dt=DT)
    change = palms(step, g1)[1] - palms(before, g1)[1]
    assert np.abs(change).max() < 0.02


def test_a_hand_that_waits_says_what_it_said_after_a_change_of_options(
    g1: Hand,
) -> None:
    follower = RobotFollower(RobotMapper(g1, HUMANS, "teleoperation"))
    for i in range(20):
        samples = samples_of(i)
        left = replace(samples["left"], confidence=0.5)
        follower.map_samples(samples | {"left": left})
    mapper = follower.mapper
    mapper.configure("teleoperation")
    mapper.motion = mapper.motion
    step = follower.map_samples({"right": samples_of(20)["right"]})
    assert step.hands["left"].confidence == 0.5
    mapper.clutch()
    step = follower.map_samples({"right": samples_of(21)["right"]})
    assert step.hands["left"].confidence == 1.0


def test_a_robot_with_two_hands_is_not_one_hand(g1: Hand) -> None:
    with pytest.raises(InvalidInputError, match="RobotMapper"):
        HandMapper(HUMANS["left"], g1)
    with pytest.raises(InvalidInputError, match="name them in `ik`"):
        RobotMapper(g1, HUMANS, tasks=[])
    assert g1.has_floating_base
    assert RobotMapper(g1, HUMANS).robot.has_floating_base
    with pytest.raises(InvalidInputError, match="robot_points"):
        load_whole("g1", points="tips")
