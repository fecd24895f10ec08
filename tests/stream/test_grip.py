"""What thumb and finger grip: touch by encoders, a posture and a force, and the way out."""

from __future__ import annotations

import copy
import dataclasses
import itertools
from functools import cache
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from grip_cases import HUMAN, Blocked, gap_of, grip_follower, run, samples
from picks import made_pick

from handmap_core.human.recording import sample_columns
from handmap_core.ik.tasks import AttachedPoints, JointPositions, PointDistances
from handmap_core.mapping.step import MapStep
from handmap_core.stream.closing_pads import ClosingPads, PadsState
from handmap_core.stream.hand_grip import Gathering, GripOptions, _Grip
from handmap_core.stream.object_place import ObjectPlace
from handmap_qp import Hand, HandMapper, load_hand, read_recording
from handmap_qp.apps.offline.comparison import prepare_take
from handmap_qp.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.human import tip_gaps
from handmap_qp.mapping.hand_pair import robot_fingers
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.se3 import frozen, transform_points, unit
from handmap_qp.stream.follower import Follower
from handmap_qp.stream.grasp import can_grip, has_grasp
from handmap_qp.stream.grip import GripFollower


@pytest.fixture(scope="module")
def allegro() -> Hand:
    return load_hand("allegro_right")


def test_without_an_object_nothing_is_gripped(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    plain = Follower(HandMapper(HUMAN, allegro, "teleoperation"), smoothing=None)
    for (step, _), sample in zip(run(grip, width=-1.0), samples(), strict=True):
        assert step.command.effort is None
        other = plain.map_sample(sample)
        np.testing.assert_array_equal(step.command.q, other.command.q)


def held(grip: GripFollower) -> _Grip:
    found = grip.hand_grip._grip
    assert found is not None
    return found


@pytest.mark.parametrize("stiffness", [3.0, 6.0])
@pytest.mark.parametrize("force", [1.5, 3.0])
def test_what_is_met_is_pressed_along_the_line_of_the_pads(
    allegro: Hand, stiffness: float, force: float
) -> None:
    grip = grip_follower(allegro, stiffness=stiffness, force=force)
    steps = list(run(grip))
    q = np.array([step.command.q for step, _ in steps])
    assert (np.abs(np.diff(q, axis=0)) * 60.0 <= allegro.velocity_limits + 1e-9).all()
    found = held(grip)
    posture, levers = found.posture, found.levers
    # What the joints do is done to the pads: tau dq = -F d(gap).
    for joint, lever in enumerate(levers):
        ahead, behind = posture.copy(), posture.copy()
        ahead[joint] += 1e-6
        behind[joint] -= 1e-6
        slope = (gap_of(allegro, ahead) - gap_of(allegro, behind)) / 2e-6
        assert lever == pytest.approx(-slope, abs=1e-5)
    # Once all of the force is there, position control presses with it.
    last = steps[-1][0].command
    assert last.effort is not None
    np.testing.assert_allclose(last.effort, force * levers, rtol=1e-9)
    moved = np.abs(levers) > 1e-3
    pressed = stiffness * (last.q - posture)
    np.testing.assert_allclose(pressed[moved], last.effort[moved], atol=0.003 * force)


def test_the_force_rises_from_that_of_the_command(allegro: Hand) -> None:
    grip = grip_follower(allegro, stiffness=2.0, force=40.0)
    commands = [(step.command, measured) for step, measured in run(grip)]
    levers = held(grip).levers
    efforts = [command.effort for command, _ in commands]
    forces = [e @ levers / (levers @ levers) for e in efforts if e is not None]
    touch, measured = commands[-len(forces)]
    own = 2.0 * levers @ (touch.q - measured) / (levers @ levers)
    assert 1.0 < own < 30.0
    assert forces[0] == pytest.approx(own)
    # In a tenth of a second, evenly.
    np.testing.assert_allclose(np.diff(forces[:6]), (40.0 - own) / 6.0, rtol=1e-6)
    np.testing.assert_allclose(forces[6:], 40.0)


def test_a_hand_that_is_not_pinching_grips_nothing(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    plant = Blocked(allegro, width=0.13)
    slow = sample_columns(made_pick("right", closing=1.5))
    for i in range(len(slow.time)):
        step = grip.map_sample(slow.sample(i), plant.q)
        plant.follow(step.command.q)
        if step.command.effort is not None:
            assert step.named("gaps").min() < 0.045
    assert grip.hand_grip.terms
    assert grip.follower.mapper.tasks == ()


@pytest.mark.parametrize("picking", [0.5, 1.0])
def test_what_counts_more_does_not_decide_when_a_person_grips(
    allegro: Hand, picking: float
) -> None:
    """Pinch rows of an open hand have weight then; that is no pinch of the person."""
    spans = []
    for choices in (Teleoperation(), Teleoperation(picking=picking)):
        mapper = HandMapper(HUMAN, allegro, choices, ik=Teleoperation.weights)
        grip = GripFollower(Follower(mapper, smoothing=None))
        steps = [step for step, _ in run(grip, opens=True)]
        held = [step.command.effort is not None for step in steps]
        spans.append(np.flatnonzero(np.diff(held)))
        # Met while the person closes, and let go with the person's opening.
        assert len(spans[-1]) == 2
    begins, ends = np.transpose(spans)
    assert np.ptp(begins) <= 6
    assert np.ptp(ends) <= 6
    assert steps[0].named("pinching").max() > 0.0


@pytest.mark.parametrize("every", [2, 4])
def test_encoders_that_are_read_seldom_are_no_touch(allegro: Hand, every: int) -> None:
    grip = grip_follower(allegro)
    plant = Blocked(allegro, width=-1.0)
    for i, sample in enumerate(samples(opens=True)):
        step = grip.map_sample(sample, plant.q)
        assert step.command.effort is None
        if i % every == 0:
            plant.follow(step.command.q)


def test_a_grip_begins_after_the_fingers_have_been_apart(allegro: Hand) -> None:
    def closed(is_apart: bool) -> bool:
        grip = grip_follower(allegro)
        plant = Blocked(allegro)
        steps = []
        for i, sample in enumerate(samples()):
            # At first, it sees a hand that has closed, or all of the closing.
            if is_apart or i > 75:
                steps.append(grip.map_sample(sample, plant.q))
                plant.follow(steps[-1].command.q)
        return steps[-1].command.effort is not None

    assert closed(True)
    assert not closed(False)


def test_a_hand_that_trembles_keeps_what_it_grips(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    at = _Grip(0, np.array([0]), allegro.rest, allegro.rest, 1.0, 0.02)
    random = np.random.default_rng(7)
    # A gap that rises by 1 mm a second, and trembles by 3 mm.
    for i in range(1800):
        gap = 0.02 + 0.001 * i / 60.0 + random.uniform(0.0, 0.003)
        at = grip.hand_grip._held(at, np.array([gap]), 1.0 / 60.0)
        assert at.opening == 0.0


def test_only_pads_that_stay_behind_are_a_grip(allegro: Hand) -> None:
    never = grip_follower(allegro, behind=1.0, force=100.0)
    assert all(step.command.effort is None for step, _ in run(never))
    # What is as narrow as they are behind is not found.
    narrow = grip_follower(allegro, behind=0.02)
    assert all(step.command.effort is None for step, _ in run(narrow, width=0.01))


@pytest.mark.parametrize("force", [0.8, 1.5])
def test_what_is_touched_is_pressed_no_harder_than_with_the_force(
    allegro: Hand, force: float
) -> None:
    grip = grip_follower(allegro, force=force, gentle=True)
    ran = list(run(grip, centre=meeting(allegro)))
    last, stopped = ran[-1]
    placed = allegro.configuration()
    placed.place(allegro.configuration_vector(stopped))
    pads = grip.hand_grip._pairs[0]
    slopes, _ = pads.slopes(placed, pads.state(placed).line)
    levers = slopes[allegro.joint_columns]
    # The gap that position control closes farther for one newton.
    compliance = levers @ levers / grip.grip.stiffness
    gap = gap_of(allegro, stopped)
    pressed = [
        (gap - gap_of(allegro, step.command.q)) / compliance
        for step, measured in ran
        if np.array_equal(measured, stopped)
    ]
    assert len(pressed) > 10
    assert max(pressed) < 1.4 * force
    # It is gripped with this force, although it gives way by little.
    effort = last.command.effort
    assert effort is not None
    assert np.abs(effort).max() == pytest.approx(force * np.abs(levers).max(), rel=0.1)


def test_a_small_force_closes_gently(allegro: Hand) -> None:
    speeds = []
    centre = meeting(allegro)
    for gentle in (False, True):
        grip = grip_follower(allegro, force=0.8, gentle=gentle)
        q, gaps = allegro.rest.copy(), []
        for sample in samples():
            gaps.append(gap_of(allegro, q))
            # Joints that lag behind their commands by 70 ms.
            command = grip.map_sample(sample, q, centre, 0.0).command
            q = q + (command.q - q) * (1.0 / 60.0 / 0.07)
        near = np.array(gaps) < 0.03
        speeds.append(-np.diff(gaps)[near[1:]].min() * 60.0)
    assert speeds[1] < 0.5 * speeds[0]


@pytest.mark.parametrize("opens_by", [0.008, 1.0])
def test_it_opens_when_the_person_opens(allegro: Hand, opens_by: float) -> None:
    grip = grip_follower(allegro, opens_by=opens_by)
    steps = [step for step, _ in run(grip, opens=True)]
    efforts = [
        0.0 if step.command.effort is None else np.abs(step.command.effort).max()
        for step in steps
    ]
    assert max(efforts) > 0.1
    if opens_by == 1.0:
        assert efforts[-1] > 0.1
        return
    assert efforts[-1] == 0.0
    assert grip.follower.mapper.tasks == ()
    # Without chatter, and fading: once on, once off.
    is_on = np.array(efforts) > 0.0
    assert np.abs(np.diff(is_on.astype(int))).sum() == 2
    last = np.flatnonzero(is_on)[-1]
    assert efforts[last] < 0.5 * max(efforts)


def test_it_opens_from_the_smallest_gap_of_the_grip(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    at = _Grip(0, np.array([0]), allegro.rest, allegro.rest, 1.0, 0.03)
    for gap in (0.02, 0.01, 0.017):
        at = grip.hand_grip._held(at, np.array([gap]), 0.02)
        assert at.opening == 0.0
    assert grip.hand_grip._held(at, np.array([0.02]), 0.02).opening == pytest.approx(
        0.2
    )


def test_a_grip_that_opens_fades_without_a_jump(allegro: Hand) -> None:
    """What holds the joints is a small part of what it was when the robot lets go."""
    grip = grip_follower(allegro)
    weights = [
        float(np.max(term.weight))
        for _ in run(grip, opens=True)
        for term in grip.hand_grip.terms
        if isinstance(term, JointPositions)
    ]
    assert weights[-1] < 0.05 * max(weights)
    falling = weights[weights.index(max(weights)) :]
    assert falling == sorted(falling, reverse=True)


@pytest.mark.parametrize(("speed", "lets_go"), [(0.015, False), (0.03, True)])
def test_fingers_that_drift_apart_slower_than_20_mm_a_second_let_nothing_go(
    allegro: Hand, speed: float, lets_go: bool
) -> None:
    grip = grip_follower(allegro)
    at = _Grip(0, np.array([0]), allegro.rest, allegro.rest, 1.0, 0.01)
    for k in range(300):
        at = grip.hand_grip._held(at, np.array([0.01 + speed * 0.01 * k]), 0.01)
    assert (at.opening > 0.0) is lets_go


def test_terms_of_the_user_stay(allegro: Hand) -> None:
    points = AttachedPoints.reference_points(allegro)
    term = PointDistances(points, [(0, 1)], [0.05], [1e-6])
    grip = grip_follower(allegro)
    grip.follower.mapper.configure(tasks=[term])
    seen = [
        (grip.follower.mapper.tasks, grip.hand_grip.terms)
        for _ in run(grip, opens=True)
    ]
    # Between samples, the mapper has the user's alone.
    assert {tasks for tasks, _ in seen} == {(term,)}
    assert {len(own) for _, own in seen} == {0, 1}


@pytest.mark.parametrize("way", ["clutch", "reset"])
def test_a_new_reference_lets_go(allegro: Hand, way: str) -> None:
    grip = grip_follower(allegro)
    *_, (step, measured) = run(grip)
    assert step.command.effort is not None
    assert grip.hand_grip.terms
    assert grip.follower.mapper.tasks == ()
    plain = copy.deepcopy(grip).follower
    plain.mapper.configure(tasks=())
    for mapper in (grip.follower.mapper, plain.mapper):
        getattr(mapper, way)()
    *_, sample = samples()
    later = dataclasses.replace(sample, time=sample.time + 1.0 / 60.0)
    step = grip.map_sample(later, measured)
    assert step.command.effort is None
    assert grip.hand_grip._grip is None
    np.testing.assert_array_equal(step.command.q, plain.map_sample(later).command.q)


def test_a_release_keeps_a_grip(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    plant = Blocked(allegro)
    kept = None
    for i, sample in enumerate(samples(opens=True)):
        step = grip.map_sample(sample, plant.q)
        if i == 105:
            grip.follower.mapper.release()
            kept = step.command.effort
            assert kept is not None
        elif kept is not None:
            np.testing.assert_array_equal(step.command.effort, kept)


def test_copies_continue_alike(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    plant = Blocked(allegro)
    copies: list[GripFollower] = []
    for i, sample in enumerate(samples()):
        if i == 75:
            copies += copy.deepcopy(grip), copy.copy(grip)
            assert all(each.follower is not grip.follower for each in copies)
        step = grip.map_sample(sample, plant.q)
        for each in copies:
            same = each.map_sample(sample, plant.q)
            np.testing.assert_allclose(same.command.q, step.command.q, atol=1e-12)
        plant.follow(step.command.q)
    assert grip.hand_grip.terms
    assert grip.follower.mapper.tasks == ()


def test_one_error_for_what_cannot_be_used(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    first, second, *_ = samples()
    grip.map_sample(first, allegro.rest)
    before = grip.follower.mapper.point_ik.gate.stamp
    for wrong in (allegro.rest[1:], np.full(len(allegro.rest), np.nan), "open"):
        with pytest.raises(InvalidInputError, match="measured_q"):
            grip.map_sample(second, wrong)
    assert grip.follower.mapper.point_ik.gate.stamp == before
    with pytest.raises(InvalidInputError, match="`teleoperation` moves"):
        GripFollower(Follower(HandMapper(HUMAN, allegro, "paper")))
    with pytest.raises(InvalidOptionsError, match="stiffness"):
        GripOptions(stiffness=0.0)
    with pytest.raises(InvalidInputError, match="grip: expected a GripOptions"):
        GripFollower(grip.follower, {"force": 5.0})  # ty: ignore[invalid-argument-type]


def pads_middle(hand: Hand, q: np.ndarray, wrist: np.ndarray) -> np.ndarray:
    """Middle between the surfaces of the pads of thumb and index [m], from their links."""
    placed = hand.configuration()
    placed.place(hand.configuration_vector(q, wrist))
    thumb, index = (robot_fingers(hand).pads[name] for name in ("thumb", "index"))
    ends = [
        transform_points(placed.data.oMi[pad.joint].homogeneous, pad.offset)
        for pad in (thumb, index)
    ]
    way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
    return (ends[0] + thumb.radius * way + ends[1] - index.radius * way) / 2.0


@cache
def meeting(allegro: Hand) -> np.ndarray:
    """Return where the pads meet with nothing between them [m], shape (3,)."""
    closed = [step for step, _ in run(grip_follower(allegro), width=-1.0)][75].command
    return frozen(pads_middle(allegro, closed.q, closed.wrist))


def closings(allegro: Hand, away: np.ndarray) -> tuple[list[MapStep], np.ndarray]:
    """Close without anything between the pads, around a place beside where they would meet."""
    centre = meeting(allegro) + away
    grip = grip_follower(allegro)
    q = allegro.rest
    steps = []
    for sample in samples():
        steps.append(grip.map_sample(sample, q, centre, 0.0))
        q = steps[-1].command.q
    return steps, centre


def test_pads_close_around_a_known_place(allegro: Hand) -> None:
    away = np.array([0.005, 0.006, -0.005])
    steps, centre = closings(allegro, away)
    plain = [step for step, _ in run(grip_follower(allegro), width=-1.0)]
    command = steps[75].command
    off = np.linalg.norm(pads_middle(allegro, command.q, command.wrist) - centre)
    assert off < 0.2 * np.linalg.norm(away)
    # The wrist and the other fingers stay with the person.
    np.testing.assert_allclose(command.wrist, plain[75].command.wrist, atol=1e-3)
    others = [j for j, n in enumerate(allegro.joint_names) if "ring" in n]
    np.testing.assert_allclose(
        command.q[others], plain[75].command.q[others], atol=1e-2
    )
    q = np.array([step.command.q for step in steps])
    assert (np.abs(np.diff(q, axis=0)) * 60.0 <= allegro.velocity_limits + 1e-9).all()


def test_pads_gather_around_a_place_before_the_person_pinches(allegro: Hand) -> None:
    """A closing of 0.2 s leaves no time to bring both pads around an object."""
    away = np.array([0.01, 0.01, -0.01])
    centre = meeting(allegro) + away
    near, plain = grip_follower(allegro), grip_follower(allegro)
    missed = []
    for sample in samples():
        steps = [
            near.map_sample(sample, allegro.rest, centre, 0.0),
            plain.map_sample(sample, allegro.rest),
        ]
        if steps[0].named("gaps").min() < 0.045:
            break
        missed.append(
            [
                np.linalg.norm(
                    pads_middle(allegro, step.command.q, step.command.wrist) - centre
                )
                for step in steps
            ]
        )
    gathered, open_hand = missed[-1]
    assert gathered < 0.7 * open_hand
    # The funnel's time counts from the pinch on, which is this sample.
    assert near.hand_grip._closing.time == pytest.approx(1.0 / 60.0)


def gathered_in_a_pick(name: str) -> tuple[Hand, np.ndarray, np.ndarray]:
    """Return the commands before the pinch of a recorded pick, with a place and without.

    The object is 14 mm beside where the pads of thumb and index finger meet.
    """
    hand = load_hand(name)
    recording = read_recording("pinch", "right")
    columns = sample_columns(recording)
    human = prepare_take(recording).human
    pads = grip_follower(hand).hand_grip._pairs[0]
    placed = hand.configuration()
    centre = None
    found = []
    for _ in range(2):
        grip = GripFollower(Follower(HandMapper(human, hand, "teleoperation")))
        q = hand.rest
        steps = []
        for k in range(len(recording)):
            steps.append(grip.map_sample(columns.sample(k), q, centre, 0.003))
            q = steps[-1].command.q
        # The pick is in the first second; then the hand opens again.
        opened = [step.named("pinching").max() <= 0.0 for step in steps[3:33]]
        found.append(np.array([step.command.q for step in steps[3:33]])[opened])
        gaps = [step.named("gaps")[0] for step in steps[3:]]
        placed.place(steps[3 + int(np.argmin(gaps))].ik.q)
        centre = pads.state(placed).middle + np.array([0.008, 0.008, -0.008])
    plain, gathered = found
    return hand, gathered, plain


@pytest.mark.parametrize("name", ["allegro_right", "leap_right"])
def test_pads_gather_without_a_tremble_around_a_place_that_is_out_of_reach(
    name: str,
) -> None:
    """Fingers alone do not reach a place before the wrist is there."""
    _, gathered, plain = gathered_in_a_pick(name)
    assert len(gathered) > 20
    bends = [np.abs(np.diff(q[-20:], 2, axis=0)).mean() for q in (gathered, plain)]
    assert bends[0] < 2.0 * bends[1]


def test_thumb_and_index_finger_gather_whichever_finger_is_nearest() -> None:
    """In an open hand it may be any: in this recording, the ring finger's tip is."""
    hand, gathered, plain = gathered_in_a_pick("allegro_right")
    used = robot_fingers(hand).used
    away = np.abs(gathered - plain).max(axis=0)
    moved = {name: away[finger.columns].max() for name, finger in used.items()}
    assert moved["index"] > 0.04
    # The others make room at most.
    assert moved["ring"] < 0.3 * moved["index"]


def test_a_wide_open_hand_stays_the_persons(allegro: Hand) -> None:
    grip = grip_follower(allegro).hand_grip
    assert grip._gathering(0.05) == Gathering(0.0, 0.0)
    grip.see(np.zeros(3), 0.0)
    gaps = (0.2, 0.13, 0.115, 0.1, 0.085, 0.07, 0.02)
    along, across = zip(*map(grip._gathering, gaps), strict=True)
    np.testing.assert_allclose(along, [0.0, 0.0, 0.5, 1.0, 1.0, 1.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(across, [0.0, 0.0, 0.0, 0.0, 0.5, 1.0, 1.0], atol=1e-12)


def gathered_in_an_open_hand(hand: Hand, ahead: float) -> tuple[float, float]:
    """Return how far pads of an open hand move to a place [m]: along their line, and across it.

    The place is beside the pads' middle along their line, and ahead of it across the line. The
    person's thumb and index finger stay 100 mm apart.

    Args:
        hand: The robot hand.
        ahead: How far ahead [m].
    """
    apart = [tip_gaps(sample.landmarks[None])[0, 0] for sample in samples()]
    held_open = [*samples()][int(np.argmin(np.abs(np.array(apart) - 0.1)))]
    placed = hand.configuration()
    states: list[PadsState] = []
    centre = None
    for _ in range(2):
        grip = grip_follower(hand)
        pads = grip.hand_grip._pairs[0]
        q = hand.rest
        for k in range(60):
            sample = dataclasses.replace(held_open, time=k / 60.0)
            step = grip.map_sample(sample, q, centre, 0.0)
            q = step.command.q
        placed.place(step.ik.q)
        states.append(pads.state(placed))
        _, middle, line = states[0]
        across = unit(np.cross(line, [0.3, -0.5, 0.7]))
        centre = middle + 0.01 * line + ahead * across
    moved = states[1].middle - states[0].middle
    return float(moved @ line), float(moved @ across)


def test_pads_of_an_open_hand_gather_along_their_line_alone(allegro: Hand) -> None:
    """Where they meet is elsewhere: brought there at once, they would stretch the fingers."""
    along, across = gathered_in_an_open_hand(allegro, ahead=0.03)
    assert along > 0.007
    assert abs(across) < 0.01


def test_a_place_moves_pads_the_less_the_less_certain_it_is(allegro: Hand) -> None:
    away = np.array([0.005, 0.006, -0.005])
    centre = meeting(allegro) + away
    missed = []
    for deviation in (0.0, 0.005, 0.01, 0.03, 10.0):
        grip = grip_follower(allegro)
        ran = run(grip, width=-1.0, centre=centre, deviation=deviation)
        command = next(itertools.islice(ran, 75, None))[0].command
        middle = pads_middle(allegro, command.q, command.wrist)
        missed.append(np.linalg.norm(middle - centre) / np.linalg.norm(away))
    assert missed == sorted(missed)
    assert missed[0] < 0.2
    assert 0.2 < missed[1] < 0.8
    # The person's own closing where nothing is known.
    assert missed[-1] == pytest.approx(1.0, abs=0.02)


def test_a_touch_corrects_the_place_along_the_line_of_the_pads(allegro: Hand) -> None:
    away = np.array([0.004, 0.004, -0.004])
    centre = meeting(allegro) + away
    grip = grip_follower(allegro)
    ran = list(run(grip, centre=centre, deviation=0.005))
    assert ran[-1][0].command.effort is not None
    place = grip.hand_grip.place
    assert place is not None
    touch, measured = next(each for each in ran if each[0].command.effort is not None)
    placed = allegro.configuration()
    placed.place(allegro.configuration_vector(measured, touch.command.wrist))
    pads = grip.hand_grip._pairs[0]
    _, middle, line = pads.state(placed)
    before = (middle - centre) @ line
    after = (middle - place.centre) @ line
    assert abs(after) < 0.3 * abs(before) + 1e-3
    assert place.deviation_along(line) < 0.0025
    across = np.cross(line, [0.0, 0.0, 1.0])
    across /= np.linalg.norm(across)
    assert place.deviation_along(across) == pytest.approx(0.005, rel=0.1)


def test_a_finger_that_another_part_stops_is_no_grip_of_a_known_object(
    allegro: Hand,
) -> None:
    """Its pads are behind the command and still, as in a grip, but far from around the place."""
    centre = meeting(allegro)
    index = robot_fingers(allegro).used["index"].columns

    def grips(place: np.ndarray | None) -> bool:
        grip = grip_follower(allegro)
        q = allegro.rest
        steps = []
        for sample in samples():
            steps.append(grip.map_sample(sample, q, place, 0.0))
            # Stopped open, the index finger leaves the thumb 40 mm or more away.
            stopped = q[index]
            q = steps[-1].command.q.copy()
            q[index] = stopped
        return any(step.command.effort is not None for step in steps)

    assert grips(None)
    assert not grips(centre)


def test_a_corrected_place_outlives_the_grip_and_an_object_that_is_hidden(
    allegro: Hand,
) -> None:
    centre = meeting(allegro) + np.array([0.004, 0.004, -0.004])
    grip = grip_follower(allegro)
    *_, (step, q) = run(grip, opens=True, centre=centre, deviation=0.005)
    assert step.command.effort is None
    place = grip.hand_grip.place
    assert place is not None
    assert np.linalg.norm(place.correction) > 1e-3
    *_, last = samples(opens=True)
    for i in range(1, 4):
        later = dataclasses.replace(last, time=last.time + i / 60.0)
        grip.map_sample(later, q)
    grip.map_sample(dataclasses.replace(last, time=last.time + 0.1), q, centre)
    again = grip.hand_grip.place
    assert again is not None
    np.testing.assert_array_equal(again.correction, place.correction)


def test_pads_beside_a_place_wait_until_they_are_around_it(allegro: Hand) -> None:
    """What one pad meets first is pushed away; a person who goes on closing is obeyed."""
    centre = meeting(allegro)
    grip = grip_follower(allegro, behind=1.0)
    apart, gaps, pinching = [], [], []
    for sample in samples():
        # Joints that do not follow: the measured pads stay beside the place.
        command = grip.map_sample(sample, allegro.rest, centre, 0.0).command
        middle = pads_middle(allegro, allegro.rest, command.wrist)
        apart.append(np.linalg.norm(middle - centre))
        gaps.append(gap_of(allegro, command.q))
        pinching.append(grip.hand_grip._closing.time)
    least = np.minimum(4.0 * np.array(apart), 0.06)
    share = 1.0 - np.array(pinching) / 0.4
    waits = (share > 0.2) & (share < 0.8)
    assert waits.sum() > 5
    assert (np.array(gaps)[waits] > (share * least)[waits] - 0.006).all()
    assert gaps[-1] < 0.005


def test_pads_gather_the_more_the_nearer_the_persons_fingers_are(
    allegro: Hand,
) -> None:
    """From 130 mm on, and fully from 100 mm on: weights do not jump."""
    grip = grip_follower(allegro).hand_grip
    centre = meeting(allegro)
    grip.see(centre, 0.0)
    assert grip.place is not None
    shares = []
    for gap in (0.13, 0.1225, 0.115, 0.1, 0.05):
        share = grip._gathering(gap)
        commanded = PadsState(0.0, centre, np.array([1.0, 0.0, 0.0]))
        (term,) = grip._around(grip._pairs[0], grip.place, commanded, 0.0, share)
        assert isinstance(term, ClosingPads)
        shares.append(term.share)
    np.testing.assert_allclose(shares, [0.0, 0.25, 0.5, 1.0, 1.0], atol=1e-12)


def test_patience_begins_anew_with_each_pinch(allegro: Hand) -> None:
    """A person who opens the fingers and closes them again has not gone on closing."""
    grip = grip_follower(allegro, behind=1.0)
    centre = meeting(allegro)
    times = []
    for sample in samples(opens=True):
        grip.map_sample(sample, allegro.rest, centre, 0.0)
        times.append(grip.hand_grip._closing.time)
    assert max(times) > 0.4
    assert times[-1] == 0.0


def test_a_place_far_away_changes_nothing(allegro: Hand) -> None:
    steps, _ = closings(allegro, np.array([0.15, 0.0, 0.0]))
    for step, (plain, _) in zip(
        steps, run(grip_follower(allegro), width=-1.0), strict=True
    ):
        np.testing.assert_array_equal(step.command.q, plain.command.q)


def test_the_term_of_a_place_has_the_slopes_of_its_error(allegro: Hand) -> None:
    grip = grip_follower(allegro)
    step = [step for step, _ in run(grip, width=-1.0)][75]
    centre = pads_middle(allegro, step.command.q, step.command.wrist) + 0.01
    grip.hand_grip._placed.place(step.ik.q)
    place = ObjectPlace.first(centre, 0.0)
    own_grip = grip.hand_grip
    commanded = PadsState(0.0, centre - 0.01, np.array([1.0, 0.0, 0.0]))
    gathering = Gathering(1.0, 1.0)
    pads = own_grip._pairs[0]
    (term,) = own_grip._around(pads, place, commanded, 0.0, gathering)
    placed = allegro.configuration()
    own = [allegro.joint_columns[grip.hand_grip._pairs[0].columns].tolist()]
    base = step.ik.q

    def error(way: np.ndarray) -> np.ndarray:
        placed.place(pin.integrate(allegro.model, base, way))
        return term.linearise(placed).residual[:3]

    placed.place(base)
    jacobian = term.linearise(placed).jacobian[:3]
    for column in range(allegro.model.nv):
        way = np.zeros(allegro.model.nv)
        way[column] = 1e-6
        slope = (error(way) - error(-way)) / 2e-6
        wanted = slope if column in own[0] else np.zeros(3)
        # The middle turns with the line of the pads where their radii differ.
        np.testing.assert_allclose(jacobian[:, column], wanted, atol=2e-1)


@pytest.mark.parametrize("deviation", [-0.001, np.nan, np.inf])
def test_a_deviation_that_is_none_is_refused(allegro: Hand, deviation: float) -> None:
    grip = grip_follower(allegro)
    with pytest.raises(InvalidInputError, match="object_deviation"):
        grip.map_sample(next(samples()), allegro.rest, np.zeros(3), deviation)


@pytest.mark.parametrize("centre", [(1.0, 2.0), (0.0, 0.0, np.nan), "here"])
def test_a_place_that_is_none_is_refused(allegro: Hand, centre: Any) -> None:
    grip = grip_follower(allegro)
    with pytest.raises(InvalidInputError, match="object_centre"):
        grip.map_sample(next(samples()), allegro.rest, centre)


@pytest.mark.parametrize(
    "given",
    [
        {"object_deviation": "5 mm"},
        {"object_deviation": None},
        {"object_deviation": 1e200},
        {"object_centre": [1e200, 0.0, 0.0]},
        {"measured_q": np.full(16, 1e200)},
    ],
)
def test_numbers_that_cannot_be_are_an_error_before_the_robot_moves(
    allegro: Hand, given: dict[str, Any]
) -> None:
    grip = grip_follower(allegro)
    first, second, *_ = samples()
    centre = np.zeros(3)
    grip.map_sample(first, allegro.rest, centre)
    before = grip.follower.mapper.point_ik.gate.stamp
    arguments: dict[str, Any] = {"measured_q": allegro.rest, "object_centre": centre}
    arguments |= given
    (name,) = given
    with pytest.raises(InvalidInputError, match=name):
        grip.map_sample(second, **arguments)
    assert grip.follower.mapper.point_ik.gate.stamp == before


def test_asking_whether_a_hand_can_grip_reads_no_meshes() -> None:
    hand = load_hand("three_finger")
    # A hand of its own, which nobody has measured before.
    robot = hand.with_points([point.name for point in hand.reference_points[:2]])
    source = HandMapper(HUMAN, robot, "paper").source
    assert has_grasp(robot)
    assert not can_grip(source)
    assert "pads" not in vars(robot_fingers(robot))
