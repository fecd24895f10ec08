"""What the core measures of people and hands is what numpy, coal and Pinocchio measure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import numpy as np
import pytest
from oracles import people
from oracles.nearest_posture import distance, nearest_posture

from handmap_core.human.sample import landmarks_at_rest
from handmap_qp import HumanLengths, load_hand, read_recording
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands import core_tree
from handmap_qp.hands.fingers import PalmKinematics
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.pads import find_pads
from handmap_qp.hands.shape_pairs import pair_distances
from handmap_qp.human.measure import _standard_palm, measure_shape
from handmap_qp.ik import nearest_posture as posture_module
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping import hand_pair
from handmap_qp.mapping.hand_pair import HandPair, robot_fingers
from handmap_qp.se3 import Array, inverse_pose, transform_points

HANDS = ("allegro_right", "three_finger", "hey5", "g1_right", "ur5_allegro")


def _points_in_palm(
    hand: Hand, q: Array, places: Sequence[tuple[int, Array]] | None = None
) -> Array:
    if places is None:
        frames = hand.point_frames
        places = [(f.parentJoint, f.placement.translation) for f in frames]
    return PalmKinematics(hand).points(q, places)


def _pinches(fingers: hand_pair.RobotFingers) -> Array:
    """Pinch with each finger in turn, by QPs over Pinocchio until the pads touch."""
    hand = fingers.hand
    ik = PointIk(hand, hand_pair._PINCHING.replaced(formulation="direct"))
    task = hand_pair.gap_task(hand, [*fingers.pads.values()])
    postures = []
    for finger, row in enumerate(np.diag(task.weights)):
        aimed = task.aimed_at(task.distances, row)
        ik.place(hand.configuration_vector(hand.rest))
        targets = ik.configuration.points
        wrist = ik.configuration.wrist.homogeneous
        for _ in range(hand_pair._PINCH_STEPS):
            ik.solve(targets, wrist, hand_pair._UNHURRIED, tasks=[aimed])
            thumb, *tips = task.points.positions(ik.configuration)
            apart = np.linalg.norm(tips[finger] - thumb)
            if abs(apart - task.distances[finger]) < hand_pair._TOUCHING:
                break
        postures.append(ik.gate.motion.q[hand.q_indices])
    return np.array(postures)


@pytest.fixture
def in_python(monkeypatch: pytest.MonkeyPatch) -> Callable[[], None]:
    """Take the core away from what is called afterwards."""

    def take() -> None:
        monkeypatch.setattr(hand_pair, "nearest_posture", nearest_posture)
        monkeypatch.setattr(hand_pair, "points_in_palm", _points_in_palm)
        monkeypatch.setattr(hand_pair.RobotFingers, "pinches", property(_pinches))
        options = hand_pair._OPENING.replaced(formulation="direct")
        monkeypatch.setattr(hand_pair, "_OPENING", options)
        hand_pair.robot_fingers.cache_clear()
        hand_pair.hand_pair.cache_clear()

    return take


def persons(count: int) -> list[HumanLengths]:
    rng = np.random.default_rng(3)
    usual = HumanLengths.from_hand_length(0.19)
    return [
        HumanLengths(
            usual.bases * rng.uniform(0.85, 1.15, (5, 1)),
            usual.segments * rng.uniform(0.8, 1.2, (5, 3)),
            rng.uniform(-0.3, 0.3, 5),
        )
        for _ in range(count)
    ]


@pytest.mark.parametrize("name", HANDS)
def test_the_robot_is_matched_to_people_as_in_python(
    name: str, in_python: Callable[[], None]
) -> None:
    robot = load_hand(name)
    side = "human" if robot.side == "right" else "human_left"
    humans = [load_hand(side, points="landmarks", lengths=each) for each in persons(3)]
    fast = [HandPair(human, robot) for human in humans]
    in_python()
    for human, one in zip(humans, fast, strict=True):
        other = HandPair(human, robot)
        for key in ("human_rest", "human_reach", "robot_rest", "robot_distances"):
            np.testing.assert_allclose(
                getattr(one, key), getattr(other, key), atol=1e-8
            )
        np.testing.assert_allclose(one.matched, other.matched, atol=1e-8)


@pytest.mark.parametrize("name", HANDS)
def test_a_posture_is_the_nearest_one_to_hostile_targets_too(
    name: str,
) -> None:
    hand = load_hand(name)
    rng = np.random.default_rng(1)
    cases = []
    for _ in range(20):
        scale = 10.0 ** rng.uniform(-3, 0)
        targets = hand.points(hand.rest)
        targets = targets + rng.normal(scale=scale, size=targets.shape)
        costs = rng.uniform(0.0, 100.0, len(targets))
        start = rng.uniform(hand.lower_limits, hand.upper_limits)
        arguments = hand, targets, costs, 0.05, start
        cases.append((arguments, posture_module.nearest_posture(*arguments)))
    apart = []
    for arguments, q in cases:
        assert (q >= hand.lower_limits).all()
        assert (q <= hand.upper_limits).all()
        other = nearest_posture(*arguments)
        terms_at = distance(*arguments[:4])
        values = [terms_at(x).value for x in (q, other)]
        # Of several minima nearby, rounding may choose.
        apart.append(abs(values[0] - values[1]) / values[1])
    assert np.median(apart) < 1e-12
    assert (np.array(apart) < 1e-9).mean() >= 0.9


def test_people_are_measured_as_by_procrustes_analysis() -> None:
    """Recorded, noisy, flat and mirrored hands, and an odd and an even count of samples."""
    rng = np.random.default_rng(2)
    palm = _standard_palm()
    seen = read_recording("demo", "right").landmarks
    seen = np.concatenate([seen, seen + rng.normal(0.0, 0.004, seen.shape)])
    flat = 0.1 * rng.normal(size=(60, 21, 3))
    flat[:20, :, 2] = 0.0
    flat[20:40, [0, 5, 9, 13, 17]] = palm * (1.0, 1.0, -1.0)
    for part in (*np.split(seen, [1, 3, 34]), flat):
        found = measure_shape(part, palm)
        for one, other in zip(found, people.measure_shape(part, palm), strict=True):
            np.testing.assert_allclose(one, other, atol=1e-9)
    _, rolls, _ = measure_shape(np.zeros((5, 21, 3)), palm)
    np.testing.assert_array_equal(rolls, 0.0)


@pytest.mark.parametrize("name", HANDS)
def test_gaps_are_measured_as_by_coal(name: str) -> None:
    robot = load_hand(name)
    rng = np.random.default_rng(5)
    q = rng.uniform(
        robot.lower_limits, robot.upper_limits, (40, len(robot.joint_names))
    )
    meter = GapMeter(robot)
    near, pinches = meter.nearest(q, most=-0.001), meter.pinches(q)
    assert GapMeter(robot).nearest(q[:1]) == meter.nearest(q[:1])
    # coal's search ends at 1e-6, and overlaps of curved shapes are less exact.
    for finger, geometry in meter._pinching.items():
        gap = pair_distances(robot, geometry, q).min(axis=1)
        np.testing.assert_allclose(pinches[finger], gap, atol=2e-5)
    contacts = robot_fingers(robot).contacts
    expected = pair_distances(robot, contacts.geometry, q).min(axis=1, initial=-0.001)
    np.testing.assert_allclose(near, expected, atol=2e-5)


@pytest.mark.parametrize("name", ["human", "human_left"])
def test_pads_of_a_scaled_hand_are_those_of_its_urdf(name: str) -> None:
    for lengths in persons(2):
        scaled = load_hand(name, points="landmarks", lengths=lengths)
        plain = msgspec.structs.replace(scaled.spec, mirror=False)
        read = Hand(plain, points="landmarks", urdf_text=scaled.urdf_text)
        found = find_pads(scaled)
        for finger, pad in find_pads(read).items():
            np.testing.assert_allclose(pad.offset, found[finger].offset, atol=1e-12)
            assert pad.radius == pytest.approx(found[finger].radius, abs=1e-12)


@pytest.mark.parametrize("name", ["human", "human_left"])
def test_the_core_moves_the_joints_of_a_scaled_hand(name: str) -> None:
    rng = np.random.default_rng(8)
    for lengths in persons(5):
        human = load_hand(name, points="landmarks", lengths=lengths)
        q = rng.uniform(human.lower_limits, human.upper_limits)
        palm = human.frame_pose("palm", q)
        expected = transform_points(inverse_pose(palm), human.points(q))
        tree: Any = core_tree(human)
        np.testing.assert_allclose(tree.points(q), expected, atol=1e-12)
        links = [point.link for point in human.reference_points]
        offsets = np.array([point.xyz for point in human.reference_points])
        in_palm = tree.points_on_links(q, links, offsets)
        np.testing.assert_allclose(in_palm, expected, atol=1e-12)
        at_rest = human.points(human.rest)
        np.testing.assert_allclose(landmarks_at_rest(human), at_rest, atol=1e-12)
