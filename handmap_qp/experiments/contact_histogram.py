"""Histogram of the number of contacts in planned grasps."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.errors import InvalidInputError
from handmap_qp.experiments.style import INK, styled, words

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


@styled
def contact_histogram_figure(
    counts: Mapping[str, Mapping[int, int]],
    published: Mapping[str, Mapping[int, int]] | None = None,
) -> Figure:
    """Draw the share of grasps by number of contacts, one panel per hand.

    Args:
        counts: Numbers of grasps by number of contacts (`contact_counts`), by name of the hand.
        published: The same for comparison (`ReferenceGrasp.published_counts`), for any of these
            hands; drawn as outlines.

    Returns:
        The figure.

    Raises:
        InvalidInputError: If there is no hand, or a hand has no grasps.
        MissingExtraError: If matplotlib is not installed.
    """
    from matplotlib.figure import Figure

    if not counts or not all(sum(one.values()) for one in counts.values()):
        raise InvalidInputError(
            argument="counts", expected="at least one hand, and grasps of each", value=counts
        )
    references = published or {}
    ranges = [sorted({*one, *references.get(name, {})}) for name, one in counts.items()]
    # Bars of equal width: a panel is as wide as its range of numbers.
    widths = [max(numbers[-1] - numbers[0] + 2.0, 4.0) for numbers in ranges]
    figure = Figure(figsize=(1.6 + 0.6 * sum(widths), 3.4), layout="constrained")
    fields = figure.subplots(1, len(counts), sharey=True, squeeze=False, width_ratios=widths)[0]
    for axes, name, numbers in zip(fields, counts, ranges, strict=True):
        _draw(axes, name, numbers, counts[name], references.get(name))
    fields[0].set_ylabel("share of grasps [%]")
    return figure


def _draw(
    axes: Axes,
    name: str,
    numbers: list[int],
    counts: Mapping[int, int],
    published: Mapping[int, int] | None,
) -> None:
    colour = HUMAN_COLOUR if name.startswith("human") else ROBOT_COLOUR
    total = sum(counts.values())
    shares = {number: 100.0 * count / total for number, count in counts.items()}
    most = max(shares, key=lambda number: shares[number])
    tints = [(*colour, 1.0 if number == most else 0.45) for number in shares]
    axes.bar(list(shares), list(shares.values()), width=0.72, color=tints)
    axes.fill_between([], [], color=colour, linewidth=0.0, label=f"here, {total} grasps")
    theirs = (
        {}
        if published is None
        else {
            number: 100.0 * count / sum(published.values()) for number, count in published.items()
        }
    )
    if published is not None:
        label = f"toolbox, {sum(published.values())} grasps"
        axes.bar(
            list(theirs),
            list(theirs.values()),
            width=0.86,
            fill=False,
            edgecolor=INK,
            linewidth=1.0,
            label=label,
        )
    for number, share in shares.items():
        outline = theirs.get(number, 0.0)
        # Place the label on its bar, or above an outline that it would overlap.
        top = outline if share < outline < share + 10.0 else share
        axes.annotate(
            f"{share:.0f} %",
            (number, top),
            (0, 3),
            textcoords="offset points",
            ha="center",
            fontsize=8,
        )
    axes.set_title(f"{words(name).capitalize()}: most often {most}", fontsize=11)
    axes.set_xlabel("contacts")
    axes.set_xticks(np.arange(numbers[0], numbers[-1] + 1))
    middle, width = 0.5 * (numbers[0] + numbers[-1]), max(numbers[-1] - numbers[0] + 2.0, 4.0)
    axes.set_xlim(middle - 0.5 * width, middle + 0.5 * width)
    axes.set_ylim(0.0, 130.0)
    axes.set_yticks([0, 20, 40, 60, 80, 100])
    axes.spines["left"].set_bounds(0.0, 100.0)
    axes.grid(visible=False)
    axes.legend(loc="upper left", fontsize=8, borderaxespad=0.2)
