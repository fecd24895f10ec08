"""A recording in the browser: `ReplayViewer` keeps scene, gauges and controls in step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.mapping.options_file import options_text
from handmap_qp.viewer.controls import PlayBar, SteeringControls, dock_main_panel
from handmap_qp.viewer.frames import GAUGES_PERIOD, Throttle, run_frames
from handmap_qp.viewer.gauges import Gauges, gauge_row
from handmap_qp.viewer.replay import Replay, ViewSample
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
        gauges: Plots and joint bars.
        play_bar: Play, pause, scrub.
        steering: Clutch and option controls.
    """

    def __init__(self, server: viser.ViserServer, replay: Replay) -> None:
        self.server = server
        self.replay = replay
        self.scene = HandScene(
            server, replay.human, replay.robot, replay.samples[0], replay.choice.alignment
        )
        self.gauges = Gauges(server, replay.robot)
        self._show_samples()
        dock_main_panel(server)
        self.play_bar = PlayBar(server, float(replay.time[-1]))
        # Options count from `_base`: the initial ones, or those of a preset chosen later.
        self._start = self._base = replay.choice
        self._changes: dict[str, Any] = {}
        self._is_behind = False
        self.steering = SteeringControls(server, replay.robot, self._start, replay.presets)
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
        """The sample that is shown."""
        return self.replay.samples[self.index]

    def tick(self, elapsed: float) -> None:
        """Carry out the user's requests, advance time, and draw.

        Args:
            elapsed: Time since the last call [s]; 0 also updates the gauges at once.
        """
        self.play_bar.advance(elapsed)
        self._carry_out_requests()
        self.steering.display.apply_to(self.scene)
        self.scene.cameras.update()
        state = (self.sample, self.scene.follow, self.scene.deformation_shape)
        if state != self._drawn:
            self.scene.draw(self.sample)
            self.steering.show_released(self.replay.is_released(self.index))
            self._drawn = state
        if state != self._gauges_drawn and (elapsed == 0.0 or self._gauges_throttle.is_due()):
            self.gauges.draw(self.sample, self.index)
            self._gauges_drawn = state

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
        if not self._is_behind:
            return
        self.steering.show_message("mapping …")
        self.server.flush()
        self._is_behind = False
        try:
            self.replay.remap(self._base.with_changes(self._changes))
        except HandmapError as error:
            self.steering.show_error(error)
            return
        self.steering.show_error(None)
        choice = self.replay.choice
        self.steering.options_text = options_text(choice, self.replay.preset(choice.preset))
        self._show_samples()

    def _show_samples(self) -> None:
        self.scene.align(self.replay.choice.alignment)
        self.scene.reserve_travel(self.replay.samples)
        self.gauges.set_rows([gauge_row(sample) for sample in self.replay.samples])
