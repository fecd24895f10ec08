"""The page of `handmap hands edit` in a headless Chromium, operated by clicks that are counted."""

from __future__ import annotations

import time

import pytest
from browser import Browser, find_chromium


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
        self.click("input", f"e => e.value == '{before}'")
        self._pick(name)

    def choose_in(self, label: str, name: str) -> None:
        """Choose an entry of the list with a label."""
        row = "p => p && (p.innerText.trim() == wanted ? true : above(p.parentElement))"
        is_of = f"(() => {{ const wanted = '{label}'; const above = {row}; return above; }})()"
        self.click("input", f"e => ({is_of})(e.parentElement)")
        self._pick(name)

    def _pick(self, name: str) -> None:
        """Click an entry of the open list; the page has the entries of all lists."""
        is_shown = "e.offsetParent !== null"
        self.click(
            "[role=option]", f"e => {is_shown} && e.innerText.trim() == '{name}'"
        )


def is_asked(browser: Browser, y: float) -> bool:
    """Click in the middle of the scene; return whether the page asks for the thumb's name."""
    browser.click(710, y)
    time.sleep(1.0)
    return browser.evaluate(
        "document.body.innerText.includes('Name the finger that is called thumb')"
    )
