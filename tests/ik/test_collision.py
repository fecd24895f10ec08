"""Self-collision avoidance.

Rows that are the distances' derivatives, never contradict the box, and keep links apart.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pinocchio as pin
import pytest
import trimesh
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from ik_cases import loosened, problem_of, random_cases
from oracles.shape_distances import MeasuredPairs
from scipy.optimize import linprog

from handmap_qp import HandError, IkOptions, MissingExtraError, load_hand
from handmap_qp.errors import InvalidOptionsError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.shape_pairs import ShapePairs
from handmap_qp.hands.sources import read_urdf, urdf_directory
from handmap_qp.hands.spec import CollisionSpec, Mount, read_hand_spec
from handmap_qp.ik.qp import PointIk
from handmap_qp.reference.daqp_solver import solve_by_daqp

DT = 1.0 / 60.0
AVOIDING = IkOptions(avoids_self_collision=True)
DISTAL_SHAPE = '<cylinder radius="0.0085" length="0.05"/>'
"""Collision shape of the three-fingered hand's distal links, in its URDF."""
# Hands with many joints and links that reach each other; other hands add time, not cases.
HANDS = ("allegro_left", "allegro_right", "human", "human_left", "three_finger")
each_name = pytest.mark.parametrize("name", HANDS)


def load(name: str, mount: Mount = "fixed") -> Hand:
    try:
        return load_hand(name, mount=mount)
    except MissingExtraError:
        pytest.skip("example-robot-data is not installed")


def avoiding_step(
    ik: PointIk, limit: MeasuredPairs, targets: np.ndarray, dt: float
) -> np.ndarray | None:
    """Return the step of the QP with the rows of all pairs, before the gate."""
    H, c, lower, upper = problem_of(ik, targets, None, dt)
    near = limit.within(ik.configuration.q)
    rows = loosened(limit.rows(ik.configuration, near), lower, upper)
    return solve_by_daqp(H, c, lower, upper, rows)


def is_boxy(name: str) -> bool:
    """Return whether the hand's shapes have flat faces, on which nearest points jump."""
    return name.startswith("allegro")


@each_name
def test_rows_are_the_derivative_of_the_distances(name: str) -> None:
    hand = load(name, "floating")
    limit, configuration, rng = (
        MeasuredPairs(hand),
        hand.configuration(),
        np.random.default_rng(0),
    )
    errors, small = [], 1e-5
    for _ in range(60):
        q = hand.configuration_vector(
            rng.uniform(hand.lower_limits, hand.upper_limits), np.eye(4)
        )
        dq = rng.normal(size=len(hand.active_columns))
        dq *= small / np.linalg.norm(dq)
        configuration.place(q)
        G, h = limit.rows(configuration, limit.within(q))
        free = limit.within(configuration.q).found[:, 0] - limit.margin
        np.testing.assert_allclose(h, 0.85 * free, atol=1e-8)
        distances = []
        for sign in (1.0, -1.0):
            configuration.displace(q, sign * dq)
            distances.append(limit.within(configuration.q).found[:, 0])
        errors.append(np.abs((distances[0] - distances[1]) / 2.0 + G @ dq) / small)
    # coal stops within 1e-9 m, here of 1e-5 m. At the edges of flat faces the distance has no
    # derivative.
    assert np.quantile(errors, 0.97 if is_boxy(name) else 1.0) < 1e-4


def test_moving_the_wrist_changes_no_distance() -> None:
    hand = load("three_finger", "floating")
    configuration = hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest, np.eye(4)))
    limit = MeasuredPairs(hand)
    G, _ = limit.rows(configuration, limit.within(configuration.q))
    np.testing.assert_array_equal(G[:, :6], 0.0)
    assert (np.abs(G).max(axis=1) > 1e-3).all()


@each_name
def test_a_hand_at_rest_keeps_its_margin(name: str) -> None:
    hand = load(name)
    limit, configuration = MeasuredPairs(hand), hand.configuration()
    configuration.place(hand.configuration_vector(hand.rest))
    assert limit.nearest(configuration.q) > limit.margin


