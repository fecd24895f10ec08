"""A changing piece of HTML, as what stays and what changes: `html_film`."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

# Numbers change from instant to instant; what is between them mostly stays.
_TOKENS = re.compile(r"([<>;:\"])")


def html_film(frames: Sequence[str]) -> dict[str, Any]:
    """Return frames of HTML in a form that a page can carry by the thousand.

    Frames that are made of equally many tokens share one list of tokens. A frame is then the values
    of the tokens that differ.

    Args:
        frames: The HTML of each instant.

    Returns:
        `kinds`: for each number of tokens, `parts`, the tokens of its first frame, and `places`,
        the indices of those that change; `rows`: for each frame its kind and the values there.
    """
    split = [_TOKENS.split(frame) for frame in frames]
    lengths = list(dict.fromkeys(map(len, split)))
    kinds: list[dict[str, Any]] = []
    for length in lengths:
        alike = [tokens for tokens in split if len(tokens) == length]
        columns = zip(*alike, strict=True)
        places = [i for i, column in enumerate(columns) if len(set(column)) > 1]
        kinds.append({"parts": alike[0], "places": places})
    rows = []
    for tokens in split:
        kind = lengths.index(len(tokens))
        rows.append([kind, [tokens[i] for i in kinds[kind]["places"]]])
    return {"kinds": kinds, "rows": rows}
