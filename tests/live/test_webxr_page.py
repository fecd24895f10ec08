"""The page for headsets in Chromium, with an emulated headset: from its hands to the robot."""

from __future__ import annotations

import itertools
import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import Browser, find_chromium
from msgspec import structs
from patience import wait_until
from service_tools import (
    WEB,
    address_of,
    client_of,
    connected,
    in_loop,
    serving,
    token_file,
)
from webxr_pages import (
    EMULATION,
    LAYOUT,
    RATE,
    TOKEN,
    open_page,
    show_hands,
    start,
    text,
    wait_for_text,
    webxr_joints,
)

from handmap_core.client.messages import Open
from handmap_qp import hand_names, load_hand
from handmap_qp.apps.live.service import ServiceSource
from handmap_qp.apps.service import pages
from handmap_qp.apps.service.server import Server
from handmap_qp.apps.service.session import Session
from handmap_qp.hands.library import HUMAN_HANDS, missing_hands
from handmap_qp.mapping import assumed_note, assumed_speeds, fist_time, slow_note
from handmap_qp.trackers.layouts.points import PointLayout

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("patient")]
STATUSES = Path(pages.__file__).with_name("webxr") / "statuses.json"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    token = token_file(tmp_path_factory.mktemp("token"), TOKEN)
    # The emulated headset has a clock of its own.
    with serving(**WEB, web_token_file=token, simulated_time=True) as server:
        yield server


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium; HANDMAP_CHROMIUM names one")
    with Browser(program, size=(1100, 1000)) as browser:
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=EMULATION)
        yield browser


def sessions(server: Server) -> dict[str, Session]:
    sessions = server.dispatcher.sessions
    found = in_loop(server, lambda: list(sessions.by_secret.values()))
    return {session.name: session for session in found}


def test_both_hands_lead_one_robot(browser: Browser, server: Server) -> None:
    start(browser, server, words="?robot=g1")
    show_hands(browser, "right", "left")
    for side in ("right", "left"):
        wait_for_text(browser, f"#{side} .state", "streaming")
    robots = {name: each.robot.name for name, each in sessions(server).items()}
    assert robots == {"webxr-both": "g1"}
    with client_of(server) as watcher:
        watcher.watch("webxr-both")
        before = np.array(watcher.status().q)
        wait_until(
            lambda: bool(np.abs(np.array(watcher.status().q) - before).max() > 0.05)
        )
    # One hand is lost: its side holds, and the other one goes on.
    show_hands(browser, "right")
    wait_for_text(browser, "#left .state", "hand lost: the robot holds")
    wait_for_text(browser, "#left .robot", "held")
    wait_for_text(browser, "#right .state", "streaming")
    browser.wait_for("document.querySelector('#right .robot').textContent != 'held'")
    # One hold for both.
    browser.click_on("#left .hold")
    wait_for_text(browser, "#right .state", "held until Engage")
    browser.click_on("#right .engage")
    wait_for_text(browser, "#right .state", "streaming")
    # Joints that do not follow hold the whole robot, and both hands say so.
    session = sessions(server)["webxr-both"]

    def lose() -> None:
        session._measured = session._commanded.q
        session._lose()

    def both_say_so() -> bool:
        # An Engage that is still on its way takes up the session again.
        in_loop(server, lose)
        states = [text(browser, f"#{side} .state") for side in ("right", "left")]
        return all("joints do not follow" in state for state in states)

    wait_until(both_say_so)
    browser.click_on("#right .engage")
    wait_for_text(browser, "#right .state", "streaming")
    browser.click_on("#stop")
    wait_for_text(browser, "#right .state", "emergency stop")
    browser.click_on("#right .clear")
    wait_for_text(browser, "#right .state", "held until Engage")
    browser.click_on("#end")
    wait_until(lambda: "webxr-both" not in sessions(server))


def test_a_page_asks_for_the_services_clock(tmp_path: Path) -> None:
    """As on a headset: the other tests of this page have the clock of a simulation."""
    program = find_chromium()
    if program is None:
        pytest.skip("no Chromium; HANDMAP_CHROMIUM names one")
    plain = EMULATION + "\nWebSocket.prototype.send = send;\n"
    with (
        serving(**WEB, web_token_file=token_file(tmp_path, TOKEN)) as server,
        Browser(program, size=(1100, 1000)) as browser,
    ):
        browser.call("Page.addScriptToEvaluateOnNewDocument", source=plain)
        start(browser, server)
        show_hands(browser, "right")
        browser.wait_for(
            "parseInt(document.querySelector('#right .sent').textContent) > 0"
        )
        request = sessions(server)["webxr-right"].request
        usual = {field.name: field.default for field in structs.fields(Open)}
        assert request.time_from == usual["time_from"]
        assert request.watchdog == usual["watchdog"]


