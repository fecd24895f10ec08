"""Anatomical names of fingers and sides in the names of links and joints.

A name is split into tokens at separators, digits and changes of case. A token counts if it is made
of known words: `ringlittle` of two fingers, `ffmiddle` of a finger and a phalanx, `spring` of none.
"""

import re
from collections.abc import Iterable, Sequence
from functools import cache
from itertools import chain
from typing import NamedTuple

import numpy as np
from scipy.optimize import linear_sum_assignment

from handmap_core.se3 import Array
from handmap_qp.hands import FINGERS, Side

# Words of each finger; those of the other languages are of hands from there.
_WORDS = {
    "thumb": "thumb pollex daumen pollice pouce pulgar",
    "index": "index forefinger firstfinger pointer zeigefinger indice",
    "middle": "middle medium midfinger longfinger mittelfinger medio majeur",
    "ring": "ring anular annular anulare annulaire",
    "little": "little pinky pinkie smallfinger mignolo auriculaire",
}
# Abbreviations, as of the Shadow hand: `rh_FFJ4`. Each has other meanings too (`rf`: right front).
_SHORT = {
    "thumb": "th thb",
    "index": "ff if idx",
    "middle": "mf",
    "ring": "rf rng",
    "little": "lf pf pnk",
}
# Single letters, as in `hand_T-MP`, but not at the start of a name: there one may be a side.
_LETTERS = {"thumb": "t", "index": "i", "middle": "m", "ring": "r", "little": "p l"}
# What may be beside these in one token: phalanges, joints, kinds of links, and sides.
_PARTS = """
    proximal prox intermediate inter medial mid distal dist knuckle metacarpal meta phalanx
    tip base hub touch biotac seg segment finger fingertip link joint j motor mcp pip dip ip cmc mp
    abd abduction add adduction flex flexion bend roll pitch yaw rot rotation rotator swing
    opposition servo tendon pad nail left right hand palm frame sensor l r lh rh
"""
# Names of phalanges beside that of the middle one.
_PHALANX = re.compile("prox|dist", re.IGNORECASE)
TOKEN = re.compile("[A-Z]+(?![a-z])|[A-Z]?[a-z]+|[0-9]+")
"""Words of a name: `FFJ4` has FFJ and 4, `IndexTip` Index and Tip."""
# `fore_finger` and the like are one word.
_SPLIT_WORD = re.compile("(fore|first|mid|long|small)[_ -](?=finger)", re.IGNORECASE)
# Long words count within tokens that are not made of known words too.
_LONG = re.compile("(thumb|index|middle|little|pinky|pinkie)", re.IGNORECASE)
# Of several fingers in a name the first one counts in full: `index_middle` is its middle phalanx.
_LATER = 0.25
# Abbreviations name at least this many fingers.
_LEAST_SHORT = 3
# A name that is lost at this cost only is another chain's as well, in shares of full evidence.
_UNCLEAR = 0.15
# A single letter counts only at the start or end of a name: `l3` is usually the third link.
_RIGHT = re.compile(
    r"[Rr]ight|RIGHT|(?:^|_)(?:rh|RH)(?:_|$)|^[rR]_|_[rR]$|^R(?=[A-Z][a-z])"
)
_LEFT = re.compile(
    r"[Ll]eft|LEFT|(?:^|_)(?:lh|LH)(?:_|$)|^[lL]_|_[lL]$|^L(?=[A-Z][a-z])"
)
# A product's name, as `rh_p12_rn`: a letter and a number of at least two digits after the `rh`.
_PRODUCT = re.compile(r"(?:^|_)[rl]h[_-]?[a-z]{1,3}\d{2,}", re.IGNORECASE)


def named_side(names: Iterable[str]) -> Side | None:
    """Return the side that most names contain; None if they contain none, or both equally."""
    plain = [_PRODUCT.sub("", name) for name in names]
    balance = sum(
        bool(_RIGHT.search(name)) - bool(_LEFT.search(name)) for name in plain
    )
    return None if balance == 0 else "right" if balance > 0 else "left"


def named_fingers(chains: Sequence[Sequence[str]]) -> list[str | None]:
    """Return the anatomical name that the links and joints of each chain contain.

    The names of all chains are assigned together. If two chains have an equal claim to a name, that
    one name is lost.

    Args:
        chains: Names of the links and joints of each chain.

    Returns:
        Name of each finger: `thumb`, `index`, `middle`, `ring` or `little`; None for chains without
        one.
    """
    claims = finger_claims(chains)
    rows, columns = linear_sum_assignment(-claims)
    best = claims[rows, columns].sum()
    found: list[str | None] = [None] * len(chains)
    for row, column in zip(rows, columns, strict=True):
        if claims[row, column] == 0.0:
            continue
        without = claims.copy()
        without[row, column] = 0.0
        margin = best - without[linear_sum_assignment(-without)].sum()
        if margin > _UNCLEAR * claims[row, column]:
            found[row] = FINGERS[column]
    return found


