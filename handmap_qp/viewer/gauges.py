"""The panel on the left: point error and step time over time, and the robot's joints against their limits."""

from __future__ import annotations

from collections.abc import Sequence
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.hand import Hand
from handmap_qp.viewer.samples import ViewSample

if TYPE_CHECKING:
    import viser

_WIDTH = 330
_BLUE, _GREY, _RED, _ORANGE = "#2166d8", "#9aa0a8", "#d62929", "#f08c00"
_AXIS = {"stroke": "#666", "font": "11px sans-serif", "size": 40, "grid": {"stroke": "#eee"}}


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
            self.error = _add_plot(server, "point error [mm]", ("mean", "largest"), (_BLUE, _GREY))
            self.timing = _add_plot(server, "time per step [µs]", ("step",), (_BLUE,))
            self.joints = server.gui.add_html("")
        panel.dock_left()
        panel.set_width(_WIDTH)
        self._columns: tuple[np.ndarray, ...] = ()

    def set_samples(self, samples: Sequence[ViewSample], *, latest: float | None = None) -> None:
        """Plot other samples.

        Args:
            samples: All that is to be seen.
            latest: For the last so many seconds, with the last sample at zero [s]; from the first sample to the last if omitted.
        """
        time = np.array([sample.time for sample in samples])
        # A plot keeps its range when its data change, and a new range costs a new plot: so a range that moves is one that stands.
        span = (float(time[0]), float(max(time[-1], time[0] + 0.1)))
        if latest is not None:
            time, span = time - time[-1], (-latest, 0.0)
        errors = [1e3 * sample.point_error for sample in samples]
        mean = np.array([error.mean() if len(error) else np.nan for error in errors])
        largest = np.array([error.max() if len(error) else np.nan for error in errors])
        step = np.array([1e6 * sample.duration for sample in samples])
        self._columns = (time, mean, largest, step)
        _set_scales(self.error, _scales(span, largest))
        # A few steps that the machine was interrupted in would flatten all others.
        _set_scales(self.timing, _scales(span, np.minimum(step, 3.0 * np.median(step))))

    def draw(self, sample: ViewSample, index: int) -> None:
        """Mark the present sample in the plots and show its joints.

        Args:
            sample: The sample.
            index: Its place among those given to `set_samples`.
        """
        time, mean, largest, step = self._columns
        self.error.data = (time, mean, largest, _only(mean, index))
        self.timing.data = (time, step, _only(step, index))
        self.joints.content = joint_bars(self._robot, sample)


def joint_bars(robot: Hand, sample: ViewSample) -> str:
    """Every joint between its limits, as HTML: a bar from the lower limit to the upper one, red where a limit holds the joint.

    Args:
        robot: The robot hand.
        sample: Its posture.

    Returns:
        The HTML.
    """
    shares = (sample.robot_q - robot.lower_limits) / (robot.upper_limits - robot.lower_limits)
    rest = (robot.rest - robot.lower_limits) / (robot.upper_limits - robot.lower_limits)
    rows = []
    for name, q, share, rest_share, is_held in zip(robot.joint_names, sample.robot_q, shares, rest, sample.at_limit, strict=True):
        colour = _RED if is_held else _BLUE
        track = "flex:1;position:relative;height:7px;background:#e4e6ea;border-radius:4px"
        fill = f"position:absolute;left:0;width:{100 * share:.1f}%;height:7px;background:{colour};border-radius:4px"
        mark = f"position:absolute;left:{100 * rest_share:.1f}%;top:-2px;width:1px;height:11px;background:#333"
        rows.append(
            '<div style="display:flex;align-items:center;height:15px">'
            f'<span style="width:118px;overflow:hidden;white-space:nowrap;text-overflow:ellipsis">{escape(name)}</span>'
            f'<span style="{track}"><span style="{fill}"></span><span style="{mark}"></span></span>'
            f'<span style="width:44px;text-align:right;color:{colour}">{np.degrees(q):.0f}°</span></div>'
        )
    head = '<div style="font-weight:600;margin-bottom:3px">joints between their limits</div>'
    return f'<div style="font-size:11px;line-height:15px;padding:4px 14px">{head}{"".join(rows)}</div>'


def _add_plot(server: viser.ViserServer, title: str, names: tuple[str, ...], colours: tuple[str, ...]) -> Any:
    """A plot of some series over time, with a dot on the first of them for now."""
    from viser import uplot

    series = [uplot.Series(label="s")]
    series += [uplot.Series(label=name, stroke=colour, width=1.5) for name, colour in zip(names, colours, strict=True)]
    series.append(uplot.Series(label="now", stroke=_ORANGE, width=0, points=uplot.Series_Points(show=True, size=9, fill=_ORANGE)))
    nothing = (np.arange(2.0), *(np.zeros(2) for _ in series[1:]))
    return server.gui.add_uplot(
        nothing,
        tuple(series),
        title=title,
        height=170,
        scales=_scales((0.0, 1.0), np.ones(2)),
        axes=(uplot.Axis(**_AXIS), uplot.Axis(**_AXIS)),
        legend=uplot.Legend(show=False),
    )


def _scales(span: tuple[float, float], values: np.ndarray) -> dict[str, Any]:
    """Ranges of both axes: this much time, and from zero to a little above the next round number."""
    from viser import uplot

    largest = max(float(np.nanmax(values)) if np.isfinite(values).any() else 1.0, 1e-6)
    decade = 10.0 ** np.floor(np.log10(largest))
    top = next(step * decade for step in (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0, 10.0) if step * decade >= largest * (1.0 - 1e-9))
    return {"x": uplot.Scale(time=False, auto=False, range=span), "y": uplot.Scale(auto=False, range=(0.0, 1.08 * float(top)))}


def _set_scales(plot: Any, scales: dict[str, Any]) -> None:
    """Give a plot other ranges, for which the browser makes it anew: only if they are other ones."""
    if plot.scales != scales:
        plot.scales = scales


def _only(values: np.ndarray, index: int) -> np.ndarray:
    """One value, and nothing elsewhere."""
    only = np.full(len(values), np.nan)
    only[index] = values[index]
    return only
