"""The gauges: numbers of the instant, plots over time, and joints between their limits."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from html import escape
from itertools import cycle
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from handmap_qp.apps.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.apps.viewer.figure import DEFORMATION_COLOUR, TARGET_COLOUR, as_bytes
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.errors import HandError
from handmap_qp.hands.fingers import find_fingers
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import CONTACT_GAP, FINGERS
from handmap_qp.human.contact_gap import tip_gaps

if TYPE_CHECKING:
    import viser

HUMAN, FIRST, SECOND = "#8a8f98", "#2166d8", "#0b8f7c"
ROBOTS = (FIRST, SECOND, "#a83e9b", "#8a5a00")
"""The robot's values, and those of the robots that it is compared with."""
GREY, RED, ORANGE = "#9aa0a8", "#d62929", "#f08c00"
# Gaps longer than this fill the whole bar [m].
_LONGEST_GAP = 0.15
# Bins per plot; more than a plot has pixels.
_MOST_BINS = 600
_AXIS = {"stroke": "#666", "font": "11px sans-serif", "grid": {"stroke": "#eee"}}
_CELL = "padding:0 0 0 8px;text-align:right;white-space:nowrap"
_BAR = "position:absolute;left:0;height"


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """Return a legend of coloured dots, of names and colours, as HTML."""
    return small_text(
        " ".join(
            f'<span style="white-space:nowrap"><b style="color:{colour}">●</b> {escape(name)}'
            "&ensp;</span>"
            for name, colour in entries
        )
    )


def small_text(html: str) -> str:
    """Return a small line of text as HTML."""
    return f'<div style="font-size:11px;line-height:15px;padding:0 14px;color:#666">{html}</div>'


SCENE_LEGEND = legend(
    [
        (name, f"rgb{as_bytes(colour)}")
        for name, colour in (
            ("human points", HUMAN_COLOUR),
            ("robot points", ROBOT_COLOUR),
            ("targets", TARGET_COLOUR),
            ("ball after T_def", DEFORMATION_COLOUR),
        )
    ]
)
"""What the colours in the scene mean, as HTML."""


class Readings(NamedTuple):
    """What the gauges say about one robot at one instant; NaN if it is not known.

    Attributes:
        mean_error: Mean point error [m].
        largest_error: Largest point error [m].
        wrist_shift: Distance of the wrist from its target [m]; NaN for one that cannot move.
        wrist_angle: Angle between the wrist and its target [rad], likewise.
        pinches: Gap between the surfaces of the thumb's and each other finger's last link [m],
            negative where they overlap, by the finger's name.
    """

    mean_error: float
    largest_error: float
    wrist_shift: float
    wrist_angle: float
    pinches: dict[str, float]