@each_name
def test_links_are_kept_apart(name: str) -> None:
    # All fingertips have one common target, or the positions of a random posture.
    hand = load(name).with_points("fingertips")
    with_avoidance, without = (
        _nearest_on_the_way(hand, avoids=True),
        _nearest_on_the_way(hand, avoids=False),
    )
    assert without < -0.01
    # Remaining margin of 1 to 2 mm after linearisation: at full speed a link turns by a third of a
    # radian in a sample. The smallest measured is -0.1 mm, on an Allegro hand.
    assert with_avoidance > -5e-4


def _nearest_on_the_way(hand: Hand, *, avoids: bool) -> float:
    ik, elsewhere, rng = (
        PointIk(hand, IkOptions(avoids_self_collision=avoids)),
        hand.configuration(),
        np.random.default_rng(0),
    )
    ik.place(hand.configuration_vector(hand.rest))
    limit, nearest = MeasuredPairs(hand), np.inf
    for i in range(12):
        elsewhere.place(
            hand.configuration_vector(rng.uniform(hand.lower_limits, hand.upper_limits))
        )
        targets = elsewhere.points.copy()
        if i % 2:
            targets[:] = targets.mean(axis=0)
        for _ in range(15):
            assert ik.solve(targets, None, DT).status != "failed"
            nearest = min(nearest, limit.nearest(ik.configuration.q))
    return nearest


@each_name
def test_rows_never_contradict_the_box(name: str) -> None:
    # Also among overlapping links and outside the joints' limits.
    hand = load(name)
    limit, ik, overlaps = MeasuredPairs(hand), PointIk(hand, IkOptions()), 0
    for case in random_cases(hand, 40, seed=1):
        ik.place(case.q)
        overlaps += limit.nearest(ik.configuration.q) < 0.0
        assert avoiding_step(ik, limit, case.point_targets, case.dt) is not None
    assert overlaps > 5


@given(st.integers(0, 10_000))
@settings(max_examples=40, deadline=None)
def test_parting_leaves_room_and_does_not_jump(seed: int) -> None:
    """Where a distance hardly depends on the joints, all of the box parts by a few um."""
    rng = np.random.default_rng(seed)
    count, size = int(rng.integers(1, 5)), 6
    G = rng.normal(size=(count, size)) * 10.0 ** rng.uniform(-5.0, -1.0, (count, 1))
    excess = 10.0 ** rng.uniform(-6.0, -2.0, count)
    lower, upper = -rng.uniform(0.01, 0.2, size), rng.uniform(0.01, 0.2, size)
    rows = loosened((G, -excess), lower, upper)
    # A pull of any strength leaves a solution, also in a slightly smaller box.
    for share in (1.0, 0.91):
        pull = rng.normal(size=size) * 10.0 ** rng.uniform(-3.0, 3.0)
        step = solve_by_daqp(np.eye(size), pull, share * lower, share * upper, rows)
        assert step is not None
        np.testing.assert_array_less(G @ step, rows[1] + 1e-8)
    # What alone satisfies the rows is short: a damped solution, x^T x <= e^T e / (4 lever^2).
    step = solve_by_daqp(np.eye(size), np.zeros(size), lower, upper, rows)
    assert step is not None
    assert np.linalg.norm(step) < np.linalg.norm(excess) / (2.0 * 0.015) + 1e-9


def test_overlapping_links_part() -> None:
    hand = load("three_finger")
    limit, ik = MeasuredPairs(hand), PointIk(hand, IkOptions())
    rng, starts = np.random.default_rng(0), 0
    while starts < 5:
        ik.place(
            hand.configuration_vector(rng.uniform(hand.lower_limits, hand.upper_limits))
        )
        distances = limit.within(ik.configuration.q).found[:, 0]
        # One pair at a time, because the rows of several pairs may conflict.
        if not (distances.min() < -0.002 and np.sort(distances)[1] > 0.02):
            continue
        starts += 1
        targets = ik.configuration.points.copy()
        # By 0.3 of the excess in each.
        for _ in range(25):
            dq = avoiding_step(ik, limit, targets, DT)
            assert dq is not None
            ik.place(pin.integrate(hand.model, ik.configuration.q, dq))
        assert limit.nearest(ik.configuration.q) > 0.9 * limit.margin


