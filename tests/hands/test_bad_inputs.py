"""Invalid inputs: every public call names the argument and changes nothing."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from marks import slow

from handmap_qp import (
    Hand,
    HandError,
    HandmapError,
    HandSpec,
    HumanLengths,
    InvalidInputError,
    PointSpec,
    load_hand,
)
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.hands.spec import MimicSpec, PalmSpec, check_point, read_hand_spec
from handmap_qp.hands.synergies import load_synergies

HAND = load_hand("three_finger")
CHAINED = load_hand("hey5")
COUNT = len(HAND.joint_names)
SYNERGIES = load_synergies()
LENGTHS = HumanLengths.from_hand_length(0.19)


def spoilt(value: float, count: int = COUNT) -> list[Any]:
    return [0.0] * (count - 1) + [value]


def not_numbers(count: int) -> dict[str, Any]:
    """Return values that are not `count` finite numbers."""
    return {
        "text": "x",
        "letters": ["a"] * count,
        "digits": ["1"] * count,
        "bytes": b"12345678",
        "None": None,
        "Nones": [None] * count,
        "objects": np.array([object()] * count),
        "digits in an array of objects": np.array(["1"] * count, dtype=object),
        "ragged": [[1.0, 2.0], [3.0]],
        "complex": [1j] * count,
        "NaN": spoilt(np.nan, count),
        "infinite": spoilt(-np.inf, count),
        "too large for a float": spoilt(10**400, count),
        "too few": [0.0] * (count - 1),
        "too many": [0.0] * (count + 1),
        "scalar": 0.0,
        "three dimensions": np.zeros((1, 1, count)),
        "dictionary": {"q": 1.0},
        "function": len,
        "dates": np.array(["2020-01-01"] * count, dtype="datetime64[D]"),
    }


NOT_Q = not_numbers(COUNT)
NOT_POSES = {
    "text": "x",
    "letters": [["a"] * 4] * 4,
    "three rows": np.eye(3),
    "zeros": np.zeros((4, 4)),
    "mirror": np.diag([1.0, 1.0, -1.0, 1.0]),
    "NaN": np.full((4, 4), np.nan),
    "complex": 1j * np.eye(4),
    "seven numbers": [0, 0, 0, 0, 0, 0, 1],
    "number": 5,
    "objects": np.array([[None] * 4] * 4),
}
CALLS_WITH_Q: dict[str, Callable[[Any], Any]] = {
    "points": HAND.points,
    "point_jacobian": HAND.point_jacobian,
    "configuration_vector": HAND.configuration_vector,
    "all_joints": HAND.all_joints,
    "frame_pose": lambda q: HAND.frame_pose("palm", q),
    "link_poses": lambda q: HAND.link_poses(["palm"], q),
}
CALLS_WITH_POSE: dict[str, Callable[[Any], Any]] = {
    "points": lambda pose: HAND.points(HAND.rest, pose),
    "point_jacobian": lambda pose: HAND.point_jacobian(HAND.rest, pose),
    "configuration_vector": lambda pose: HAND.configuration_vector(HAND.rest, pose),
    "frame_pose": lambda pose: HAND.frame_pose("palm", HAND.rest, pose),
    "link_poses": lambda pose: HAND.link_poses(["palm"], HAND.rest, pose),
}


@pytest.mark.parametrize("call", CALLS_WITH_Q)
def test_invalid_joint_angles_are_named(call: str) -> None:
    before = HAND.points(HAND.rest)
    for name, q in NOT_Q.items():
        with pytest.raises(InvalidInputError) as caught:
            CALLS_WITH_Q[call](q)
        assert caught.value.argument == "q", name
        assert str(caught.value).startswith("q: expected "), name
        assert "\n" not in str(caught.value)
    np.testing.assert_array_equal(HAND.points(HAND.rest), before)


@pytest.mark.parametrize("call", CALLS_WITH_POSE)
def test_an_invalid_wrist_pose_is_named(call: str) -> None:
    for name, pose in NOT_POSES.items():
        with pytest.raises(InvalidInputError) as caught:
            CALLS_WITH_POSE[call](pose)
        assert caught.value.argument == "wrist_pose", name
        assert "\n" not in str(caught.value)


def test_numbers_of_every_real_kind_are_taken() -> None:
    expected = HAND.points(np.zeros(COUNT))
    kinds: tuple[Any, ...] = (
        [0] * COUNT,
        (False,) * COUNT,
        np.zeros(COUNT, np.float32),
        [Fraction(0)] * COUNT,
    )
    for q in kinds:
        np.testing.assert_array_equal(HAND.points(q), expected)


FRAMES = {
    "no frame": (lambda: HAND.frame_pose("moon", HAND.rest), "frame"),
    "number as a frame": (lambda: HAND.frame_pose(5, HAND.rest), "frame"),  # ty: ignore[invalid-argument-type]
    "no name": (lambda: HAND.frame_pose(None, HAND.rest), "frame"),  # ty: ignore[invalid-argument-type]
    "no link": (lambda: HAND.link_poses(["palm", "moon"], HAND.rest), "links[1]"),
    "number as a link": (lambda: HAND.link_poses([5], HAND.rest), "links[0]"),  # ty: ignore[invalid-argument-type]
    "text as links": (lambda: HAND.link_poses("palm", HAND.rest), "links"),
    "no links": (lambda: HAND.link_poses(None, HAND.rest), "links"),  # ty: ignore[invalid-argument-type]
}
LOADING: dict[str, tuple[Callable[[], Any], str]] = {
    "hand": (lambda: load_hand(5), "hand"),  # ty: ignore[invalid-argument-type]
    "no hand": (lambda: load_hand(None), "hand"),  # ty: ignore[invalid-argument-type]
    "points": (lambda: load_hand("human", points=5), "points"),  # ty: ignore[invalid-argument-type]
    "a point": (lambda: load_hand("human", points=(5,)), "points[0]"),  # ty: ignore[invalid-argument-type]
    "place of a point": (
        lambda: load_hand(
            "human", points=(PointSpec("p", "palm", xyz=(0.0, np.nan, 0.0)),)
        ),
        "points[0].xyz[1]",
    ),
    "place of text": (
        lambda: load_hand("human", points=(PointSpec("p", "palm", xyz="abc"),)),  # ty: ignore[invalid-argument-type]
        "points[0].xyz",
    ),
    "weight of a point": (
        lambda: load_hand(
            "human", points=("index_tip", PointSpec("p", "palm", weight=0.0))
        ),
        "points[1].weight",
    ),
    "mount": (lambda: load_hand("human", mount="flying"), "mount"),  # ty: ignore[invalid-argument-type]
    "length": (lambda: load_hand("human", hand_length="x"), "hand_length"),  # ty: ignore[invalid-argument-type]
    "digits": (lambda: load_hand("human", hand_length="0.19"), "hand_length"),  # ty: ignore[invalid-argument-type]
    "no length": (lambda: load_hand("human", hand_length=0.0), "hand_length"),
    "breadth": (lambda: HumanLengths.from_hand_length(0.19, [0.1]), "hand_breadth"),  # ty: ignore[invalid-argument-type]
    "lengths": (lambda: load_hand("human", lengths=0.19), "lengths"),  # ty: ignore[invalid-argument-type]
    "both": (lambda: load_hand("human", lengths=LENGTHS, hand_length=0.19), "lengths"),
    "of a robot": (lambda: load_hand("three_finger", hand_length=0.19), "lengths"),
    "spec": (lambda: Hand("human"), "spec"),  # ty: ignore[invalid-argument-type]
    "URDF": (lambda: Hand(HAND.spec, urdf_text=5), "urdf_text"),  # ty: ignore[invalid-argument-type]
}


@pytest.mark.parametrize("case", [*FRAMES, *LOADING])
def test_other_arguments_are_named(case: str) -> None:
    call, argument = {**FRAMES, **LOADING}[case]
    with pytest.raises(InvalidInputError) as caught:
        call()
    assert caught.value.argument == argument
    assert "\n" not in str(caught.value)


SYNERGY_CALLS: dict[str, tuple[Callable[[Any], Any], dict[str, Any], str]] = {
    "posture": (SYNERGIES.posture, not_numbers(16), "z"),
    "coordinates": (SYNERGIES.coordinates, not_numbers(20), "q"),
    "bases": (
        lambda bases: HumanLengths(bases, LENGTHS.segments),
        not_numbers(15),
        "bases",
    ),
    "segments": (
        lambda bones: HumanLengths(LENGTHS.bases, bones),
        not_numbers(15),
        "segments",
    ),
}


@pytest.mark.parametrize("call", SYNERGY_CALLS)
def test_an_invalid_human_measure_is_named(call: str) -> None:
    use, bad, argument = SYNERGY_CALLS[call]
    # Fifteen numbers are a valid posture.
    for name in bad.keys() - ({"too few"} if call == "posture" else set()):
        with pytest.raises(InvalidInputError) as caught:
            use(bad[name])
        assert caught.value.argument == argument, name


SPECS = {
    "numbers as names": ({"joints": (1, 2)}, "joints[0]"),
    "text as a number": (
        {"rest": {**HAND.spec.rest, HAND.joint_names[0]: "0.1"}},
        "rest",
    ),
    "no palm": ({"palm": None}, "palm"),
    "palm of text": ({"palm": PalmSpec("palm", "abc", (0.0, 0.0, 1.0))}, "palm.distal"),  # ty: ignore[invalid-argument-type]
    "complex weight": ({"points": (PointSpec("p", "palm", weight=1j),)}, None),  # ty: ignore[invalid-argument-type]
    "points by name": ({"points": ("thumb",)}, "points[0]"),
    "a set of a number": ({"sets": {"fingertips": 5}}, "sets"),
    "side": ({"side": "both"}, "side"),
    "a set of numbers": ({"locked": {1, 2}}, "locked"),
    "rule": ({"mimic": {"a": MimicSpec("b", multiplier=None)}}, "mimic"),  # ty: ignore[invalid-argument-type]
    "infinite arm": ({"rest": dict.fromkeys(HAND.joint_names, np.inf)}, "rest"),
}


@pytest.mark.parametrize("case", SPECS)
def test_a_spec_built_in_code_is_checked_throughout(case: str) -> None:
    changes, key = SPECS[case]
    with pytest.raises(HandError) as caught:
        msgspec.structs.replace(HAND.spec, **changes)
    assert (caught.value.key or "").startswith(key or "")


def test_a_spec_accepts_numpy_values_and_copies_its_arguments() -> None:
    rest = dict(HAND.spec.rest)
    changes = {"rest": rest, "joints": list(HAND.spec.joints)}
    spec: HandSpec = msgspec.structs.replace(
        HAND.spec, **changes, palm=PalmSpec("palm", *np.eye(3)[:2])
    )
    rest.clear()
    assert spec.rest == HAND.spec.rest
    assert spec.joints == HAND.spec.joints
    assert spec.palm.distal == (1.0, 0.0, 0.0)
    assert check_point(PointSpec("p", "palm", weight=np.float64(2.0))).weight == 2.0


@pytest.mark.parametrize(
    "name", ["a\0b", "\0.yaml", "x" * 5000, "", ".", "x" * 5000 + ".yaml"]
)
def test_names_that_are_not_files_are_rejected(name: str) -> None:
    with pytest.raises(HandError):
        load_hand(name)


@pytest.mark.parametrize(
    "text",
    [
        "name: 2001-99-99",
        "extends: [1, 2]",
        "extends: hand.yaml",
        "1: 2",
        "arm: {extends: 5}",
        slow("[" * 2100),
        "name: &a [*a]",
        "urdf: {a: b}",
    ],
)
def test_odd_descriptions_are_rejected_in_one_line(tmp_path: Path, text: str) -> None:
    path = tmp_path / "hand.yaml"
    path.write_text(text)
    with pytest.raises(HandmapError) as caught:
        read_hand_spec(path)
    assert "\n" not in str(caught.value)
    assert str(path.parent) in str(caught.value)


def test_points_of_one_name_are_rejected() -> None:
    with pytest.raises(HandError, match="'index_tip' is given twice"):
        load_hand("human", points=("index_tip", "index_tip"))


def test_points_may_be_called_as_frames_and_links_are() -> None:
    offsets = {"palm": (0.1, 0.0, 0.0), "wrist": (0.0, 0.2, 0.0), "0": (0.0, 0.0, 0.3)}
    points = tuple(PointSpec(name, "palm", xyz=xyz) for name, xyz in offsets.items())
    hand = load_hand("human", points=points)
    np.testing.assert_allclose(
        hand.points(hand.rest), list(offsets.values()), atol=1e-12
    )
    np.testing.assert_allclose(
        hand.frame_pose("wrist", hand.rest), np.eye(4), atol=1e-12
    )


def test_environment_variables_in_the_path_of_a_urdf(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spec = read_hand_spec(urdf_directory() / "three_finger" / "hand.yaml")
    spec = msgspec.structs.replace(spec, urdf="${HANDMAP_TEST}/hand.urdf")
    monkeypatch.delenv("HANDMAP_TEST", raising=False)
    with pytest.raises(HandError, match="set the environment variable HANDMAP_TEST"):
        load_hand(spec)
    monkeypatch.setenv("HANDMAP_TEST", str(urdf_directory() / "three_finger"))
    assert load_hand(spec).name == "three_finger"
