"""Measure the human hand and the contact gap from the first landmarks of a session."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future

import numpy as np

from handmap_qp.human.contact_gap import TOUCH_GAP, clipped_gap, smallest_gap
from handmap_qp.human.landmarks import check_length, measure_hand
from handmap_qp.human.recording import Recording
from handmap_qp.human.sample import HumanSample
from handmap_qp.human.verdict import Rule
from handmap_qp.service.hand_cache import HandCache
from handmap_qp.service.messages import Open
from handmap_qp.service.opening import Hands, prepare_hands
from handmap_qp.service.refusals import with_field_errors
from handmap_qp.stream.guard import StreamGuard

CALIBRATION_SAMPLES = 30
"""Number of landmark samples that the human hand is measured from."""

_PERIOD = 1.0 / 60.0
"""Usual time between the samples [s]; gaps are medians over 0.1 s."""

Defer = Callable[[Callable[[], Hands]], "Future[Hands]"]
"""Runs slow work in another thread."""


class Calibration:
    """Measure the human hand from landmarks, and prepare the hands of the session with it.

    Args:
        request: The request that opened the session.
        cache: The hands that clients may open.
        defer: Runs the measurement, which takes some 200 ms, in another thread.
    """

    def __init__(self, request: Open, cache: HandCache, defer: Defer) -> None:
        self._request = request
        self._cache = cache
        self._defer = defer
        self._guard = StreamGuard(cache.human(request.side, None))
        self._landmarks: list[np.ndarray] = []
        self._work: Future[Hands] | None = None

    def add(self, sample: HumanSample) -> tuple[Rule, Hands | None]:
        """Take one more sample, unless it makes no sense.

        Args:
            sample: The sample.

        Returns:
            What is wrong with the sample, which is then ignored, empty if nothing; and the hands,
            once they are ready.

        Raises:
            RefusedError: If the landmarks are not a hand in metres; the sample is then ignored. Or
                if the samples so far cannot be measured; then new ones are collected.
        """
        verdict = self._guard.check(sample)
        if verdict.rule in ("missing", "zero"):
            return verdict.rule, None
        landmarks = sample.landmarks
        with_field_errors("landmarks", lambda: check_length(landmarks[None]))
        # The person may be much larger or smaller than the model.
        if verdict.is_held and verdict.rule != "size":
            return verdict.rule, None
        if self._work is None:
            self._landmarks.append(landmarks)
            if len(self._landmarks) >= CALIBRATION_SAMPLES:
                collected, self._landmarks = np.array(self._landmarks), []
                self._work = self._defer(lambda: self._prepare(collected))
        if self._work is None or not self._work.done():
            return "", None
        work, self._work = self._work, None
        return "", work.result()

    def _prepare(self, landmarks: np.ndarray) -> Hands:
        count = len(landmarks)
        recording = Recording(
            "calibration",
            np.arange(count, dtype=float),
            landmarks,
            np.ones(count, dtype=bool),
            self._request.side,
        )
        lengths = with_field_errors("landmarks", lambda: measure_hand(recording))
        # Without a touch, nothing was measured: the preset's own gap is the better guess.
        smallest = smallest_gap(_PERIOD * recording.time, landmarks)
        gap = clipped_gap(smallest) if smallest < TOUCH_GAP else None
        return prepare_hands(self._request, self._cache, lengths, gap)
