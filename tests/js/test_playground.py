"""The playground in Chromium: every input leads the robot, on desktops, phones, and offline."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from browser import Browser
from wasm_library import PACKAGE, ROOT

from handmap_qp import load_hand

pytestmark = pytest.mark.slow
HANDS = ("allegro_right", "three_finger")
TIP = 8  # of the index finger


def joints(page: Browser) -> np.ndarray:
    """Return the joint positions that the page shows."""
    return np.array(json.loads(page.evaluate("document.body.dataset.q")))


def choose(page: Browser, name: str) -> None:
    """Choose an input."""
    page.evaluate(f"document.querySelector('input[value={name}]').click()")


def wait_to_move(page: Browser) -> None:
    """Wait until the robot is elsewhere than now."""
    before = json.dumps(joints(page).tolist())
    page.wait_for(
        f"JSON.parse(document.body.dataset.q).some((x, j) => Math.abs(x - {before}[j]) > 0.02)"
    )


def test_a_recording_leads_the_robot_within_its_limits(page: Browser) -> None:
    choose(page, "recording")
    wait_to_move(page)
    lower, upper = load_hand("allegro_right").limits
    for _ in range(3):
        wait_to_move(page)
        q = joints(page)
        assert (q >= lower - 1e-9).all()
        assert (q <= upper + 1e-9).all()


def test_a_fingertip_is_dragged(page: Browser) -> None:
    choose(page, "drag")
    page.wait_for("document.body.dataset.held === 'false'")
    at = page.evaluate(
        f"playground.scene.onScreen(playground.scene.person.points[{TIP}])"
    )
    # Down, to the palm: the finger bends.
    ends = at, [at[0], at[1] + 70]
    for kind, (x, y) in zip(("mousePressed", "mouseMoved"), ends, strict=True):
        page.call(
            "Input.dispatchMouseEvent",
            type=kind,
            x=x,
            y=y,
            button="left",
            buttons=1,
            clickCount=1,
        )
    wait_to_move(page)
    page.wait_for(
        f"playground.scene.onScreen(playground.scene.person.points[{TIP}])[1] > {at[1] + 35}"
    )
    page.call(
        "Input.dispatchMouseEvent",
        type="mouseReleased",
        x=ends[1][0],
        y=ends[1][1],
        button="left",
        clickCount=1,
    )


@pytest.mark.parametrize("name", ["webcam", "headset"])
def test_what_a_camera_or_a_headset_sees_leads_the_robot(
    name: str, page: Browser
) -> None:
    """A recording takes the place of what finds the hand: the page reads its `landmarks`."""
    choose(page, "recording")
    page.evaluate(
        f"""(() => {{
            const from = playground.recording;
            playground.input = "{name}";
            playground["{name}"] = {{
                get landmarks() {{ return from.at(playground.time); }}, stop() {{}},
            }};
            playground.hand.engage();
        }})()"""
    )
    wait_to_move(page)
    page.evaluate(f"playground['{name}'] = {{ landmarks: null, stop() {{}} }}")
    page.wait_for("document.body.dataset.held === 'true'")
    page.evaluate("playground.lead('recording')")
    page.wait_for("document.body.dataset.held === 'false'")


def test_without_a_camera_or_a_headset_the_page_says_so(page: Browser) -> None:
    for name, said in (("webcam", "No webcam"), ("headset", "WebXR|No headset")):
        choose(page, name)
        page.wait_for(
            f"/{said}/.test(document.getElementById('input-state').textContent)"
        )
    choose(page, "recording")


def test_a_stop_holds_until_engaged(page: Browser) -> None:
    choose(page, "recording")
    wait_to_move(page)
    page.evaluate("document.getElementById('stop').click()")
    page.wait_for("document.body.dataset.held === 'true'")
    # It brakes within half a second.
    page.wait_for("playground.hand.hold(0.01).velocity.every((x) => x === 0)")
    q = joints(page)
    page.evaluate("document.getElementById('engage').click()")
    page.wait_for("document.body.dataset.held === 'false'")
    wait_to_move(page)
    assert not np.array_equal(q, joints(page))


def test_a_lost_hand_holds_and_comes_back(page: Browser) -> None:
    choose(page, "recording")
    page.evaluate("playground.lostUntil = Infinity")
    page.wait_for("document.body.dataset.held === 'true'")
    page.evaluate("playground.lostUntil = 0")
    page.wait_for("document.body.dataset.held === 'false'")


def test_another_hand_is_chosen(page: Browser) -> None:
    page.evaluate(
        "(() => { const list = document.getElementById('hands');"
        " list.value = 'three_finger'; list.dispatchEvent(new Event('change')); })()"
    )
    page.wait_for("playground.hand.name === 'three_finger'")
    page.wait_for("JSON.parse(document.body.dataset.q).length === 8")
    wait_to_move(page)
    page.evaluate(
        "(() => { const list = document.getElementById('hands');"
        " list.value = 'allegro_right'; list.dispatchEvent(new Event('change')); })()"
    )
    page.wait_for("JSON.parse(document.body.dataset.q).length === 16")


def test_both_hands_are_seen_on_a_phone_and_nothing_is_wider(page: Browser) -> None:
    page.resize(390, 780)
    page.wait_for("document.documentElement.scrollWidth <= 390")
    page.wait_for("playground.scene.canvas.clientWidth <= 390")
    wait_to_move(page)
    points = np.array(
        page.evaluate(
            "playground.scene.person.points.map((p) => playground.scene.onScreen(p))"
        )
    )
    size = page.evaluate(
        "[playground.scene.canvas.clientWidth, playground.scene.canvas.clientHeight]"
    )
    assert (points > 0).all()
    assert (points < size).all()
    page.resize(640, 420)


def test_it_works_without_a_network_and_asks_no_other_host(
    page: Browser, address: str, folder: Path
) -> None:
    page.wait_for(
        "navigator.serviceWorker.ready.then((found) => found.active !== null)"
    )
    count = len(json.loads((folder / "files.json").read_text())["files"])
    page.wait_for(
        "caches.keys().then((names) => caches.open(names[0])).then((kept) => kept.keys())"
        f".then((kept) => kept.length >= {count})"
    )
    page.open(address, offline=True)
    page.wait_for("document.body && document.body.dataset.frames > 0")
    wait_to_move(page)
    hosts = page.evaluate(
        "performance.getEntriesByType('resource').map((each) => new URL(each.name).host)"
    )
    assert {*hosts} == {address.split("/")[2]}
    page.open(address)
    page.wait_for("document.body && document.body.dataset.frames > 0")


def test_the_page_names_files_that_there_are() -> None:
    page = PACKAGE / "playground"
    text = "".join(each.read_text() for each in page.iterdir())
    for file in page.glob("*.js"):
        assert file.name in text
    assert (ROOT / "Makefile").read_text().count("packages/handmap-js/pack.py") == 1
