"""What a hand may be, and which evidence speaks for it: one table, one score.

A *hypothesis* says which finger is the thumb, whether the palm is turned over against what the
joints' ranges say, whether fingers with one joint each are fingers or jaws, and whether the hand
points where its fingers or where the arm does. That settles the side, the directions of the palm,
the straight posture and the order of the fingers' names. Each kind
of evidence says from -1 (contradicts it) to 1 (agrees) what it thinks of it. The hypothesis with
the largest weighted sum is taken, and it is as certain as it is ahead of the next one.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

from handmap_qp.hands import Side
from .single_joints import FingerKind

# Confidence with two kinds of evidence that agree, with one, and with two that disagree.
CERTAIN = 0.95
LIKELY = 0.75
DISPUTED = 0.5
CLEAR = 0.3
"""Score margin of a clear answer."""
VISIBLE = 0.1
"""Score margin of an answer."""
CLEAR_FLEXION = 0.9
"""Ranges that show flexion with more confidence than this are clear."""


@dataclass(frozen=True, slots=True)
class Term:
    """One kind of evidence.

    Attributes:
        name: Its name, as in the values of a hypothesis.
        weight: What it counts.
        agrees: What it says of a hypothesis that it agrees with.
        differs: What it says of one that it contradicts.
    """

    name: str
    weight: float
    agrees: str
    differs: str


TERMS = (
    Term("difference", 4.0, "this finger differs most", "another finger differs more"),
    Term("thumb name", 4.0, "the names say thumb", "the names call another finger a thumb"),
    Term("flexion", 2.0, "the joints' ranges flex to the palm", "the joints flex to the back"),
    Term("side name", 1.0, "the names have this side", "the names have the other side"),
    Term("other hand", 1.5, "the other hand has the other side", "the other hand has this side"),
    Term("finger names", 0.8, "the fingers' names begin at the thumb",
         "the fingers' names begin at the other side"),
    Term("thumb ahead", 0.5, "the thumb closes before the palm",
         "the thumb closes behind the back"),
    Term("parallel", 5.0, "this kind of fingers are parallel at zero as these are",
         "another kind of fingers are parallel at zero as these are"),
    Term("range", 3.0, "this kind of fingers has zero at that place of its range",
         "another kind of fingers has zero at that place of its range"),
    Term("apart", 6.0, "this kind of fingers goes apart from zero",
         "another kind of fingers goes apart from zero"),
    Term("thumb and finger", 6.0, "the names say a thumb and a finger",
         "the names say a thumb and a finger"),
    Term("straight fingers", 3.0, "the fingers do not tell their direction",
         "the straight fingers have another direction"),
    Term("arm", 1.0, "the joint of the arm that turns the hand about its length has this direction",
         "the joint of the arm that turns the hand about its length has another direction"),
)  # fmt: skip
"""All kinds of evidence.

The ranges of joints that flex to one side only outweigh a name of the wrong side, as of a copied
file; a name outweighs ranges that show little. Where names say which finger is the thumb, no
difference outweighs them. The next four tell fingers with one joint each from jaws: a row of
parallel fingers, or a thumb by name, outweighs ranges; a pair that opens away from the others does
not make a row. The arm outweighs fingers only if where their tips are is a guess.
"""
SMALL_MARGIN = 0.4
"""The next hypothesis is named if it is less than this behind."""
_OVERRULED = 0.5


def score(values: Mapping[str, float], *, without: str = "") -> float:
    """Return the weighted sum of evidence, perhaps without one kind of it."""
    return sum(
        term.weight * values.get(term.name, 0.0)
        for term in TERMS
        if term.name != without
    )


class Hypothesis(NamedTuple):
    """What a hand may be.

    Attributes:
        thumb: Index of the finger that is the thumb; None of a hand with one finger.
        link: The thumb's last link.
        side: The hand's side.
        is_turned: Whether the palm is turned over against the flexion that was found.
        values: What each kind of evidence says, from -1 to 1, by its name; 0 is left out.
        kind: What its fingers with one flexing joint are; None if there are none.
        is_along_arm: Whether it points where the arm does, and not where its fingers do.
    """

    thumb: int | None
    link: str
    side: Side
    is_turned: bool
    values: Mapping[str, float]
    kind: FingerKind | None = None
    is_along_arm: bool = False

    @property
    def answer(self) -> tuple[int | None, Side, bool, FingerKind | None, bool]:
        """What it says: thumb, side, if the palm is turned over, the kind, if along the arm."""
        return self.thumb, self.side, self.is_turned, self.kind, self.is_along_arm

    @property
    def options(self) -> tuple[int | None, Side, bool, FingerKind | None]:
        """What an option of the command, or a picture of the page, chooses of it."""
        return self.answer[:-1]

    @property
    def score(self) -> float:
        """The weighted sum of all evidence."""
        return score(self.values)

    def overrules(self, other: "Hypothesis") -> bool:
        """Return whether it says something else with clearly more evidence."""
        return bool(self.differences(other)) and self.score > other.score + _OVERRULED

    def differences(self, other: "Hypothesis") -> list[str]:
        """Return in which answers two hypotheses differ: for another kind, in where distal is."""
        whats = ("thumb", "side", "dorsal", "distal", "distal")
        answers = zip(whats, self.answer, other.answer, strict=True)
        return [
            *dict.fromkeys(what for what, mine, theirs in answers if mine != theirs)
        ]

    def is_near(self, other: "Hypothesis") -> bool:
        """Return whether another one has nearly as much evidence."""
        return self.score - other.score < SMALL_MARGIN

    def doubt(self, following: "Hypothesis") -> str:
        """Return a note about the next hypothesis, and how to choose it, if it is near."""
        if not self.is_near(following):
            return ""
        options, words = [], []
        if self.thumb != following.thumb:
            words.append(f"the thumb may be {following.link}")
            options.append(f"--thumb {following.link}")
        if self.side != following.side:
            words.append(f"it may be a {following.side} hand")
            options.append(f"--side {following.side}")
        if self.kind != following.kind:
            words.append(f"its fingers may be {following.kind}")
            options.append(f"--kind {following.kind}")
        return (
            f"{' and '.join(words)}: choose that with {' '.join(options)} (evidence "
            f"{following.score:.2f}, of what was taken {self.score:.2f})"
        )

    def told_from(self, other: "Hypothesis") -> str:
        """Return what speaks most for this one and against another one, in words."""
        terms = {
            term: term.weight
            * (self.values.get(term.name, 0.0) - other.values.get(term.name, 0.0))
            for term in TERMS
        }
        best = max(terms, key=lambda term: terms[term])
        agrees = self.values.get(best.name, 0.0) > 0.0
        return best.agrees if agrees else f"not so: {best.differs}"
