"""Anatomical names of fingers and sides in the names of links and joints."""

import re
from collections.abc import Iterable
from statistics import mode

from handmap_qp.hands import Side

# Long names of fingers, found anywhere in a name; all patterns name the finger by its group.
_WORDS = re.compile(
    r"""(?P<thumb> (?i:thumb))
    | (?P<index> (?i:index | fore_?finger | first_?finger | pointer))
    | (?P<middle> (?i:middle | medium | mid_?finger | long_?finger))
    | (?P<ring> (?<![A-Za-z])[Rr]ing | Ring | RING)
    | (?P<little> (?i:little | pinky | pinkie | small_?finger))""",
    re.VERBOSE,
)
# Abbreviations of the Shadow hand, as in `rh_FFJ4`, before a phalanx or the number of a joint.
_SHORT = re.compile(
    r"""(?: ^ | [^a-zA-Z])
    (?: (?P<thumb> th | TH)
    | (?P<index> ff | FF | if | IF)
    | (?P<middle> mf | MF)
    | (?P<ring> rf | RF)
    | (?P<little> lf | LF | pf | PF))
    (?= [jJ]?_?\d | _ | $
    | prox | mid | dist | knuck | meta | tip | base | hub | touch | biotac | seg)""",
    re.VERBOSE,
)
# Single letters as in `hand_T-MP`; at the start of a name one may be a side.
_LETTERS = re.compile(
    r"""(?<= [^a-zA-Z])
    (?: (?P<thumb> [tT])
    | (?P<index> [iI])
    | (?P<middle> [mM])
    | (?P<ring> [rR])
    | (?P<little> [pPlL]))
    (?! [a-zA-Z])""",
    re.VERBOSE,
)
# A single letter counts only at the start or end of a name: `l3` is usually the third link.
_RIGHT = re.compile(
    r"[Rr]ight|RIGHT|(?:^|_)(?:rh|RH)(?:_|$)|^[rR]_|_[rR]$|^R(?=[A-Z][a-z])"
)
_LEFT = re.compile(
    r"[Ll]eft|LEFT|(?:^|_)(?:lh|LH)(?:_|$)|^[lL]_|_[lL]$|^L(?=[A-Z][a-z])"
)


def named_side(names: Iterable[str]) -> Side | None:
    """Return the side that most names contain; None if they contain none, or both equally."""
    balance = sum(
        bool(_RIGHT.search(name)) - bool(_LEFT.search(name)) for name in names
    )
    return None if balance == 0 else "right" if balance > 0 else "left"


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
    for pattern, least in (
        (_SHORT, every),
        (_WORDS, 1),
        (_SHORT, 3),
        (_LETTERS, every),
    ):
        found = [_most_frequent(chain, pattern) for chain in chains]
        given = [*filter(None, found)]
        if len({*given}) == len(given) >= least:
            return found
    return [None] * len(chains)


def _most_frequent(names: list[str], pattern: re.Pattern[str]) -> str | None:
    """Return the finger that most names contain; the first one in a name counts."""
    found = [match.lastgroup for match in map(pattern.search, names) if match]
    return mode(found) if found else None
