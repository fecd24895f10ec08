"""`Finding`: what the input is instead of what it says, as the core found it, and in words.

The core says which mistake it is, with a number. Sentences are made when they are read, so that a
bad sample takes no longer than a good one.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import msgspec

from handmap_core.core import core
from handmap_core.hands import FINGERS, OTHER_SIDE, Side

HAND_LENGTHS: tuple[float, float] = core.HAND_LENGTHS
"""Lengths that a hand may have [m], from wrist to middle fingertip: from a child's of five years to
more than those of nearly all men. Adults that were tracked have 0.175 to 0.195."""
_STEPS: tuple[float, float] = core.SAMPLE_STEPS
"""Shortest and longest median time between samples [s]: from 2500 Hz to 2 Hz."""
_TIME_UNITS = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
_ADULT = (0.12, 0.26)
"""Usual lengths of an adult's hand [m]."""
_LENGTH_UNITS = {
    1e-3: "so the landmarks are in millimetres (or pixels)",
    1e3: "as if metres had been taken for millimetres",
    1e-2: "so the landmarks are in centimetres",
    1e2: "as if metres had been taken for centimetres",
    0.0254: "so the landmarks are in inches",
    1.0 / 0.0254: "as if metres had been taken for inches",
}
"""Factors that make metres of landmarks in other units, and what they mean."""
_PIXELS = 30.0
"""A hand that is longer in any unit is one of pixels."""

FindingNumbers = tuple[str, str, float, int]
"""What the core says of a finding: its kind, mistake, number and index."""
Words = tuple[str, str]
"""What was found, and what to do about it."""


class Finding(msgspec.Struct, frozen=True):
    """What is wrong with the input.

    Attributes:
        kind: The kind of mistake: a rule that says `for a while`.
        mistake: Which mistake of that kind; a key of the table of sentences.
        side: The hand that the samples are said to be of.
        number: What was measured, where the mistake has a number; else NaN.
        which: Index of a finger or order; -1 where there is none.
        order: Name of the order that the landmarks are in; empty where they are in ours.
    """

    kind: str
    mistake: str
    side: Side
    number: float
    which: int
    order: str

    @classmethod
    def of_core(
        cls, numbers: FindingNumbers | None, side: Side, orders: Sequence[str]
    ) -> Finding | None:
        """Return what the core has found.

        Args:
            numbers: What the core says; None if the input is plausible.
            side: The hand that the samples are said to be of.
            orders: Names of the orders in which landmarks may come.
        """
        if numbers is None:
            return None
        kind, mistake, number, which = numbers
        order = orders[which] if mistake == "order" else ""
        return cls(kind, mistake, side, number, which, order)

    @property
    def problem(self) -> str:
        """What was found, in one line."""
        return WORDS[self.mistake](self)[0]

    @property
    def advice(self) -> str:
        """What to do about it."""
        return WORDS[self.mistake](self)[1]

    def __str__(self) -> str:
        """Compose `problem: advice`."""
        return ": ".join(WORDS[self.mistake](self))


def _say_rate(finding: Finding) -> Words:
    return (
        f"time stamps run at {finding.number:.3g} times the speed at which samples arrive",
        "give the time of the tracker's clock in seconds",
    )


def _say_step(finding: Finding) -> Words:
    step = finding.number
    low, high = _STEPS
    found = f"the time between samples is {step:.6g} s"
    fitting = [name for name, unit in _TIME_UNITS.items() if low <= step * unit <= high]
    if step < low:
        advice = "this looks like seconds divided by a power of 1000"
        return found, f"give time in seconds; {advice}"
    if step == 1.0:
        advice = "give time in seconds, or the rate by --fps"
        return f"{found}, so it counts samples or milliseconds", advice
    if fitting:
        unit = fitting[0]
        return f"{found}, so it is in {unit}", f"multiply it by {_TIME_UNITS[unit]:g}"
    return found, f"give time in seconds, with steps from {low:g} to {high:g} s"


def _say_image(finding: Finding) -> Words:
    return (
        "the wrist's z is always 0, so these are image coordinates (in pixels or of 0 to 1)",
        "give MediaPipe's world landmarks, in metres",
    )


