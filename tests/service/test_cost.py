"""What an answer costs, in calls: exact under any load.

`sys.setprofile` reports each call of a function of Python ("call") and of C ("c_call") in this
thread, from `Dispatcher.receive` to the callback that takes the answer. Both are counted, because
work that moves from Python to numpy is still work. Calls of types, operators and the core's own
functions inside C++ are not reported. The first samples are left out: they measure and cache.
"""

from __future__ import annotations

import asyncio
import gc
import sys
from collections import Counter
from collections.abc import Callable
from types import FrameType
from typing import Any

import msgspec
import numpy as np
import pytest
from live_cases import moving_hand
from marks import full
from service_tools import CACHE, PERIOD, Sampler, human_q, opening

from handmap_core.human.recording import Recording, sample_columns
from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.logs import Metrics
from handmap_qp.apps.service.sessions import Caller, Sessions
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client.messages import HandSample, Step
from handmap_qp.hands import Side

MOST_CALLS = 111
"""Calls of Python and C for an answer."""
MOST_CALLS_FOR_TWO = 334
"""Likewise for a robot with two hands."""
MOST_CALLS_OF_A_TICK = 14
"""Calls for a look at a session that is led, of which there are 50 in a second."""
WARM = 20
MEASURED = 20


def rows_of(landmarks: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    """Return landmarks as a message has them."""
    return tuple((x, y, z) for x, y, z in landmarks.tolist())


def samples(kind: str) -> list[Step]:
    """Return the samples of a hand that moves, which are all followed."""
    sampler = Sampler()
    count = WARM + MEASURED
    if kind == "q":
        return [sampler(i * PERIOD, human_q(0.05 * i)) for i in range(count)]
    seen = [each for each in sample_columns(moving_hand(count + 1)) if each.valid]
    rows = [rows_of(each.landmarks) for each in seen]
    return [sampler(i * PERIOD, landmarks=rows[i]) for i in range(count)]


def profiled(
    note: Callable[[FrameType, str, Any], None],
    function: Callable[..., object],
    *arguments: object,
) -> None:
    """Call a function; note its calls, but not those of finalizers of other objects."""
    gc.disable()
    sys.setprofile(note)
    try:
        function(*arguments)
    finally:
        sys.setprofile(None)
        gc.enable()


def calls_of_answers(steps: list[Step], **choices: Any) -> list[Counter[str]]:
    """Return the calls of each answer after the first ones, by name.

    The last count is that of a tick behind them.
    """
    now = 0.0
    sessions = Sessions(Settings(rate=1e6), CACHE, Metrics(), clock=lambda: now)
    dispatcher = Dispatcher(sessions)
    asyncio.run(sessions.open(opening(**choices), Caller()))
    answers: list[bytes] = []
    counts: list[Counter[str]] = []

    def count(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call":
            counts[-1][frame.f_code.co_qualname] += 1
        elif event == "c_call":
            counts[-1][f"{argument.__name__} in {frame.f_code.co_qualname}"] += 1

    for step in steps:
        now = step.time
        payload = msgspec.msgpack.encode(step)
        counts.append(Counter())
        profiled(count, dispatcher.receive, payload, "test", answers.append)
    counts.append(Counter())
    profiled(count, dispatcher.tick)
    sessions.close()
    rules = {msgspec.msgpack.decode(answer)["rule"] for answer in answers[WARM:]}
    assert rules == {""}
    return counts[WARM:]


@pytest.mark.parametrize("robot", ["allegro_right", "three_finger"])
@pytest.mark.parametrize("preset", [None, "paper"])
@pytest.mark.parametrize("kind", ["landmarks", "q"])
def test_an_answer_takes_few_calls(robot: str, preset: str | None, kind: str) -> None:
    choices: dict[str, Any] = {"robot": robot, "preset": preset, "input": kind}
    if kind == "landmarks":
        choices["hand_length"] = 0.18
    *answers, tick = calls_of_answers(samples(kind), **choices)
    for counts in answers:
        assert counts.total() <= MOST_CALLS, counts.most_common()
    assert tick.total() <= MOST_CALLS_OF_A_TICK, tick.most_common()


@pytest.mark.parametrize("robot", ["g1", full("alex")])
def test_an_answer_for_two_hands_takes_few_calls(robot: str) -> None:
    sampler = Sampler()
    count = WARM + MEASURED
    hands: dict[Side, Recording] = {
        side: moving_hand(count + 11, side) for side in ("left", "right")
    }
    steps = []
    for i in range(11, count + 11):
        both: dict[Side, HandSample] = {
            side: HandSample(landmarks=rows_of(recording.landmarks[i]))
            for side, recording in hands.items()
        }
        steps.append(sampler(i * PERIOD, wrist=None, hands=both))
    choices = {"input": "landmarks", "hand_length": 0.18}
    *answers, tick = calls_of_answers(steps, robot=robot, preset=None, **choices)
    for counts in answers:
        assert counts.total() <= MOST_CALLS_FOR_TWO, counts.most_common()
    assert tick.total() <= MOST_CALLS_OF_A_TICK, tick.most_common()


def test_a_count_does_not_depend_on_the_machine() -> None:
    first, second = (calls_of_answers(samples("q"), preset="paper") for _ in range(2))
    assert first == second
