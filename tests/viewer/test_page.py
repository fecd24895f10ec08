"""The command `handmap view` and the page it writes, also in a headless Chromium."""

from __future__ import annotations

import base64
import gzip
import json
import re
import sys
import time
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from PIL import Image

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from browser import DRAWING, Browser, light_simply
from edit_page import chromium
from patience import PATIENCE, kept_going, wait_until
from viewer_cases import COUNT, make_replay, plotted, write_recording

import handmap_qp
from handmap_qp import (
    HandError,
    HandmapError,
    InvalidInputError,
    MissingExtraError,
    RecordingError,
)
from handmap_qp.apps.arguments import MappingArguments, MethodFlags
from handmap_qp.apps.viewer.cli import View
from handmap_qp.apps.viewer.gauges import FIRST
from handmap_qp.apps.viewer.replay import ReplayViewer
from handmap_qp.apps.viewer.serving import serving

# The area of the hands between the panels, and the fewest of its 420 x 540 pixels that are skin.
MIDDLE = np.s_[160:, 340:760]
FEWEST_PIXELS = 200


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    return write_recording(tmp_path / "closing.npz")


@pytest.mark.slow
def test_the_command_writes_one_page_that_needs_no_network(
    recording: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    page = tmp_path / "page.html"
    View(recording, "three_finger", html=page).run()
    assert capsys.readouterr().out == f"wrote {page}\n"
    text = page.read_text(encoding="utf-8")
    assert "__VISER_EMBED_DATA__" in text
    title = re.search("<title>(.*)</title>", text)
    assert title is not None
    assert re.fullmatch(r"\w+ on three_finger, \w+ - handmap view", title[1])
    assert f"handmap_qp {handmap_qp.__version__}</p>" in text
    packed = re.search(r'atob\("(.*?)"\)', text)
    assert packed is not None
    gauges = json.loads(gzip.decompress(base64.b64decode(packed[1])))
    assert gauges["time"][0] == 0.0
    assert len(gauges["table"]) == len(gauges["bars"]) == len(gauges["time"])
    assert len(plotted(text, FIRST)[0]) == COUNT
    assert "pinch gaps" in gauges["table"][-1]
    assert "position limit" in gauges["bars"][-1]
    for attribute in ('src="http', "src='http", '<link rel="stylesheet" href="http'):
        assert attribute not in text
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "closing.npz",
        "page.html",
    ]


MISTAKES: dict[str, tuple[dict[str, Any], type[HandmapError]]] = {
    "no recording": ({"recording": Path("absent.npz")}, RecordingError),
    "no such robot": ({"robot": "tentacle"}, HandError),
    "page is no html": ({"html": Path("page.txt")}, InvalidInputError),
    "page in no folder": ({"html": Path("nowhere/page.html")}, InvalidInputError),
    "no such port": ({"port": 70000}, InvalidInputError),
    "neither recording nor service": ({"recording": None}, InvalidInputError),
    "recording and service": ({"live": "127.0.0.1"}, InvalidInputError),
    "page of a service": (
        {"recording": None, "live": "127.0.0.1", "html": Path("page.html")},
        InvalidInputError,
    ),
    "service nowhere": ({"recording": None, "live": "127.0.0.1:no"}, InvalidInputError),
    "no such keys": (
        {"recording": None, "live": "127.0.0.1", "keys": (Path("a"), Path("b"))},
        InvalidInputError,
    ),
    "keys for a recording": ({"keys": (Path("a"), Path("b"))}, InvalidInputError),
    "session of a recording": ({"session": "lab"}, InvalidInputError),
    "address of a page": (
        {"html": Path("page.html"), "host": "127.0.0.2"},
        InvalidInputError,
    ),
    "points for a service": (
        {
            "recording": None,
            "live": "127.0.0.1",
            "arguments": MappingArguments(human_points="fingertips"),
        },
        InvalidInputError,
    ),
    "options for a service": (
        {
            "recording": None,
            "live": "127.0.0.1",
            "arguments": MappingArguments(method=MethodFlags(ridge=0.3)),
        },
        InvalidInputError,
    ),
    "no such method": ({"compare": "papr"}, InvalidInputError),
    "comparison of a service": (
        {"recording": None, "live": "127.0.0.1", "compare": "paper"},
        InvalidInputError,
    ),
    "all addresses": ({"host": ""}, InvalidInputError),
    "service of no name": ({"recording": None, "live": ""}, InvalidInputError),
    "not our address": ({"host": "192.0.2.1"}, InvalidInputError),
}


