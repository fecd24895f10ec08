"""A hand that sessions share cannot be changed through the arrays that it returns."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest

from handmap_qp import Hand, HumanLengths, hand_names, load_hand, load_synergies
from handmap_qp.apps.onboarding.detect import detect

CHAINED = Path(__file__).parents[1] / "data" / "urdf" / "chained_mimics.urdf"


def arrays_in(value: Any) -> Iterator[np.ndarray]:
    """Return every array in a value, also inside tuples, lists, dictionaries and structs."""
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, tuple | list):
        for part in value:
            yield from arrays_in(part)
    elif isinstance(value, dict):
        yield from arrays_in(list(value.values()))
    elif isinstance(value, msgspec.Struct):
        yield from arrays_in(msgspec.structs.astuple(value))


def attributes_of(hand: Hand) -> dict[str, Any]:
    """Return public attributes and properties of a hand, without its methods."""
    names = [name for name in dir(hand) if not name.startswith("_")]
    values = {name: getattr(hand, name) for name in names}
    return {name: value for name, value in values.items() if not callable(value)}


def results_of(hand: Hand) -> dict[str, Any]:
    """Return the results of all methods of a hand at its rest posture."""
    q = hand.rest
    return {
        "configuration_vector": hand.configuration_vector(q),
        "all_joints": hand.all_joints(q),
        "points": hand.points(q),
        "point_jacobian": hand.point_jacobian(q),
        "palm": hand.frame_pose("palm", q),
        "wrist": hand.frame_pose("wrist", q),
        "point": hand.frame_pose(hand.reference_points[0].name, q),
        "joint": hand.frame_pose(hand.joint_names[0], q),
        "link": hand.frame_pose(hand.reference_points[0].link, q),
        "link_poses": hand.link_poses([hand.spec.palm.link, hand.spec.wrist.link], q),
    }


def snapshot(hand: Hand) -> list[np.ndarray]:
    return [
        array.copy()
        for array in arrays_in([*attributes_of(hand).values(), results_of(hand)])
    ]


def overwrite(array: np.ndarray) -> None:
    """Write into an array, unless it is read-only."""
    with suppress(ValueError):
        array[...] = 77


@pytest.mark.parametrize("name", [*hand_names(), "chained"])
def test_writing_into_any_array_of_a_hand_changes_nothing(name: str) -> None:
    hand = load_hand(detect(CHAINED).spec if name == "chained" else name)
    before = snapshot(hand)
    assert len(before) >= 19
    for array in arrays_in([*attributes_of(hand).values(), results_of(hand)]):
        overwrite(array)
    for array, expected in zip(snapshot(hand), before, strict=True):
        np.testing.assert_array_equal(array, expected)
    # A hand made from it afterwards is not affected either.
    for array, expected in zip(snapshot(hand.with_points(None)), before, strict=True):
        np.testing.assert_array_equal(array, expected)


def test_writing_into_a_workspaces_views_is_rejected() -> None:
    workspace = load_hand("three_finger").configuration()
    for array in (workspace.q, workspace.points):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 77


def test_writing_into_human_measures_is_rejected() -> None:
    lengths = HumanLengths.from_hand_length(0.19)
    for array in arrays_in((lengths, load_synergies())):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 77


def test_a_hand_keeps_no_array_of_its_caller() -> None:
    hand = load_hand("three_finger")
    q, pose = hand.rest.copy(), np.eye(4)
    vector = hand.configuration_vector(q, pose)
    q[:], pose[:] = 77, 77
    np.testing.assert_array_equal(vector, hand.configuration_vector(hand.rest))
