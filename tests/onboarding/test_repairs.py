"""Wrong descriptions are right after a few clicks on the page of `hands edit`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from browser import Browser, light_simply
from edit_page import Clicks, Page, chromium
from made_hands import MadeHand, make_hand
from patience import kept_going
from repair import (
    TURNS,
    Requests,
    Truth,
    error,
    repair,
)

from handmap_qp import load_hand
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.apps.onboarding.finger_permutation import all_tips, with_names
from handmap_qp.apps.onboarding.palm_turns import palm_axes, with_turn
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.hands.spec import HandSpec, read_hand_spec

# Whole hands and a browser: not for the fast suite.
pytestmark = pytest.mark.slow

# A user makes a click in this time [s], and has a minute.
_PER_CLICK = 2.5
_MINUTE = 60.0
_MADE = 10


@pytest.fixture(autouse=True)
def no_gestures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the mapping of gestures: that is another test's."""
    monkeypatch.setattr(
        "handmap_qp.apps.onboarding.gesture_tab.draw_gestures",
        lambda _: ({"fist": np.full((2, 4, 4, 3), 0.5)}, ""),
    )


def made_truth(made: MadeHand) -> Truth:
    names = {link: name for name, link in made.tips.items()}
    return Truth(made.distal, made.dorsal, made.side, names)


def spoilt(spec: HandSpec, generator: np.random.Generator) -> HandSpec:
    """Return a description with wrong axes, wrong names, a finger less, and a wrong side."""
    hand = load_hand(spec)
    for turn in generator.choice(np.array(TURNS), 2).tolist():
        hand = load_hand(with_turn(hand, turn))
    tips = all_tips(hand)
    names: dict[str, str | None] = dict(
        zip(
            [tip.link for tip in tips.values()],
            generator.permutation(np.array([*tips])).tolist(),
            strict=True,
        )
    )
    if len(names) > 3:
        lost = next(link for link, name in names.items() if name != "thumb")
        names[lost] = None
    spec = with_names(hand, names)
    return edit.with_other_side(load_hand(spec)) if generator.random() < 0.5 else spec


def is_right(spec: HandSpec, truth: Truth) -> bool:
    named = {tip.link: name for name, tip in all_tips(load_hand(spec)).items()}
    return (
        error(palm_axes(spec), truth) < 20.0
        and spec.side == truth.side
        and named == {link: name for link, name in truth.names.items() if name}
    )


def made_hand(seed: int, folder: Path) -> tuple[MadeHand, HandSpec]:
    """Return a hand of at most five fingers, and its description."""
    generator = np.random.default_rng(seed)
    made = make_hand(generator)
    while len(made.tips) > 5:
        made = make_hand(generator)
    file = folder / f"made_{seed}.urdf"
    file.write_text(made.urdf)
    return made, detect(file).spec


@pytest.mark.parametrize("seed", range(_MADE))
def test_a_spoilt_description_is_right_within_a_minute_of_clicks(
    seed: int, tmp_path: Path
) -> None:
    made, spec = made_hand(seed, tmp_path)
    wrong = spoilt(spec, np.random.default_rng(seed))
    truth = made_truth(made)
    assert not is_right(wrong, truth)
    with serving() as server:
        found = Detection(wrong, (), (), {})
        editor = HandEditor(server, found, tmp_path / "mine.yaml")
        requests = Requests(editor)
        repair(requests, lambda: editor.found.spec, lambda: truth)
        assert not editor.message.visible
    assert is_right(editor.found.spec, truth)
    assert requests.clicks * _PER_CLICK < _MINUTE


def test_a_spoilt_description_is_repaired_in_a_browser(tmp_path: Path) -> None:
    program = chromium()
    made, spec = made_hand(2, tmp_path)
    wrong = spoilt(spec, np.random.default_rng(2))
    truth = made_truth(made)
    out = tmp_path / "mine.yaml"
    with serving() as server, Browser(program) as browser:
        light_simply(server)
        editor = HandEditor(server, Detection(wrong, (), (), {}), out)
        with kept_going(editor.tick, 0.05):
            browser.open(f"http://127.0.0.1:{server.get_port()}")
            page = Page(browser)
            clicks = Clicks(page, editor)
            repair(clicks, lambda: editor.found.spec, lambda: truth)
            clicks.save()
            clicks_needed = page.clicks
            assert not browser.errors
    assert is_right(read_hand_spec(out), truth)
    assert clicks_needed * _PER_CLICK < _MINUTE
