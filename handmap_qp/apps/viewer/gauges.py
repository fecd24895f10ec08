"""The gauges: numbers of the instant, plots over time, and joints between their limits."""

from collections.abc import Sequence
from html import escape
from itertools import cycle

import numpy as np

from handmap_core.errors import HandError
from handmap_core.se3 import Array
from handmap_qp.apps.drawing import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.apps.offline.surface_gaps import GapMeter
from handmap_qp.hands import CONTACT_GAP, FINGERS, Hand, Values, find_fingers
from handmap_qp.human import tip_gaps
from .figure import DEFORMATION_COLOUR, TARGET_COLOUR, known
from .sample import HumanView, Variant, ViewSample
from .serving import ViserServer

HUMAN = "#8a8f98"
FIRST = "#2166d8"
SECOND = "#0b8f7c"
ROBOTS = (FIRST, SECOND, "#a83e9b", "#8a5a00")
"""The robot's values, and those of the robots that it is compared with."""
GREY = "#9aa0a8"
RED = "#d62929"
ORANGE = "#f08c00"
# Gaps longer than this fill the whole bar [m].
_LONGEST_GAP = 0.15
# Points of a line of a plot: two for each pixel.
_MOST_POINTS = 456
# Width and height of a plot, without its labels [px].
_PLOT = (228.0, 86.0)
_STEPS = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0)
_ERRORS = (
    ("point error, mean", 1e3, " mm"),
    ("point error, largest", 1e3, " mm"),
    ("wrist position error", 1e3, " mm"),
    ("wrist rotation error", np.degrees(1.0), "°"),
)
"""Name, factor and unit of each of `InstantGauges.errors`."""
_CELL = "padding:0 0 0 8px;text-align:right;white-space:nowrap"
_BAR = "position:absolute;left:0;height"


def legend(entries: Sequence[tuple[str, str]]) -> str:
    """Return a legend of coloured dots, of names and colours, as HTML."""
    dots = " ".join(
        f'<b style="color:{colour}">●</b>&nbsp;{escape(name)}&ensp;'
        for name, colour in entries
    )
    return f'<div style="font-size:11px;line-height:15px;padding:0 14px;color:#666">{dots}</div>'


SCENE_LEGEND = legend(
    [
        (name, "rgb({:.1%} {:.1%} {:.1%})".format(*colour))
        for name, colour in (
            ("human points", HUMAN_COLOUR),
            ("robot points", ROBOT_COLOUR),
            ("targets", TARGET_COLOUR),
            ("ball after T_def", DEFORMATION_COLOUR),
        )
    ]
)
"""What the colours in the scene mean, as HTML."""


