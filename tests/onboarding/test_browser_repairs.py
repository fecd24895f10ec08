"""Each kind of mistake in a description is repaired by a few clicks in a browser.

The number of clicks is tested. With `-s` the time is printed that a browser takes for them, which
depends on the machine.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from browser import Browser, light_simply
from edit_page import Clicks, Page, chromium
from made_hands import MadeHand, make_hand, two_hands_mjcf
from patience import kept_going, wait_until
from repair import Truth, error, repair

from handmap_qp import HandSpec, load_hand
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.apps.onboarding.finger_permutation import (
    all_tips,
    exchanged,
    with_names,
)
from handmap_qp.apps.onboarding.hand_choice import first_hand
from handmap_qp.apps.onboarding.palm_turns import palm_axes, with_turn
from handmap_qp.apps.onboarding.write import open_source
from handmap_qp.apps.viewer.serving import ViserServer, serving
from handmap_qp.hands.spec import read_hand_spec

# Whole hands and a browser: not for the fast suite.
pytestmark = pytest.mark.slow

# A hand whose description is right, with four fingers.
_SEED = 2


@pytest.fixture(autouse=True)
def no_gestures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the mapping of gestures: that is another test's."""
    monkeypatch.setattr(
        "handmap_qp.apps.onboarding.gesture_tab.draw_gestures",
        lambda _: ({"fist": np.full((2, 4, 4, 3), 0.5)}, ""),
    )


class Made(NamedTuple):
    """A made hand, with its right description."""

    hand: MadeHand
    spec: HandSpec

    @property
    def truth(self) -> Truth:
        names = {link: name for name, link in self.hand.tips.items()}
        return Truth(self.hand.distal, self.hand.dorsal, self.hand.side, names)

    def is_right(self, spec: HandSpec) -> bool:
        named = {tip.link: name for name, tip in all_tips(load_hand(spec)).items()}
        return (
            error(palm_axes(spec), self.truth) < 20.0
            and spec.side == self.hand.side
            and named == self.truth.names
        )


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    hand = make_hand(np.random.default_rng(_SEED))
    file = tmp_path_factory.mktemp("made") / "made.urdf"
    file.write_text(hand.urdf)
    return Made(hand, detect(file).spec)


@pytest.fixture(scope="module")
def served() -> Iterator[tuple[ViserServer, Browser]]:
    """Serve one page to a browser."""
    with serving() as server, Browser(chromium()) as browser:
        light_simply(server)
        browser.open(f"http://127.0.0.1:{server.get_port()}")
        yield server, browser


@pytest.fixture
def open_page(served: tuple[ViserServer, Browser]) -> tuple[ViserServer, Browser]:
    """Return the page without controls: each test makes those of a hand of its own in it.

    A click on a control of the test before would do nothing.
    """
    server, browser = served
    server.gui.reset()
    buttons = "[...document.querySelectorAll('button')]"
    browser.wait_for(f"!{buttons}.some(e => e.innerText.trim() == 'Save')")
    return server, browser


def _wrong(spec: HandSpec, mistake: str) -> HandSpec:
    hand = load_hand(spec)
    match mistake:
        case "fingers exchanged":
            return with_names(hand, exchanged(hand, "index", "middle"))
        case "palm turned by 90 degrees":
            return with_turn(hand, "y")
        case "palm turned over":
            return edit.with_palm_turned(hand)
        case "wrong side":
            return edit.with_other_side(hand)
        case "wrong thumb":
            return with_names(hand, exchanged(hand, "thumb", "index"))
    raise AssertionError(mistake)


@pytest.mark.parametrize(
    ("mistake", "most"),
    [
        # Two lists, each opened and chosen from, and the button; the last click saves.
        ("fingers exchanged", 6),
        ("palm turned by 90 degrees", 4),
        ("palm turned over", 3),
        ("wrong side", 2),
        ("wrong thumb", 6),
    ],
)
def test_a_mistake_is_repaired_by_a_few_clicks(
    mistake: str,
    most: int,
    made: Made,
    open_page: tuple[ViserServer, Browser],
    tmp_path: Path,
) -> None:
    wrong = _wrong(made.spec, mistake)
    assert made.is_right(made.spec)
    assert not made.is_right(wrong)
    server, browser = open_page
    editor = HandEditor(server, Detection(wrong, (), (), {}), tmp_path / "mine.yaml")
    start = time.perf_counter()
    with kept_going(editor.tick, 0.05):
        clicks = Clicks(Page(browser), editor)
        repair(clicks, lambda: editor.found.spec, lambda: made.truth)
        clicks.save()
    taken = time.perf_counter() - start
    print(f"{mistake}: {clicks.clicks} clicks, {taken:.1f} s in the browser")
    assert made.is_right(read_hand_spec(editor.out))
    assert clicks.clicks <= most
    assert not browser.errors


def test_a_wrong_root_is_repaired_by_choosing_the_other_picture(
    open_page: tuple[ViserServer, Browser], tmp_path: Path
) -> None:
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    file = tmp_path / "two.xml"
    file.write_text(two_hands_mjcf(1.0))
    source = open_source(file, tmp_path)
    found = edit.described(first_hand(source.urdf), source)
    (other,) = found.other_roots
    server, browser = open_page
    editor = HandEditor(server, found, tmp_path / "mine.yaml")
    start = time.perf_counter()
    with kept_going(editor.tick, 0.05):
        clicks = Clicks(Page(browser), editor)
        clicks.page.press("The right one")
        wait_until(lambda: editor.found is not found, "no other hand")
        clicks.save()
    taken = time.perf_counter() - start
    print(f"wrong root: {clicks.clicks} clicks, {taken:.1f} s in the browser")
    assert read_hand_spec(editor.out).palm.link == other
    assert clicks.clicks == 2
