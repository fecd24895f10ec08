"""Fingers that are named all at once, dropped, and added again."""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import pytest

from handmap_qp import Hand, InvalidInputError, load_hand
from handmap_qp.apps.onboarding.finger_permutation import (
    all_tips,
    left_out,
    with_names,
)
from handmap_qp.apps.onboarding.hand_choice import first_hand
from handmap_qp.hands.fingers import find_fingers

DATA = Path(__file__).parents[1] / "data" / "urdf"
HANDS = ("three_finger", "allegro_left")


def links_of(hand: Hand) -> dict[str, str]:
    """Return the name of the finger of each tip's link."""
    return {tip.link: name for name, tip in all_tips(hand).items()}


def dropped(hand: Hand, name: str) -> Hand:
    return load_hand(with_names(hand, {all_tips(hand)[name].link: None}))


@pytest.mark.parametrize("name", HANDS)
def test_any_permutation_is_undone_by_its_inverse(name: str) -> None:
    hand = load_hand(name)
    now = links_of(hand)
    for order in itertools.islice(itertools.permutations(now.values()), 0, None, 5):
        names = dict(zip(now, order, strict=True))
        other = load_hand(with_names(hand, names))
        assert links_of(other) == names
        # Joints stay with their chain.
        for link, finger in names.items():
            mine = find_fingers(other)[finger].joints
            assert mine == find_fingers(hand)[now[link]].joints
        assert with_names(other, now) == hand.spec


def test_points_of_a_thumb_have_other_names_than_those_of_a_finger() -> None:
    hand = load_hand("allegro_left")
    tips = all_tips(hand)
    names = {tips["thumb"].link: "index", tips["index"].link: "thumb"}
    points = {point.name for point in with_names(hand, names).points}
    assert {"thumb_tip", "thumb_ip", "index_tip", "index_pip"} <= points
    assert points == {point.name for point in hand.spec.points}


@pytest.mark.parametrize("name", HANDS)
def test_a_dropped_finger_is_still_and_can_be_added(name: str) -> None:
    hand = load_hand(name)
    finger = find_fingers(hand)["middle"]
    link = all_tips(hand)["middle"].link
    less = dropped(hand, "middle")
    assert "middle" not in all_tips(less)
    assert not any(point.finger == "middle" for point in less.spec.points)
    mine = [hand.joint_names[i] for i in finger.columns]
    assert {*hand.joint_names} - {*less.joint_names} == {*mine}
    for joint in mine:
        at = hand.rest[hand.joint_names.index(joint)]
        assert less.spec.locked[joint] == pytest.approx(at)
    tips = [tip.name for tip in all_tips(less).values()]
    np.testing.assert_allclose(
        less.with_points(tips).points(less.rest),
        hand.with_points(tips).points(hand.rest),
        atol=1e-5,
    )
    assert [*left_out(less.spec)] == [link]
    assert not left_out(hand.spec)
    again = load_hand(with_names(less, {link: "middle"}))
    assert links_of(again) == links_of(hand)
    assert {*again.joint_names} == {*hand.joint_names}
    assert again.spec.rest == pytest.approx(hand.spec.rest, abs=1e-5)
    (place,) = again.with_points([all_tips(again)["middle"].name]).points(again.rest)
    (before,) = hand.with_points([all_tips(hand)["middle"].name]).points(hand.rest)
    assert np.linalg.norm(place - before) < 0.015


def test_names_that_cannot_be_are_refused() -> None:
    hand = load_hand("allegro_left")
    tips = all_tips(hand)
    for names, why in (
        ({tips["index"].link: "middle"}, "each name once"),
        ({tips["thumb"].link: None}, "one that is the thumb"),
        ({"palm": "little"}, "end a chain"),
    ):
        with pytest.raises(InvalidInputError, match=why):
            with_names(hand, names)


def test_additional_fingers_have_names_too() -> None:
    hand = load_hand(first_hand(DATA / "seven_fingers.urdf").spec)
    names = links_of(hand)
    assert len(names) == 7
    extra = next(link for link, name in names.items() if name.startswith("finger"))
    index = all_tips(hand)["index"].link
    swapped = {extra: "index", index: names[extra]}
    other = load_hand(with_names(hand, swapped))
    assert links_of(other) == names | swapped
    assert "index_tip" in {point.name for point in other.spec.points}
    less = dropped(hand, names[extra])
    assert [*left_out(less.spec)] == [extra]