class InstantGauges:
    """The numbers and the joint bars of one instant, as HTML.

    Args:
        robot: The robot hand, whichever method moves it.
        human: The human hand; None for robots alone.
    """

    def __init__(self, robot: Hand, human: Hand | None) -> None:
        self._robot = robot
        self._groups = joints_by_finger(robot)
        self._contact_gap = human.contact_gap if human else CONTACT_GAP
        try:
            self._measures = [GapMeter(hand).pinches for hand in robot.hands]
        except HandError:
            # Without readable collision shapes, only the pinch gaps are missing.
            self._measures = [lambda _: {}] * len(robot.hands)

    def errors(self, sample: ViewSample) -> Array:
        """Return a robot's errors; NaN for those that are not known.

        Returns:
            Mean and largest point error [m], distance [m] and angle [rad] of the wrist from its
            target if it can move, shape (4,). Of several wrists, the largest.
        """
        points = sample.point_error
        wrist = sample.wrist_error if self._robot.has_moving_wrist else 2 * [np.nan]
        return np.array([points.mean(), points.max(), *wrist])

    def pinches(self, sample: ViewSample, hand: int = 0) -> Values:
        """Return a robot's gap between thumb and each other finger [m], by the finger's name.

        It is measured between the surfaces of the last links, and negative where they overlap.
        """
        gaps = self._measures[hand](sample.robot_q[None])
        return {finger: gap[0] for finger, gap in gaps.items()}

    def human_pinches(self, human: HumanView) -> Values:
        """Return the human's gap between thumb and each other finger [m], by the finger's name.

        The contact gap is subtracted, so that a touch reads zero.
        """
        if (landmarks := known(human.landmarks)) is None:
            return {}
        gaps = np.maximum(tip_gaps(landmarks) - self._contact_gap, 0.0)
        return dict(zip(FINGERS[1:], gaps.tolist(), strict=True))

    def table(self, samples: Sequence[ViewSample], labels: Sequence[str]) -> str:
        """Return errors and pinch gaps of one sample of each robot, and the robots' labels."""
        errors = np.transpose([self.errors(sample) for sample in samples])
        pinches = ""
        humans = samples[0].humans or [HumanView()]
        for i, human in enumerate(humans):
            gaps = [self.pinches(sample, i) for sample in samples]
            whose = self._robot.hands[i].side if humans[1:] else ""
            pinches += _pinch_bars(whose, [self.human_pinches(human), *gaps])
        heads = "".join(
            f'<th style="{_CELL};color:{colour};font-weight:600">{escape(label)}</th>'
            for label, colour in zip(labels, cycle(ROBOTS), strict=False)
        )
        rows = "".join(
            f'<tr><td style="color:#666">{name}</td>'
            + "".join(
                f'<td style="{_CELL}">{_text(factor * value, unit)}</td>'
                for value in values
            )
            + "</tr>"
            for (name, factor, unit), values in zip(_ERRORS, errors, strict=True)
        )
        return (
            '<div style="font-size:11px;line-height:15px;padding:2px 14px">'
            f'<table style="width:100%;border-collapse:collapse"><tr><th></th>{heads}</tr>{rows}'
            f"</table>{pinches}</div>"
        )

    def bars(self, samples: Sequence[ViewSample]) -> str:
        """Draw every joint as a bar between its position limits, finger by finger.

        The bar is red at a position limit, and orange where the speed limit held the joint. The
        second robot's is a narrow bar below.
        """
        robot = self._robot
        sample, *others = samples[:2]
        low, high = robot.limits
        q = sample.robot_q
        postures = [q, robot.rest, *(other.robot_q for other in others)]
        shares = 100.0 * np.clip((postures - low) / (high - low), 0.0, 1.0)
        held = np.where(sample.is_limited, ORANGE, FIRST)
        colours = np.where(robot.at_position_limit(q), RED, held)
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


def _joint_bar(name: str, q: float, shares: Array, colour: str) -> str:
    """Return name, bar with a mark at rest, and angle [rad] as HTML; names lose their starts."""
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


def _pinch_bars(whose: str, tables: Sequence[Values]) -> str:
    """Return the gaps of one hand of the human and the robots, by finger, as bars and numbers."""
    rows = []
    for finger in tables[1]:
        gaps = [table.get(finger, np.nan) for table in tables]
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
        '<div style="margin-top:4px;color:#666"><b style="font-weight:600;color:#000">'
        f'{whose} pinch gaps [mm]</b> thumb to finger: <span style="color:{HUMAN}">human</span>, '
        f'<span style="color:{FIRST}">robot</span></div>'
    )
    return "".join([title, *rows]) if rows else ""


def _text(value: float, unit: str, digits: int = 1) -> str:
    """Return a number and its unit; a dash for NaN."""
    return "-" if np.isnan(value) else f"{value:z.{digits}f}{unit}"


def joints_by_finger(robot: Hand) -> dict[str, list[int]]:
    """Return the joints that move one finger alone, by its name, and all others as `palm`.

    Of a robot with several hands, names begin with the side, and all others are `body and arms`.

    Args:
        robot: The robot hand.

    Returns:
        Indices into `Hand.joint_names`; every joint once.
    """
    fingers = {
        f"{hand.side} {name}" if robot.parts else name: finger
        for hand in robot.hands
        for name, finger in find_fingers(hand).items()
    }
    others = "body and arms" if robot.parts else "palm"
    groups: dict[str, list[int]] = {}
    for i in range(len(robot.joint_names)):
        moved = [name for name, finger in fingers.items() if i in finger.columns]
        groups.setdefault(moved[0] if len(moved) == 1 else others, []).append(i)
    return groups


