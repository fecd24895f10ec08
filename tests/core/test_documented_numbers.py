"""Numbers that pages state in words are those of the code."""

from __future__ import annotations

import re
from pathlib import Path
from typing import NamedTuple

import pytest

from handmap_core.mapping import two_palms
from handmap_core.stream import rejoin, robot_follower

DOCS = Path(__file__).resolve().parents[2] / "docs"


class Stated(NamedTuple):
    """A sentence of a page, with a place for each number, and the numbers in the code."""

    page: str
    sentence: str
    numbers: tuple[float, ...]


SENTENCES = {
    "return": Stated(
        "faults",
        "It adds at most {} m/s and {} rad/s to the palm and {} m/s to the fingers.",
        (rejoin.PALM_SPEED, rejoin.TURN_SPEED, rejoin.FINGER_SPEED),
    ),
    "palms that meet": Stated(
        "own_hand",
        "it begins below {} m and is complete below {} m.",
        (two_palms.NEAR, two_palms.TOGETHER),
    ),
    "silence of a hand": Stated(
        "service",
        "has been without one for {} s of the commands' time, holds its side",
        (robot_follower._SILENCE,),
    ),
}


@pytest.mark.parametrize("name", SENTENCES)
def test_a_page_states_the_numbers_of_the_code(name: str) -> None:
    page, sentence, numbers = SENTENCES[name]
    text = " ".join((DOCS / f"{page}.md").read_text(encoding="utf-8").split())
    pattern = re.escape(sentence).replace(re.escape("{}"), r"(\d*\.?\d+)")
    found = re.search(pattern, text)
    assert found, f"{page}.md does not say: {sentence}"
    assert tuple(map(float, found.groups())) == pytest.approx(numbers)
