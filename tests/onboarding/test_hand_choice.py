"""The part of a robot that is the hand: roots, links that are drawn, and a thumb that is given."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from made_hands import make_hand, two_hands_mjcf

from handmap_qp import HandError, load_hand
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.finger_permutation import all_tips, with_names
from handmap_qp.apps.onboarding.hand_choice import (
    at_root,
    first_hand,
    links_of_hand,
    possible_roots,
    with_thumb,
)
from handmap_qp.apps.onboarding.write import open_source


@pytest.fixture(scope="module")
def two_hands(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the URDF of a robot with two left hands, which `detect` refuses."""
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    folder = tmp_path_factory.mktemp("two")
    file = folder / "two.xml"
    file.write_text(two_hands_mjcf(1.0))
    return open_source(file, folder).urdf


def test_of_two_hands_one_is_taken_and_the_other_can_be_chosen(two_hands: Path) -> None:
    with pytest.raises(HandError, match="2 possible palms"):
        detect(two_hands)
    found = first_hand(two_hands)
    palms = {"left_palm", "right_palm"}
    assert found.spec.palm.link in palms
    assert "2 possible palms" in found.notes[0]
    assert palms <= {*possible_roots(two_hands)}
    (other,) = palms - {found.spec.palm.link}
    again = at_root(found, other)
    assert again.spec.palm.link == other
    assert load_hand(again.spec).joint_names
    # A given side is held.
    flipped = "right" if again.spec.side == "left" else "left"
    assert at_root(found, other, flipped).spec.side == flipped
    with pytest.raises(HandError):
        at_root(found, "left_thumb_2")


def test_a_hand_that_is_found_is_taken_as_it_is(tmp_path: Path) -> None:
    file = tmp_path / "hand.urdf"
    file.write_text(make_hand(np.random.default_rng(3)).urdf)
    assert first_hand(file).spec == detect(file).spec
    with pytest.raises(HandError, match="cannot be read"):
        first_hand(tmp_path / "none.urdf")


def test_links_of_an_arm_are_not_those_of_the_hand() -> None:
    hand, alone = load_hand("ur5_allegro"), load_hand("allegro_right")
    links = links_of_hand(hand)
    assert {point.link for point in hand.spec.points} <= {*links}
    assert hand.spec.palm.link in links
    # The body of the palm contains what is bolted to it, and no link that an arm's joint moves.
    carrying = hand.model.supports[hand.palm_frame.parentJoint]
    assert all(hand.frames[link].parentJoint not in [*carrying][:-1] for link in links)
    assert {*links} < {*hand.frames}
    assert {*links_of_hand(alone)} == {*alone.frames}


def test_another_thumb_brings_what_follows_from_it() -> None:
    """As `--thumb` does: the palm is found again for the thumb that is given."""
    generator = np.random.default_rng(11)
    is_corrected = False
    for _ in range(6):
        made = make_hand(generator)
        is_corrected |= _corrected(made.urdf, made.tips["thumb"], made.palm)
    assert is_corrected


def _corrected(urdf: str, thumb: str, palm: str) -> bool:
    """Describe a hand with a wrong thumb, and correct that; return whether the palm was wrong."""
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "hand.urdf"
        file.write_text(urdf)
        right = detect(file).spec
        tips = {tip.link: name for name, tip in all_tips(load_hand(right)).items()}
        if tips.get(thumb) != "thumb":
            return False
        hand = load_hand(right)
        index = all_tips(hand)["index"].link
        other = hand.model.names[hand.frames[index].parentJoint]
        try:
            wrong = detect(file, thumb=other).spec
        except HandError:
            return False
        if {*wrong.joints} != {*right.joints}:
            return False
        spec = with_names(load_hand(wrong), tips)
        spec = with_thumb(Detection(spec, (), (), {}), thumb)
        assert spec.palm.distal == right.palm.distal
        assert spec.palm.dorsal == right.palm.dorsal
        assert spec.side == right.side
        assert spec.palm.link == palm
        return wrong.palm != right.palm
