"""What a mapped recording shows of its time, wrist and size, and what was assumed of them.

`handmap retarget` prints it below the summary of the robot's motion.
"""

import math
from collections.abc import Sequence

from handmap_qp.hands import Values
from handmap_qp.human import Recording
from handmap_qp.trackers import STILL_TRAVEL, STILL_TURN, hints, recording_facts

_EQUAL = 0.01  # share of a step by which steps of one rate may differ
_STAMPS = "the time stamps of the file"


def describe_input(recording: Recording) -> Values:
    """Describe a recording by plain values, with the unit in their name; None is not known.

    `time` says where the instants are from; `rate_hz` and `step_ms` (5th and 95th percentile) how
    they follow each other; `finger_frequency_hz` how fast the fingers move. `palm_turn_deg` and
    `palm_travel_mm` measure the palm, and `wrist_turn_deg` and `wrist_travel_mm` the wrist poses of
    the file, which are not mapped. `size_ratio` is the largest over the smallest size of the hand.
    `hints` has a line for each thing that is unusual (`trackers.hints`).
    """
    facts = recording_facts(recording)
    has_wrist = facts.has_wrist
    return {
        "side": recording.side,
        "time": facts.time_source or _STAMPS,
        "rate_hz": _known(facts.rate),
        "step_ms": [_known(1e3 * step) for step in facts.steps],
        "finger_frequency_hz": _known(facts.frequency),
        "palm_turn_deg": math.degrees(facts.palm_turn),
        "palm_travel_mm": 1e3 * facts.palm_travel,
        "wrist_turn_deg": math.degrees(facts.wrist_turn) if has_wrist else None,
        "wrist_travel_mm": 1e3 * facts.wrist_travel if has_wrist else None,
        "size_ratio": _known(facts.growth),
        "hints": hints(facts),
    }


def input_rows(inputs: Sequence[Values]) -> dict[str, str]:
    """Return what was assumed of each recording as text, by label."""
    rows = {}
    for found in inputs:
        which = f", {found['side']} hand" if len(inputs) > 1 else ""
        rows[f"time{which}"] = _time_text(found)
        rows[f"wrist{which}"] = _wrist_text(found)
        rows[f"size of the hand{which}"] = _size_text(found)
    return rows


def input_notes(inputs: Sequence[Values]) -> list[str]:
    """Return a line for each thing that is unusual in the recordings."""
    notes = []
    for found in inputs:
        which = f"{found['side']} hand: " if len(inputs) > 1 else ""
        notes += [which + hint for hint in found["hints"]]
    return notes


def _time_text(found: Values) -> str:
    rate = found["rate_hz"]
    if rate is None:
        return found["time"]
    short, long = found["step_ms"]
    is_even = long - short <= _EQUAL * 1e3 / rate
    steps = "equal steps" if is_even else f"steps of {short:.3g} to {long:.3g} ms"
    frequency = found["finger_frequency_hz"]
    fingers = (
        "fingers hardly move"
        if frequency is None
        else f"fingers move at {frequency:.2g} Hz"
    )
    return f"{found['time']}: {rate:.3g} samples/s in {steps}; {fingers}"


def _wrist_text(found: Values) -> str:
    turn = found["palm_turn_deg"]
    travel = found["palm_travel_mm"]
    if turn <= math.degrees(STILL_TURN) and travel <= 1e3 * STILL_TRAVEL:
        motion = "which does not move in this file"
    else:
        motion = f"which turns by {turn:.0f} deg and travels {travel:.0f} mm"
    if found["wrist_turn_deg"] is None:
        own = "the file has no wrist poses"
    else:
        own = "the wrist poses of the file are not mapped"
    return f"that of the palm's landmarks, {motion}; {own}"


def _size_text(found: Values) -> str:
    ratio = found["size_ratio"]
    if ratio is None:
        return "taken as constant; the recording is too short to tell"
    return f"taken as constant; it changes by {100.0 * (ratio - 1.0):.0f} %"


def _known(number: float) -> float | None:
    return None if math.isnan(number) else number
