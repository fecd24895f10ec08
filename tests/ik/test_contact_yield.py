"""How far commanded links may overlap, so that the real ones press by a force."""

from __future__ import annotations

from copy import deepcopy

import numpy as np
from oracles.shape_distances import MeasuredPairs
from oracles.shape_distances import overlaps_of as overlaps_of_pairs
from scipy.optimize import nnls

from handmap_core.hands.contact_yield import common_yield
from handmap_qp import HandMapper, Teleoperation, load_hand, read_recording
from handmap_qp.hands import (
    ContactYield,
    Hand,
    Side,
    find_fingers,
    load_robot,
    pair_ends,
)
from handmap_qp.mapping import RobotMapper
from handmap_qp.mapping.presets import get_preset
from handmap_qp.se3 import Array

HUMAN = load_hand("human", points="landmarks")
PINCH = read_recording("demo", "right").landmarks[:180:2]
FORCE = 3.0  # N
STIFFNESS = 2.0  # N m/rad
# One sample moves links between the posture in which the overlap is computed and the next one [m].
MOVED = 1.5e-3


def overlaps_of(G: Array, torque: float = np.inf, depth: float = 1.0) -> Array:
    """Return the overlaps of pairs that all touch, with one spring for each coordinate."""
    count, size = G.shape
    ones = np.ones
    yielding = ContactYield(
        forces=FORCE * ones(count),
        depths=depth * ones(count),
        compliances=ones(size) / STIFFNESS,
        torques=torque * ones(size),
    )
    return overlaps_of_pairs(yielding, np.arange(count), G, G, -1e-3 * ones(count))


def forces_of(G: Array, overlaps: Array) -> Array:
    """Return the contact forces of links that are commanded to overlap [N]."""
    # A f = d + w, f >= 0, w >= 0, f w = 0: the optimum of |B^T f - x|^2 with B B^T = A, B x = d.
    B = G / np.sqrt(STIFFNESS)
    forces, _ = nnls(B.T, np.linalg.lstsq(B, overlaps, rcond=None)[0])
    return forces


def test_one_pair_presses_by_the_force() -> None:
    G = np.array([[0.08, 0.05, -0.06]])
    overlaps = overlaps_of(G)
    np.testing.assert_allclose(overlaps, FORCE * np.square(G).sum() / STIFFNESS)
    np.testing.assert_allclose(forces_of(G, overlaps), FORCE)


def test_torques_and_shapes_limit_the_overlap() -> None:
    G = np.array([[0.08, 0.05, -0.06]])
    give = np.square(G).sum() / STIFFNESS
    np.testing.assert_allclose(overlaps_of(G, torque=0.08), 1.0 * give)
    np.testing.assert_allclose(overlaps_of(G, depth=0.002), 0.002)


def test_a_finger_between_thumb_and_palm_is_pressed_by_no_more() -> None:
    # Two joints of a thumb, two of the finger: thumb on finger, and finger on palm.
    G = np.array([[0.06, 0.05, 0.07, 0.04], [0.0, 0.0, -0.07, -0.04]])
    overlaps = overlaps_of(G)
    assert overlaps[0] > 0.0
    assert overlaps[1] == 0.0
    np.testing.assert_allclose(forces_of(G, overlaps), FORCE, rtol=1e-9)


def test_several_pairs_press_by_no_more_where_each_has_its_share() -> None:
    random = np.random.default_rng(3)
    counted = 0
    for _ in range(300):
        count = int(random.integers(2, 5))
        G = random.normal(scale=0.05, size=(count, 12))
        overlaps = overlaps_of(G)
        # Never less than none: links are not kept farther apart than without it.
        assert overlaps.min() >= 0.0
        if overlaps.min() == 0.0:
            continue
        counted += 1
        assert forces_of(G, overlaps).max() <= FORCE * (1.0 + 1e-9)
    assert counted > 100


def mapper_of(squeeze: float, name: str = "leap_right") -> HandMapper:
    ik = get_preset("teleoperation").ik
    return HandMapper(HUMAN, load_hand(name), Teleoperation(squeeze=squeeze), ik=ik)


def nearest_after(mapper: HandMapper, limit: MeasuredPairs, landmarks: Array) -> float:
    """Return the least distance of all pairs after a sample [m]."""
    mapper.map_landmarks(landmarks, dt=0.033)
    return limit.nearest(mapper.motion.q)


def test_pairs_overlap_by_no_more_than_they_may_and_others_never_do() -> None:
    mapper = mapper_of(FORCE)
    limit = MeasuredPairs.of(mapper.point_ik)
    assert limit.yielding
    must_not = limit.yielding.forces == 0.0
    deepest = 0.0
    for landmarks in PINCH:
        before = mapper.motion.q
        near = limit.within(before)
        most = limit.overlaps(before, near)
        mapper.map_landmarks(landmarks, dt=0.033)
        distances = limit.within(mapper.motion.q).found[:, 0]
        assert distances[must_not].min() > 0.0
        # A pair that may overlap by less now, because joints have moved, comes no nearer.
        least = np.minimum(-most, near.found[:, 0]) - 1e-5
        assert (distances >= least).all()
        deepest = min(deepest, distances.min())
    assert deepest < -1e-3


def test_a_hand_without_squeeze_is_kept_apart_as_before() -> None:
    mapper = mapper_of(0.0)
    limit = MeasuredPairs.of(mapper.point_ik)
    assert limit.yielding is None
    for landmarks in PINCH:
        mapper.map_landmarks(landmarks, dt=0.033)
        assert limit.nearest(mapper.motion.q) > 0.0


