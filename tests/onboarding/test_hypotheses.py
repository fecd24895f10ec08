"""What a hand may be: every kind of evidence decides on some hand, and near answers are named."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from box_hands import NAMES, BoxHand, pair_against_one, slides_without_shapes

from handmap_core.se3 import Array
from handmap_qp.apps.onboarding.anatomy import Anatomy, find_anatomy
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.hypotheses import LIKELY, TERMS, Hypothesis, score
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.single_joints import FingerKind
from handmap_qp.apps.onboarding.structure import find_structure
from handmap_qp.apps.onboarding.two_hands import PairedSide
from handmap_qp.apps.onboarding.vectors import UNKNOWN
from handmap_qp.hands import Side

PLAIN = tuple("abcde")
EVEN = (-0.8, 0.8)
# Beside the fingers and like them, and where a thumb is.
ROW = (0.09, 0.05, 0.0)
HAND = BoxHand(turn=np.eye(3), names=PLAIN)


def _anatomy(hand: BoxHand, paired: PairedSide | None = None) -> Anatomy:
    return _anatomy_of(hand.urdf(), paired)


def _anatomy_of(
    text: str, paired: PairedSide | None = None, ahead: Array = UNKNOWN
) -> Anatomy:
    robot = Robot(Path("x"), text)
    return find_anatomy(robot, find_structure(robot), paired=paired, ahead=ahead)


def _leader(anatomy: Anatomy, without: str = "") -> tuple[Hypothesis, float]:
    """Return the hypothesis with most evidence, and how far it is ahead, without one kind."""
    ranked = sorted(anatomy.ranking, key=lambda one: score(one.values, without=without))
    *_, second, first = (score(one.values, without=without) for one in ranked)
    return ranked[-1], first - second


# A hand that needs each kind of evidence: its thumb is the first finger.
LEFT = PairedSide("left", "by the other hand")
NEEDED: dict[str, tuple[BoxHand, Side, PairedSide | None]] = {
    "difference": (HAND, "right", None),
    "thumb name": (replace(HAND, thumb=ROW, names=("thumb", *PLAIN[1:])), "right", None),
    "flexion": (replace(HAND, names=("left_a", *PLAIN[1:])), "right", None),
    "side name": (replace(HAND, span=EVEN, palm="left_palm"), "left", None),
    "other hand": (replace(HAND, span=EVEN), "left", LEFT),
    "finger names": (
        replace(HAND, thumb=ROW, names=("x", "index", "middle", "ring", "y")), "right", None
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", NEEDED)
def test_a_hand_needs_each_kind_of_evidence(name: str) -> None:
    hand, side, paired = NEEDED[name]
    anatomy = _anatomy(hand, paired)
    best, margin = _leader(anatomy)
    assert (best.thumb, best.side) == (0, side), best
    assert margin > 0.05
    other, less = _leader(anatomy, without=name)
    assert (other.thumb, other.side) != (0, side) or less < margin - 0.05
    # It is what is found.
    assert anatomy.side == side
    assert anatomy.fingers[0].joint_names[0].startswith(hand.names[0])


# Fingers with one joint each that need each kind of evidence for what they are.
SINGLE = replace(HAND, joints=1)
KINDS: dict[str, tuple[str, FingerKind]] = {
    "parallel": (replace(SINGLE, span=EVEN).urdf(), "fingers"),
    "range": (
        replace(SINGLE, names=("thumb", "fingers"), span=EVEN).urdf(), "jaws"
    ),
    "apart": (pair_against_one(gap=0.01, sense=-1.0), "jaws"),
    "thumb and finger": (replace(SINGLE, names=("thumb", "fingers")).urdf(), "fingers"),
}  # fmt: skip


@pytest.mark.parametrize("name", KINDS)
def test_fingers_with_one_joint_need_each_kind_of_evidence(name: str) -> None:
    text, kind = KINDS[name]
    anatomy = _anatomy_of(text)
    best, _ = _leader(anatomy)
    less, _ = _leader(anatomy, without=name)
    assert best.kind == kind
    assert less.kind not in (None, kind)


# Hands on an arm, the direction in which that points, and whether they point there, too.
X, Y, Z = np.eye(3)
ON_ARMS: dict[str, tuple[str, Array, bool]] = {
    # Slides without shapes, whose tips are guessed from where they begin.
    "arm": (slides_without_shapes(), Z, True),
    # A hand on a bent mount, whose fingers tell their direction.
    "straight fingers": (HAND.urdf(), Y, False),
}


@pytest.mark.parametrize("name", ON_ARMS)
def test_the_direction_of_a_hand_needs_each_kind_of_evidence(name: str) -> None:
    text, ahead, is_along_arm = ON_ARMS[name]
    anatomy = _anatomy_of(text, ahead=ahead)
    best, _ = _leader(anatomy)
    less, _ = _leader(anatomy, without=name)
    assert best.is_along_arm == is_along_arm
    assert less.is_along_arm != is_along_arm
    # It is what is found.
    np.testing.assert_allclose(anatomy.distal, ahead if is_along_arm else X, atol=1e-9)


def test_an_arm_along_the_fingers_changes_nothing() -> None:
    plain, on_arm = (_anatomy_of(HAND.urdf(), ahead=ahead) for ahead in (UNKNOWN, X))
    assert not on_arm.hypothesis.is_along_arm
    assert on_arm.hypothesis.options == plain.hypothesis.options
    assert on_arm.clues == plain.clues
    assert on_arm.notes == plain.notes


def test_a_direction_by_the_arm_is_not_certain() -> None:
    anatomy = _anatomy_of(slides_without_shapes(), ahead=Z)
    assert anatomy.sure["distal"] == pytest.approx(LIKELY)
    # The tips stay guesses, and so does what depends on them.
    assert anatomy.sure["dorsal"] < 0.6


def test_fingers_that_curl_are_of_one_kind() -> None:
    assert {one.kind for one in _anatomy(HAND).ranking} == {None}


def test_a_near_kind_is_named_with_the_option_that_chooses_it() -> None:
    """Two alike fingers: one is a thumb by its name, and zero is well inside of the ranges."""
    text = replace(SINGLE, names=("thumb", "fingers"), span=(-0.5, 1.2)).urdf()
    found = detect(Path("x"), text)
    (note,) = (note for note in found.notes if "choose that" in note)
    assert "its fingers may be " in note
    kind = note.partition("--kind ")[2].split()[0]
    # What depends on the kind is no surer than it.
    sure = {clue.what: clue.confidence for clue in found.clues}
    assert max(sure["distal"], sure["dorsal"], sure["rest"]) < 0.6
    other = detect(Path("x"), text, kind="jaws" if kind == "jaws" else "fingers")
    assert other.spec.palm.distal != found.spec.palm.distal
    assert not any("--kind" in note for note in other.notes)


def test_the_values_of_all_evidence_are_bounded_and_known() -> None:
    names = {term.name for term in TERMS}
    for hand, _, paired in NEEDED.values():
        for one in _anatomy(hand, paired).ranking:
            assert {*one.values} <= names
            assert all(-1.0 <= value <= 1.0 for value in one.values.values())


def test_a_near_answer_is_named_with_the_option_that_chooses_it() -> None:
    """Five alike fingers in a row: a thumb is at either end, and the text of `init` says so."""
    hand = replace(HAND, thumb=ROW)
    found = detect(Path("x"), hand.urdf())
    (note,) = (note for note in found.notes if "choose that" in note)
    option = note.partition("--thumb ")[2].split()[0]
    other = detect(Path("x"), hand.urdf(), thumb=option)
    assert other.chains["thumb"] != found.chains["thumb"]
    assert other.spec.side != found.spec.side
    # What is given is not asked for again, and a clear hand asks for nothing.
    assert not any("choose that" in note for note in other.notes)
    clear = detect(Path("x"), replace(HAND, names=NAMES).urdf())
    assert not any("choose that" in note for note in clear.notes)


def test_a_thumb_before_the_palm_outweighs_a_wrong_side_in_the_names() -> None:
    """The ranges show flexion only a little: alone they would yield to the palm's name."""
    anatomy = _anatomy(replace(HAND, span=(-0.4, 0.8), palm="left_palm"))
    best, _ = _leader(anatomy)
    assert (best.thumb, best.side, best.is_turned) == (0, "right", False)
    less, _ = _leader(anatomy, without="thumb ahead")
    assert less.side == "left"
    # Both are near, so the one that is not taken is named.
    assert any("--side" in note for note in anatomy.notes)