# A controller without a hand, and one of the left hand with the older actuators, keep their pulses.
_GAMEPADS = """
window.pulses = { both: [], left: [] };
const rumble = { playEffect: (kind, effect) => {
  pulses.both.push([kind, effect.strongMagnitude, effect.duration]);
  return Promise.resolve("complete");
} };
const buzz = { pulse: (value, time) => {
  pulses.left.push([value, time]);
  return Promise.resolve(true);
} };
navigator.getGamepads = () => [
  null, { hand: "", vibrationActuator: rumble }, { hand: "left", hapticActuators: [buzz] }];
"""


def test_what_the_robot_feels_is_shown_and_vibrates(
    browser: Browser, server: Server
) -> None:
    start(
        browser, server, more=_GAMEPADS, words="?right=three_finger&left=allegro_left"
    )
    wait_until(lambda: "webxr-right" in sessions(server), "no session opens")
    values = (
        "[...document.querySelectorAll('#right .haptics meter')].map((m) => m.value)"
    )
    with client_of(server) as driver:
        driver.watch("webxr-right")

        def feel(force: float) -> None:
            driver.touch(forces={"thumb": force, "index": 0.05})

        def is_shown(strength: float) -> bool:
            feel(0.1 + 4.9 * strength)
            shown = browser.evaluate(values)
            return len(shown) == 2 and bool(np.allclose(shown, [strength, 0.0]))

        wait_until(lambda: is_shown(0.5), "no force is shown")
        wait_until(
            lambda: feel(2.55) or browser.evaluate("pulses.both.length"), "no pulse"
        )
        kind, strength, duration = browser.evaluate("pulses.both.at(-1)")
        assert (kind, round(strength, 6), duration) == ("dual-rumble", 0.5, 100)
        # More than the largest force is felt as the largest.
        driver.touch(forces={"thumb": 400.0, "index": 0.0})
        wait_until(
            lambda: (
                driver.touch(forces={"thumb": 400.0})
                or browser.evaluate("pulses.both.at(-1)[1]") == 1.0
            ),
            "no strongest pulse",
        )
        # The left hand's controller does not feel the right hand's robot.
        assert browser.evaluate("pulses.left") == []
    # The driver has ended: bars vanish, and pulses with them.
    wait_until(
        lambda: browser.evaluate("document.querySelector('#right .haptics').hidden"),
        "bars of a driver that has ended stay",
    )
    count = browser.evaluate("pulses.both.length")
    browser.evaluate("new Promise((done) => setTimeout(done, 300))")
    assert browser.evaluate("pulses.both.length") == count
    browser.click_on("#end")


# A service that lets haptics count for an hour.
_LONG_LIFE = """
const parse = JSON.parse;
JSON.parse = (text) => {
  const message = parse(text);
  if ("haptics_life" in message) message.haptics_life = 3600;
  return message;
};
"""


