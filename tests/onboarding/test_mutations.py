"""Whatever a description of a robot is like, `handmap hands init` ends in one line or in a hand."""

from __future__ import annotations

import warnings
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_hands import ODDITIES, make_hand, make_odd_hand, two_hands_mjcf
from made_loops import LOOPS
from mutations import MUTATIONS, mutated

from handmap_qp import HandmapError, load_hand
from handmap_qp.apps.onboarding.init import init_hands
from handmap_qp.hands.sources import urdf_directory

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[1]
COUNT = 500
# Others, which no change of the package has been tried on before.
MORE = range(17103, 17123)
# A third of a second each.
IN_EVERY_RUN = 50


def _texts() -> Iterator[tuple[str, str]]:
    """Yield descriptions without meshes, by their names."""
    for seed in range(6):
        yield f"made {seed}", make_hand(np.random.default_rng(seed)).urdf
    for kind in ODDITIES:
        yield kind, make_odd_hand(np.random.default_rng(7), kind).urdf
    for name in ("chained_mimics", "prismatic_fingers", "absent_limits", "one_finger"):
        file = ROOT / "data" / "urdf" / f"{name}.urdf"
        yield name, file.read_text(encoding="utf-8")
    file = urdf_directory() / "three_finger" / "hand.urdf"
    yield "three_finger", file.read_text(encoding="utf-8")
    yield "two hands", two_hands_mjcf()
    for name, make in LOOPS.items():
        yield name, make()


TEXTS = dict(_texts())


def _mutation(seed: int) -> tuple[str, str, str]:
    """Return the name of a description, what was done to it, and the outcome."""
    name = [*TEXTS][seed % len(TEXTS)]
    return name, *mutated(TEXTS[name], np.random.default_rng(seed))


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Let MuJoCo write its log of warnings to another folder."""
    monkeypatch.chdir(tmp_path)


def _run(seed: int, folder: Path) -> bool:
    """Describe the hand of a changed description; return whether there was one."""
    name, done, text = _mutation(seed)
    kind = "xml" if "<mujoco" in text[:60] else "urdf"
    file = folder / f"robot{seed}.{kind}"
    file.write_text(text, encoding="utf-8")
    case = f"{seed}: {done} in {name}"
    try:
        with warnings.catch_warnings():
            # Of limits that contradict a rule: a note of the hand.
            warnings.simplefilter("ignore", UserWarning)
            result = init_hands(file, out=folder / f"{seed}" / "hand.yaml")
            for hand in result.hands:
                load_hand(hand.file)
    except HandmapError as error:
        message = str(error)
        assert "\n" not in message, f"{case}: {message}"
        assert str(folder) in message, f"{case}: {message} names no file"
        return False
    except Exception as error:
        error.add_note(case)
        raise
    return True


def test_there_are_as_many_descriptions_as_are_said() -> None:
    assert len(TEXTS) >= 30


def test_every_mutation_changes_a_description() -> None:
    """One that finds nothing to change would test nothing."""
    seen = {done for seed in range(COUNT) for done in _mutation(seed)[1].split(", ")}
    assert seen >= MUTATIONS.keys()
    changed = [TEXTS[name] != text for name, _, text in map(_mutation, range(60))]
    assert np.mean(changed) > 0.9


@pytest.mark.parametrize("first", range(0, IN_EVERY_RUN, 10))
def test_no_damaged_description_ends_in_a_traceback(first: int, tmp_path: Path) -> None:
    outcomes = [_run(seed, tmp_path) for seed in range(first, first + 10)]
    # Both outcomes are tried.
    assert 0 < sum(outcomes) < len(outcomes)


@pytest.mark.full
def test_none_of_twenty_more_does(tmp_path: Path) -> None:
    outcomes = [_run(seed, tmp_path) for seed in MORE]
    assert 0 < sum(outcomes) < len(outcomes)


@pytest.mark.full
@pytest.mark.parametrize("first", range(IN_EVERY_RUN, COUNT, 50))
def test_none_of_many_does(first: int, tmp_path: Path) -> None:
    for seed in range(first, min(first + 50, COUNT)):
        _run(seed, tmp_path)
