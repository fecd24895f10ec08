"""The panel on the left.

Point error and step time over time, and the robot's joints against their limits.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.hands.hand import Hand
from handmap_qp.viewer.replay import ViewSample
from handmap_qp.viewer.scene import DEFORMATION_COLOUR, TARGET_COLOUR

if TYPE_CHECKING:
    import viser

_WIDTH = 330
_BLUE, _GREY, _RED, _ORANGE = "#2166d8", "#9aa0a8", "#d62929", "#f08c00"
_AXIS = {"stroke": "#666", "font": "11px sans-serif", "grid": {"stroke": "#eee"}}
# More points than a plot has pixels.
_MOST_PLOTTED = 600
# Longer names of joints lose their middle.
_LONGEST_NAME = 19
_SCENE_COLOURS = (
    ("human's points", HUMAN_COLOUR),
    ("robot's points", ROBOT_COLOUR),
    ("their targets", TARGET_COLOUR),
    ("T_def of a ball", DEFORMATION_COLOUR),
)


def gauge_row(sample: ViewSample) -> tuple[float, float, float, float]:
    """What the plots show of a sample.

    Time [s], mean and largest point error [mm], time of the step [µs].
    """
    error = sample.point_error if sample.targets is not None else np.array([np.nan])
    return sample.time, 1e3 * float(error.mean()), 1e3 * float(error.max()), 1e6 * sample.duration


class Gauges:
    """Plots and joint bars.

    Args:
        server: A running viser server.
        robot: The robot hand.
    """

    def __init__(self, server: viser.ViserServer, robot: Hand) -> None:
        self._robot = robot
        panel = server.gui.add_panel()
        with panel.add_tab("Gauges"):
            server.gui.add_html(_legend([(name, _css(colour)) for name, colour in _SCENE_COLOURS]))
            self.error = _add_plot(server, "point error [mm]", ("mean", "largest"), (_BLUE, _GREY))
            server.gui.add_html(_legend((("mean", _BLUE), ("largest", _GREY), ("now", _ORANGE))))
            self.timing = _add_plot(server, "time per step [µs]", ("step",), (_BLUE,))
            self.timing_note = server.gui.add_html("")
            self.joints = server.gui.add_html("")
        panel.dock_left()
        panel.set_width(_WIDTH)
        self._rows, self._plotted, self._starts = (
            np.empty((0, 4)),
            np.empty((0, 4)),
            np.empty(0, dtype=int),
        )

    def set_rows(self, rows: npt.ArrayLike, *, latest: float | None = None) -> None:
        """Plot other samples.

        Args:
            rows: What `gauge_row` says of each, shape (n, 4), n > 0.
            latest: For the last so many seconds, with the last sample at zero [s]; from the first
                sample to the last if omitted.
        """
        self._rows = np.array(rows, dtype=float)
        time = self._rows[:, 0]
        # A plot keeps its range when its data change, and a new range costs a new plot: so a range
        # that moves is one that stands.
        span = (float(time[0]), float(max(time[-1], time[0] + 0.1)))
        if latest is not None:
            time -= time[-1]
            span = (-latest, 0.0)
        # Of samples that share a place the worst are seen, and the last one's time.
        self._starts = np.linspace(
            0, len(time), min(len(time), _MOST_PLOTTED), endpoint=False
        ).astype(int)
        self._plotted = np.fmax.reduceat(self._rows, self._starts, axis=0)
        step = self._rows[:, 3]
        median, p99 = np.percentile(step, (50, 99))
        _set_scales(self.error, _scales(span, self._rows[:, 2]))
        # A few steps that the machine was interrupted in would flatten all others.
        _set_scales(self.timing, _scales(span, np.minimum(step, 3.0 * median)))
        cut = " (cut off)" if step.max() > self.timing.scales["y"]["range"][1] else ""
        self.timing_note.content = _foot(
            f"median {median:.0f} · p99 {p99:.0f} · largest {step.max():.0f}{cut}"
        )

    def draw(self, sample: ViewSample, index: int) -> None:
        """Mark the present sample in the plots and show its joints.

        Args:
            sample: The sample.
            index: Its place among those given to `set_rows`.
        """
        time, mean, largest, step = self._plotted.T
        place, now = int(np.searchsorted(self._starts, index, side="right")) - 1, self._rows[index]
        self.error.data = (time, mean, largest, _only(len(time), place, now[1]))
        self.timing.data = (time, step, _only(len(time), place, now[3]))
        self.joints.content = joint_bars(self._robot, sample)


def joint_bars(robot: Hand, sample: ViewSample) -> str:
    """Every joint between its limits, as HTML.

    A bar from the lower limit to the upper one, red where a limit holds the joint.

    Args:
        robot: The robot hand.
        sample: Its posture.

    Returns:
        The HTML.
    """
    shares = (sample.robot_q - robot.lower_limits) / (robot.upper_limits - robot.lower_limits)
    rest = (robot.rest - robot.lower_limits) / (robot.upper_limits - robot.lower_limits)
    rows, names = [], zip(robot.joint_names, short_names(robot.joint_names), strict=True)
    for (name, short), q, share, rest_share, is_held in zip(
        names, sample.robot_q, shares, rest, sample.at_limit, strict=True
    ):
        colour = _RED if is_held else _BLUE
        track = "flex:1;position:relative;height:7px;background:#e4e6ea;border-radius:4px"
        fill = f"position:absolute;left:0;width:{100 * share:.1f}%;height:7px;background:{colour};border-radius:4px"
        mark = f"position:absolute;left:{100 * rest_share:.1f}%;top:-2px;width:1px;height:11px;background:#333"
        rows.append(
            '<div style="display:flex;align-items:center;height:15px">'
            f'<span title="{escape(name)}" style="width:118px;overflow:hidden;white-space:nowrap">{escape(short)}</span>'
            f'<span style="{track}"><span style="{fill}"></span><span style="{mark}"></span></span>'
            f'<span style="width:44px;text-align:right;color:{colour}">{np.degrees(q):.0f}°</span></div>'
        )
    head = '<div style="font-weight:600;margin-bottom:3px">joints between their limits</div>'
    return (
        f'<div style="font-size:11px;line-height:15px;padding:4px 14px">{head}{"".join(rows)}</div>'
    )


def short_names(names: Sequence[str]) -> list[str]:
    """Names.

    Where some are too long, without the beginning that all share, and without their middle: they
    differ at the ends.
    """
    if max(map(len, names)) <= _LONGEST_NAME:
        return list(names)
    # What a name is called after must not be torn apart.
    alike = takewhile(lambda letters: len(set(letters)) == 1, zip(*names, strict=False))
    shared = (
        re.split(r"[^_./]*$", "".join(letters[0] for letters in alike))[0] if len(names) > 1 else ""
    )
    rest = [name.removeprefix(shared) for name in names]
    head, tail = _LONGEST_NAME // 2 - 3, _LONGEST_NAME // 2 + 3
    return [
        name if len(name) <= _LONGEST_NAME else f"{name[:head]}…{name[-tail:]}" for name in rest
    ]


def _add_plot(
    server: viser.ViserServer, title: str, names: tuple[str, ...], colours: tuple[str, ...]
) -> Any:
    """A plot of some series over time, with a dot on the first of them for now."""
    from viser import uplot

    series = [uplot.Series(label="s")]
    series += [
        uplot.Series(label=name, stroke=colour, width=1.5)
        for name, colour in zip(names, colours, strict=True)
    ]
    series.append(
        uplot.Series(
            label="now",
            stroke=_ORANGE,
            width=0,
            points=uplot.Series_Points(show=True, size=9, fill=_ORANGE),
        )
    )
    nothing = (np.arange(2.0), *(np.zeros(2) for _ in series[1:]))
    return server.gui.add_uplot(
        nothing,
        tuple(series),
        title=title,
        height=175,
        scales=_scales((0.0, 1.0), np.ones(2)),
        axes=(
            uplot.Axis(
                **_AXIS, label="time [s]", labelFont="11px sans-serif", labelSize=16, size=30
            ),
            uplot.Axis(**_AXIS, size=50),
        ),
        legend=uplot.Legend(show=False),
    )


def _scales(span: tuple[float, float], values: np.ndarray) -> dict[str, Any]:
    """Ranges of both axes.

    This much time, and from zero to a little above the next round number.
    """
    from viser import uplot

    largest = max(float(np.nanmax(values)) if np.isfinite(values).any() else 1.0, 1e-6)
    decade = 10.0 ** np.floor(np.log10(largest))
    top = next(
        step * decade
        for step in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0)
        if step * decade >= largest * (1.0 - 1e-9)
    )
    return {
        "x": uplot.Scale(time=False, auto=False, range=span),
        "y": uplot.Scale(auto=False, range=(0.0, 1.08 * float(top))),
    }


def _set_scales(plot: Any, scales: dict[str, Any]) -> None:
    """Give a plot other ranges, for which the browser makes it anew.

    Only if they are other ones.
    """
    if plot.scales != scales:
        plot.scales = scales


def _only(count: int, place: int, value: float) -> np.ndarray:
    """A column with one value, and nothing elsewhere."""
    only = np.full(count, np.nan)
    only[place] = value
    return only


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    """Dots in colours, and what each stands for, as HTML."""
    return _foot(
        " ".join(
            f'<span style="white-space:nowrap"><b style="color:{colour}">●</b> {name}&ensp;</span>'
            for name, colour in entries
        )
    )


def _foot(html: str) -> str:
    """A small line below a plot."""
    return f'<div style="font-size:11px;line-height:15px;padding:0 14px;color:#666">{html}</div>'


def _css(colour: tuple[float, float, float]) -> str:
    return f"rgb({', '.join(str(round(255 * part)) for part in colour)})"
