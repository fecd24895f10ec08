"""Today's engine commands what that of the golden files did."""

from __future__ import annotations

import golden
import numpy as np
import pytest
from marks import crossed, rotated

from handmap_qp.mapping.presets import PRESETS

GOLDEN = {file: golden.read(file) for file in golden.MAKERS}
HANDS = list(dict.fromkeys(name.split("/")[0] for name in GOLDEN["hands"]))
OTHERS = {
    file: [(file, name) for name in GOLDEN[file]]
    for file in ("robots", "streams", "problems")
}


def expect_as_before(file: str, name: str) -> None:
    case = golden.MAKERS[file](name, 0.0)
    before = GOLDEN[file][name]
    assert case.numbers.shape == before.numbers.shape
    np.testing.assert_array_equal(case.codes, before.codes, err_msg=name)
    np.testing.assert_allclose(
        case.numbers, before.numbers, rtol=0.0, atol=before.tolerance, err_msg=name
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    # The suite moves each hand by one preset, and by each preset two hands or more.
    ("hand", "preset"),
    crossed(HANDS, [*PRESETS], every=len(PRESETS)),
)
def test_a_hand_moves_as_before(hand: str, preset: str) -> None:
    if f"{hand}/{preset}" not in golden.case_names("hands"):
        pytest.skip(f"{hand} is not installed")
    expect_as_before("hands", f"{hand}/{preset}")


@pytest.mark.slow
@pytest.mark.parametrize(
    "case",
    # The suite meets every fault of a stream: they are ten, of which it takes one of three.
    [case for cases in OTHERS.values() for case in rotated(cases, 3)],
    ids="/".join,
)
def test_robots_streams_and_problems_are_as_before(case: tuple[str, str]) -> None:
    file, name = case
    if name not in golden.case_names(file):
        pytest.skip(f"{name} is not installed")
    expect_as_before(file, name)


def test_the_files_hold_what_they_promise() -> None:
    assert len(HANDS) >= 25
    assert {name.split("/")[1] for name in GOLDEN["hands"]} == set(PRESETS)
    assert len(GOLDEN["robots"]) == 6
    assert len(GOLDEN["streams"]) == 40
    assert sum(len(case.numbers) for case in GOLDEN["problems"].values()) == 1000
    sizes = [file.stat().st_size for file in golden.FOLDER.iterdir()]
    assert sum(sizes) <= 4e6


def test_nearly_all_cases_are_held_to_the_tolerance() -> None:
    cases = [case for file in GOLDEN.values() for case in file.values()]
    exact = [case for case in cases if case.tolerance == golden.TOLERANCE]
    assert len(exact) >= 0.95 * len(cases)


def test_packed_numbers_come_back(tmp_path: object) -> None:
    numbers = np.random.default_rng(0).normal(size=(7, 3))
    back = golden._unpacked(golden._packed(numbers))
    np.testing.assert_allclose(back, numbers, rtol=0.0, atol=0.5001e-10)
