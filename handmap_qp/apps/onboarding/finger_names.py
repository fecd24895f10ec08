"""Anatomical names of fingers and sides in the names of links and joints."""

from __future__ import annotations

import re
from collections.abc import Iterable
from statistics import mode

from handmap_qp.hands.spec import Side

# Long names of fingers, found anywhere in a name.
_WORDS = {
    "thumb": re.compile(r"thumb", re.IGNORECASE),
    "index": re.compile(r"index|fore_?finger|first_?finger|pointer", re.IGNORECASE),
    "middle": re.compile(r"middle|medium|mid_?finger|long_?finger", re.IGNORECASE),
    "ring": re.compile(r"(?<![A-Za-z])[Rr]ing|Ring|RING"),
    "little": re.compile(r"little|pinky|pinkie|small_?finger", re.IGNORECASE),
}
# What stands behind the abbreviations of the Shadow hand, as in `rh_FFJ4` and `ffmiddle`: a phalanx
# or the number of a joint.
_PART = r"(?=[jJ]?_?\d|_|$|prox|mid|dist|knuck|meta|tip|base|hub|touch|biotac|seg)"
# Abbreviations, and single letters as in `hand_T-MP`; at the start of a name one may be a side.
_BRIEF = {
    "thumb": ("th|TH", "tT"),
    "index": ("ff|FF|if|IF", "iI"),
    "middle": ("mf|MF", "mM"),
    "ring": ("rf|RF", "rR"),
    "little": ("lf|LF|pf|PF", "pPlL"),
}
_SHORT = {
    finger: re.compile(rf"(?:^|[^a-zA-Z])(?:{short}){_PART}")
    for finger, (short, _) in _BRIEF.items()
}
_LETTERS = {
    finger: re.compile(rf"(?<=[^a-zA-Z])[{letters}](?![a-zA-Z])")
    for finger, (_, letters) in _BRIEF.items()
}
# A single letter counts only at the start or end of a name: `l3` is usually the third link, not a
# left one.
_SIDES = {
    "right": re.compile(
        r"[Rr]ight|RIGHT|(?:^|_)(?:rh|RH)(?:_|$)|^[rR]_|_[rR]$|^R(?=[A-Z][a-z])"
    ),
    "left": re.compile(
        r"[Ll]eft|LEFT|(?:^|_)(?:lh|LH)(?:_|$)|^[lL]_|_[lL]$|^L(?=[A-Z][a-z])"
    ),
}


def named_side(names: Iterable[str]) -> Side | None:
    """Return the side that most names contain; None if they contain none, or both equally."""
    names = list(names)
    right, left = (
        sum(bool(pattern.search(name)) for name in names) for pattern in _SIDES.values()
    )
    return None if right == left else "right" if right > left else "left"


def named_fingers(chains: list[list[str]]) -> list[str | None]:
    """Return the anatomical name that the links and joints of each chain contain.

    Args:
        chains: Names of the links and joints of each chain.

    Returns:
        Name of each finger: `thumb`, `index`, `middle`, `ring` or `little`. None for chains without
        one; all None if two chains have the same one.
    """
    # `rh_ffmiddle` is the middle phalanx of the first finger, and short names have other meanings
    # (`rf`: right front): those that name all chains come first, a hand has at least three.
    every = max(3, len(chains))
    for patterns, least in (
        (_SHORT, every),
        (_WORDS, 1),
        (_SHORT, 3),
        (_LETTERS, every),
    ):
        found = [_most_frequent(chain, patterns) for chain in chains]
        given = [name for name in found if name is not None]
        if len({*given}) == len(given) >= least:
            return found
    return [None] * len(chains)


def _most_frequent(
    names: list[str], patterns: dict[str, re.Pattern[str]]
) -> str | None:
    """Return the finger that most names contain; the first one in a name counts."""
    found = list[str]()
    for name in names:
        places = {
            finger: match.start()
            for finger, pattern in patterns.items()
            if (match := pattern.search(name))
        }
        if places:
            found.append(min(places, key=places.__getitem__))
    return mode(found) if found else None