class InstantGauges:
    """The numbers and the joint bars of one instant, as HTML.

    Args:
        variants: The robots, one or two.
        human: The human hand; None for robots alone.
    """

    def __init__(self, variants: Sequence[Variant], human: Hand | None) -> None:
        self._labels = [variant.label for variant in variants]
        self._robot = robot = variants[0].robot
        self._groups = joints_by_finger(robot)
        self._contact_gap = CONTACT_GAP if human is None else human.contact_gap
        try:
            self._meter = GapMeter(robot)
        except HandError:
            # Without readable collision shapes, only the pinch gaps are missing.
            self._meter = None

    def read(self, sample: ViewSample) -> Readings:
        """Return the numbers of a robot's sample."""
        errors, wrist, wanted = (
            sample.point_error,
            sample.robot_wrist,
            sample.wrist_target,
        )
        shift = angle = np.nan
        if wanted is not None and self._robot.has_moving_wrist:
            shift = np.linalg.norm(wrist[:3, 3] - wanted[:3, 3])
            angle = np.linalg.norm(pin.log3(wanted[:3, :3].T @ wrist[:3, :3]))
        gaps = {} if self._meter is None else self._meter.pinches(sample.robot_q[None])
        pinches = {finger: float(gap[0]) for finger, gap in gaps.items()}
        return Readings(
            errors.mean(), errors.max(), float(shift), float(angle), pinches
        )

    def human_pinches(self, sample: ViewSample) -> dict[str, float]:
        """Return the human's gap between thumb and each other finger [m], by the finger's name.

        The contact gap is subtracted, so that a touch reads zero.
        """
        if sample.landmarks is None or not np.isfinite(sample.landmarks).all():
            return {}
        gaps = np.maximum(tip_gaps(sample.landmarks) - self._contact_gap, 0.0)
        return dict(zip(FINGERS[1:], gaps.tolist(), strict=True))

    def table(self, samples: Sequence[ViewSample]) -> str:
        """Return errors and pinch gaps of one sample of each robot."""
        readings = [self.read(sample) for sample in samples]
        heads = "".join(
            f'<th style="{_CELL};color:{colour};font-weight:600">{escape(label)}</th>'
            for label, colour in zip(self._labels, cycle(ROBOTS), strict=False)
        )
        rows = "".join(
            f'<tr><td style="color:#666">{name}</td>'
            + "".join(
                f'<td style="{_CELL}">{_text(factor * r[i], unit)}</td>'
                for r in readings
            )
            + "</tr>"
            for i, name, factor, unit in (
                (0, "point error, mean", 1e3, " mm"),
                (1, "point error, largest", 1e3, " mm"),
                (2, "wrist position error", 1e3, " mm"),
                (3, "wrist rotation error", np.degrees(1.0), "°"),
            )
        )
        return (
            '<div style="font-size:11px;line-height:15px;padding:2px 14px">'
            f'<table style="width:100%;border-collapse:collapse"><tr><th></th>{heads}</tr>{rows}'
            f"</table>{_pinch_bars(self.human_pinches(samples[0]), readings)}</div>"
        )

    def bars(self, samples: Sequence[ViewSample]) -> str:
        """Draw every joint as a bar between its position limits, finger by finger.

        The bar is red at a position limit, and orange where the speed limit held the joint. The
        second robot's is a narrow bar below.
        """
        robot, (sample, *others) = self._robot, samples[:2]
        low, high, q = robot.lower_limits, robot.upper_limits, sample.robot_q
        postures = [q, robot.rest, *(other.robot_q for other in others)]
        shares = 100.0 * np.clip((np.array(postures) - low) / (high - low), 0.0, 1.0)
        held = (
            np.zeros(len(q), dtype=bool)
            if sample.is_limited is None
            else sample.is_limited
        )
        colours = np.where(
            robot.at_position_limit(q), RED, np.where(held, ORANGE, FIRST)
        )
        bars = list(map(_joint_bar, robot.joint_names, q, shares.T, colours))
        groups = "".join(
            f'<div style="color:#666;margin-top:2px">{escape(finger)}</div>'
            + "".join(bars[i] for i in joints)
            for finger, joints in self._groups.items()
        )
        return (
            '<div style="font-size:11px;line-height:14px;padding:4px 14px">'
            f'<div style="font-weight:600">joints between their limits</div>{groups}</div>'
            + legend((("position limit", RED), ("speed limit", ORANGE)))
        )


def _joint_bar(name: str, q: float, shares: np.ndarray, colour: str) -> str:
    """Return a joint's name, its bar with a mark at the rest angle, and its angle [rad], as HTML.

    Long names are cut at their start, because names differ at their ends.
    """
    share, rest, *compared = shares
    second = "".join(
        f'<span style="{_BAR}:3px;top:5px;width:{width:.1f}%;background:{SECOND}"></span>'
        for width in compared
    )
    return (
        '<div style="display:flex;align-items:center;height:14px">'
        f'<span title="{escape(name)}" style="width:112px;overflow:hidden;white-space:nowrap;'
        'text-overflow:ellipsis;direction:rtl;text-align:left;padding-right:6px">'
        f"<bdi>{escape(name)}</bdi></span>"
        '<span style="flex:1;position:relative;height:7px;background:#e4e6ea;border-radius:4px">'
        f'<span style="{_BAR}:7px;width:{share:.1f}%;border-radius:4px;background:{colour}"></span>'
        f'{second}<span style="position:absolute;top:-2px;left:{rest:.1f}%;width:1px;height:11px;'
        f'background:#333"></span></span><span style="width:40px;text-align:right;color:{colour}">'
        f"{np.degrees(q):.0f}°</span></div>"
    )