@given(st.integers(0, 10_000))
@settings(max_examples=60, deadline=None)
def test_pairs_that_cannot_all_part_leave_a_solution(seed: int) -> None:
    """What parts pairs may bring others nearer than their margin: then they need not part."""
    rng = np.random.default_rng(seed)
    count, size = int(rng.integers(2, 7)), int(rng.integers(1, 4))
    G = rng.normal(size=(count, size))
    h = rng.choice([-0.01, 0.0, 0.01], count)
    bounds = rng.uniform(0.01, 0.2, size)
    rows, limits = loosened((G, h), -bounds, bounds)
    found = linprog(
        np.zeros(size),
        rows,
        limits + 1e-12,
        bounds=np.column_stack([-bounds, bounds]),
    )
    assert found.success, found.message
    assert (limits <= h)[h >= 0.0].all()


@given(st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_rows_of_a_later_iteration_hold_for_the_whole_sample(seed: int) -> None:
    rng = np.random.default_rng(seed)
    G, so_far = rng.normal(size=(4, 6)), rng.uniform(-0.01, 0.01, 6)
    h = np.abs(rng.normal(size=4)) + 1.0
    rows, limits = loosened((G, h), -np.ones(6), np.ones(6), so_far=so_far)
    rest = rng.normal(size=(200, 6))
    np.testing.assert_array_equal(
        (rest @ rows.T <= limits).all(axis=1),
        ((so_far + rest) @ G.T <= h).all(axis=1),
    )


def test_far_rows_change_no_step() -> None:
    hand = load("three_finger")
    targets = hand.points(hand.rest) + 0.01
    steps = []
    for options in (IkOptions(max_iterations=1), AVOIDING.replaced(max_iterations=1)):
        ik = PointIk(hand, options)
        ik.place(hand.configuration_vector(hand.rest))
        steps.append(ik.solve(targets, None, DT).displacement)
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-9)


def links_of(limit: MeasuredPairs) -> list[tuple[str, str]]:
    """Return the links of each pair."""
    return [*ShapePairs(limit.bounds.geometry, ()).links]


def test_a_link_with_two_shapes_has_two_rows() -> None:
    hand = load("three_finger")
    shape = (
        '<collision name="knob"><origin xyz="0 0 0.02"/>'
        '<geometry><sphere radius="0.01"/></geometry></collision>'
    )
    text = (
        read_urdf(hand.spec)
        .decode()
        .replace(
            '<collision name="finger1_distal">',
            f'{shape}<collision name="finger1_distal">',
        )
    )
    limit = MeasuredPairs(Hand(hand.spec, mount="fixed", urdf_text=text))
    pairs = links_of(limit)
    assert len(pairs) == len(links_of(MeasuredPairs(hand))) + 4
    assert pairs.count(("finger1_distal", "finger2_distal")) == 2


def test_a_mesh_counts_as_its_convex_hull(tmp_path: Path) -> None:
    # The same box as a primitive and as a mesh, around the same link.
    box = trimesh.creation.box((0.05, 0.017, 0.017))
    box.export(tmp_path / "box.stl")
    hand = load("three_finger")
    assert DISTAL_SHAPE in read_urdf(hand.spec).decode()
    distances = []
    for geometry in ('<box size="0.05 0.017 0.017"/>', '<mesh filename="box.stl"/>'):
        text = (
            read_urdf(hand.spec)
            .decode()
            .replace(DISTAL_SHAPE, geometry)
            .replace("<capsule ", "<no_capsule ")
        )
        boxy = Hand(
            msgspec.structs.replace(hand.spec, directory=tmp_path),
            mount="fixed",
            urdf_text=text,
        )
        configuration, limit = boxy.configuration(), MeasuredPairs(boxy)
        for q in (hand.rest, hand.upper_limits):
            configuration.place(boxy.configuration_vector(q))
            distances.append(limit.within(configuration.q).found[:, 0])
    assert min(distances[1]) < 0.0
    np.testing.assert_allclose(distances[2:], distances[:2], atol=1e-7)


def test_links_whose_mesh_is_not_there_are_kept_apart_by_stand_ins(
    tmp_path: Path,
) -> None:
    hand = load("three_finger")
    text = (
        read_urdf(hand.spec)
        .decode()
        .replace(DISTAL_SHAPE, '<mesh filename="gone.stl"/>')
    )
    spec = msgspec.structs.replace(hand.spec, directory=tmp_path)
    bare = Hand(spec, mount="fixed", urdf_text=text)
    limit = MeasuredPairs(bare)
    configuration = bare.configuration()
    configuration.place(bare.configuration_vector(hand.rest))
    distances = limit.within(configuration.q).found[:, 0]
    assert np.isfinite(distances).all()