def test_each_kind_of_evidence_has_a_hand() -> None:
    assert {term.name for term in TERMS} == {*NEEDED, "thumb ahead", *KINDS, *ON_ARMS}


def test_names_of_the_others_overrule_the_order_of_the_file() -> None:
    """Alike fingers in a row: the thumb is beside the index finger, and the last in the file."""
    names = ("y", "ring", "middle", "index", "x")
    anatomy = _anatomy(replace(HAND, thumb=ROW, names=names))
    assert anatomy.fingers[0].joint_names[0].startswith("x")
    assert anatomy.side == "left"
    (clue,) = (clue for clue in anatomy.clues if clue.what == "thumb")
    assert clue.how.endswith("the fingers' names begin at the thumb")
    assert clue.certainty != "certain"


def test_a_finger_that_is_named_otherwise_is_no_thumb() -> None:
    names = ("little", "ring", "middle", "index", "x")
    anatomy = _anatomy(replace(HAND, thumb=ROW, names=names))
    assert anatomy.fingers[0].joint_names[0].startswith("x")
    assert [finger.name for finger in anatomy.fingers] == [*NAMES]


def test_the_ranking_begins_with_most_evidence() -> None:
    scores = [one.score for one in _anatomy(HAND).ranking]
    assert scores == sorted(scores, reverse=True)
    assert len(scores) > len(PLAIN)
