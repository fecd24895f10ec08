"""Two readings of a file, side by side: the page asks where they have nearly as much evidence."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from box_hands import BoxHand
from browser import Browser, light_simply
from edit_page import Page, chromium
from made_hands import two_hands_mjcf
from patience import kept_going, wait_until

from handmap_qp import Hand, HandSpec, load_hand
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.choices import (
    PALMS,
    Question,
    count_questions,
    first_question,
    question,
)
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.apps.onboarding.finger_permutation import all_tips
from handmap_qp.apps.onboarding.hand_choice import first_hand
from handmap_qp.apps.onboarding.write import RobotSource, open_source, write_hand
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.hands.spec import read_hand_spec

# Whole hands and a browser: not for the fast suite.
pytestmark = pytest.mark.slow

# Alike fingers in a row: the thumb is at either end. Or it is clearly one of them.
ROW = BoxHand(turn=np.eye(3), names=tuple("abcde"), thumb=(0.09, 0.05, 0.0))
CLEAR = replace(ROW, names=("thumb", "index", "middle", "ring", "little"))


@pytest.fixture(autouse=True)
def no_gestures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out the mapping of gestures: pictures differ by the hand's side and thumb."""

    def draw(hand: Hand) -> tuple[dict[str, np.ndarray], str]:
        shade = 0.2 if _thumb(hand.spec).startswith("a") else 0.8
        return dict.fromkeys(("open", "fist"), np.full((2, 4, 4, 3), shade)), ""

    monkeypatch.setattr("handmap_qp.apps.onboarding.gesture_tab.draw_gestures", draw)


def _thumb(spec: HandSpec) -> str:
    return all_tips(load_hand(spec))["thumb"].link


def _described(folder: Path, hand: BoxHand) -> Detection:
    file = folder / "row.urdf"
    file.write_text(hand.urdf())
    return edit.described(first_hand(file), RobotSource(file, str(file)))


@pytest.fixture
def two_hands(tmp_path: Path) -> Detection:
    """Return the first hand of a robot with two palms."""
    pytest.importorskip("mujoco", reason="mujoco is not installed")
    file = tmp_path / "two.xml"
    file.write_text(two_hands_mjcf(1.0))
    source = open_source(file, tmp_path)
    return edit.described(first_hand(source.urdf), source)


@contextmanager
def _page(found: Detection, folder: Path) -> Iterator[HandEditor]:
    with serving() as server:
        yield HandEditor(server, found, folder / "mine.yaml")


def _asked(editor: HandEditor, drawn: int) -> Question | None:
    wait_until(lambda: editor.tick() or editor.gestures.drawn == drawn)
    return editor.gestures.question


def test_another_thumb_is_shown_beside_the_one_that_was_found(tmp_path: Path) -> None:
    found = _described(tmp_path, ROW)
    asked = question(found, 0)
    left, right = (choice.spec for choice in asked.choices)
    assert left == found.spec
    assert _thumb(left) != _thumb(right)
    assert left.side != right.side
    for spec in (left, right):
        assert _thumb(spec) in asked.caption
        assert spec.side in asked.caption
    # The user knows the answers then.
    for choice in asked.choices:
        assert {"thumb", "side", "dorsal"}.isdisjoint(
            clue.what for clue in choice.clues
        )
        assert first_question(choice) is None
    assert count_questions(found) == 1 + PALMS
    # After the other reading come palms that are turned.
    assert not question(found, 1).is_reading
    assert question(found, 1).choices[0].spec == found.spec


def test_a_clear_hand_has_no_other_reading(tmp_path: Path) -> None:
    found = _described(tmp_path, CLEAR)
    assert found.runner_up is None
    assert count_questions(found) == PALMS


@pytest.mark.parametrize("which", ["left", "right"])
def test_a_click_takes_a_reading_and_ends_the_question(
    which: str, tmp_path: Path
) -> None:
    with _page(_described(tmp_path, ROW), tmp_path) as editor:
        asked = _asked(editor, 1)
        assert asked is not None
        editor._press(which, None)
        assert _asked(editor, 2) is None
        assert editor.found == asked.choices[which == "right"]
        write_hand(editor.found, editor.out)
    assert _thumb(read_hand_spec(editor.out)) == _thumb(editor.found.spec)
    assert "# as given" in editor.out.read_text()


def test_neither_leads_on_to_turned_palms(tmp_path: Path) -> None:
    with _page(_described(tmp_path, ROW), tmp_path) as editor:
        asked = [_asked(editor, 1)]
        for number in range(count_questions(editor.found)):
            editor._press("neither", None)
            asked.append(_asked(editor, 2 + number))
        readings = [one.is_reading for one in asked if one]
        assert readings == [True, *PALMS * [False], True]


