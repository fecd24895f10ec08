"""The page of `hands edit` answers while gestures are mapped, and shows the newest ones only."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from patience import wait_until

from handmap_qp import Hand, HandError, HandSpec, load_hand
from handmap_qp.apps.onboarding import edit
from handmap_qp.apps.onboarding.background import Background
from handmap_qp.apps.onboarding.choices import PALMS, palms
from handmap_qp.apps.onboarding.editor import HandEditor
from handmap_qp.apps.onboarding.palm_turns import palm_axes
from handmap_qp.apps.viewer.serving import serving


class Mapping:
    """Stands in for `draw_gestures`: maps when it is allowed to."""

    def __init__(self) -> None:
        self.allowed = threading.Semaphore(0)
        self.started: list[str] = []
        self.problem: HandError | None = None

    def __call__(self, hand: Hand) -> tuple[dict[str, np.ndarray], str]:
        self.started.append(hand.side)
        assert self.allowed.acquire(timeout=180.0)
        if self.problem:
            raise self.problem
        return {"fist": np.full((2, 4, 4, 3), 0.5)}, f"scores of {hand.side}"


@pytest.fixture
def mapping(monkeypatch: pytest.MonkeyPatch) -> Iterator[Mapping]:
    """Replace the mapping of gestures by one that waits."""
    mapping = Mapping()
    monkeypatch.setattr("handmap_qp.apps.onboarding.gesture_tab.draw_gestures", mapping)
    yield mapping
    mapping.allowed.release(100)


def test_requests_are_answered_while_gestures_are_mapped(
    mapping: Mapping, tmp_path: Path
) -> None:
    with serving() as server:
        found = edit.open_description("allegro_left")
        editor = HandEditor(server, found, tmp_path / "mine.yaml")
        editor.tick()
        wait_until(lambda: mapping.started == ["left"])
        # Ten corrections, and none of them waits for the first mapping.
        for number in range(10):
            editor._press("side", None)
            editor.tick()
            assert editor.hand.side == ("left" if number % 2 else "right")
        editor._press("side", None)
        editor.tick()
        assert mapping.started == ["left"]
        assert editor.gestures.drawn == 0
        assert "mapping" in editor.status.content
        # What was mapped meanwhile is of another hand: only the newest is shown.
        mapping.allowed.release()
        wait_until(lambda: editor.tick() or len(mapping.started) == 2)
        assert mapping.started == ["left", "right"]
        assert editor.gestures.drawn == 0
        mapping.allowed.release()
        wait_until(lambda: editor.tick() or editor.gestures.drawn == 1)
        assert not editor.status.visible
        for _ in range(5):
            editor.tick()
        assert len(mapping.started) == 2


def test_why_gestures_cannot_be_mapped_is_said(
    mapping: Mapping, tmp_path: Path
) -> None:
    mapping.problem = HandError("it has no hand")
    mapping.allowed.release()
    with serving() as server:
        found = edit.open_description("allegro_left")
        editor = HandEditor(server, found, tmp_path / "mine.yaml")
        wait_until(lambda: editor.tick() or editor.gestures.drawn == 1)
        assert "it has no hand" in editor.status.content


def test_neither_leads_to_other_palms_and_a_picture_chooses_one(
    mapping: Mapping, tmp_path: Path
) -> None:
    mapping.allowed.release(1000)
    with serving() as server:
        found = edit.open_description("allegro_left")
        editor = HandEditor(server, found, tmp_path / "mine.yaml")

        def see(request: str | None, drawn: int) -> None:
            if request:
                editor._press(request, None)
            wait_until(lambda: editor.tick() or editor.gestures.drawn == drawn)

        see(None, 1)
        assert editor.gestures.question is None

        def pair() -> list[HandSpec]:
            question = editor.gestures.question
            assert question is not None
            return [choice.spec for choice in question.choices]

        see("palms", 2)
        pairs = [pair()]
        for number in range(PALMS):
            see("neither", 3 + number)
            pairs.append(pair())
        # After the last pair, the first one comes again.
        assert pairs[-1] == pairs[0]
        assert pairs[0][0] == found.spec
        see("neither", 3 + PALMS)
        _, chosen = pair()
        see("right", 4 + PALMS)
        assert editor.found.spec == chosen
        assert editor.gestures.question is None


@pytest.mark.parametrize("name", ["three_finger", "allegro_left"])
def test_hypotheses_are_different_palms(name: str) -> None:
    spec = load_hand(name).spec
    axes = [
        tuple(palm_axes(each).round(6).ravel().tolist())
        for number in range(PALMS)
        for each in palms(spec, number)
    ]
    assert len({*axes}) == len(axes)


def test_a_background_passes_on_results_problems_and_bugs() -> None:
    work = Background[int]()
    assert not work.is_busy
    work.start(lambda: 3)
    assert work.is_busy
    assert wait_until(work.take) == 3
    assert not work.is_busy

    def fail() -> int:
        raise HandError("no")

    work.start(fail)
    assert isinstance(wait_until(work.take), HandError)
    work.start(lambda: 1 // 0)
    with pytest.raises(ZeroDivisionError):
        wait_until(work.take)