def test_what_is_felt_counts_as_long_as_the_service_says(
    browser: Browser, server: Server
) -> None:
    start(browser, server, more=_LONG_LIFE, words="?right=three_finger&left=")
    wait_until(lambda: "webxr-right" in sessions(server), "no session opens")
    is_hidden = "document.querySelector('#right .haptics').hidden"
    with client_of(server) as driver:
        driver.watch("webxr-right")
        wait_until(
            lambda: (
                driver.touch(forces={"thumb": 2.0}) or not browser.evaluate(is_hidden)
            ),
            "no force is shown",
        )
    browser.evaluate("new Promise((done) => setTimeout(done, 600))")
    assert not browser.evaluate(is_hidden)
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def test_a_slow_hand_has_a_line(browser: Browser, server: Server) -> None:
    start(browser, server, words="?right=svh_right")
    show_hands(browser, "right", "left")
    for side in ("right", "left"):
        wait_for_text(browser, f"#{side} .state", "streaming")
    fist = fist_time(load_hand("human"), load_hand("svh_right"))
    assert text(browser, "#right .slow") == slow_note(fist)
    is_hidden = "document.querySelector('#{} .slow').hidden"
    assert not browser.evaluate(is_hidden.format("right"))
    assert text(browser, "#left .slow") == ""
    assert browser.evaluate(is_hidden.format("left"))
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def test_a_robot_that_assumed_speeds_hold_has_a_line(
    browser: Browser, server: Server, monkeypatch: pytest.MonkeyPatch
) -> None:
    # However seldom they do, and however few the samples are.
    monkeypatch.setattr(assumed_speeds, "ASSUMED_SHARE", -1.0)
    monkeypatch.setattr(assumed_speeds, "_LEAST_SAMPLES", 0)
    start(browser, server, words="?right=leap_right&left=three_finger")
    show_hands(browser, "right", "left")
    lines = "[...document.querySelectorAll('#robots .assumed')]"
    browser.wait_for(f"{lines}.some((line) => line.textContent)")
    (shown,) = browser.evaluate(
        f"{lines}.filter((line) => !line.hidden).map((line) => line.textContent)"
    )
    counted = sessions(server)["webxr-right"].state(0, "0", 0, 0.0).assumed_speed
    assert counted is not None
    # The words are those of the package; the counts go on.
    numbers = r"\d+ %|often \w*"
    assert re.sub(numbers, "", shown) == re.sub(numbers, "", assumed_note(counted))
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def test_hands_move_the_robots(browser: Browser, server: Server) -> None:
    start(browser, server)
    request = browser.evaluate("emulated.requests")[0]
    assert request["mode"] == "immersive-vr"
    assert request["wanted"]["requiredFeatures"] == ["hand-tracking"]
    wait_for_text(browser, "#right .state", "waiting for the hand")
    show_hands(browser, "right", "left")
    for side in ("right", "left"):
        wait_for_text(browser, f"#{side} .state", "streaming")
    wait_for_text(browser, "#state", "Streaming")
    robots = {name: each.robot.name for name, each in sessions(server).items()}
    assert robots == {"webxr-right": "allegro_right", "webxr-left": "three_finger"}
    sides = {name: each.request.side for name, each in sessions(server).items()}
    assert sides == {"webxr-right": "right", "webxr-left": "left"}
    with client_of(server) as watcher:
        watcher.watch("webxr-right")
        before = np.array(watcher.status().q)
        wait_until(
            lambda: bool(np.abs(np.array(watcher.status().q) - before).max() > 0.05)
        )
    browser.wait_for("parseInt(document.querySelector('#right .sent').textContent) > 0")
    assert int(text(browser, "#right .sent").split()[0]) <= 1.2 * RATE
    followed = ("converged", "limited", "unsettled", "unreachable")
    wait_until(
        lambda: text(browser, "#right .robot") in followed
    )  # after the calibration
    assert text(browser, "#right .delay").endswith(" ms")
    assert _is_drawn(browser, "#right canvas")
    # Landmarks at the service are the headset's joints in the order of MediaPipe.
    assert isinstance(LAYOUT, PointLayout)
    expected = webxr_joints("right")[:, LAYOUT.order("right")]
    for sample in itertools.islice(
        ServiceSource(address_of(server), session="webxr-right"), 5
    ):
        assert np.abs(expected - sample.landmarks).max(axis=(1, 2)).min() < 1e-9
    # Losing one hand holds its robot, and the other one goes on.
    browser.evaluate("delete joints.left; delete emulated.hands.left; 0")
    wait_for_text(browser, "#left .state", "hand lost: the robot holds")
    wait_until(lambda: text(browser, "#left .robot") in ("held", "hold"))
    wait_for_text(browser, "#right .state", "streaming")
    # The buttons hold and engage.
    browser.click_on("#right .hold")
    wait_for_text(browser, "#right .state", "held until Engage")
    wait_until(lambda: sessions(server)["webxr-right"].mode == "released")
    browser.click_on("#right .engage")
    browser.wait_for(
        "!document.querySelector('#right .state').textContent.includes('held')"
    )
    # An emergency stop is latched until it is cleared on purpose.
    browser.click_on("#stop")
    wait_for_text(browser, "#state", "EMERGENCY STOP")
    wait_for_text(browser, "#advice", "webxr-left, webxr-right")
    wait_for_text(browser, "#right .state", "emergency stop")
    wait_for_text(browser, "#right .robot", "stopped")
    browser.click_on("#right .engage")
    assert sessions(server)["webxr-right"].mode == "stopped"
    browser.click_on("#right .clear")
    wait_for_text(browser, "#right .state", "held until Engage")
    browser.click_on("#right .engage")
    browser.wait_for(
        "!document.querySelector('#right .state').textContent.includes('held')"
    )
    browser.click_on("#left .clear")
    browser.click_on("#end")
    wait_for_text(browser, "#state", "Ready")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