def test_a_corrected_side_is_not_asked_for_again(tmp_path: Path) -> None:
    found = _described(tmp_path, ROW)
    other = edit.corrected(found, edit.with_other_side(load_hand(found.spec)))
    assert other.runner_up is None


def test_the_other_palm_of_a_robot_is_one_click_away(
    two_hands: Detection, tmp_path: Path
) -> None:
    (other,) = two_hands.other_roots
    with _page(two_hands, tmp_path) as editor:
        asked = _asked(editor, 1)
        assert asked is not None
        assert other in asked.caption
        editor._press("right", None)
        editor.tick()
        assert editor.hand.spec.palm.link == other
        assert not editor.found.other_roots
        assert editor.root.value == other
        # The lists and sliders of the page are those of the other hand.
        assert {*editor.names} == {tip.link for tip in all_tips(editor.hand).values()}
        assert len(editor.joints) == len(editor.hand.joint_names)
        assert not editor.message.visible


def test_fingers_that_were_taken_for_jaws_are_three_clicks_away(tmp_path: Path) -> None:
    """Another kind of fingers is straight elsewhere: palm and rest are found again."""
    one_joint = replace(ROW, joints=1, span=(-0.5, 1.2))
    truth = _described(tmp_path, one_joint)
    assert truth.kind == "fingers"
    wrong = edit.described(
        detect(tmp_path / "row.urdf", kind="jaws"),
        RobotSource(tmp_path / "row.urdf", str(tmp_path / "row.urdf")),
    )
    assert wrong.spec.palm != truth.spec.palm
    assert wrong.spec.rest != truth.spec.rest
    with _page(wrong, tmp_path) as editor:
        editor.tick()
        assert editor._kinds.visible
        assert editor.kind.value == "jaws"
        # The user has said which finger is the thumb: that is held.
        editor._press("names", None)
        editor.tick()
        editor.kind.value = "fingers"
        editor._press("kind", None)
        editor.tick()
        wait_until(lambda: editor.tick() or not editor._search.is_busy)
        assert not editor.message.visible
        assert editor.found.spec.palm.distal == truth.spec.palm.distal
        shown = [slider.value for slider in editor.joints]
        np.testing.assert_allclose(shown, editor.hand.rest, atol=1e-9)
        assert editor.kind.value == "fingers"
        assert _thumb(editor.found.spec) == _thumb(wrong.spec)


def test_fingers_that_curl_have_no_list_of_kinds(tmp_path: Path) -> None:
    with _page(_described(tmp_path, CLEAR), tmp_path) as editor:
        editor.tick()
        assert not editor._kinds.visible


def test_buttons_stay_while_a_page_is_rebuilt(
    two_hands: Detection, tmp_path: Path
) -> None:
    """A click that is under way when its button is removed would be dropped by viser."""
    with _page(two_hands, tmp_path) as editor:
        _asked(editor, 1)
        lists = {*editor.names}
        handles = editor._gui._gui_input_handle_from_uuid
        buttons = {
            uuid: handle for uuid, handle in handles.items() if handle._impl.is_button
        }
        assert len(buttons) > 10
        editor._press("right", None)
        _asked(editor, 2)
        assert {*editor.names}.isdisjoint(lists)
        assert {uuid for uuid in buttons if handles.get(uuid) is buttons[uuid]} == {
            *buttons
        }


def test_a_click_on_a_page_that_is_rebuilt_is_carried_out(
    two_hands: Detection, tmp_path: Path
) -> None:
    """The button is found before the page is another hand's, and clicked afterwards."""
    program = chromium()
    first = two_hands.spec.palm.link
    save = "[...document.querySelectorAll('button')].find(e => e.innerText == 'Save')"
    with _page(two_hands, tmp_path) as editor, Browser(program) as browser:
        light_simply(editor._server)
        with kept_going(editor.tick, 0.05):
            browser.open(f"http://127.0.0.1:{editor._server.get_port()}")
            page = Page(browser)
            browser.wait_for(f"!!(window.save = {save})")
            page.press("The right one")
            wait_until(lambda: editor.hand.spec.palm.link != first, "no other hand")
            browser.wait_for(
                f"document.body.innerText.includes('{editor.hand.joint_names[0]}')"
            )
            browser.evaluate("window.save.click()")
            wait_until(editor.out.is_file, "the click is lost")
            assert not browser.errors
    assert read_hand_spec(editor.out).palm.link != first
