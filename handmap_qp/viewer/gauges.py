"""The panel on the left: point error, step time, and joints between their limits."""

from __future__ import annotations

import re
from collections.abc import Sequence
from html import escape
from itertools import takewhile
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.hands.hand import Hand
from handmap_qp.viewer.replay import ViewSample
from handmap_qp.viewer.scene import DEFORMATION_COLOUR, TARGET_COLOUR

if TYPE_CHECKING:
    import viser

_WIDTH = 330
_BLUE, _GREY, _RED, _ORANGE = "#2166d8", "#9aa0a8", "#d62929", "#f08c00"
_AXIS = {"stroke": "#666", "font": "11px sans-serif", "grid": {"stroke": "#eee"}}
# Bins per plot; more than a plot has pixels.
_MOST_BINS = 600
# Characters; longer joint names are shortened in the middle.
_LONGEST_NAME = 19
_SCENE_COLOURS = (
    ("human points", HUMAN_COLOUR),
    ("robot points", ROBOT_COLOUR),
    ("targets", TARGET_COLOUR),
    ("ball after T_def", DEFORMATION_COLOUR),
)


def gauge_row(sample: ViewSample) -> tuple[float, float, float, float]:
    """Return the plotted values of a sample.

    These are time [s], mean and largest point error [mm], and duration of the step [µs].
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
        """Replace the plotted samples.

        Args:
            rows: `gauge_row` of each sample, shape (n, 4), n > 0.
            latest: Length of the time axis, which then ends with the last sample at zero [s]; all
                samples if omitted.
        """
        self._rows = np.array(rows, dtype=float)
        time = self._rows[:, 0]
        # Changing the range rebuilds the plot: keep it fixed and shift the data.
        span = (float(time[0]), float(max(time[-1], time[0] + 0.1)))
        if latest is not None:
            time -= time[-1]
            span = (-latest, 0.0)
        # Decimate: plot each bin's maximum, at its last sample's time.
        self._starts = np.linspace(0, len(time), min(len(time), _MOST_BINS), endpoint=False).astype(
            int
        )
        self._plotted = np.fmax.reduceat(self._rows, self._starts, axis=0)
        step = self._rows[:, 3]
        median, p99 = np.percentile(step, (50, 99))
        _set_scales(self.error, _scales(span, self._rows[:, 2]))
        # Outliers (the process was preempted) would flatten all other steps, so cut them off.
        _set_scales(self.timing, _scales(span, np.minimum(step, 3.0 * median)))
        cut = " (cut off)" if step.max() > self.timing.scales["y"]["range"][1] else ""
        self.timing_note.content = _foot(
            f"median {median:.0f} · p99 {p99:.0f} · largest {step.max():.0f}{cut}"
        )

    def draw(self, sample: ViewSample, index: int) -> None:
        """Mark a sample in the plots and show its joints.

        Args:
            sample: The sample.
            index: Its index among those given to `set_rows`.
        """
        time, mean, largest, step = self._plotted.T
        place = int(np.searchsorted(self._starts, index, side="right")) - 1
        now = self._rows[index]
        self.error.data = (time, mean, largest, _only(len(time), place, now[1]))
        self.timing.data = (time, step, _only(len(time), place, now[3]))
        self.joints.content = joint_bars(self._robot, sample)


def joint_bars(robot: Hand, sample: ViewSample) -> str:
    """Draw every joint as a bar from its lower to its upper position limit, finger by finger.

    The bar is red at a position limit, and orange where the speed limit held the joint.

    Args:
        robot: The robot hand.
        sample: Its posture.

    Returns:
        The HTML.
    """
    ranges = robot.upper_limits - robot.lower_limits
    columns = zip(
        robot.joint_names,
        short_names(robot.joint_names),
        sample.robot_q,
        (sample.robot_q - robot.lower_limits) / ranges,
        (robot.rest - robot.lower_limits) / ranges,
        np.where(
            robot.at_position_limit(sample.robot_q),
            _RED,
            np.where(sample.is_limited, _ORANGE, _BLUE),
        ),
        strict=True,
    )
    bars = [_joint_bar(*column) for column in columns]
    groups = "".join(
        f'<div style="color:#666;margin-top:3px">{escape(finger)}</div>'
        f"{''.join(bars[i] for i in joints)}"
        for finger, joints in joints_by_finger(robot).items()
    )
    entries = (("position limit", _RED), ("speed limit", _ORANGE))
    return (
        '<div style="font-size:11px;line-height:15px;padding:4px 14px">'
        '<div style="font-weight:600">joints between their limits</div>'
        f"{groups}</div>{_legend(entries)}"
    )


def joints_by_finger(robot: Hand) -> dict[str, list[int]]:
    """Return the joints that move one finger alone, by its name, and all others as `palm`.

    Args:
        robot: The robot hand.

    Returns:
        Indices into `Hand.joint_names`; every joint once.
    """
    model = robot.model
    carried = [
        (
            point.finger,
            set(
                model.supports[
                    model.frames[model.getFrameId(point.link, pin.FrameType.BODY)].parentJoint
                ]
            ),
        )
        for point in robot.spec.points
        if point.finger is not None
    ]
    groups: dict[str, list[int]] = {}
    for i, name in enumerate(robot.joint_names):
        joint = model.getJointId(name)
        fingers = {finger for finger, joints in carried if joint in joints}
        groups.setdefault(fingers.pop() if len(fingers) == 1 else "palm", []).append(i)
    return groups


def _joint_bar(name: str, short: str, q: float, share: float, rest: float, colour: str) -> str:
    """Return one joint's row: name, bar with a mark at the rest angle, and angle, as HTML."""
    bar = f"height:7px;border-radius:4px;background:{colour}"
    return (
        '<div style="display:flex;align-items:center;height:15px">'
        f'<span title="{escape(name)}" style="width:118px;overflow:hidden;white-space:nowrap">'
        f"{escape(short)}</span>"
        '<span style="flex:1;position:relative;height:7px;background:#e4e6ea;border-radius:4px">'
        f'<span style="position:absolute;left:0;width:{100 * share:.1f}%;{bar}"></span>'
        f'<span style="position:absolute;left:{100 * rest:.1f}%;top:-2px;width:1px;height:11px;'
        'background:#333"></span></span>'
        f'<span style="width:44px;text-align:right;color:{colour}">{np.degrees(q):.0f}°</span>'
        "</div>"
    )


