"""What speaks for a chain as a finger and for a body as a palm: names, lengths, what carries it."""

from __future__ import annotations

from pathlib import Path

import pytest

from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.limbs import finger_evidence, palm_evidence
from handmap_qp.apps.onboarding.robot import Robot
from handmap_qp.apps.onboarding.structure import find_palms
from handmap_qp.errors import HandError

PLAIN = ("a", "b", "c")


def _joint(name: str, parent: str, xyz: str, axis: str = "0 1 0") -> str:
    return (
        f'<joint name="{name}_joint" type="revolute"><parent link="{parent}"/>'
        f'<child link="{name}"/><origin xyz="{xyz}"/><axis xyz="{axis}"/>'
        '<limit lower="0" upper="1.4" effort="1" velocity="3"/></joint>'
    )


def _fork(palm: str, names: tuple[str, ...] = PLAIN, length: float = 0.08) -> str:
    """Return chains of two equal boxes that branch from a body.

    Args:
        palm: The body's link.
        names: Name of each chain.
        length: That of each [m].
    """
    half = 0.5 * length
    shape = (
        f'<visual><origin xyz="{0.5 * half} 0 0"/><geometry><box size="{half} .01 .01"/>'
        "</geometry></visual>"
    )
    return "".join(
        f'<link name="{name}_{k}">{shape}</link>'
        + _joint(
            f"{name}_{k}",
            f"{name}_0" if k else palm,
            f"{half} 0 0" if k else f"0.05 {0.02 * place} 0",
        )
        for place, name in enumerate(names)
        for k in range(2)
    )


def _robot(*parts: tuple[tuple[str, ...], str]) -> str:
    """Return a robot whose base carries chains of links, each with something at its end."""
    text = ""
    for chain, end in parts:
        text += "".join(f'<link name="{link}"/>' for link in chain)
        ways = zip(("base", *chain), chain, strict=False)
        text += "".join(_joint(link, parent, "0.3 0 0") for parent, link in ways)
        text += end
    return f'<robot name="x"><link name="base"/>{text}</robot>'


def _palms(text: str) -> list[str]:
    return find_palms(Robot(Path("x"), text))


def _carried(*chain: str, names: tuple[str, ...] = PLAIN) -> list[str]:
    return _palms(_robot((chain, _fork(chain[-1], names))))


@pytest.mark.parametrize(
    "chain",
    [("head", "mouth"), ("neck_yaw", "x"), ("left_knee", "x"), ("hip", "x"), ("tibia_2", "x")],
)  # fmt: skip
def test_what_a_head_or_a_leg_carries_is_no_hand_unless_it_is_named_so(
    chain: tuple[str, ...],
) -> None:
    assert _carried(*chain) == []
    named = tuple(f"finger_{name}" for name in PLAIN)
    assert _carried(*chain, names=named) == [chain[-1]]


def test_an_arm_above_a_leg_carries_a_hand() -> None:
    """A robot whose body stands on one folding leg."""
    assert _carried("ankle", "knee", "hip", "shoulder", "elbow", "x") == ["x"]


def test_the_hand_on_an_arm_is_told_from_other_forks() -> None:
    arm, leg = ("shoulder", "elbow", "x"), ("hip_pitch", "knee", "y")
    both = _robot((arm, _fork("x")), (leg, _fork("y", ("d", "e", "f"))))
    assert _palms(both) == ["x"]
    # Two that nothing tells apart are both named.
    even = _robot((("p", "x"), _fork("x")), (("q", "y"), _fork("y", ("d", "e"))))
    assert _palms(even) == ["x", "y"]
    # A name tells them apart.
    named = _robot((("p", "x"), _fork("x")), (("q", "y"), _fork("y", ("jaw1", "jaw2"))))
    assert _palms(named) == ["y"]


