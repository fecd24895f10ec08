"""`handmap hands edit`: corrections of a description, and the page in a headless Chromium."""

from __future__ import annotations

import itertools
import re
import shutil
import types
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from browser import DRAWING, Browser, light_simply
from edit_page import Page, chromium, is_asked
from made_hands import make_hand
from patience import kept_going, wait_until

from handmap_qp import Hand, HandError, InvalidInputError, load_hand
from handmap_qp.apps.offline.fidelity import ByFinger, sample_workspace
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.cli import HandsInit
from handmap_qp.apps.onboarding.detect import Detection, detect
from handmap_qp.apps.onboarding.editor import HandEditor, HandsEdit
from handmap_qp.apps.onboarding.findings import HandReport
from handmap_qp.apps.onboarding.finger_permutation import exchanged, with_names
from handmap_qp.apps.onboarding.gestures import GESTURES, draw_gestures
from handmap_qp.apps.onboarding.measure import check_fist
from handmap_qp.apps.onboarding.palm_turns import with_turn
from handmap_qp.apps.onboarding.write import write_hand
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.spec import HandSpec, read_hand_spec

# Whole hands and a browser: not for the fast suite.
pytestmark = pytest.mark.slow

DATA = Path(__file__).parents[1] / "data" / "urdf"
HANDS = ("three_finger", "allegro_left")


def applied(hand: Hand, *corrections: Callable[[Hand], HandSpec]) -> Hand:
    for correct in corrections:
        hand = load_hand(correct(hand))
    return hand


def renaming(finger: str, name: str) -> Callable[[Hand], HandSpec]:
    return lambda hand: with_names(hand, exchanged(hand, finger, name))


@pytest.mark.parametrize("name", HANDS)
@pytest.mark.parametrize(
    "correct",
    [
        edit.with_palm_turned,
        edit.with_other_side,
        edit.with_other_palm,
        renaming("index", "middle"),
        renaming("thumb", "index"),
        renaming("middle", "little"),
    ],
)
def test_a_correction_is_one_and_two_are_none(
    name: str, correct: Callable[[Hand], HandSpec]
) -> None:
    hand = load_hand(name)
    once = applied(hand, correct)
    twice = applied(once, correct)
    assert once.spec != hand.spec
    assert twice.spec == hand.spec


def test_turning_the_palm_and_the_side_is_what_the_detection_makes_of_that_side(
    tmp_path: Path,
) -> None:
    """Joints are symmetric: the thumb's place allows a right hand and a left one, turned over."""
    generator = np.random.default_rng(3)
    made = make_hand(generator)
    while made.is_one_sided:
        made = make_hand(generator)
    file = tmp_path / "hand.urdf"
    file.write_text(made.urdf)
    right, left = (detect(file, side=side).spec for side in ("right", "left"))
    turned = edit.with_other_palm(load_hand(right))
    assert turned.side == left.side
    np.testing.assert_allclose(turned.palm.dorsal, left.palm.dorsal)
    for joint, at in turned.rest.items():
        assert at == pytest.approx(left.rest[joint], abs=2e-3), joint
    # The fingers close to the palm, whichever that is.
    for spec in (right, turned):
        hand = load_hand(spec, points="fingertips")
        _, *moved = hand.points(hand.rest) - hand.points(hand.zero)
        assert (moved @ np.array(spec.palm.dorsal) < -0.01).all()


def test_a_palm_turned_over_is_found_and_turned_back() -> None:
    hand = load_hand("allegro_left")
    turned = applied(hand, edit.with_palm_turned)
    levels = []
    for each in (hand, turned):
        report = HandReport(each.name)
        report.add(check_fist(each))
        levels.append([finding.level for finding in report.findings])
    assert levels == [["fine"], ["warning"]]
    # Ranges say how its fingers close, so that it rests as before.
    assert turned.spec.rest == hand.spec.rest


def test_fingers_exchange_all_that_names_them() -> None:
    hand = load_hand("allegro_left")
    renamed = applied(hand, renaming("index", "ring"))
    joints = {name: finger.joints for name, finger in find_fingers(hand).items()}
    for name, finger in find_fingers(renamed).items():
        other = {"index": "ring", "ring": "index"}.get(name, name)
        assert finger.joints == joints[other]
    three = renaming("index", "ring")(load_hand("three_finger"))
    partners = {point.name: point.partner for point in three.points}
    assert partners["finger3_tip"] == "ring_tip"
    assert partners["finger2_tip"] == "middle_tip"
    with pytest.raises(InvalidInputError, match="one that is the thumb"):
        renaming("thumb", "little")(hand)


def test_a_tip_is_where_it_was_put_unless_that_is_far_outside() -> None:
    hand = load_hand("allegro_left")
    xyz = np.array([0.00312, -0.002, 0.004])
    moved = applied(hand, lambda each: edit.with_tip(each, "middle", xyz))
    (pose,) = moved.link_poses([moved.spec.points[2].link], moved.rest)
    tip = moved.with_points(["middle_tip"]).points(moved.rest)[0]
    np.testing.assert_allclose(tip, pose[:3, :3] @ xyz + pose[:3, 3], atol=5e-5)
    with pytest.raises(HandError, match="outside the shape") as caught:
        edit.with_tip(hand, "middle", xyz + 0.1)
    assert caught.value.key == "points.middle_tip"


