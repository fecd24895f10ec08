"""The tab of the page with gestures as they are mapped, and with pictures to choose the palm by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from handmap_core.errors import HandmapError
from handmap_core.se3 import Array, Arrays
from handmap_qp.apps.viewer.controls import add_controls, say
from handmap_qp.hands import HandSpec, load_hand
from .background import Background
from .detect import Detection
from .edit import with_other_palm
from .gestures import draw_gestures
from .palm_turns import Turn, with_turn

Pair = tuple[HandSpec, HandSpec]
# Turns of the palm by which the hypotheses of a pair differ from the description; the first pair is
# the description itself and the other hand that the thumb's place allows.
_PAIRS: tuple[tuple[Turn, ...], ...] = (
    ("y", "dorsal"),
    ("distal", "dorsal"),
    ("x", "dorsal"),
    ("z", "distal"),
)
PAIRS = 1 + len(_PAIRS)
"""Pairs of hypotheses, which `neither` leads through."""


class Drawn(NamedTuple):
    """Gestures as they are mapped.

    Attributes:
        pictures: Pictures by gesture, as of `draw_gestures`.
        scores: Scores in words.
        fists: Pictures of a fist of both hypotheses, side by side, if they are asked for.
        pair: The hypotheses.
    """

    pictures: Arrays
    scores: str
    fists: Array | None
    pair: Pair | None


def hypotheses(spec: HandSpec, number: int) -> Pair:
    """Return two descriptions with different palms.

    Args:
        spec: The description.
        number: Which pair, from 0 on: the description and its palm turned over, then quarter turns
            about the direction of the fingers, then the fingers in other directions.
    """
    hand = load_hand(spec)
    if number % PAIRS == 0:
        return spec, with_other_palm(hand)
    first, second = _PAIRS[number % PAIRS - 1]
    one = with_turn(hand, first)
    return one, with_turn(load_hand(one), second)


class GestureTab:
    """Shows gestures as they are mapped, which are computed in the background.

    Args:
        gui: Where viser adds controls.
        tab: The tab.
        status: The text that says that gestures are mapped, or why they cannot be.
        press: Called with the name of a button of the choice, and the browser's handle.

    Attributes:
        pair: The hypotheses that are shown; None if there is no question.
        drawn: Number of descriptions that were mapped and shown.
    """

    def __init__(
        self, gui: Any, tab: Any, status: Any, press: Callable[[str, Any], object]
    ) -> None:
        self._gui = gui
        self._tab = tab
        self._status = status
        self._press = press
        self._work = Background[Drawn]()
        self._started: tuple[Detection, int | None] | None = None
        self._folder: Any = None
        self.pair: Pair | None = None
        self.drawn = 0

    def update(self, found: Detection, question: int | None) -> None:
        """Show what was mapped, and map the description if it is another one; call it often.

        Args:
            found: The description.
            question: Number of the pair of hypotheses to choose from; None to ask nothing.
        """
        if self._work.is_busy:
            outcome = self._work.take()
            if outcome is None:
                return
            # A description that was corrected meanwhile is not shown as it was.
            if self._is_started(found, question):
                self._show(outcome)
        if not self._is_started(found, question):
            self._started = (found, question)
            say(self._status, "mapping the gestures …")
            self._work.start(lambda: _draw(found, question))

    def _is_started(self, found: Detection, question: int | None) -> bool:
        if self._started is None:
            return False
        before, asked = self._started
        return before is found and asked == question

    def _show(self, outcome: Drawn | HandmapError) -> None:
        """Show gestures, or why there are none."""
        self.drawn += 1
        if isinstance(outcome, HandmapError):
            say(self._status, outcome)
            self.pair = None
            return
        say(self._status, None)
        gui = self._gui
        if self._folder is not None:
            self._folder.remove()
        with self._tab:
            self._folder = gui.add_folder("as mapped")
        self.pair = outcome.pair
        with self._folder:
            gui.add_markdown(outcome.scores)
            if outcome.fists is not None:
                gui.add_image(outcome.fists, label="Which picture is a fist?")
                add_controls(gui, "choosing", self._press)
            for name, picture in outcome.pictures.items():
                gui.add_image(np.hstack([*picture]), label=name)


def _draw(found: Detection, question: int | None) -> Drawn:
    """Map the gestures, and the fist of both hypotheses."""
    pictures, scores = draw_gestures(load_hand(found.spec))
    if question is None:
        return Drawn(pictures, scores, None, None)
    pair = hypotheses(found.spec, question)
    fists = []
    for spec in pair:
        shown = pictures
        if spec is not found.spec:
            shown, _ = draw_gestures(load_hand(spec))
        fists.append(shown["fist"][1])
    return Drawn(pictures, scores, np.hstack(fists), pair)
