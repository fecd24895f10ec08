"""Anatomical names in the names of links and joints: tokens, and one assignment of all chains."""

from __future__ import annotations

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest
from box_hands import BoxHand

from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.finger_names import named_fingers, named_side

NAMES = {
    "words": ([["thumb_1"], ["index_middle"], ["middle_distal"], ["pinky_tip"]],
              ["thumb", "index", "middle", "little"]),
    "shadow": ([["rh_THJ5", "rh_thmiddle"], ["rh_FFJ4", "rh_ffmiddle"], ["rh_MFJ4", "rh_mfmiddle"]],
               ["thumb", "index", "middle"]),
    "letters": ([["hand_T-AP", "hand_T-TS"], ["hand_I-AP", "hand_I-PP"], ["hand_M-AP", "hand_M-P"]],
                ["thumb", "index", "middle"]),
    "twice": ([["index_1"], ["index_2"]], [None, None]),
    "legs": ([["rf_hip"], ["lf_hip"]], [None, None]),
    "springs": ([["spring_1"], ["springs"]], [None, None]),
    # A joint of two fingers is none of either, and the last word says which one it is.
    "shared": ([["ringlittle", "ringlittle/ring"], ["ringlittle", "ringlittle/little"]],
               ["ring", "little"]),
    "camel": ([["LThumbProx"], ["LIndexTip"], ["leftringdistal"], ["small_finger_tip"]],
              ["thumb", "index", "ring", "little"]),
    "phalanges": ([["a_proximal", "a_middle", "a_distal"], ["b_proximal", "b_distal"]],
                  [None, None]),
    "most": ([["thumb_1", "thumb_2"], ["thumb_base", "index_1", "index_2"]], ["thumb", "index"]),
    # The same name twice is lost, and no other one.
    "collision": ([["thumb"], ["index"], ["middle"], ["ring_1"], ["ring_2"]],
                  ["thumb", "index", "middle", None, None]),
}  # fmt: skip


@pytest.mark.parametrize(("chains", "expected"), NAMES.values(), ids=NAMES.keys())
def test_names_of_fingers(chains: list[list[str]], expected: list[str | None]) -> None:
    for order in permutations(range(len(chains))):
        found = named_fingers([chains[i] for i in order])
        assert found == [expected[i] for i in order]


def test_names_of_sides() -> None:
    assert named_side(["r_palm", "l3"]) == "right"
    assert named_side(["Left_index", "right_hand"]) is None
    assert named_side(["rh_FFJ4", "rh_palm"]) == "right"
    # The maker's name of a hand for both sides.
    assert named_side(["rh_p12_rn", "rh_p12_rn_base"]) is None


@pytest.mark.parametrize("lost", ["ring", "little"])
def test_a_collision_loses_one_name_and_no_finger(lost: str) -> None:
    """Two fingers have the same name: places tell them apart, all others keep theirs."""
    names = ("thumb", "index", "middle", "ring", "little")
    given = tuple(f"{lost}{k}" if name in ("ring", "little") else name
                  for k, name in enumerate(names))  # fmt: skip
    found = detect(Path("x"), BoxHand(names=given, turn=np.eye(3)).urdf())
    chains = {finger: joints[0] for finger, joints in found.chains.items()}
    assert chains == {
        name: f"{own}_0_joint" for name, own in zip(names, given, strict=True)
    }
    clues = {clue.what: clue for clue in found.clues}
    assert clues["fingers"].how.endswith("the names index, middle agree")
    assert clues["thumb"].certainty == "certain"


def test_a_name_tells_a_finger_that_is_missing() -> None:
    """Of three fingers, names say that the outer one is the little one: it stays that."""
    given = ("thumb", "a", "middle", "little")
    found = detect(Path("x"), BoxHand(names=given, turn=np.eye(3)).urdf())
    assert [*found.chains] == ["thumb", "index", "middle", "little"]
