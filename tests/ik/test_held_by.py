"""The two links that keep a hand from its targets are named, on every path."""

from __future__ import annotations

import pickle
from typing import Any

import numpy as np
import pytest
from oracles.shape_distances import MeasuredPairs

from handmap_core.ik.result import IkResult
from handmap_qp import HandMapper, IkOptions, load_hand, read_recording
from handmap_qp.hands.shape_pairs import all_pairs
from handmap_qp.ik.qp import PointIk

FORMULATIONS = ["direct", "mink", "compiled"]


def pressed(
    formulation: Any, *, limit: float | None = None
) -> tuple[PointIk, IkResult]:
    """Lead the thumb of an Allegro hand through its index finger's place."""
    hand = load_hand("allegro_right")
    options = IkOptions(formulation=formulation, max_acceleration=limit)
    ik = PointIk(hand, options, contacts=all_pairs(hand))
    ik.place(hand.configuration_vector(hand.rest))
    points, wrist = ik.configuration.points.copy(), ik.configuration.wrist.homogeneous
    names = [point.finger for point in hand.reference_points]
    index, thumb = names.index("index"), names.index("thumb")
    points[[index, thumb]] = points[[thumb, index]]
    for _ in range(150):
        result = ik.solve(points, wrist, 0.02)
    return ik, result


@pytest.mark.parametrize("limit", [None, 25.0], ids=["free", "accelerating"])
@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_links_that_press_on_each_other_are_named(
    formulation: Any, limit: float | None
) -> None:
    ik, result = pressed(formulation, limit=limit)
    assert len(result.held_by) == 2
    limits = MeasuredPairs.of(ik)
    near = limits.within(ik.gate.motion.q)
    links = limits.bounds.links
    gaps = [
        found[0]
        for pair, found in zip(near.pairs, near.found, strict=True)
        if links[pair] == result.held_by
    ]
    assert min(gaps) == pytest.approx(limits.margin, abs=1e-3)
    # A braking hand is held by nothing.
    assert ik.hold(0.02).held_by == ()


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_an_open_hand_is_held_by_nothing(formulation: Any) -> None:
    hand = load_hand("allegro_right")
    options = IkOptions(formulation=formulation)
    for contacts in (None, all_pairs(hand)):
        ik = PointIk(hand, options, contacts=contacts)
        ik.place(hand.configuration_vector(hand.rest))
        placed = ik.configuration
        result = ik.solve(placed.points.copy(), placed.wrist.homogeneous, 0.02)
        assert result.held_by == ()


@pytest.mark.parametrize("limit", [None, 25.0], ids=["free", "accelerating"])
@pytest.mark.parametrize("name", ["allegro_right", "three_finger", "g1_left"])
def test_both_paths_name_the_same_links_on_hostile_input(
    name: str, limit: float | None
) -> None:
    hand = load_hand(name)
    pairs = all_pairs(hand)
    options = IkOptions(max_acceleration=limit, speed_weight=0.1)
    fast = PointIk(hand, options, contacts=pairs)
    slow = PointIk(hand, options.replaced(formulation="direct"), contacts=pairs)
    rng = np.random.default_rng(4)
    held = 0
    for i in range(200):
        if i % 40 == 0:
            for ik in (fast, slow):
                ik.place(hand.configuration_vector(hand.rest))
        points = slow.configuration.points
        scale = 10.0 ** rng.uniform(-3, -0.5)
        points = points + rng.normal(scale=scale, size=points.shape)
        wrist, dt = slow.configuration.wrist.homogeneous, 10.0 ** rng.uniform(-3, -0.5)
        one, other = (ik.solve(points, wrist, dt) for ik in (fast, slow))
        assert one.held_by == other.held_by
        held += bool(other.held_by)
        fast.gate.motion = slow.gate.motion
    assert held


@pytest.mark.parametrize("formulation", FORMULATIONS)
def test_a_step_and_its_copy_name_the_links(formulation: Any) -> None:
    recording = read_recording("demo", "right")
    human = load_hand("human", points="landmarks")
    mapper = HandMapper(human, load_hand("allegro_right"))
    mapper.configure(ik=mapper.ik.replaced(formulation=formulation))
    count = 40 if formulation == "mink" else 216
    steps = [mapper.map_landmarks(each) for each in recording.landmarks[::2][:count]]
    assert {len(step.held_by) for step in steps} <= {0, 2}
    for step in steps:
        assert step.held_by == step.ik.held_by
        assert pickle.loads(pickle.dumps(step)).held_by == step.held_by
    if formulation != "mink":
        assert any(step.held_by for step in steps)
        assert not all(step.held_by for step in steps)