@pytest.mark.parametrize("size", [(1100, 1000), (390, 780)])
def test_a_page_that_leads_nothing_stops_every_robot(
    browser: Browser, server: Server, size: tuple[int, int]
) -> None:
    browser.resize(*size)
    # A phone without a headset, beside a robot that others lead.
    open_page(browser, server, more="emulated.isSupported = false;")
    wait_for_text(browser, "#scope", "No robot is controlled now")
    with (
        connected(server, name="lab", is_shared=True) as shared,
        connected(server, name="private") as private,
    ):
        wait_for_text(browser, "#scope", "all 2 robots of this service")
        assert browser.evaluate(_IS_IN_SIGHT)
        browser.click_on("#stop")
        wait_for_text(browser, "#state", "EMERGENCY STOP")
        wait_until(lambda: shared.status().mode == private.status().mode == "stopped")
        wait_for_text(browser, "#advice", "lab, private")
        wait_for_text(
            browser, "#advice", "Only its owner or a supervisor may clear private"
        )
        # It does not offer what the service would refuse.
        assert browser.evaluate(
            "document.querySelector('[data-name=private] .clear').hidden"
        )
        browser.click_on("[data-name=lab] .clear")
        wait_until(lambda: not shared.status().stop)
        browser.wait_for(
            "!document.querySelector('#advice').textContent.includes('lab')"
        )
        assert text(browser, "#state") == "EMERGENCY STOP"
        private.clear(private.status().stop)
        wait_for_text(browser, "#state", "This browser offers no headset")
    wait_for_text(browser, "#scope", "No robot is controlled now")
    assert browser.errors == []
    browser.resize(1100, 1000)


_IS_IN_SIGHT = """(() => {
    const box = document.querySelector("#stop").getBoundingClientRect();
    return box.top >= 0 && box.bottom <= innerHeight && box.height >= 48;
})()"""
"""Whether the emergency stop can be pressed without scrolling."""


def test_a_stop_that_is_not_answered_says_so(browser: Browser, server: Server) -> None:
    open_page(browser, server)
    wait_for_text(browser, "#state", "Ready")
    # The network swallows what the page sends.
    browser.evaluate("WebSocket.prototype.send = () => {}; 0")
    browser.click_on("#stop")
    wait_for_text(browser, "#state", "EMERGENCY STOP: no answer")
    wait_for_text(browser, "#advice", "the robot's own emergency stop")


DISC = np.array([0.0, 0.22, -0.38])
"""Middle of the emergency stop in the scene, from the eyes of who looks along -z [m]."""
BESIDE = DISC + np.array([0.07, 0.0, 0.0])
"""A place beside it [m]."""
_REACH = """
window.sample = 0;
emulated.beforeFrame = () => {
  sample += 1;
  const touches = sample % PERIOD < FRAMES;
  emulated.hands = { left: away, right: touches ? touching : away };
};
0
"""
"""Let the right hand touch something for some of the frames of a period."""


def reach(browser: Browser, place: np.ndarray, frames: int, period: int = 30) -> None:
    """Let the tip of the right index finger be at a place [m] for frames of each period."""
    away = webxr_joints("right")[0] - [0.0, 0.6, 0.0]
    touching = away + place - away[9]
    browser.evaluate(
        f"window.away = {json.dumps(away.tolist())};"
        f"window.touching = {json.dumps(touching.tolist())};"
        + _REACH.replace("PERIOD", str(period)).replace("FRAMES", str(frames))
    )


def modes(server: Server) -> dict[str, str]:
    """Return what the robot of each session does."""
    return {name: session.mode for name, session in sessions(server).items()}


def are_all(server: Server, mode: str) -> bool:
    """Tell whether all robots are in one mode."""
    return {*modes(server).values()} == {mode}