def short_names(names: Sequence[str]) -> list[str]:
    """Shorten joint names to the panel's width.

    If any name is too long, remove the prefix that all share, then the middle of those still too
    long: names differ at their ends.
    """
    if max(map(len, names)) <= _LONGEST_NAME:
        return list(names)
    # Cut the shared prefix only after a separator.
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
    """Add a plot of series over time, with a dot on the first of them at the current sample."""
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
    """Return the ranges of both axes: `span`, and zero to just above the next round number."""
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
    """Set the ranges of a plot if they differ, because the browser then rebuilds the plot."""
    if plot.scales != scales:
        plot.scales = scales


def _only(count: int, place: int, value: float) -> np.ndarray:
    """Return a column with one value, and NaN elsewhere."""
    only = np.full(count, np.nan)
    only[place] = value
    return only


def _legend(entries: Sequence[tuple[str, str]]) -> str:
    """Return a legend of coloured dots as HTML."""
    return _foot(
        " ".join(
            f'<span style="white-space:nowrap"><b style="color:{colour}">●</b> {name}&ensp;</span>'
            for name, colour in entries
        )
    )


def _foot(html: str) -> str:
    """Return a small line of text as HTML."""
    return f'<div style="font-size:11px;line-height:15px;padding:0 14px;color:#666">{html}</div>'


def _css(colour: tuple[float, float, float]) -> str:
    return f"rgb({', '.join(str(round(255 * part)) for part in colour)})"
