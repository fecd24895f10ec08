"""Which finger is the thumb: the one that differs from the others, or that names call so."""

from collections.abc import Sequence

import numpy as np

from handmap_core.se3 import Array, lengths, unit
from handmap_qp.hands import THUMB
from .flexion import HandFlexion
from .hypotheses import CERTAIN, CLEAR, DISPUTED, LIKELY, VISIBLE
from .structure import Clue

# Score margin of a name that is clear.
_DECISIVE = 5.0


def find_thumb(
    flexion: HandFlexion,
    names: Sequence[Sequence[str]],
    labels: Sequence[str | None],
    assumed: int | None,
    values: dict[str, float],
) -> tuple[int | None, Clue]:
    """Find the finger that differs from the others, or that the names call a thumb.

    Args:
        flexion: How all fingers flex.
        names: Names of the joints and links of each finger.
        labels: The anatomical name in these, of each finger.
        assumed: Index of the finger that is taken whatever is found, if any.
        values: Evidence, to which that for the thumb is added.
    """
    count = len(names)
    if count < 2:
        return None, Clue("thumb", "none", "the hand has one finger only", 0.9)
    peaks = [_stands_out(part) for part in _differences(flexion)]
    # The number of joints counts less than the others, a name as much as a clear margin; where
    # every finger has its own name, or one of several has lost it, they decide.
    sizes = np.array([*map(len, names)])
    is_named = np.array(labels) == THUMB
    scores = 0.5 * sum(peaks) + 0.15 * _stands_out(sizes[:, None] != sizes)
    is_decisive = labels.count(None) <= int(count > 3)
    differences = scores
    scores = scores + (_DECISIVE if is_decisive else CLEAR) * is_named
    best = int(np.argmax(scores))
    lead = np.diff(np.sort(scores))[-1]
    margin = lead if count > 2 else CLEAR * is_named.sum()
    agreeing = is_named[best] + sum(
        np.argmax(peak) == best and max(peak) > VISIBLE for peak in peaks
    )
    how = f"it differs most in position, direction, flexion and name (margin {margin:.2f} of 1)"
    sure = CERTAIN if margin > CLEAR and agreeing > 1 else LIKELY
    if margin <= VISIBLE:
        how = "the fingers are alike: one that differs little was taken"
        sure = 0.3
        best = best if margin > 1e-6 else 0
    if assumed is not None and assumed != best:
        best = assumed
        how = "chosen by all evidence together"
        sure = LIKELY
    elif is_named.any() and not is_named[best]:
        how += "; the names suggest another finger"
        sure = DISPUTED
    named = 1.0 if is_decisive else 0.5 * CLEAR
    values["difference"] = float(np.clip(differences[best], -1.0, 1.0))
    if is_named.any() or labels[best]:
        values["thumb name"] = named if is_named[best] else -named
    return best, Clue("thumb", names[best][-1], how, sure)


def _differences(flexion: HandFlexion) -> tuple[Array, Array, Array]:
    """Return how much fingers differ in position, direction and flexion, 0 to 1, shape (F, F)."""
    lines = flexion.tips_open - flexion.roots
    sizes = lengths(lines)
    directions = unit(lines)
    along = unit(directions[:, None] + directions)
    between = flexion.roots[:, None] - flexion.roots
    apart = np.abs(np.vecdot(between, along))
    longer = np.maximum.outer(sizes, sizes).clip(1e-9)
    ahead = np.minimum(1.0, 2.0 * apart / longer)
    return ahead, 1.0 - directions @ directions.T, 1.0 - flexion.ways @ flexion.ways.T


def _stands_out(differences: Array) -> Array:
    """Return how much each finger differs from the others, less how much they differ, (F,)."""
    others = len(differences) - 1
    own = differences.sum(axis=1) - differences.diagonal()
    # Differences are symmetric.
    among = differences.sum() - 2.0 * own - differences.diagonal()
    return own / others - among / max(1, others * (others - 1))
