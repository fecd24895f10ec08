"""The gauges: numbers of the instant, plots over time, and joints between their limits."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from handmap_qp.drawing.hands import HUMAN_COLOUR, ROBOT_COLOUR
from handmap_qp.mapping.methods.teleoperation import Teleoperation
from handmap_qp.viewer.deformation import DEFORMATION_COLOUR
from handmap_qp.viewer.joint_bars import joint_bars
from handmap_qp.viewer.markup import FIRST, GREY, ORANGE, SECOND, css, legend, small_text
from handmap_qp.viewer.reading_table import reading_table
from handmap_qp.viewer.readings import RobotReader, human_pinches
from handmap_qp.viewer.sample import Variant, ViewSample
from handmap_qp.viewer.scene import TARGET_COLOUR

if TYPE_CHECKING:
    import viser

_AXIS = {"stroke": "#666", "font": "11px sans-serif", "grid": {"stroke": "#eee"}}
# Bins per plot; more than a plot has pixels.
_MOST_BINS = 600
SCENE_COLOURS = (
    ("human points", HUMAN_COLOUR),
    ("robot points", ROBOT_COLOUR),
    ("targets", TARGET_COLOUR),
    ("ball after T_def", DEFORMATION_COLOUR),
)
"""What the colours in the scene mean."""


def gauge_row(sample: ViewSample) -> tuple[float, float, float, float]:
    """Return the plotted values of a sample.

    These are time [s], mean and largest point error [mm], and duration of the step [µs].
    """
    error = sample.point_error if sample.targets is not None else np.array([np.nan])
    return sample.time, 1e3 * float(error.mean()), 1e3 * float(error.max()), 1e6 * sample.duration


class InstantGauges:
    """The numbers and the joint bars of one instant, as HTML.

    Args:
        variants: The robots, one or two.
        contact_gap: What the tracker measures between two tips where the skin touches [m]; that of
            teleoperation if omitted.
    """

    def __init__(self, variants: Sequence[Variant], contact_gap: float | None = None) -> None:
        self._labels = [variant.label for variant in variants]
        self._robot = variants[0].robot
        self._reader = RobotReader(self._robot)
        self._contact_gap = Teleoperation().contact_gap if contact_gap is None else contact_gap

    def table(self, samples: Sequence[ViewSample]) -> str:
        """Return errors and pinch gaps of one sample of each robot."""
        readings = [self._reader.read(sample) for sample in samples]
        return reading_table(self._labels, readings, human_pinches(samples[0], self._contact_gap))

    def bars(self, samples: Sequence[ViewSample]) -> str:
        """Return the joints of one sample of each robot."""
        return joint_bars(self._robot, *samples[:2])


class Gauges:
    """Numbers, plots and joint bars, where viser adds controls.

    Args:
        server: A running viser server.
        variants: The robots, one or two.
        contact_gap: What the tracker measures between two tips where the skin touches [m]; that of
            teleoperation if omitted.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        variants: Sequence[Variant],
        contact_gap: float | None = None,
    ) -> None:
        gui = server.gui
        gui.add_html(legend([(name, css(colour)) for name, colour in SCENE_COLOURS]))
        self.table = gui.add_html("")
        self.error = _add_plot(
            server, "point error [mm]", ("mean", "largest", "other"), (FIRST, GREY, SECOND)
        )
        self.error_note = gui.add_html("")
        self.joints = gui.add_html("")
        with gui.add_folder("time per step", expand_by_default=False):
            self.timing = _add_plot(server, "time per step [µs]", ("step",), (FIRST,))
        self.timing_note = gui.add_html("")
        self._contact_gap = contact_gap
        self._rows = self._plotted = np.empty((0, 5))
        self._starts = np.empty(0, dtype=int)
        self.set_variants(variants)

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show other methods' values, after which `set_rows` gives theirs over time."""
        self._instant = InstantGauges(variants, self._contact_gap)
        first, second = "mean", ()
        if len(variants) > 1:
            first, second = variants[0].label, ((variants[1].label, SECOND),)
        self.error_note.content = legend(
            ((first, FIRST), ("largest", GREY), *second, ("now", ORANGE))
        )

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
        _set_scales(self.error, _scales(span, np.fmax(self._rows[:, 2], mean)))
        # Outliers (the process was preempted) would flatten all other steps, so cut them off.
        _set_scales(self.timing, _scales(span, np.minimum(step, 3.0 * median)))
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
        place = int(np.searchsorted(self._starts, index, side="right")) - 1
        now = self._rows[index]
        self.error.data = (time, mean, largest, other, _only(len(time), place, now[1]))
        self.timing.data = (time, step, _only(len(time), place, now[3]))
        self.table.content = self._instant.table(samples)
        self.joints.content = self._instant.bars(samples)


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
            stroke=ORANGE,
            width=0,
            points=uplot.Series_Points(show=True, size=9, fill=ORANGE),
        )
    )
    nothing = (np.arange(2.0), *(np.zeros(2) for _ in series[1:]))
    return server.gui.add_uplot(
        nothing,
        tuple(series),
        title=title,
        height=150,
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