def test_a_rest_is_inside_the_limits_and_leaves_the_arm() -> None:
    hand = load_hand("ur5_allegro")
    spec = edit.with_rest(hand, hand.upper_limits + 1.0)
    assert spec.arm == hand.spec.arm
    assert load_hand(spec).rest[6:] == pytest.approx(hand.upper_limits[6:])


@pytest.mark.parametrize("name", ["seven_fingers", "absent_limits"])
def test_what_is_opened_is_written_as_init_wrote_it(name: str, tmp_path: Path) -> None:
    file, again = tmp_path / "hand.yaml", tmp_path / "again.yaml"
    HandsInit(DATA / f"{name}.urdf", out=file).run()
    found = edit.open_description(file)
    write_hand(found, again)
    assert comments(again) == comments(file)
    assert read_hand_spec(again).points == read_hand_spec(file).points
    # What the user knows has no evidence of the detection.
    spec = edit.with_palm_turned(load_hand(file))
    write_hand(edit.corrected(found, spec), again)
    new = comments(again) - comments(file)
    # Fingers that curl equally far both ways rest on the other side.
    new -= {"# rest posture [rad or m]: as given"}
    assert new == {"# dorsal, out of the back of the hand: as given"}


def comments(file: Path) -> set[str]:
    lines = file.read_text().splitlines()
    return {line.strip() for line in lines if line.strip().startswith("# ")}


@pytest.fixture
def small_gestures(monkeypatch: pytest.MonkeyPatch) -> None:
    """Map gestures as ever, but draw them in a few pixels; what fingers can reach is not shown.

    Pictures of gestures are those of tests/drawing/test_contact_sheet.py.
    """

    def drawn(columns: list[Any], rows: list[Any], **_: str) -> np.ndarray:
        return np.full((len(rows), 1 + len(columns), 2, 4, 4, 3), 0.5)

    def reachable(hand: Hand) -> ByFinger:
        return sample_workspace(hand, count=100)

    monkeypatch.setattr("handmap_qp.apps.onboarding.gestures.pose_pictures", drawn)
    monkeypatch.setattr("handmap_qp.apps.offline.fidelity.sample_workspace", reachable)


def test_gestures_have_pictures_of_human_and_robot() -> None:
    shown, _ = draw_gestures(load_hand("three_finger"))
    assert tuple(shown) == GESTURES
    for picture in shown.values():
        # Both are drawn, and no two are the same.
        assert (picture.std(axis=(1, 2, 3)) > 0.01).all()
    assert len({picture.tobytes() for picture in shown.values()}) == len(GESTURES)


def test_scores_tell_a_palm_that_is_turned_over(small_gestures: None) -> None:
    hand = load_hand("allegro_left")
    scores = []
    for each in (hand, applied(hand, edit.with_palm_turned)):
        shown, said = draw_gestures(each)
        assert tuple(shown) == GESTURES
        scores.append(
            [float(number) for number in re.findall(r"[\d.]+$|[\d.]+(?=,)", said)]
        )
    (extension, direction, closed), wrong = scores
    assert extension > 0.8 > wrong[0]
    assert direction < 20.0 < wrong[1]
    # A pinch may close a sample or two after the person's.
    assert closed > 0.95 > wrong[2]