def _say_length(finding: Finding) -> Words:
    length = finding.number
    low, high = HAND_LENGTHS
    found = f"the hand is {length:.3g} m long"
    for factor, meaning in _LENGTH_UNITS.items():
        if _ADULT[0] <= length * factor <= _ADULT[1]:
            return f"{found}, {meaning}", f"multiply the landmarks by {factor:g}"
    if length > _PIXELS:
        found += ", as if the landmarks were pixels"
    return found, f"give landmarks in metres, of a hand of {low} to {high} m"


def _say_order(finding: Finding) -> Words:
    known = f"their order is {finding.order}"
    unknown = "they are no hand in any order known here"
    return (
        "the landmarks are not in the order wrist, thumb, ..., little finger; "
        f"{known if finding.order else unknown}",
        "name the layout of the data (handmap layouts), or reorder them",
    )


def _say_flexion(finding: Finding) -> Words:
    return (
        "the fingers bend backwards, to the back of the hand",
        "turn the sign of the flexion angles, or of the axis that points out of the palm",
    )


_NEGATE = "negate one axis of the data if its coordinates are left-handed"


def _of_another(side: Side, what: str) -> str:
    return f"the landmarks are taken for a {side} hand's, and are those of {what}"


def _say_side(side: Side) -> str:
    return f"say that the hand is the {side} one (--side {side}; side= in Python)"


def _say_other_side(finding: Finding) -> Words:
    other = OTHER_SIDE[finding.side]
    return (
        _of_another(finding.side, f"a {other} hand, or of a mirrored world"),
        f"{_say_side(other)}, or {_NEGATE}",
    )


def _say_other_hand(finding: Finding) -> Words:
    other = OTHER_SIDE[finding.side]
    return (
        _of_another(finding.side, f"a {other} hand, and so is the wrist's pose"),
        _say_side(other),
    )


def _say_mirrored(finding: Finding) -> Words:
    what = f"a mirrored {finding.side} hand; the wrist's pose is not"
    return _of_another(finding.side, what), _NEGATE


def _say_stuck(finding: Finding) -> Words:
    finger = FINGERS[finding.which]
    return (
        f"the {finger} finger repeats exactly while the others do not",
        "check the tracker's sensor or model of that finger",
    )


def _say_resized(finding: Finding) -> Words:
    return (
        f"the hand is {finding.number:.3g} times as large as it was at first",
        "measure the person again, and open a session for each person",
    )


def _say_wrist_away(finding: Finding) -> Words:
    return (
        f"the wrist pose is {finding.number:.3g} m from the wrist's landmark",
        "give both in metres and in the same world",
    )


_LOOSE = "the wrist's orientation does not follow the palm"


def _but(reading: str) -> Callable[[Finding], Words]:
    """Return the sentence about a wrist that follows the palm when it is read otherwise."""

    def say(finding: Finding) -> Words:
        return (
            f"{_LOOSE}, but {reading} would",
            "check the order of the quaternion and the direction of the pose",
        )

    return say


def _say_wrist_loose(finding: Finding) -> Words:
    return (
        f"{_LOOSE} that the landmarks show",
        "check its quaternion's order, and that its world is that of the landmarks",
    )


WORDS: dict[str, Callable[[Finding], Words]] = {
    "rate": _say_rate,
    "step": _say_step,
    "image": _say_image,
    "length": _say_length,
    "order": _say_order,
    "unknown_order": _say_order,
    "flexion": _say_flexion,
    "other_side": _say_other_side,
    "other_hand": _say_other_hand,
    "mirrored": _say_mirrored,
    "stuck": _say_stuck,
    "resized": _say_resized,
    "wrist_away": _say_wrist_away,
    "wrist_wxyz": _but("a quaternion w, x, y, z that was read as x, y, z, w"),
    "wrist_xyzw": _but("a quaternion x, y, z, w that was read as w, x, y, z"),
    "wrist_inverse": _but("its inverse"),
    "wrist_loose": _say_wrist_loose,
}
"""The sentences of each mistake, by the core's names (`core.MISTAKES`)."""