def _pinch_bars(human: Mapping[str, float], readings: Sequence[Readings]) -> str:
    """Return the gaps between the thumb and each finger, as bars and numbers."""
    fingers = dict.fromkeys([name for reading in readings for name in reading.pinches])
    rows = []
    for finger in fingers:
        gaps = [
            table.get(finger, np.nan)
            for table in (human, *(r.pinches for r in readings))
        ]
        entries = list(zip(gaps, (HUMAN, *ROBOTS), strict=False))
        bars = "".join(
            f'<div style="height:4px;margin:1px 0;background:{colour};'
            f'width:{100.0 * np.clip(np.nan_to_num(gap) / _LONGEST_GAP, 0.0, 1.0):.1f}%"></div>'
            for gap, colour in entries
        )
        numbers = "".join(
            f'<span style="display:inline-block;width:30px;text-align:right;color:{colour}">'
            f"{_text(1e3 * gap, '', 0)}</span>"
            for gap, colour in entries
        )
        rows.append(
            '<div style="display:flex;align-items:center;margin-top:1px">'
            f'<span style="width:44px;color:#666">{escape(finger)}</span>'
            f'<span style="flex:1;background:#f1f2f4">{bars}</span>{numbers}</div>'
        )
    title = (
        '<div style="margin-top:4px;color:#666"><b style="font-weight:600;color:#000">pinch gaps '
        f'[mm]</b> thumb to finger: <span style="color:{HUMAN}">human</span>, '
        f'<span style="color:{FIRST}">robot</span></div>'
    )
    return "".join([title, *rows]) if rows else ""


def _text(value: float, unit: str, digits: int = 1) -> str:
    """Return a number and its unit; a dash for NaN."""
    return "-" if np.isnan(value) else f"{value:z.{digits}f}{unit}"


def joints_by_finger(robot: Hand) -> dict[str, list[int]]:
    """Return the joints that move one finger alone, by its name, and all others as `palm`.

    Args:
        robot: The robot hand.

    Returns:
        Indices into `Hand.joint_names`; every joint once.
    """
    moved = {
        name: finger.columns.tolist() for name, finger in find_fingers(robot).items()
    }
    counts = Counter(joint for joints in moved.values() for joint in joints)
    own = {i: name for name, joints in moved.items() for i in joints if counts[i] == 1}
    groups: dict[str, list[int]] = {}
    for i in range(len(robot.joint_names)):
        groups.setdefault(own.get(i, "palm"), []).append(i)
    return groups


def gauge_row(sample: ViewSample) -> tuple[float, float, float, float]:
    """Return the plotted values of a sample.

    These are time [s], mean and largest point error [mm], and duration of the step [µs].
    """
    error = 1e3 * sample.point_error
    return sample.time, float(error.mean()), float(error.max()), 1e6 * sample.duration


def bin_starts(count: int, most: int) -> np.ndarray:
    """Return the first sample of each bin, at most `most` of them."""
    return np.linspace(0, count, min(count, most), endpoint=False).astype(int)


def round_up(value: float, steps: Sequence[float]) -> float:
    """Return the next round number above a value, of these steps in a decade and 10."""
    decade = 10.0 ** np.floor(np.log10(value))
    return float(
        next(s for s in (*steps, 10.0) if s * decade >= value * (1.0 - 1e-9)) * decade
    )