def test_a_hand_without_pairs_is_rejected_with_advice() -> None:
    spec = msgspec.structs.replace(load("three_finger").spec, collision=None)
    with pytest.raises(InvalidOptionsError, match=r"collision\.pairs"):
        MeasuredPairs(Hand(spec))


@pytest.mark.parametrize(
    ("link", "what"), [("moon", "not a link"), ("finger1_tip", "no collision shape")]
)
def test_a_link_that_cannot_collide_is_named(link: str, what: str) -> None:
    collision = CollisionSpec(
        pairs=(("finger1_distal", "finger2_distal"), ("finger1_distal", link))
    )
    spec = msgspec.structs.replace(load("three_finger").spec, collision=collision)
    with pytest.raises(HandError, match=what) as caught:
        MeasuredPairs(Hand(spec))
    assert caught.value.key == "collision.pairs[1]"
    assert caught.value.file is not None


@pytest.mark.parametrize(
    ("collision", "key"),
    [
        (
            {"pairs": [["finger1_distal", "finger2_distal"]], "margin": -1.0},
            "collision.margin",
        ),
        (
            {"pairs": [["finger1_distal", "finger2_distal"]], "margin": float("nan")},
            "collision.margin",
        ),
        ({"pairs": []}, "collision.pairs"),
        ({"pairs": [["palm", "palm"]]}, "collision.pairs[0]"),
        (
            {"pairs": [["palm", "finger1_distal"], ["finger1_distal", "palm"]]},
            "collision.pairs[1]",
        ),
        ({"pairs": [["palm"]]}, "collision.pairs[0]"),
        ({"pairs": [["palm", "finger1_distal"]], "distance": 1.0}, "collision"),
        ({}, "collision"),
    ],
)
def test_a_wrong_block_is_named(
    collision: dict[str, Any], key: str, tmp_path: Path
) -> None:
    document = yaml.safe_load(
        (urdf_directory() / "three_finger" / "hand.yaml").read_text(encoding="utf-8")
    )
    file = tmp_path / "hand.yaml"
    file.write_text(
        yaml.safe_dump(document | {"collision": collision}), encoding="utf-8"
    )
    with pytest.raises(HandError) as caught:
        read_hand_spec(file)
    assert caught.value.key == key
    assert caught.value.file == file


def test_the_block_is_optional(tmp_path: Path) -> None:
    document = yaml.safe_load(
        (urdf_directory() / "three_finger" / "hand.yaml").read_text(encoding="utf-8")
    )
    del document["collision"]
    file = tmp_path / "hand.yaml"
    file.write_text(yaml.safe_dump(document), encoding="utf-8")
    assert read_hand_spec(file).collision is None


def test_pairs_within_the_horizon_have_the_rows_they_have_without_one() -> None:
    hand, rng = load_hand("allegro_right"), np.random.default_rng(8)
    every, limit = MeasuredPairs(hand), MeasuredPairs(hand)
    configuration = hand.configuration()
    margins = rng.uniform(0.0, 0.003, size=len(every.bounds.first))
    for _ in range(20):
        q = rng.uniform(hand.lower_limits, hand.upper_limits)
        configuration.place(hand.configuration_vector(q))
        near = limit.within(configuration.q, margins + 0.012)
        assert len(near.pairs) < len(every.bounds.first)
        G, h = every.rows(configuration, every.within(configuration.q), margins)
        some_G, some_h = limit.rows(configuration, near, margins)
        # GJK is warm-started, so both agree to its tolerance only.
        np.testing.assert_allclose(some_h, h[near.pairs], atol=1e-6)
        np.testing.assert_allclose(some_G, G[near.pairs], atol=1e-4)


@pytest.mark.parametrize("stopping", [0.0, 1.0, 3.0])
def test_a_row_leaves_room_for_the_stop_behind_a_displacement(stopping: float) -> None:
    G, h = np.array([[1.0, 2.0]]), np.array([0.3])
    bounds = np.full(2, 1.0)
    _, kept = loosened((G, h), -bounds, bounds, stopping=stopping)
    # The farthest displacement and the stop behind it, on one line, end where the row does.
    np.testing.assert_allclose((1.0 + stopping) * kept, h, rtol=0.0, atol=1e-15)