def clear_all(browser: Browser) -> None:
    """Clear the stops of both hands on the page."""
    for side in ("right", "left"):
        browser.click_on(f"#{side} .clear")
        browser.wait_for(f"document.querySelector('#{side} .clear').hidden")


def test_a_touch_of_the_disc_in_the_headset_stops_every_robot(
    browser: Browser, server: Server
) -> None:
    eye = np.array([0.1, 1.5, 0.2])
    start(browser, server)
    browser.evaluate(f"emulated.eye = {json.dumps(eye.tolist())}; 0")
    reach(browser, eye + DISC, 0)
    wait_until(lambda: len(sessions(server)) == 2)
    # A hand that is there for two frames (67 ms) was perhaps never there, and one beside the
    # disc touches nothing.
    for place, frames in ((DISC, 2), (BESIDE, 30)):
        reach(browser, eye + place, frames)
        browser.wait_for("sample > 60")
        assert "stopped" not in modes(server).values()
    with connected(server, name="lab", is_shared=True) as other:
        reach(browser, eye + DISC, 30)
        # Its questions keep the session of another client open.
        wait_until(lambda: other.status().mode == "stopped")
        wait_until(lambda: are_all(server, "stopped"))
        # A finger that stays there does not stop again what somebody has cleared.
        other.clear(other.status().stop)
        last = browser.evaluate("sample") + 10
        wait_until(lambda: other.status() and browser.evaluate("sample") > last)
        assert not other.status().stop
    wait_for_text(browser, "#state", "EMERGENCY STOP")
    reach(browser, eye + DISC, 0)
    clear_all(browser)
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def press(browser: Browser, button: int, side: str = "left") -> None:
    """Let a controller be held, with one button pressed; -1 for none."""
    browser.evaluate(
        "emulated.controllers = [{ handedness: SIDE, gamepad: { buttons:"
        " Array.from({ length: 6 }, (_, i) => ({ pressed: i === BUTTON })) } }]; 0".replace(
            "SIDE", json.dumps(side)
        ).replace("BUTTON", str(button))
    )


@pytest.mark.parametrize("side", ["left", "right"])
def test_the_upper_button_of_a_controller_stops_every_robot(
    browser: Browser, server: Server, side: str
) -> None:
    start(browser, server)
    show_hands(browser, "right", "left")
    wait_for_text(browser, "#right .state", "streaming")
    # The other buttons, which people press to hold something, do nothing.
    for button in (-1, 0, 1, 2, 3, 4):
        press(browser, button, side)
        count = browser.evaluate("sample")
        browser.wait_for(f"sample > {count} + 3")
    assert "stopped" not in modes(server).values()
    press(browser, 5, side)
    wait_until(lambda: are_all(server, "stopped"))
    wait_for_text(browser, "#right .state", "emergency stop")
    browser.evaluate("emulated.controllers = []; 0")
    clear_all(browser)
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def test_the_end_of_the_headsets_session_leaves_no_robot_moving(
    browser: Browser, server: Server
) -> None:
    start(browser, server, words="?right=allegro_right&left=")
    show_hands(browser, "right")
    wait_until(lambda: are_all(server, "following"))
    with client_of(server) as watcher:
        watcher.watch("webxr-right")
        wait_until(lambda: watcher.latest(1.0))
        # By the system: a menu, a battery, a headset that is put down.
        browser.evaluate("emulated.session.end(); 0")
        wait_until(lambda: not sessions(server))
        while watcher.latest():
            pass
        # Drivers stop without a command: see `LOST` of `handmap drive`.
        assert watcher.latest(0.5) is None
    wait_for_text(browser, "#state", "Ready")
    assert browser.errors == []


def test_a_stop_outlasts_the_headsets_session_and_can_be_cleared(
    browser: Browser, server: Server
) -> None:
    start(browser, server, words="?right=allegro_right&left=")
    show_hands(browser, "right")
    wait_until(lambda: are_all(server, "following"))
    press(browser, 5)
    wait_until(lambda: are_all(server, "stopped"))
    wait_for_text(browser, "#right .state", "emergency stop")
    browser.evaluate("emulated.session.end(); emulated.controllers = []; 0")
    browser.wait_for("!document.querySelector('#start-vr').disabled")
    # The page is what a person sees now: it says what holds the robot, and can end that.
    wait_for_text(browser, "#state", "EMERGENCY STOP")
    assert are_all(server, "stopped")
    assert "emergency stop" in text(browser, "#right .state")
    browser.click_on("#right .clear")
    wait_until(lambda: not sessions(server))
    wait_for_text(browser, "#state", "Ready")
    # The next start follows again.
    browser.click_on("#start-vr")
    wait_until(lambda: are_all(server, "following"))
    browser.click_on("#end")
    wait_until(lambda: not sessions(server))
    assert browser.errors == []