def draw_plot(
    title: str,
    time: Array,
    lines: Sequence[tuple[str, str, Array]],
    index: int,
    *,
    latest: float | None = None,
) -> str:
    """Draw lines from zero to a round number as HTML, with gaps where there are no values.

    Args:
        title: What is plotted.
        time: Times [s], shape (n,).
        lines: Name, colour and values of each, shape (n,).
        index: Index of the sample to mark.
        latest: Length of the time axis, which then ends with the last sample at zero [s]; all
            samples if omitted.

    Returns:
        The plot; empty if there is nothing to show.
    """
    time = time - time[0 if latest is None else -1]
    start, end = (0.0, max(time[-1], 1e-3)) if latest is None else (-latest, 0.0)
    width, height = _PLOT
    places = width * (time - start) / (end - start)
    values = np.array([line for _, _, line in lines])
    if not np.isfinite(values).any():
        return ""
    # Decimate: plot the maximum of each bin, at the time of its first sample.
    count = min(len(time), _MOST_POINTS)
    bins = np.linspace(0, len(time), count, endpoint=False).astype(int)
    binned = np.fmax.reduceat(values, bins, axis=1)
    largest = max(np.nanmax(binned), 1e-3)
    decade = 10.0 ** np.floor(np.log10(largest))
    top = decade * _STEPS[np.searchsorted(_STEPS, largest / decade * (1 - 1e-9))]
    x = places[bins]
    y = height * (1.0 - binned / top)
    parts = [
        f'<path d="M0 {height * (1 - share)}h{width}" stroke="#e6e8eb"/><text x="-4" '
        f'y="{height * (1 - share)}" dy="3.5" text-anchor="end">{share * top:g}</text>'
        f'<text x="{share * width}" y="99" text-anchor="middle">'
        f"{start + share * (end - start):.1f}</text>"
        for share in (0.0, 0.5, 1.0)
    ]
    # The first line is drawn last, over the others.
    for (_, colour, _), row in reversed(list(zip(lines, y, strict=True))):
        # Interrupted where there are no values.
        runs = np.ma.clump_unmasked(np.ma.masked_invalid(row))
        points = [map("{:.1f} {:.1f}".format, x[run], row[run]) for run in runs]
        path = "".join(f"M{'L'.join(run)}" for run in points)
        parts.append(f'<path d="{path}" fill="none" stroke="{colour}"/>')
    svg = "".join(parts)
    html = (
        '<div style="padding:4px 14px 0;font-size:11px"><b style="font-weight:600">'
        f'{title}</b><svg viewBox="0 0 272 112" style="display:block;width:100%;'
        f'font-size:10px;fill:#666"><g transform="translate(30 8)">{svg}<path class="now" '
        f'd="M0 0v{height}" transform="translate({places[index]:.1f} 0)" stroke="{ORANGE}" '
        f'stroke-width="2"/></g></svg></div>'
    )
    return html + legend([line[:2] for line in lines])


def error_plot(
    variants: Sequence[Variant], index: int, *, latest: float | None = None
) -> str:
    """Plot the mean point error of each robot, and the largest of the first one [mm].

    Args:
        variants: The robots, with their samples.
        index: See `draw_plot`.
        latest: See `draw_plot`.
    """
    columns = [variant.plotted for variant in variants]
    time, _, largest, _ = columns[0]
    labels = [variant.label for variant in variants] if columns[1:] else ["mean"]
    lines = list(
        zip(labels, cycle(ROBOTS), (each[1] for each in columns), strict=False)
    )
    lines.insert(1, ("largest", GREY, largest))
    return draw_plot("point error [mm]", time, lines, index, latest=latest)


class Gauges:
    """Numbers, plots and joint bars, where viser adds controls."""

    def __init__(self, server: ViserServer, robot: Hand, human: Hand) -> None:
        gui = server.gui
        gui.add_html(SCENE_LEGEND)
        self.table = gui.add_html("")
        self.error = gui.add_html("")
        self.joints = gui.add_html("")
        with gui.add_folder("time per step", expand_by_default=False):
            self.timing = gui.add_html("")
        self.timing_note = gui.add_html("")
        self._instant = InstantGauges(robot, human)

    def draw(
        self, variants: Sequence[Variant], index: int, *, latest: float | None = None
    ) -> None:
        """Plot the samples of the robots, and show the numbers and joints of one instant.

        Args:
            variants: The robots, with their samples.
            index: Index of the instant's samples.
            latest: See `draw_plot`.
        """
        self.error.content = error_plot(variants, index, latest=latest)
        time, _, _, step = variants[0].plotted
        median, p99 = np.percentile(step, (50, 99))
        # Outliers (the process was preempted) would flatten all other steps, so cut them off.
        limit = 3.0 * median
        cut = " (cut off)" if step.max() > limit else ""
        self.timing.content = draw_plot(
            "time per step [µs]",
            time,
            [("step", FIRST, np.minimum(step, limit))],
            index,
            latest=latest,
        )
        note = f"median {median:.0f} · p99 {p99:.0f} · largest {step.max():.0f}{cut}"
        self.timing_note.content = legend([(f"step [µs]: {note}", FIRST)])
        samples = [variant.samples[index] for variant in variants]
        labels = [variant.label for variant in variants]
        self.table.content = self._instant.table(samples, labels)
        self.joints.content = self._instant.bars(samples)