def test_mistakes_are_found_before_a_page_is_shown(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("mine")
    for out in (file, tmp_path / "mine.txt"):
        with pytest.raises(InvalidInputError):
            HandsEdit("three_finger", out=out).run()
    with pytest.raises(HandError):
        HandsEdit(str(file)).run()
    assert file.read_text() == "mine"
    with pytest.raises(HandError, match="cannot be read"):
        HandsEdit(str(tmp_path / "none.urdf")).run()
    with pytest.raises(InvalidInputError) as caught:
        HandsEdit("three_finger", out=tmp_path / "new.yaml", port=70000).run()
    assert caught.value.argument == "--port"
    np.savez(tmp_path / "hand.npz", landmarks=np.zeros((2, 21, 3)))
    with pytest.raises(HandError, match="handmap retarget FILE --robot HAND"):
        HandsEdit(str(tmp_path / "hand.npz")).run()


def test_the_page_is_where_it_was_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = []

    def show(host: str, port: int, *, opens: bool) -> nullcontext[None]:
        asked.append((host, port, opens))
        return nullcontext()

    module = "handmap_qp.apps.onboarding.editor"
    monkeypatch.setattr(f"{module}.showing", show)
    monkeypatch.setattr(f"{module}.run_frames", lambda _: None)
    monkeypatch.setattr(f"{module}.HandEditor", lambda *_: SimpleNamespace(tick=None))
    out = tmp_path / "new.yaml"
    HandsEdit("three_finger", out=out, host="0.0.0.0", port=8123).run()
    assert asked == [("0.0.0.0", 8123, False)]


def test_a_urdf_is_described_and_saved_as_init_writes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The page itself is not served: what it is given, is saved at once."""
    urdf = tmp_path / "seven.urdf"
    shutil.copy(DATA / "seven_fingers.urdf", urdf)
    HandsInit(urdf, out=tmp_path / "init.yaml").run()
    given = []

    def save(_: Any, found: Detection, out: Path, remark: str) -> Any:
        assert not remark
        write_hand(found, out)
        given.append(out)
        return types.SimpleNamespace(tick=None)

    for name, stand_in in (
        ("showing", lambda *_, **__: nullcontext()),
        ("HandEditor", save),
        ("run_frames", lambda _: None),
    ):
        monkeypatch.setattr(f"handmap_qp.apps.onboarding.editor.{name}", stand_in)
    HandsEdit(str(urdf)).run()
    assert given == [tmp_path / "seven.yaml"]
    assert given[0].read_text() == (tmp_path / "init.yaml").read_text()
    with pytest.raises(InvalidInputError, match="exists"):
        HandsEdit(str(urdf)).run()


def test_a_tip_is_dragged_and_one_that_is_too_far_goes_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Gestures are those of another test.
    monkeypatch.setattr(
        "handmap_qp.apps.onboarding.gesture_tab.draw_gestures", lambda _: ({}, "")
    )
    with serving() as server:
        found = edit.open_description("allegro_left")
        editor = HandEditor(server, found, tmp_path / "mine.yaml")
        editor.tick()
        tip = editor.hand.reference_points[1]
        arrows = editor.arrows[tip.link]
        start = np.array(arrows.position)
        across = np.array([0.0, 1.0, 0.0])
        for step, is_possible in ((0.004, True), (0.5, False)):
            before = editor.found
            arrows.position = start + step * across
            editor._press("tip", tip.link)
            editor.tick()
            assert editor.message.visible is not is_possible
            assert (editor.found is before) is not is_possible
            moved = editor.hand.points(editor.hand.rest)[1]
            np.testing.assert_allclose(moved, start + 0.004 * across, atol=1e-4)
            np.testing.assert_allclose(arrows.position, moved)
        assert "outside the shape" in editor.message.content
        # A name that is chosen while a tip is dragged comes after it.
        editor._press("tip", tip.link)
        editor.names[tip.link].value = "little"
        editor._press("names", None)
        editor.tick()
        fingers = {point.link: point.finger for point in editor.hand.reference_points}
        assert fingers[tip.link] == "little"


def test_the_page_corrects_a_hand_in_a_browser(
    tmp_path: Path, small_gestures: None
) -> None:
    program = chromium()
    out = tmp_path / "mine.yaml"
    found = edit.open_description("three_finger")
    text = "document.body.innerText.includes('{}')"

    with serving() as server, Browser(program) as browser:
        light_simply(server)
        editor = HandEditor(server, found, out)
        with kept_going(editor.tick, 0.05):
            browser.open(f"http://127.0.0.1:{server.get_port()}")
            page = Page(browser)
            press = page.press
            press("Turn the palm over")
            press("Left / right")
            wait_until(lambda: editor.hand.side == "left", "the side does not change")
            # Choose names for all fingers, and apply them at once.
            thumb, *_ = editor.hand.reference_points
            page.choose("thumb", "index")
            page.choose("middle", "thumb")
            press("Apply the names")
            browser.wait_for(text.format("each name once"))
            assert editor.hand.reference_points[0] == thumb
            # Move a slider by its keys, as a user does.
            sliders = "[...document.querySelectorAll('[role=slider]')]"
            browser.evaluate(f"{sliders}[1].focus()")
            browser.press("End", 35)
            upper = editor.hand.upper_limits[1]
            wait_until(
                lambda: editor.joints[1].value == upper, "the slider does not move"
            )
            press("Rest as shown")
            # The thumb points down in the middle, or up if the hand is turned over; where the palm
            # ends depends on when the camera was placed. A page that is not drawn yet takes no
            # click.
            heights = itertools.cycle((*range(510, 660, 20), *range(300, 200, -20)))
            wait_until(
                lambda: is_asked(browser, next(heights)), "no thumb there", DRAWING
            )
            press("index")
            wait_until(lambda: editor.hand.reference_points[0] != thumb, "no new name")
            press("Save")
            browser.wait_for(text.format("wrote"))
            browser.wait_for(text.format("finger dir."))
            assert not browser.errors
    spec = read_hand_spec(out)
    assert spec.side == "left"
    assert spec.palm.dorsal == tuple(-np.array(found.spec.palm.dorsal))
    assert spec.rest == found.spec.rest | {spec.joints[1]: upper}
    # A thumb in the middle says nothing of the side: that orders the other fingers.
    over = load_hand(with_turn(load_hand("three_finger"), "dorsal"))
    renamed = renaming("thumb", "index")(over)
    assert [p.finger for p in spec.points] == [p.finger for p in renamed.points]