def finger_claims(chains: Sequence[Sequence[str]]) -> Array:
    """Return how much the names of each chain say that it is each of `FINGERS`, shape (F, 5).

    It is 1 where all names that name a finger name this one. Abbreviations count if they name three
    fingers. Letters count if nothing else does, and they name all chains but one.
    """
    every = [[_fingers_of(name) for name in chain] for chain in chains]
    short = _claims(chains, every, {"word", "short"})
    if _named(every, "short") >= _LEAST_SHORT:
        return short
    words = _claims(chains, every, {"word"})
    if words.any():
        return words
    letters = _claims(chains, every, {"letter"})
    # A letter of several chains is that of a side or a link.
    letters *= np.count_nonzero(letters, axis=0) == 1
    is_named = letters.any(axis=1)
    return letters * (is_named.sum() >= max(3, len(chains) - 1))


class _Word(NamedTuple):
    """A finger in a name, and whether a word, an abbreviation or a letter names it."""

    finger: str
    kind: str


_VOCABULARY: dict[str, _Word | None] = dict.fromkeys(_PARTS.split()) | {
    word: _Word(finger, kind)
    for kind, table in (("short", _SHORT), ("word", _WORDS))
    for finger, words in table.items()
    for word in words.split()
}
_BY_LETTER = {
    letter: _Word(finger, "letter")
    for finger, letters in _LETTERS.items()
    for letter in letters.split()
}


def _named(every: Sequence[Sequence[Sequence[list[_Word]]]], kind: str) -> int:
    """Return how many fingers words of a kind name."""
    words = chain.from_iterable(chain.from_iterable(chain.from_iterable(every)))
    return len({word.finger for word in words if word.kind == kind})


def _claims(
    chains: Sequence[Sequence[str]],
    every: Sequence[Sequence[Sequence[list[_Word]]]],
    kinds: set[str],
) -> Array:
    """Return what the names of each chain claim by some kinds of words, shape (F, 5).

    Args:
        chains: Names of each chain.
        every: The words of each token of each of these names.
        kinds: Kinds of words that count.
    """
    claims = np.zeros((len(chains), len(FINGERS)))
    for names, tokens, row in zip(chains, every, claims, strict=True):
        found = [_claim(each, kinds) for each in tokens]
        # `f1_middle` beside `f1_proximal` is a phalanx.
        plain = (name for name, by in zip(names, found, strict=True) if not by)
        if any(map(_PHALANX.search, plain)):
            found = [by for by in found if {*by} != {"middle"}]
        given = [*filter(None, found)]
        for by in given:
            for finger, share in by.items():
                row[FINGERS.index(finger)] += share / len(given)
    return claims


def _claim(tokens: Sequence[list[_Word]], kinds: set[str]) -> dict[str, float]:
    """Return what one name claims for each finger, the first of several fingers in full."""
    claims: dict[str, float] = {}
    shared: list[str] = []
    for token in tokens:
        words = [word for word in token if word.kind in kinds]
        # `ffmiddle` is a phalanx of the first finger.
        short = [word for word in words if word.kind == "short"]
        fingers = [word.finger for word in short or words]
        if len(fingers) == 1:
            claims.setdefault(fingers[0], _LATER if claims else 1.0)
        shared += fingers
    # `ringlittle` moves both fingers: in `ringlittle/ring` the last word counts.
    return claims or dict.fromkeys(shared, 1.0 / max(1, len(shared)))


def _fingers_of(name: str) -> list[list[_Word]]:
    """Return the fingers that each token of a name contains."""
    tokens = [token.lower() for token in TOKEN.findall(_SPLIT_WORD.sub(r"\1", name))]
    found = [_words_in(token) for token in tokens]
    letters = [
        [_BY_LETTER[token]] if k and token in _BY_LETTER else []
        for k, token in enumerate(tokens)
    ]
    return [words + letter for words, letter in zip(found, letters, strict=True)]


@cache
def _words_in(token: str) -> list[_Word]:
    """Return the fingers in a token of known words, or the long words in any other."""
    pieces = _pieces(token)
    if pieces is None:
        pieces = [piece.lower() for piece in _LONG.findall(token)]
    return [word for piece in pieces if (word := _VOCABULARY[piece])]


@cache
def _pieces(token: str) -> list[str] | None:
    """Split a token into known words, the longest first; None if it cannot be split."""
    if not token:
        return []
    for size in range(len(token), 0, -1):
        if token[:size] in _VOCABULARY:
            rest = _pieces(token[size:])
            if rest is not None:
                return [token[:size], *rest]
    return None