OPTIONS_AT_FAULT = {
    "page is no html": "--html",
    "page in no folder": "--html",
    "no such port": "--port",
    "neither recording nor service": "",
    "recording and service": "",
    "page of a service": "--html",
    "service nowhere": "--live",
    "no such keys": "--live",
    "keys for a recording": "--keys",
    "session of a recording": "--session",
    "address of a page": "--host",
    "points for a service": "--human-points",
    "options for a service": "--ridge",
    "no such method": "--compare",
    "comparison of a service": "--compare",
    "all addresses": "--host",
    "service of no name": "--live",
    "not our address": "--host",
}


@pytest.mark.parametrize("mistake", MISTAKES)
def test_a_mistake_is_reported_before_anything_is_shown(
    recording: Path, mistake: str
) -> None:
    changes, error = MISTAKES[mistake]
    words: dict[str, Any] = {"recording": recording, "robot": "three_finger", **changes}
    with pytest.raises(error) as caught:
        View(**words).run()
    if isinstance(caught.value, InvalidInputError):
        assert caught.value.argument == OPTIONS_AT_FAULT[mistake]


def test_without_viser_the_command_names_the_extra(
    recording: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "viser", None)
    with pytest.raises(MissingExtraError, match=r"handmap-qp\[view\]"):
        View(recording, "three_finger").run()


def test_the_server_is_on_loopback_unless_told_otherwise(recording: Path) -> None:
    assert View(recording, "three_finger").host == "127.0.0.1"
    with serving() as server:
        assert server.get_host() == "127.0.0.1"


# -- in a browser


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with Browser(chromium()) as page:
        yield page


@pytest.fixture
def viewer() -> Iterator[ReplayViewer]:
    """Yield a paused viewer whose `tick` a thread calls."""
    with serving() as server:
        light_simply(server)
        shown = ReplayViewer(server, make_replay())
        shown.play_bar.toggle()
        shown.play_bar.slider.value = 1.6
        shown.tick(0.0)
        with kept_going(lambda: shown.tick(0.05)):
            yield shown


def skin(pixels: np.ndarray) -> int:
    """Count pixels in the colour of the human hand's skin, in light and shade."""
    red, green, blue = pixels.astype(int).transpose(2, 0, 1)
    return int(
        (
            (red - blue > 25)
            & (red > green)
            & (green > blue)
            & (red - green < 80)
            & (red > 110)
        ).sum()
    )


def reference_points(pixels: np.ndarray) -> int:
    """Count pixels in the colour of the robot's reference points."""
    red, green, blue = pixels.astype(int).transpose(2, 0, 1)
    return int(((red > 110) & (green < 0.45 * red) & (blue < 0.45 * red)).sum())


def settled_picture(browser: Browser) -> np.ndarray:
    """Return the area of the hands once two consecutive pictures are equal."""
    pictures = [later_picture(browser)[MIDDLE].astype(int)]

    def has_settled() -> bool:
        # Give a slow page time to draw again.
        time.sleep(0.2)
        pictures.append(later_picture(browser)[MIDDLE].astype(int))
        return skin(pictures[-1]) > FEWEST_PIXELS and np.array_equal(
            pictures[-2], pictures[-1]
        )

    wait_until(has_settled, "the picture does not settle, or shows no hand", DRAWING)
    return pictures[-1]


def wait_until_robot_moved(browser: Browser, before: np.ndarray) -> None:
    """Wait until the right half of the picture has changed."""
    half = before.shape[1] // 2

    def has_moved() -> bool:
        changed = (
            np.abs(later_picture(browser)[MIDDLE].astype(int) - before).max(axis=2) > 30
        )
        return int(changed[:, half:].sum()) > 500

    wait_until(has_moved, "the robot does not move in the picture", DRAWING)