def test_squeeze_can_be_changed_on_the_way_and_copied() -> None:
    mapper = mapper_of(FORCE)
    limit = MeasuredPairs.of(mapper.point_ik)
    nearest = [nearest_after(mapper, limit, landmarks) for landmarks in PINCH]
    deepest = int(np.argmin(nearest))
    mapper = mapper_of(FORCE)
    for landmarks in PINCH[: deepest + 1]:
        mapper.map_landmarks(landmarks, dt=0.033)
    pinching = PINCH[deepest]
    other = deepcopy(mapper)
    one = mapper.map_landmarks(pinching, dt=0.033).command.q
    two = other.map_landmarks(pinching, dt=0.033).command.q
    np.testing.assert_allclose(one, two, atol=1e-12)
    mapper.configure(Teleoperation(), ik=mapper.ik)
    # Links that overlap part again.
    for _ in range(60):
        later = nearest_after(mapper, limit, pinching)
    assert nearest[deepest] < -1e-3
    assert later > 0.0


def test_links_of_one_hand_of_a_robot_may_press_but_not_on_the_other_hand() -> None:
    humans: dict[Side, Hand] = {
        "left": load_hand("human_left", points="landmarks"),
        "right": HUMAN,
    }
    ik = get_preset("teleoperation").ik
    mapper = RobotMapper(load_robot("g1"), humans, Teleoperation(squeeze=FORCE), ik=ik)
    limit = MeasuredPairs.of(mapper.point_ik)
    assert limit.yielding
    may_press = limit.yielding.forces > 0.0
    pressing = [
        links for links, may in zip(limit.bounds.links, may_press, strict=False) if may
    ]
    sides = [{link.split("_")[0] for link in links} for links in pressing]
    assert {"left"} in sides
    assert {"right"} in sides
    assert {"left", "right"} not in sides


def test_a_robot_takes_of_its_hands_the_force_of_the_one_that_presses() -> None:
    """Pairs of one hand are those of the other hand too, which does not let them press."""
    inf = np.inf
    none = np.zeros(2)
    left = ContactYield(
        forces=np.array([FORCE, 0.0]),
        depths=np.array([0.004, 0.0]),
        compliances=np.array([0.5, 0.0]),
        torques=np.array([0.7, inf]),
    )
    right = ContactYield(
        forces=none,
        depths=none,
        compliances=np.array([0.0, 0.25]),
        torques=np.array([inf, 0.9]),
    )
    # The second hand has its pairs in another order.
    both = common_yield([(left, np.array([0, 1])), (right, np.array([1, 0]))])
    assert both
    np.testing.assert_array_equal(both.forces, [FORCE, 0.0])
    np.testing.assert_array_equal(both.depths, [0.004, 0.0])
    np.testing.assert_array_equal(both.compliances, [0.5, 0.25])
    np.testing.assert_array_equal(both.torques, [0.7, 0.9])
    turned = common_yield([(left, np.array([1, 0])), (None, np.array([0, 1]))])
    assert turned
    np.testing.assert_array_equal(turned.forces, [0.0, FORCE])
    assert common_yield([(None, np.array([0, 1]))] * 2) is None


def hand_yield(name: str) -> ContactYield:
    """Return how the pairs of a hand yield by the default stiffness."""
    found = mapper_of(FORCE, name).point_ik.gate.collisions
    assert found
    assert found.yielding
    return found.yielding


def test_only_thumb_fingers_and_palm_press() -> None:
    limit = mapper_of(FORCE, "allegro_right").point_ik.gate.collisions
    assert limit
    assert limit.yielding
    hand = load_hand("allegro_right")
    chains = find_fingers(hand)
    owner = {joint: name for name, chain in chains.items() for joint in chain.joints}
    shapes = limit.bounds.geometry.geometryObjects
    kinds = set()
    for (i, j), force in zip(
        pair_ends(limit.bounds.geometry), limit.yielding.forces, strict=True
    ):
        links = [owner.get(shapes[k].parentJoint, "palm") for k in (i, j)]
        may = "thumb" in links or "palm" in links
        assert (force > 0.0) == may, links
        kinds.add((may, "palm" in links))
    assert {(True, True), (True, False), (False, False)} <= kinds


def test_springs_are_those_of_turning_and_of_sliding_joints() -> None:
    options = Teleoperation()
    turning, sliding = hand_yield("allegro_right"), hand_yield("panda_gripper")
    assert {*turning.compliances.round(12)} == {0.0, round(1 / options.stiffness, 12)}
    assert {*sliding.compliances.round(12)} == {
        0.0,
        round(1 / options.sliding_stiffness, 12),
    }


def test_links_overlap_by_less_than_half_of_the_thinner_one() -> None:
    """Beyond its middle, the direction in which shapes part turns round."""
    limit = mapper_of(100.0, "allegro_right").point_ik.gate.collisions
    assert limit
    assert limit.yielding
    shapes = limit.bounds.geometry.geometryObjects
    for (i, j), depth, force in zip(
        pair_ends(limit.bounds.geometry),
        limit.yielding.depths,
        limit.yielding.forces,
        strict=True,
    ):
        halves = []
        for shape in (shapes[i], shapes[j]):
            shape.geometry.computeLocalAABB()
            box = shape.geometry.aabb_local
            halves.append(0.5 * (box.max_ - box.min_).min())
        assert 0.5 * min(halves) * (force > 0.0) <= depth < min(halves)
