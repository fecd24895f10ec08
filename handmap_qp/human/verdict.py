"""What is said about a sample of a tracker: rules, findings and verdicts.

`stream.guard` and `trackers.plausibility` make them; `MapStep` carries them.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

Rule = Literal[
    "",
    "missing",
    "zero",
    "size",
    "outlier",
    "jump",
    "flip",
    "frozen",
    "gap",
    "settling",
    "duplicate",
    "disorder",
    "clock_jump",
    "time",
    "unit",
    "order",
    "side",
    "flexion",
    "wrist",
    "unproven",
]
"""Name of what is wrong with a sample; empty if nothing is."""

RULES: dict[Rule, str] = {
    "missing": "the tracker did not see the hand, or its confidence is 0",
    "zero": "landmarks lie in one place or at the origin, as trackers send when they see no hand",
    "size": "the palm is less than half or more than twice as large as the person's, or the hand's "
    "size changed for a while",
    "outlier": "one landmark left its place on the hand: lengths of bones changed at once",
    "jump": "the hand moved faster, or from one speed to another, than hands do",
    "flip": "the hand turned over or became its mirror image from one sample to the next",
    "frozen": "the landmarks have repeated exactly for 0.25 s, or one finger for a while",
    "gap": "no sample came for more than 0.25 s; it is followed where the hand has not moved",
    "settling": "the samples make sense again, but not yet for long enough",
    "duplicate": "the time stamp is the same as that of the sample before",
    "disorder": "the time stamp is earlier than that of the sample before",
    "clock_jump": "the tracker's clock was set; the hand is where it was and is followed",
    "time": "for a while: time stamps are not in seconds, or do not run as samples arrive",
    "unit": "for a while: landmarks are not in metres",
    "order": "for a while: landmarks are in another order",
    "side": "for a while: landmarks are those of the other hand, or of a mirrored world",
    "flexion": "for a while: fingers bend backwards",
    "wrist": "for a while: the wrist's orientation does not follow the palm of the landmarks",
    "unproven": "the wrist has not followed a palm that turned yet; it is followed at a quarter of "
    "the speed limits",
}
"""The rules, in words."""

UNPROVEN_SPEED = 0.25
"""Share of the speed limits at which the robot follows a wrist that is not proven yet."""

Mistake = Literal["time", "unit", "order", "side", "flexion", "size", "frozen", "wrist"]
"""Kinds of mistakes: the unit or rate of time, the unit of length, the order of landmarks, the
other hand or a mirrored world, fingers that bend backwards, a size that changes, a finger that
repeats, the wrist's orientation."""


class Finding(NamedTuple):
    """What is wrong with the input.

    Attributes:
        kind: The kind of mistake.
        problem: What was found, in one line.
        advice: What to do about it.
    """

    kind: Mistake
    problem: str
    advice: str

    def __str__(self) -> str:
        """Compose `problem: advice`."""
        return f"{self.problem}: {self.advice}"


class Verdict(NamedTuple):
    """What the guard says about one sample.

    Attributes:
        rule: What is wrong with it; empty if nothing is.
        is_held: The robot must hold: the sample is not to be followed.
        is_return: The first sample to follow after a hold, a gap, or samples that came too late.
        dt: Time that the sample accounts for [s].
        consistency: RMS difference of the distances that cannot change (bones, and neighbours in
            the palm) from the person's [m]; NaN if there are no landmarks.
        finding: What the input is instead of what it says, in words, where the last samples agree
            that it is something else (`trackers.plausibility`).
    """

    rule: Rule
    is_held: bool
    is_return: bool
    dt: float
    consistency: float
    finding: Finding | None = None

    @property
    def speed(self) -> float:
        """Share of the robot's speed limits at which the sample may be followed."""
        return UNPROVEN_SPEED if self.rule == "unproven" else 1.0