@pytest.mark.slow
def test_the_page_draws_both_hands_and_its_controls_move_the_robot(
    browser: Browser, viewer: ReplayViewer
) -> None:
    # All in one page, because software rendering takes seconds to load it.
    browser.resize(1100, 700)
    browser.open(f"http://127.0.0.1:{viewer.server.get_port()}")
    browser.wait_for("!!document.querySelector('canvas')")
    before = settled_picture(browser)
    half = before.shape[1] // 2
    assert skin(before[:, :half]) > FEWEST_PIXELS, "the human hand, on the left"
    assert reference_points(before[:, half:]) > 100, "the robot's points, on the right"
    text = "document.body.innerText.includes('{}')"
    browser.wait_for(text.format("deformation gain"))
    assert not browser.evaluate(text.format("pinch weight"))
    # Focus the slider and use the keyboard, as a user does.
    labels = "[...document.querySelectorAll('label')]"
    browser.evaluate(
        f"{labels}.find(e => e.innerText.trim() == 'deformation gain')"
        ".closest('.mantine-Flex-root, .mantine-Box-root, div').parentElement"
        ".querySelector('[role=slider]').focus()"
    )
    robot_q = viewer.sample.robot_q
    browser.press("Home", 36)
    wait_until(
        lambda: viewer.replay.choice.method.values["deformation_gain"] == 0.0,
        "the slider does not move",
    )
    wait_until(
        lambda: np.abs(viewer.sample.robot_q - robot_q).max() > 0.05,
        "the robot's joints do not move",
    )
    wait_until_robot_moved(browser, before)
    # Open the list of presets and choose, as a user does.
    before = settled_picture(browser)
    field = "[...document.querySelectorAll('input')].find(e => e.value == 'paper')"
    browser.evaluate(f"{field}.click()")
    option = (
        "[...document.querySelectorAll('[role=option]')]"
        ".find(e => e.innerText.trim() == 'teleoperation')"
    )
    browser.wait_for(f"!!{option}")
    browser.evaluate(f"{option}.click()")
    wait_until(
        lambda: viewer.replay.choice.preset == "teleoperation",
        "the preset does not change",
    )
    browser.wait_for(text.format("pinch weight"))
    browser.wait_for(f"!{text.format('deformation gain')}")
    wait_until_robot_moved(browser, before)
    # The saved picture is that of the scene, without the panels.
    client = next(iter(viewer.server.get_clients().values()))
    sent: list[bytes] = []
    capturing = SimpleNamespace(
        camera=client.camera,
        get_render=client.get_render,
        send_file_download=lambda name, content: sent.append(content),
    )
    viewer.send("handmap.png", capturing)
    picture = np.asarray(Image.open(BytesIO(sent[0])))
    assert picture.shape == (client.camera.image_height, client.camera.image_width, 3)
    assert skin(picture) > FEWEST_PIXELS
    # In a small window, the gauges make room for the hands.
    browser.resize(800, 600)
    browser.wait_for("document.querySelector('canvas').clientWidth > 400")
    # On a phone, they are in a sheet below the hands.
    browser.resize(390, 844)
    browser.wait_for(
        "[...document.querySelectorAll('.mantine-Paper-root')].some((sheet) =>"
        "sheet.innerText.includes('gauges') && sheet.clientWidth == innerWidth &&"
        "sheet.getBoundingClientRect().top > 0.6 * innerHeight)"
    )
    assert not browser.errors


