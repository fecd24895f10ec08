"""The page of `handmap hands edit` in a headless Chromium, operated by clicks that are counted."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import pytest
from browser import Browser, find_chromium
from patience import wait_until
from repair import label_of

from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.se3 import quat_wxyz_from_rotation, rotation_from_quat_wxyz

# The lists of the page, without the hidden inputs that have the same values.
_LISTS = "input[role=combobox]"


def chromium() -> str:
    """Return the browser's program; skip the test without one."""
    program = find_chromium()
    if program is None:
        pytest.skip(
            "no Chromium: install one (on Debian: chromium), or name one in HANDMAP_CHROMIUM"
        )
    return program


class Page:
    """What a user clicks on the page.

    Args:
        browser: The browser, with the page open.

    Attributes:
        clicks: Number of clicks so far.
    """

    def __init__(self, browser: Browser) -> None:
        self.browser = browser
        self.clicks = 0

    def click(self, query: str, label: str) -> None:
        """Click what has a label once it is there; viser drops what comes within 50 ms."""
        time.sleep(0.3)
        node = f"[...document.querySelectorAll('{query}')].find({label})"
        self.browser.wait_for(f"!!{node}")
        self.browser.evaluate(f"{node}.click()")
        self.clicks += 1

    def press(self, button: str) -> None:
        """Press a button."""
        self.click("button", f"e => e.innerText.trim() == '{button}'")

    def choose(self, before: str, name: str) -> None:
        """Choose an entry of the first list that shows another one."""
        self.click(_LISTS, f"e => e.value == '{before}'")
        self._pick(name)

    def choose_in(self, label: str, name: str) -> None:
        """Choose an entry of the list with a label."""
        row = "p => p && (p.innerText.trim() == wanted ? true : above(p.parentElement))"
        is_of = f"(() => {{ const wanted = '{label}'; const above = {row}; return above; }})()"
        self.click(_LISTS, f"e => ({is_of})(e.parentElement)")
        self._pick(name)

    def _pick(self, name: str) -> None:
        """Click an entry of the open list, and wait until the list is closed and shows it.

        The page has the entries of all lists, and draws those of a list while it closes.
        """
        opened = f"document.querySelector('{_LISTS}[aria-expanded=true]')"
        self.browser.wait_for(f"!!{opened}")
        chosen = f"{opened}?.getAttribute('aria-controls')"
        self.click(
            "[role=option]",
            f"e => e.closest('[role=listbox]').id == {chosen} && e.innerText.trim() == '{name}'",
        )
        self.browser.wait_for(f"!{opened}")
        self.browser.wait_for(
            f"[...document.querySelectorAll('{_LISTS}')].some(e => e.value == '{name}')"
        )


class Clicks:
    """An `Operator` of the page in a browser.

    Args:
        page: The page.
        editor: What serves it.
    """

    def __init__(self, page: Page, editor: HandEditor) -> None:
        self.page = page
        self.editor = editor

    @property
    def clicks(self) -> int:
        """Number of clicks so far."""
        return self.page.clicks

    def add_clicks(self, count: int) -> None:
        """Count clicks that are made otherwise."""
        self.page.clicks += count

    def press(self, name: str) -> None:
        """Press a button, and wait until the description is another one."""
        self._and_wait(lambda: self.page.press(label_of(name)))

    def turn(self, axis: str) -> None:
        """Press one of the buttons of a quarter turn."""
        self._and_wait(lambda: self.page.press(axis))

    def choose(self, label: str, entry: str) -> None:
        """Choose an entry of the list with a label."""
        if label in ("root", "palm"):
            # A user opens their folder first; a script reaches into it.
            self.add_clicks(1)
        self.page.choose_in(label, entry)

    def drag_rings(self, axes: np.ndarray) -> None:
        """Turn the palm's axes by the rings: as they are where a user lets go."""
        editor = self.editor
        wait_until(self._are_rings_drawn, "the rings are not at the palm")
        palm = editor.hand.spec.palm.link
        (pose,) = editor.hand.link_poses([palm], editor._q)
        editor.rings.wxyz = quat_wxyz_from_rotation(pose[:3, :3] @ axes)
        self._and_wait(lambda: editor._press("axes", None))
        self.add_clicks(1)

    def _are_rings_drawn(self) -> bool:
        """Return whether the rings are where the last correction put the palm."""
        editor = self.editor
        started = editor.gestures._started
        turn = editor.hand.frame_pose("palm", editor._q)[:3, :3]
        shown = rotation_from_quat_wxyz(np.array(editor.rings.wxyz))
        is_newest = started is not None and started[0] is editor.found
        return is_newest and bool(np.allclose(shown, turn, atol=1e-3))

    def save(self) -> None:
        """Press Save, and wait until the file is written."""
        self.page.press("Save")
        wait_until(self.editor.out.is_file, "nothing is saved")

    def _and_wait(self, act: Callable[[], None]) -> None:
        before = self.editor.found
        act()
        wait_until(lambda: self.editor.found is not before, "nothing is corrected")


def is_asked(browser: Browser, y: float) -> bool:
    """Click in the middle of the scene; return whether the page asks for the thumb's name."""
    browser.click(710, y)
    time.sleep(1.0)
    return browser.evaluate(
        "document.body.innerText.includes('Name the finger that is called thumb')"
    )
