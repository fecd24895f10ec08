"""A recording in the browser: `ReplayViewer` keeps scene, gauges and controls in step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.mapping.options_file import options_text
from handmap_qp.viewer.controls import (
    KEPT,
    NOTHING,
    CompareControls,
    DisplayControls,
    PlayBar,
    SteeringControls,
)
from handmap_qp.viewer.export import ExportControls
from handmap_qp.viewer.frames import GAUGES_PERIOD, Throttle, run_frames
from handmap_qp.viewer.gauges import Gauges, gauge_row
from handmap_qp.viewer.page import replay_page
from handmap_qp.viewer.panels import Panels
from handmap_qp.viewer.replay import Replay
from handmap_qp.viewer.sample import ViewSample
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser


class ReplayViewer:
    """Show a recording, and map it again whenever the preset or an option changes.

    Args:
        server: A running viser server.
        replay: The recording.

    Attributes:
        replay: The recording.
        scene: The hands.
        gauges: Numbers, plots and joint bars.
        play_bar: Play, pause, scrub.
        steering: Preset, comparison, clutch and options.
        display: What the scene shows.
        exports: Buttons that download files.
    """

    def __init__(self, server: viser.ViserServer, replay: Replay) -> None:
        self.server = server
        self.replay = replay
        self.scene = HandScene(server, replay.human, replay.variants)
        panels = Panels(server)
        self.gauges = Gauges(server, replay.variants, replay.contact_gap)
        # Options count from `_base`: the initial ones, or those of a preset chosen later.
        self._start = self._base = replay.choice
        self._changes: dict[str, Any] = {}
        self._is_behind = False
        self._to_compare: str | None = None
        self._options_text = self._text_of_options()
        self._compared = NOTHING if replay.other is None else replay.other.label
        with panels.control:
            self.play_bar = PlayBar(server, float(replay.time[-1]))
            self.steering = SteeringControls(
                server,
                self._start,
                replay.presets,
                lambda: CompareControls(server, replay.presets, self._compared),
            )
        with panels.show:
            self.display = DisplayControls(server)
        with panels.save:
            self.exports = ExportControls(server, lambda: self._options_text, self._page)
        self._plot()
        self._drawn: tuple[object, ...] = ()
        self._gauges_drawn: tuple[object, ...] = ()
        self._gauges_throttle = Throttle(GAUGES_PERIOD)
        self.tick(0.0)

    @property
    def index(self) -> int:
        """Index of the sample that is shown."""
        last = int(np.searchsorted(self.replay.time, self.play_bar.time + 0.005, side="right")) - 1
        return min(max(last, 0), len(self.replay.samples) - 1)

    @property
    def sample(self) -> ViewSample:
        """The sample of the first robot that is shown."""
        return self.replay.samples[self.index]

    def tick(self, elapsed: float) -> None:
        """Carry out the user's requests, advance time, and draw.

        Args:
            elapsed: Time since the last call [s]; 0 also updates the gauges at once.
        """
        self.play_bar.advance(elapsed)
        self._carry_out_requests()
        self.display.apply_to(self.scene)
        self.scene.cameras.update()
        samples = tuple(variant.samples[self.index] for variant in self.replay.variants)
        state = (samples, self.display.state)
        if state != self._drawn:
            self.scene.draw(samples)
            self.steering.show_released(self.replay.is_released(self.index))
            self._drawn = state
        if samples != self._gauges_drawn and (elapsed == 0.0 or self._gauges_throttle.is_due()):
            self.gauges.draw(samples, self.index)
            self._gauges_drawn = samples

    def run(self) -> None:
        """Draw frames until interrupted."""
        run_frames(self.tick)

    def _carry_out_requests(self) -> None:
        """Apply buttons first, then options, and map again if either changed.

        A slider moved during the mapping takes effect with its value after the mapping.
        """
        requests, preset = self.steering.take_requests(), self.steering.take_preset()
        changes = self.steering.options.take_changes()
        self._is_behind |= bool(requests or changes or preset)
        if preset is not None:
            self._base, changes = self.replay.preset(preset), {}
            self._changes.clear()
            self.steering.show_choice(self._base)
        self._changes |= changes
        for request in requests:
            if request != "reset":
                self.replay.switches[self.index] = request == "release"
            else:
                self.replay.switches.clear()
                self._base = self._start
                self._changes.clear()
                self.steering.show_choice(self._start)
        if self._is_behind:
            self._remap()
        if self.steering.compare is not None:
            self._compare(self.steering.compare)

    def _remap(self) -> None:
        """Map again with the present options, and show why if that is not possible."""
        self.steering.show_message("mapping …")
        self.server.flush()
        self._is_behind = False
        try:
            self.replay.remap(self._base.with_changes(self._changes))
        except HandmapError as error:
            self.steering.show_error(error)
            return
        self.steering.show_error(None)
        self._options_text = self._text_of_options()
        self._show_variants()

    def _compare(self, controls: CompareControls) -> None:
        """Map by the method that the user has chosen to compare with."""
        replay = self.replay
        # Keep the choice until it has been carried out: `flush` may fail (`skip_wakeup_race`).
        name = self._to_compare = controls.take_choice() or self._to_compare
        if name is None:
            return
        self.steering.show_message("mapping …")
        self.server.flush()
        self._to_compare = None
        try:
            if name == NOTHING:
                replay.compare(None)
            elif name == KEPT:
                replay.compare(replay.choice, f"{replay.variant.label}, kept")
            else:
                replay.compare(replay.preset(name))
        except HandmapError as error:
            controls.show(self._compared)
            self.steering.show_error(error)
            return
        self._compared = name
        self.steering.show_error(None)
        self._show_variants()

    def _text_of_options(self) -> str:
        """Return the text of a file with the options in force."""
        choice = self.replay.choice
        return options_text(choice, self.replay.preset(choice.preset))

    def _page(self) -> bytes:
        return replay_page(self.replay)

    def _show_variants(self) -> None:
        self.scene.set_variants(self.replay.variants)
        self.gauges.set_variants(self.replay.variants)
        self._plot()

    def _plot(self) -> None:
        first, *others = (
            [gauge_row(sample) for sample in variant.samples] for variant in self.replay.variants
        )
        self.gauges.set_rows(first, *others)
