"""Axes of the palm that are turned, and what follows from them."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from made_hands import make_hand

from handmap_qp import Hand, load_hand
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.hand_choice import palm_links
from handmap_qp.apps.onboarding.label_places import spread_labels
from handmap_qp.apps.onboarding.palm_turns import (
    Held,
    Turn,
    palm_axes,
    snapped_axes,
    turned_axes,
    with_palm_axes,
    with_palm_link,
    with_turn,
)
from handmap_qp.hands.spec import HandSpec

HANDS = ("three_finger", "allegro_left")
TURNS: tuple[Turn, ...] = get_args(Turn)


def turned(hand: Hand, *turns: Turn) -> HandSpec:
    for turn in turns:
        hand = load_hand(with_turn(hand, turn))
    return hand.spec


def test_turns_are_rotations_and_four_quarters_are_none() -> None:
    for turn in TURNS:
        axes = turned_axes(np.eye(3), turn)
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(axes) == pytest.approx(1.0)
        quarters = 2 if turn in ("dorsal", "distal") else 4
        assert (np.linalg.matrix_power(axes, quarters) == np.eye(3)).all()
    _, distal, dorsal = np.eye(3)
    np.testing.assert_array_equal(turned_axes(np.eye(3), "dorsal")[:, 2], -dorsal)
    np.testing.assert_array_equal(turned_axes(np.eye(3), "dorsal")[:, 1], distal)
    np.testing.assert_array_equal(turned_axes(np.eye(3), "distal")[:, 1], -distal)
    np.testing.assert_array_equal(turned_axes(np.eye(3), "distal")[:, 2], dorsal)
    np.testing.assert_array_equal(turned_axes(np.eye(3), "z")[:, 0], distal)


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize("turn", TURNS)
def test_a_palm_is_turned_all_around(name: str, turn: Turn) -> None:
    hand = load_hand(name)
    quarters = 2 if turn in ("dorsal", "distal") else 4
    around = turned(hand, *[turn] * quarters)
    assert around.palm.link == hand.spec.palm.link
    np.testing.assert_allclose(palm_axes(around), palm_axes(hand.spec), atol=1e-9)
    np.testing.assert_allclose(around.palm.xyz, hand.spec.palm.xyz, atol=2e-4)
    # Where the thumb is in the middle, the side and the names are those of the last clear place.
    if name == "allegro_left":
        assert around.side == hand.side
        assert around.points == hand.spec.points


def test_all_orientations_are_reached_by_few_turns() -> None:
    """Each of the 24 is at most three clicks away."""
    reached = {
        tuple(map(tuple, axes.round().tolist()))
        for turns in itertools.product((*TURNS, None), repeat=3)
        for axes in [_all(turns)]
    }
    assert len(reached) == 24


def _all(turns: tuple[Turn | None, ...]) -> np.ndarray:
    axes = np.eye(3)
    for turn in turns:
        axes = axes if turn is None else turned_axes(axes, turn)
    return axes


def test_a_symmetric_hand_that_is_turned_over_is_the_other_hand(tmp_path: Path) -> None:
    """The side is derived from the thumb's place, as of the other palm and of the detection."""
    generator = np.random.default_rng(3)
    made = make_hand(generator)
    while made.is_one_sided:
        made = make_hand(generator)
    file = tmp_path / "hand.urdf"
    file.write_text(made.urdf)
    right, left = (detect(file, side=side).spec for side in ("right", "left"))
    over = with_turn(load_hand(right), "dorsal")
    other = edit.with_other_palm(load_hand(right))
    assert over.side == other.side == left.side
    np.testing.assert_allclose(palm_axes(over), palm_axes(other), atol=1e-9)
    names = [point.finger for point in over.points]
    assert names == [point.finger for point in left.points]
    for joint, at in over.rest.items():
        assert at == pytest.approx(left.rest[joint], abs=2e-3), joint
    # What was given is held.
    held = with_turn(load_hand(right), "dorsal", Held(side=True, names=True))
    assert held.side == "right"
    assert held.points == right.points


@pytest.mark.parametrize("name", HANDS)
def test_wrong_axes_are_corrected_to_what_they_were(name: str) -> None:
    """Right axes that are given to a hand turned at random bring side, names and origin back."""
    hand = load_hand(name)
    right = palm_axes(hand.spec)
    generator = np.random.default_rng(5)
    for _ in range(3):
        turns = generator.choice(np.array(TURNS), 2).tolist()
        wrong = load_hand(turned(hand, *turns))
        again = with_palm_axes(wrong, right)
        np.testing.assert_allclose(palm_axes(again), right, atol=1e-9)
        if name == "allegro_left":
            # The thumb of the other hand is in the middle.
            assert again.side == hand.side
            assert again.points == hand.spec.points


def test_dragged_axes_snap_to_those_of_the_link_if_all_are_near() -> None:
    def about(axis: int, degrees: float) -> np.ndarray:
        turn = np.radians(degrees)
        rotation = np.eye(3)
        rows = [(axis + 1) % 3, (axis + 2) % 3]
        rotation[np.ix_(rows, rows)] = [
            [np.cos(turn), -np.sin(turn)],
            [np.sin(turn), np.cos(turn)],
        ]
        return rotation

    for axis in range(3):
        for quarter in range(4):
            near, far = (
                about(axis, 90.0 * quarter + 5.0),
                about(axis, 90.0 * quarter + 9.0),
            )
            exact = about(axis, 90.0 * quarter)
            np.testing.assert_allclose(snapped_axes(near), exact, atol=1e-12)
            np.testing.assert_array_equal(snapped_axes(far), far)


@pytest.mark.parametrize("name", ["allegro_left", "three_finger"])
def test_the_palm_is_fixed_to_another_link_and_stays_where_it_is(name: str) -> None:
    hand = load_hand(name)
    links = palm_links(hand)
    assert hand.spec.palm.link in links
    for link in links:
        other = load_hand(with_palm_link(hand, link))
        assert other.spec.palm.link == link
        np.testing.assert_allclose(
            other.frame_pose("palm", hand.rest),
            hand.frame_pose("palm", hand.rest),
            atol=2e-4,
        )


def test_labels_do_not_overlap_and_stay_if_they_did_not() -> None:
    generator = np.random.default_rng(1)
    width, height = 0.5, 0.14
    for _ in range(50):
        points = generator.uniform(0.0, 1.0, (generator.integers(1, 9), 2))
        places = spread_labels(points, width, height)
        np.testing.assert_array_equal(places[:, 0], points[:, 0])
        gaps = np.abs(places[:, None] - places)
        overlaps = (gaps[..., 0] < width) & (gaps[..., 1] < height - 1e-9)
        assert not (overlaps & ~np.eye(len(points), dtype=bool)).any()
        apart = np.abs(points[:, None] - points)
        is_free = ((apart[..., 0] >= width) | (apart[..., 1] >= height)
                   | np.eye(len(points), dtype=bool)).all()  # fmt: skip
        if is_free:
            np.testing.assert_array_equal(places, points)