@pytest.mark.parametrize("length", [0.25, 0.35, 0.45])
def test_long_chains_are_fingers_if_their_names_say_so(length: float) -> None:
    """As of hands as big as a table, which push cubes on it."""
    names = ("finger_a", "finger_b", "finger_c")
    found = detect(Path("x"), _robot((("p", "x"), _fork("x", names, length))))
    assert found.spec.palm.link == "x"
    assert len(found.chains) == 3
    text = _robot((("p", "x"), _fork("x", PLAIN, length)))
    if length < 0.3:
        assert len(detect(Path("x"), text).chains) == 3
    else:
        with pytest.raises(HandError, match="no hand found"):
            detect(Path("x"), text)


def test_no_name_makes_an_arm_a_finger() -> None:
    names = ("finger_a", "finger_b")
    with pytest.raises(HandError, match="no hand found"):
        detect(Path("x"), _robot((("p", "x"), _fork("x", names, 0.7))))


def test_names_of_limbs_are_weighed() -> None:
    """One name is not all: a finger that says so may be on a leg, but a long one is a leg."""
    assert finger_evidence(["a", "b"], [], 0.1) > 0.0
    assert finger_evidence(["knee_a", "b"], [], 0.1) < 0.0
    assert finger_evidence(["knee_finger_a", "knee_finger_b"], [], 0.1) > 0.0
    assert finger_evidence(["knee_finger_a", "knee_finger_b"], [], 0.4) < 0.0
    # The hand at the end of an arm does not make the arm a finger.
    assert finger_evidence(["lift", "finger_b"], [], 0.4) < 0.0
    assert finger_evidence(["finger_wheel"], ["finger_wheel"], 0.1) < 0.0
    for word in ("coxa_1", "femur_1", "tarsus_1", "labrum_left", "haltere_right"):
        assert finger_evidence([word], [], 0.05) < 0.0


def test_each_kind_of_evidence_for_a_palm_counts() -> None:
    alone = palm_evidence(["x"], [])
    assert palm_evidence(["gripper"], []) > alone
    assert palm_evidence(["x"], ["left_elbow"]) > alone
    assert palm_evidence(["x"], ["left_knee"]) < 0.0 < alone
    assert palm_evidence(["x"], ["head_yaw"]) < 0.0
    # Parts of words count for nothing.
    assert palm_evidence(["x"], ["overhead", "ship_rail", "alarm"]) == alone


def test_what_is_passed_over_is_named_with_its_margin_and_how_to_choose_it() -> None:
    arm, other = ("shoulder", "elbow", "x"), ("q", "y")
    text = _robot((arm, _fork("x", ("jaw1", "jaw2"))), (other, _fork("y", PLAIN)))
    found = detect(Path("x"), text)
    (note,) = (note for note in found.notes if "no hand" in note)
    assert "evidence 1.0, of the hand 5.0" in note
    root = note.rpartition("--root ")[2]
    other_hand = detect(Path("x"), text, root=root)
    assert other_hand.spec.palm.link == "y"
    assert not any("no hand" in note for note in other_hand.notes)
    # A hand that nothing competes with has no such note.
    alone = detect(Path("x"), _robot((arm, _fork("x"))))
    assert not any("no hand" in note for note in alone.notes)


def test_coupled_joints_without_limits_are_no_wheels(tmp_path: Path) -> None:
    """Wheels turn by themselves; a gripper whose file lacks its limits does not."""
    free = _robot((("base_arm",), _fork("base_arm", PLAIN[:2])))
    free = free.replace('type="revolute"', 'type="continuous"')
    leader = "a_0_joint"
    parts = free.split('<limit lower="0"')
    names = [part.rpartition('<joint name="')[2].partition('"')[0] for part in parts]
    rule = f'<mimic joint="{leader}"/><limit lower="0"'
    coupled = "".join(
        part
        + (
            ""
            if i == len(parts) - 1
            else rule
            if name != leader
            else '<limit lower="0"'
        )
        for i, (part, name) in enumerate(zip(parts, names, strict=True))
    )
    file = tmp_path / "jaws.urdf"
    file.write_text(free)
    with pytest.raises(HandError, match="no hand found"):
        detect(file)
    file.write_text(coupled)
    assert Robot(file).endless == set()
    assert find_palms(Robot(file)) == ["base_arm"]
