"""The tab of the page with gestures as they are mapped, and with pictures to choose a hand by."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from handmap_core.errors import HandmapError
from handmap_core.se3 import Array, Arrays
from handmap_qp.apps.viewer.controls import add_controls, say
from handmap_qp.hands import load_hand
from .background import Background
from .choices import Question, question
from .detect import Detection
from .gestures import draw_gestures

# Stands for a picture that is not drawn yet.
_BLANK = np.ones((1, 1, 3))


class Drawn(NamedTuple):
    """Gestures as they are mapped.

    Attributes:
        pictures: Pictures by gesture, as of `draw_gestures`.
        scores: Scores in words.
        asked: Pictures of both choices of a question, side by side, if there is one.
        question: The question.
    """

    pictures: Arrays
    scores: str
    asked: Array | None
    question: Question | None


class GestureTab:
    """Shows gestures as they are mapped, which are computed in the background.

    Args:
        gui: Where viser adds controls.
        tab: The tab.
        status: The text that says that gestures are mapped, or why they cannot be.
        press: Called with the name of a button of the choice, and the browser's handle.

    Attributes:
        question: The question that is shown; None without one.
        drawn: Number of descriptions that were mapped and shown.
    """

    def __init__(
        self, gui: Any, tab: Any, status: Any, press: Callable[[str, Any], object]
    ) -> None:
        self._gui = gui
        self._status = status
        self._work = Background[Drawn]()
        self._started: tuple[Detection, int | None] | None = None
        self.question: Question | None = None
        self.drawn = 0
        # All controls stay as long as the page: viser drops clicks on one that was removed.
        self._pictures: dict[str, Any] = {}
        with tab:
            self._folder = gui.add_folder("as mapped", visible=False)
        with self._folder:
            self._scores = gui.add_markdown("")
            self._asked = gui.add_image(_BLANK, label="", visible=False)
            self._caption = gui.add_markdown("", visible=False)
            self._choices = add_controls(gui, "choosing", press)
        for button in self._choices:
            button.visible = False

    def update(self, found: Detection, question: int | None) -> None:
        """Show what was mapped, and map the description if it is another one; call it often.

        Args:
            found: The description.
            question: Number of the pair to choose from, as in `choices.question`; None to ask
                nothing.
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
            self.question = None
            return
        say(self._status, None)
        self._folder.visible = True
        self._scores.content = outcome.scores
        self._ask(outcome.question, outcome.asked)
        for name in self._pictures.keys() - outcome.pictures.keys():
            self._pictures[name].visible = False
        for name, both in outcome.pictures.items():
            if name not in self._pictures:
                with self._folder:
                    self._pictures[name] = self._gui.add_image(_BLANK, label=name)
            self._pictures[name].image = np.hstack([*both])
            self._pictures[name].visible = True

    def _ask(self, asked: Question | None, picture: Array | None) -> None:
        """Show a question with its pictures and buttons, or none."""
        self.question = asked
        is_asked = asked is not None and picture is not None
        if asked is not None and picture is not None:
            self._asked.label = asked.text
            self._asked.image = picture
        say(self._caption, asked.caption if asked else None)
        for handle in (self._asked, *self._choices):
            handle.visible = is_asked


def _draw(found: Detection, number: int | None) -> Drawn:
    """Map the gestures, and those of both choices of a question."""
    pictures, scores = draw_gestures(load_hand(found.spec))
    if number is None:
        return Drawn(pictures, scores, None, None)
    asked = question(found, number)
    columns = []
    for choice in asked.choices:
        shown = pictures
        if choice.spec != found.spec:
            shown, _ = draw_gestures(load_hand(choice.spec))
        rows = [shown[name][1] for name in asked.gestures if name in shown]
        columns.append(np.vstack(rows))
    return Drawn(pictures, scores, np.hstack(columns), asked)
