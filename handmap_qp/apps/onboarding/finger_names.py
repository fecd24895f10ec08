"""Anatomical names of fingers and sides in the names of links and joints."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable

from handmap_qp.hands.spec import Side

# Long names of fingers, found anywhere in a name.
_WORDS = {
    "thumb": re.compile(r"thumb", re.IGNORECASE),
    "index": re.compile(r"index|fore_?finger|first_?finger|pointer", re.IGNORECASE),
    "middle": re.compile(r"middle|medium|mid_?finger|long_?finger", re.IGNORECASE),
    "ring": re.compile(r"(?<![A-Za-z])[Rr]ing|Ring|RING"),
    "little": re.compile(r"little|pinky|pinkie|small_?finger", re.IGNORECASE),
}
# The abbreviations of the Shadow hand, before a phalanx or a joint number: `rh_FFJ4`, `ffmiddle`.
_PART = r"(?=[jJ]?_?\d|_|$|prox|mid|dist|knuck|meta|tip|base|hub|touch|biotac|seg)"
_SHORT = {
    "thumb": re.compile(rf"(?:^|[^a-zA-Z])(?:th|TH){_PART}"),
    "index": re.compile(rf"(?:^|[^a-zA-Z])(?:ff|FF|if|IF){_PART}"),
    "middle": re.compile(rf"(?:^|[^a-zA-Z])(?:mf|MF){_PART}"),
    "ring": re.compile(rf"(?:^|[^a-zA-Z])(?:rf|RF){_PART}"),
    "little": re.compile(rf"(?:^|[^a-zA-Z])(?:lf|LF|pf|PF){_PART}"),
}
_LETTERS = {
    "t": "thumb",
    "i": "index",
    "m": "middle",
    "r": "ring",
    "p": "little",
    "l": "little",
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
        sum(bool(_SIDES[side].search(name)) for name in names)
        for side in ("right", "left")
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
    for patterns in (_WORDS, _SHORT):
        found = [_most_frequent(chain, patterns) for chain in chains]
        # Abbreviations have other meanings (`rf`: right front); a hand has at least three.
        if patterns is _WORDS:
            short = [_most_frequent(chain, _SHORT) for chain in chains]
            if None not in short and len(set(short)) == len(short) > 2:
                # `rh_ffmiddle` is the middle phalanx of the first finger.
                return list(short)
        given = [name for name in found if name is not None]
        least = 1 if patterns is _WORDS else 3
        if len(given) >= least and len(set(given)) == len(given):
            return list(found)
    return _by_letters(chains)


def _most_frequent(
    names: list[str], patterns: dict[str, re.Pattern[str]]
) -> str | None:
    """Return the finger that most names contain; the first one in a name counts."""
    votes: Counter[str] = Counter()
    for name in names:
        places = {
            finger: match.start()
            for finger, pattern in patterns.items()
            if (match := pattern.search(name))
        }
        if places:
            votes[min(places, key=lambda finger: places[finger])] += 1
    return votes.most_common(1)[0][0] if votes else None


def _by_letters(chains: list[list[str]]) -> list[str | None]:
    """Return fingers named by one letter, as in `hand_T-MP`, if each chain has another one."""
    tokens = [
        Counter(
            token.lower() for name in chain for token in re.split(r"[^A-Za-z]+", name)
        )
        for chain in chains
    ]
    found: list[str | None] = []
    for i, own in enumerate(tokens):
        letters = [
            letter
            for letter in _LETTERS
            if own[letter] >= 2
            and not any(other[letter] for k, other in enumerate(tokens) if k != i)
        ]
        found.append(_LETTERS[letters[0]] if len(letters) == 1 else None)
    is_clear = None not in found and len(set(found)) == len(found) > 2
    return found if is_clear else [None] * len(chains)