@pytest.mark.slow
def test_the_page_of_a_service_draws_both_hands_and_releases(
    browser: Browser, patient: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip(
        "zmq", reason="pyzmq is not installed: pip install 'handmap-qp[service]'"
    )
    import service_tools

    from handmap_qp.apps.viewer.live import LiveViewer
    from handmap_qp.apps.viewer.remote import ServiceSession

    monkeypatch.setattr("handmap_qp.apps.viewer.remote._TIMEOUT", PATIENCE)
    with (
        service_tools.serving() as service,
        service_tools.connected(service, name="lab", is_shared=True) as client,
        serving() as server,
    ):
        light_simply(server)
        browser.resize(1000, 600)
        with kept_going(
            lambda: client.step(q=service_tools.human_q(), wrist=np.eye(4))
        ):
            viewer = LiveViewer(
                server,
                ServiceSession(
                    service_tools.address_of(service).removeprefix("tcp://")
                ),
            )
        with kept_going(viewer.tick):
            browser.open(f"http://127.0.0.1:{server.get_port()}")
            browser.wait_for("!!document.querySelector('canvas')")
            wait_until(
                lambda: has_both_hands(later_picture(browser)[160:, 60:680]),
                "no human hand on the left, or no robot's points on the right",
                DRAWING,
            )
            button = (
                "[...document.querySelectorAll('button')]"
                ".find(e => e.innerText.trim() == '{}' && !e.disabled)"
            )
            browser.wait_for(f"!!{button.format('Disengage')}")
            browser.evaluate(f"{button.format('Disengage')}.click()")
            browser.wait_for(f"!!{button.format('Engage')}")
        viewer.close()
    assert not browser.errors


def later_picture(browser: Browser) -> np.ndarray:
    """Return the page after a moment: every picture makes the page draw once more."""
    time.sleep(0.3)
    return browser.screenshot()[1]


def has_both_hands(pixels: np.ndarray) -> bool:
    half = pixels.shape[1] // 2
    return (
        skin(pixels[:, :half]) > FEWEST_PIXELS
        and reference_points(pixels[:, half:]) > 50
    )


@pytest.mark.slow
@pytest.mark.full
def test_the_page_of_a_robot_with_two_hands_draws_all_hands(browser: Browser) -> None:
    replay = View().replay(Path("demo"), "g1")
    with serving() as server:
        light_simply(server)
        viewer = ReplayViewer(server, replay)
        viewer.play_bar.toggle()
        viewer.play_bar.slider.value = 3.0
        viewer.tick(0.0)
        browser.resize(1100, 700)
        with kept_going(lambda: viewer.tick(0.05)):
            browser.open(f"http://127.0.0.1:{server.get_port()}")
            browser.wait_for("!!document.querySelector('canvas')")
            wait_until(
                lambda: has_hands_beside_robot(later_picture(browser)),
                "two human hands on the left, or no robot's points on the right",
                DRAWING,
            )
    for text in ("left pinch gaps", "right pinch gaps"):
        assert browser.evaluate(f"document.body.innerText.includes('{text}')")
    assert not browser.errors


def has_hands_beside_robot(pixels: np.ndarray) -> bool:
    """Return whether each third of the middle shows what it should: hand, hand, robot."""
    first, second, robot = np.array_split(pixels[160:, 310:790], 3, axis=1)
    return min(skin(first), skin(second)) > 40 and reference_points(robot) > 4


@pytest.mark.slow
def test_the_written_page_plays_offline(browser: Browser, tmp_path: Path) -> None:
    page = tmp_path / "page.html"
    page.write_bytes(make_replay().page())
    # A small window, because software rendering of an animation is slow.
    browser.resize(600, 400)
    browser.open(page.as_uri(), offline=True)
    browser.wait_for("!!document.querySelector('canvas')")
    # Leave out the play bar at the lower edge, which always moves.
    pictures: list[np.ndarray] = []

    def hands_move() -> bool:
        pictures.append(browser.screenshot()[1][:340])
        return has_moved(pictures)

    wait_until(hands_move, "the hands do not move by themselves", DRAWING)
    # Title, gauges and options; the gauges follow the time that is played.
    text = "document.querySelector('{}').textContent"
    assert browser.evaluate(text.format("h1")) == "closing on three_finger, paper"
    assert "ridge0.1" in browser.evaluate(text.format(".options"))
    assert "pinch gaps" in browser.evaluate(text.format("#handmap-table"))
    bars = browser.evaluate(text.format("#handmap-bars"))
    wait_until(
        lambda: browser.evaluate(text.format("#handmap-bars")) != bars,
        "the gauges stand still",
        DRAWING,
    )
    assert not browser.errors


def has_moved(pictures: list[np.ndarray]) -> bool:
    """Return whether two pictures show a hand and differ."""
    hands = [picture.astype(int) for picture in pictures if skin(picture) > 500]
    return (
        len(hands) > 1
        and int((np.abs(hands[0] - hands[-1]).max(axis=2) > 30).sum()) > 300
    )
