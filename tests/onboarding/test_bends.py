"""Fingers that rest bent to the wrong side are bent the other way."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from box_hands import BoxHand
from made_hands import make_hand
from msgspec.structs import replace

from handmap_qp import Hand, load_hand
from handmap_qp.apps.onboarding.detect import REST_MOST, detect
from handmap_qp.apps.onboarding.edit import with_bend_reversed
from handmap_qp.hands import find_fingers


def _hand(folder: Path, span: tuple[float, float]) -> Hand:
    file = folder / "box.urdf"
    file.write_text(BoxHand(turn=np.eye(3), span=span).urdf(), encoding="utf-8")
    return load_hand(detect(file).spec)


def _sides(hand: Hand) -> dict[str, float]:
    """Return to which side each finger is bent at rest."""
    return {
        name: float(
            np.sign(finger.flexion.signs @ (hand.rest - finger.flexion.straight))
        )
        for name, finger in find_fingers(hand).items()
        if finger.flexion
    }


def test_all_fingers_are_bent_to_the_other_side_and_back(tmp_path: Path) -> None:
    hand = _hand(tmp_path, (-1.0, 1.0))
    before = _sides(hand)
    assert len(before) == 5
    assert 0.0 not in before.values()
    other = load_hand(with_bend_reversed(hand, [*before]))
    assert _sides(other) == {name: -side for name, side in before.items()}
    assert np.abs(other.rest).max() <= REST_MOST
    again = load_hand(with_bend_reversed(other, [*before]))
    np.testing.assert_allclose(again.rest, hand.rest, atol=1e-4)


def test_only_the_fingers_that_are_named_are_bent(tmp_path: Path) -> None:
    hand = _hand(tmp_path, (-1.0, 1.0))
    before = _sides(hand)
    after = _sides(load_hand(with_bend_reversed(hand, ["middle"])))
    assert {name for name in before if before[name] != after[name]} == {"middle"}
    assert with_bend_reversed(hand, []).rest == hand.spec.rest


def test_a_finger_with_one_side_comes_back_from_its_limit(tmp_path: Path) -> None:
    """It has little room on the other side, and rests half bent again afterwards."""
    hand = _hand(tmp_path, (-0.1, 1.2))
    names = [*find_fingers(hand)]
    other = load_hand(with_bend_reversed(hand, names))
    assert (other.rest < 0.0).all()
    assert (other.rest >= hand.limits[0]).all()
    again = load_hand(with_bend_reversed(other, names))
    np.testing.assert_allclose(again.rest, hand.rest, atol=1e-4)


def test_straight_fingers_are_bent_to_the_side_to_which_they_close(
    tmp_path: Path,
) -> None:
    hand = _hand(tmp_path, (0.0, 1.2))
    rest = dict.fromkeys(hand.spec.rest, 0.0)
    straight = load_hand(replace(hand.spec, rest=rest))
    bent = load_hand(with_bend_reversed(straight, [*find_fingers(hand)]))
    np.testing.assert_allclose(bent.rest, hand.rest, atol=1e-4)


@pytest.mark.parametrize("seed", range(4))
def test_one_after_another_is_the_same_as_all_at_once(
    seed: int, tmp_path: Path
) -> None:
    """Whatever the hand: inside its limits, and only joints that move fingers."""
    file = tmp_path / "made.urdf"
    file.write_text(make_hand(np.random.default_rng(seed)).urdf, encoding="utf-8")
    hand = load_hand(detect(file).spec)
    names = [*find_fingers(hand)]
    once = load_hand(with_bend_reversed(hand, names))
    assert (once.rest >= hand.limits[0] - 1e-4).all()
    assert (once.rest <= hand.limits[1] + 1e-4).all()
    one_by_one = hand
    for name in names:
        one_by_one = load_hand(with_bend_reversed(one_by_one, [name]))
    np.testing.assert_allclose(one_by_one.rest, once.rest, atol=1e-4)