def _is_drawn(browser: Browser, selector: str) -> bool:
    return browser.evaluate(
        f"(() => {{ const canvas = document.querySelector({json.dumps(selector)});"
        "const { data } = canvas.getContext('2d')"
        ".getImageData(0, 0, canvas.width, canvas.height);"
        "return data.some((value) => value > 0); })()"
    )


def test_the_headset_shows_hands_panel_and_stop(
    browser: Browser, server: Server
) -> None:
    start(browser, server)
    browser.evaluate("emulated.eye = [0.05, 0.15, 0.5]; 0")
    show_hands(browser, "right")
    wait_for_text(browser, "#right .state", "streaming")
    # Frames are drawn without keeping them: read one inside the frame that drew it.
    pixels = browser.evaluate(
        "new Promise((resolve) => { emulated.afterFrame = () => {"
        "const { gl } = emulated; const { width, height } = gl.canvas;"
        "const data = new Uint8Array(4 * width * height);"
        "gl.readPixels(0, 0, width, height, gl.RGBA, gl.UNSIGNED_BYTE, data);"
        "let green = 0, panel = 0, red = 0;"
        "for (let i = 0; i < data.length; i += 4) {"
        " if (data[i + 1] > 150 && data[i] < 120) green += 1;"
        " if (data[i] === 27 && data[i + 1] === 33) panel += 1;"
        " if (data[i] > 180 && data[i + 1] < 50) red += 1; }"
        "resolve([green, panel, red]); }; })"
    )
    assert pixels[0] > 125
    assert pixels[1] > 1250
    assert pixels[2] > 1250


def test_a_lost_connection_is_taken_up_again(browser: Browser, server: Server) -> None:
    start(browser, server)
    show_hands(browser, "right")
    wait_for_text(browser, "#right .state", "streaming")
    wait_until(lambda: sessions(server)["webxr-right"].mode == "following")
    first = sessions(server)["webxr-right"]

    def cut() -> None:
        for publish in server.dispatcher.sessions.publish:
            transport = getattr(publish, "__self__", None)
            for connection in getattr(transport, "_connections", ()):
                connection.transport.abort()

    # Record the states: a busy machine may look at the page after it has connected again.
    browser.evaluate(
        "(() => { const state = document.querySelector('#right .state'); window.states = [];"
        "new MutationObserver(() => states.push(state.textContent)).observe("
        "state, { childList: true, characterData: true, subtree: true }); })()"
    )
    in_loop(server, cut)
    browser.wait_for(
        "states.some((each) => each.includes('not connected: the robot holds'))"
    )
    wait_for_text(browser, "#right .state", "streaming")
    second = wait_until(lambda: sessions(server).get("webxr-right"))
    assert second is not first
    assert second._epoch == first._epoch  # it goes on where the robot was
    browser.click_on("#end")


@pytest.mark.parametrize(
    ("more", "line"),
    [
        ("emulated.isSupported = false;", "This browser offers no headset"),
        (
            "Object.defineProperty(window, 'isSecureContext', {value: false});",
            "This address cannot use a headset",
        ),
    ],
)
def test_the_page_says_why_it_cannot_start(
    browser: Browser, server: Server, more: str, line: str
) -> None:
    open_page(browser, server, more=more)
    wait_for_text(browser, "#state", line)
    assert text(browser, "#advice")


def test_every_hand_is_offered_and_missing_ones_say_what_installs_them(
    browser: Browser, server: Server
) -> None:
    open_page(browser, server)
    wait_for_text(browser, "#state", "Ready")
    offered = browser.evaluate(
        "Array.from(document.querySelector('#right select').options,"
        " ({ value, text, disabled }) => [value, text, disabled])"
    )
    robots = [name for name in hand_names() if name not in HUMAN_HANDS]
    missing = [
        [name, f"{name} ({reason})", True] for name, reason in missing_hands().items()
    ]
    assert offered[0] == ["", "none", False]
    everything = [*([name, name, False] for name in robots), *missing]
    assert sorted(offered[1:]) == sorted(everything)