class Gauges:
    """Numbers, plots and joint bars, where viser adds controls.

    Args:
        variants: The robots, one or two.
        human: The human hand.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        variants: Sequence[Variant],
        human: Hand,
    ) -> None:
        gui = server.gui
        gui.add_html(SCENE_LEGEND)
        self.table = gui.add_html("")
        names = (("mean", FIRST), ("largest", GREY), ("other", SECOND))
        self.error = _add_plot(server, "point error [mm]", names)
        self.error_note = gui.add_html("")
        self.joints = gui.add_html("")
        with gui.add_folder("time per step", expand_by_default=False):
            self.timing = _add_plot(server, "time per step [µs]", (("step", FIRST),))
        self.timing_note = gui.add_html("")
        self._human = human
        self._rows = self._plotted = np.empty((0, 5))
        self._starts = np.empty(0, dtype=int)
        self.set_variants(variants)

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show other methods' values, after which `set_rows` gives theirs over time."""
        self._instant = InstantGauges(variants, self._human)
        self.error_note.content = legend([*error_entries(variants), ("now", ORANGE)])

    def set_rows(
        self,
        rows: npt.ArrayLike,
        other: npt.ArrayLike | None = None,
        *,
        latest: float | None = None,
    ) -> None:
        """Replace the plotted samples.

        Args:
            rows: `gauge_row` of each sample, shape (n, 4), n > 0.
            other: The same of the robot that it is compared with.
            latest: Length of the time axis, which then ends with the last sample at zero [s]; all
                samples if omitted.
        """
        rows = np.array(rows, dtype=float)
        mean = np.full(len(rows), np.nan) if other is None else np.asarray(other)[:, 1]
        self._rows = np.column_stack([rows, mean])
        time, _, largest, step, _ = self._rows.T
        # Changing the range rebuilds the plot: keep it fixed and shift the data.
        span = (float(time[0]), float(max(time[-1], time[0] + 0.1)))
        if latest is not None:
            time -= time[-1]
            span = (-latest, 0.0)
        # Decimate: plot each bin's maximum, at its last sample's time.
        self._starts = bin_starts(len(rows), _MOST_BINS)
        self._plotted = np.fmax.reduceat(self._rows, self._starts, axis=0)
        median, p99 = np.percentile(step, (50, 99))
        # Outliers (the process was preempted) would flatten all other steps, so cut them off.
        for plot, values in (
            (self.error, np.fmax(largest, mean)),
            (self.timing, np.minimum(step, 3.0 * median)),
        ):
            # The browser rebuilds the plot if its ranges are set.
            if plot.scales != (scales := _scales(span, values)):
                plot.scales = scales
        cut = " (cut off)" if step.max() > self.timing.scales["y"]["range"][1] else ""
        self.timing_note.content = small_text(
            f"step [µs]: median {median:.0f} · p99 {p99:.0f} · largest {step.max():.0f}{cut}"
        )

    def draw(self, samples: Sequence[ViewSample], index: int) -> None:
        """Mark an instant in the plots and show its numbers and joints.

        Args:
            samples: One sample for each robot.
            index: Its index among those given to `set_rows`.
        """
        time, mean, largest, step, other = self._plotted.T
        now = np.full((2, len(time)), np.nan)
        place = int(np.searchsorted(self._starts, index, side="right")) - 1
        now[:, place] = self._rows[index, [1, 3]]
        self.error.data = (time, mean, largest, other, now[0])
        self.timing.data = (time, step, now[1])
        self.table.content = self._instant.table(samples)
        self.joints.content = self._instant.bars(samples)


def error_entries(variants: Sequence[Variant]) -> list[tuple[str, str]]:
    """Return names and colours of the plotted errors of one robot or two."""
    first = variants[0].label if len(variants) > 1 else "mean"
    return [
        (first, FIRST),
        ("largest", GREY),
        *zip((v.label for v in variants[1:]), cycle(ROBOTS[1:]), strict=False),
    ]


def _add_plot(
    server: viser.ViserServer, title: str, names: Sequence[tuple[str, str]]
) -> Any:
    """Add a plot of series over time, with a dot on the first of them at the current sample."""
    from viser import uplot

    dot = uplot.Series_Points(show=True, size=9, fill=ORANGE)
    series = (
        uplot.Series(label="s"),
        *(uplot.Series(label=name, stroke=colour, width=1.5) for name, colour in names),
        uplot.Series(label="now", stroke=ORANGE, width=0, points=dot),
    )
    label = {
        "label": "time [s]",
        "labelFont": "11px sans-serif",
        "labelSize": 16,
        "size": 30,
    }
    return server.gui.add_uplot(
        (np.arange(2.0), *np.zeros((len(series) - 1, 2))),
        series,
        title=title,
        height=150,
        scales=_scales((0.0, 1.0), np.ones(2)),
        axes=(uplot.Axis(**_AXIS, **label), uplot.Axis(**_AXIS, size=50)),
        legend=uplot.Legend(show=False),
    )


def _scales(span: tuple[float, float], values: np.ndarray) -> dict[str, Any]:
    """Return the ranges of both axes: `span`, and zero to just above the next round number."""
    from viser import uplot

    largest = max(float(np.nanmax(values)) if np.isfinite(values).any() else 1.0, 1e-6)
    top = round_up(largest, (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 6.0, 8.0))
    return {
        "x": uplot.Scale(time=False, auto=False, range=span),
        "y": uplot.Scale(auto=False, range=(0.0, 1.08 * top)),
    }
