"""The picture of a study: success, time and workload of both mappings, and each person."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import NamedTuple

import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from .analysis import StudyResult, success_share, times_of
from .result_file import LABELS, Label, StudyFile
from .statistics import Interval

_STYLE = Path(__file__).with_suffix(".mplstyle")
_COLOURS = {"A": "#3f6fb5", "B": "#c8452f"}
_PERSON = "#b8bec6"
_LONGEST_NAME = 34  # characters


class _Panel(NamedTuple):
    """One measure.

    Attributes:
        title: Its name, with its unit.
        intervals: Of A and B, which are drawn.
        people: Value of each person with A and B; None where there is none.
        top: Upper end of the axis; chosen by the values if None.
    """

    title: str
    intervals: Sequence[Interval]
    people: Sequence[tuple[float | None, float | None]]
    top: float | None


def draw_study(
    file: Path, result: StudyResult, people: Sequence[StudyFile], kind: str
) -> None:
    """Draw the values of both mappings with their 95 % intervals, and a line for each person.

    Args:
        file: The picture.
        result: What the study shows.
        people: The results of all people.
        kind: `png`, `svg` or `pdf`.
    """
    with matplotlib.style.context(["default", str(_STYLE)]):
        figure = Figure(figsize=(9.0, 3.6), layout="constrained")
        panels = _panels(result, people)
        for panel, axes in zip(panels, figure.subplots(1, len(panels)), strict=True):
            _draw(axes, panel, result)
        names = [f"{one.label}: {_short(one.name)}" for one in result.mappings]
        figure.suptitle(
            f"{result.people} people, {result.trials} trials. {names[0]}; {names[1]}\n"
            "Dots: all people, with 95 % intervals. Grey lines: each person.",
            ha="left",
            x=0.01,
        )
        figure.savefig(file, format=kind)


def _short(name: str) -> str:
    """Return a name that fits, without the signs by which matplotlib begins a formula."""
    text = name if len(name) <= _LONGEST_NAME else f"{name[: _LONGEST_NAME - 3]}..."
    return text.replace("$", r"\$")


def _panels(result: StudyResult, people: Sequence[StudyFile]) -> list[_Panel]:
    def by_person(percent: float) -> list[tuple[float | None, float | None]]:
        pairs = [[success_share(one, label) for label in LABELS] for one in people]
        return [(percent * a, percent * b) for a, b in pairs]

    def time(one: StudyFile, label: Label) -> float | None:
        times = times_of(one, label)
        return median(times) if times else None

    a, b = result.mappings
    return [
        _Panel(
            "Success [% of trials]",
            [_scaled(one.success_by_person, 100.0) for one in (a, b)],
            by_person(100.0),
            105.0,
        ),
        _Panel(
            "Time of successes [s], median",
            [a.seconds, b.seconds],
            [(time(one, "A"), time(one, "B")) for one in people],
            None,
        ),
        _Panel(
            "Workload (Raw TLX)",
            [a.workload, b.workload],
            [
                (one.workload_of("A").raw(), one.workload_of("B").raw())
                for one in people
            ],
            105.0,
        ),
    ]


def _scaled(interval: Interval, factor: float) -> Interval:
    ends = (interval.value, interval.low, interval.high)
    return Interval(*(None if end is None else factor * end for end in ends))


def _draw(axes: Axes, panel: _Panel, result: StudyResult) -> None:
    axes.set_title(panel.title)
    for values in panel.people:
        points = [(x, y) for x, y in enumerate(values) if y is not None]
        xs, ys = [x for x, _ in points], [y for _, y in points]
        axes.plot(xs, ys, ".-", color=_PERSON)
    for x, (mapping, interval) in enumerate(
        zip(result.mappings, panel.intervals, strict=True)
    ):
        if interval.value is None:
            axes.text(x, 0.0, "no success", ha="center", va="bottom")
            continue
        low = interval.value if interval.low is None else interval.low
        high = interval.value if interval.high is None else interval.high
        error = [[interval.value - low], [high - interval.value]]
        axes.errorbar(
            x, interval.value, error, fmt="o", color=_COLOURS[mapping.label], zorder=3
        )
    axes.set_xticks(range(len(LABELS)), LABELS)
    axes.set_xlim(-0.5, len(LABELS) - 0.5)
    axes.set_ylim(0.0, panel.top)