def test_hands_are_grouped_by_family_and_those_to_use_come_first(
    browser: Browser, server: Server
) -> None:
    open_page(browser, server)
    wait_for_text(browser, "#state", "Ready")
    service = "import('./families.js').then(({ familyGroups }) => familyGroups"
    robots, missing = (
        ["b_left", "b_right", "c", "d_right"],
        {"a_left": "pip", "a_right": "pip", "d_left": "pip"},
    )
    groups = browser.evaluate(
        f"{service}({json.dumps(robots)}, {json.dumps(missing)}).map((group) =>"
        " [group.label, Array.from(group.children, ({ value }) => value)]))"
    )
    assert groups == [
        ["b", ["b_left", "b_right"]],
        ["c", ["c"]],
        ["d", ["d_right", "d_left"]],
        ["a: not installed", ["a_left", "a_right"]],
    ]


def test_the_page_says_what_every_status_means(
    browser: Browser, server: Server
) -> None:
    open_page(browser, server)
    browser.wait_for("document.querySelector('#statuses tbody').children.length > 0")
    shown = browser.evaluate(
        "Array.from(document.querySelectorAll('#statuses tbody tr'),"
        " (row) => Array.from(row.children, ({ textContent }) => textContent))"
    )
    table = json.loads(STATUSES.read_text(encoding="utf-8"))
    assert shown == [[name, each["means"], each["do"]] for name, each in table.items()]
    # A robot that nobody moves yet has its status in words, with what to do.
    with connected(server, name="lab"):
        browser.wait_for("document.querySelector('[data-name=lab]') !== null")
        wait_for_text(browser, "[data-name=lab] .mode", table["waiting"]["means"])
        wait_for_text(browser, "[data-name=lab] .todo", table["waiting"]["do"])
    assert browser.errors == []


def test_the_stop_works_without_the_table_of_statuses(
    browser: Browser, server: Server
) -> None:
    open_page(browser, server, more="window.fetch = () => Promise.reject(Error());")
    with connected(server, name="lab", is_shared=True) as lab:
        wait_for_text(browser, "#scope", "Stops the robot")
        browser.click_on("#stop")
        wait_until(lambda: lab.status().mode == "stopped")
        browser.wait_for("document.querySelector('[data-name=lab]') !== null")
        wait_for_text(browser, "[data-name=lab] .mode", "stopped")
    assert browser.errors == []


@pytest.mark.parametrize("name", ["leap_rigth", *list(missing_hands())[:1]])
def test_a_hand_of_the_address_that_cannot_be_led_is_named(
    browser: Browser, server: Server, name: str
) -> None:
    open_page(browser, server, words=f"?right={name}&left=")
    wait_for_text(browser, "#state", "Ready")
    reason = missing_hands().get(name, "the service has no such robot hand")
    assert text(browser, "#right .state") == f"{name}: {reason}; choose another"
    assert browser.evaluate("document.querySelector('#right').dataset.state") == "error"
    assert text(browser, "#left .state") == "no robot chosen"
    # Choosing a hand is the answer.
    browser.evaluate(
        "(() => { const select = document.querySelector('#right select');"
        "select.value = 'three_finger'; select.dispatchEvent(new Event('change')); })()"
    )
    wait_for_text(browser, "#right .state", "not started")


def test_a_headset_without_hand_tracking_is_named(
    browser: Browser, server: Server
) -> None:
    open_page(browser, server, more="emulated.hasHands = false;")
    wait_for_text(browser, "#state", "Ready")
    browser.click_on("#start-vr")
    wait_for_text(browser, "#message", "hand tracking")


def test_a_missing_token_can_be_entered(browser: Browser, server: Server) -> None:
    open_page(browser, server, token="wrong")
    wait_for_text(browser, "#state", "Not connected")
    wait_for_text(browser, "#advice", "token")
    browser.evaluate(
        "(() => { const field = document.querySelector('#token');"
        f"field.value = ' {TOKEN} '; field.dispatchEvent(new Event('change')); }})()"
    )
    wait_for_text(browser, "#state", "Ready")
    loaded = browser.evaluate(
        "performance.getEntriesByType('resource').map((e) => e.name)"
    )
    assert loaded
    assert all(f"127.0.0.1:{server.ports['web']}/" in name for name in loaded)
