"""A recording in the browser: `ReplayViewer` joins scene, gauges and controls, and keeps them in step."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.viewer.controls import PlayBar, SteeringControls, dock_main_panel
from handmap_qp.viewer.gauges import Gauges
from handmap_qp.viewer.samples import Replay, ViewSample
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

_PERIOD = 1.0 / 30.0
# Plots and bars are text and pictures to the browser, dearer than poses.
_GAUGES_PERIOD = 0.1


class ReplayViewer:
    """Shows a recording, and maps it anew whenever an option is changed.

    Args:
        server: A running viser server.
        replay: The recording.

    Attributes:
        replay: The recording.
        scene: The hands.
        gauges: Plots and joint bars.
        play_bar: Play, pause, scrub.
        steering: Clutch and options.
    """

    def __init__(self, server: viser.ViserServer, replay: Replay) -> None:
        self.server = server
        self.replay = replay
        self.scene = HandScene(server, replay.human, replay.robot, replay.samples[0], replay.mapping)
        self.gauges = Gauges(server, replay.robot)
        self.gauges.set_samples(replay.samples)
        dock_main_panel(server)
        self.play_bar = PlayBar(server, float(replay.time[-1]))
        self.steering = SteeringControls(server, replay.robot, replay.mapping, replay.ik)
        self._drawn: tuple[object, ...] = ()
        self._gauges_drawn: tuple[object, ...] = ()
        self._gauges_time = -np.inf
        self.tick(0.0)

    @property
    def index(self) -> int:
        """The sample that is shown."""
        last = int(np.searchsorted(self.replay.time, self.play_bar.time + 0.005, side="right")) - 1
        return min(max(last, 0), len(self.replay.samples) - 1)

    @property
    def sample(self) -> ViewSample:
        """What is shown."""
        return self.replay.samples[self.index]

    def tick(self, elapsed: float) -> None:
        """Do what the user asked for, let time run, and draw.

        Args:
            elapsed: Since the last call [s].
        """
        wishes = self.steering.take_wishes()
        for wish in wishes:
            if wish == "clutch":
                self.replay.toggle_clutch(self.index)
            else:
                self.replay.switches.clear()
        self.play_bar.advance(elapsed)
        self._remap_if_asked(in_any_case=bool(wishes))
        self.steering.picture.apply_to(self.scene)
        state = (self.sample, self.scene.follow, self.scene.deformation_shape)
        if state != self._drawn:
            self.scene.draw(self.sample)
            self.steering.show_released(self.replay.is_released(self.index))
            self._drawn = state
        now = time.monotonic()
        if state != self._gauges_drawn and (now - self._gauges_time >= _GAUGES_PERIOD or elapsed == 0.0):
            self.gauges.draw(self.sample, self.index)
            self._gauges_drawn, self._gauges_time = state, now

    def run(self) -> None:
        """Go on until interrupted."""
        before = time.monotonic()
        while True:
            now = time.monotonic()
            self.tick(now - before)
            before = now
            time.sleep(max(0.0, _PERIOD - (time.monotonic() - now)))

    def _remap_if_asked(self, *, in_any_case: bool) -> None:
        try:
            options = self.steering.take_options(in_any_case=in_any_case)
            if options is None:
                return
            self.replay.remap(*options)
        except HandmapError as error:
            self.steering.complain(error)
            return
        self.steering.complain(None)
        self.scene.align(options[0])
        self.gauges.set_samples(self.replay.samples)
