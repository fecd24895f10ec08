"""A recording in the browser.

`ReplayViewer` joins scene, gauges and controls, and keeps them in step.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.viewer.controls import PlayBar, SteeringControls, dock_main_panel
from handmap_qp.viewer.gauges import Gauges, gauge_row
from handmap_qp.viewer.option_controls import Options
from handmap_qp.viewer.replay import Replay, ViewSample
from handmap_qp.viewer.scene import HandScene
from handmap_qp.viewer.serving import drawing

if TYPE_CHECKING:
    import viser

_PERIOD = 1.0 / 30.0
# Plots and bars are text and pictures to the browser, dearer than poses.
_GAUGES_PERIOD = 0.1
# The most that time goes on from one picture to the next [s].
_LONGEST_TICK = 0.2


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
        self.scene = HandScene(
            server, replay.human, replay.robot, replay.samples[0], replay.mapping
        )
        self.gauges = Gauges(server, replay.robot)
        self._show_samples()
        dock_main_panel(server)
        self.play_bar = PlayBar(server, float(replay.time[-1]))
        self._start = Options(replay.mapping, replay.ik)
        self._changes: dict[str, Any] = {}
        self._is_behind = False
        self.steering = SteeringControls(server, replay.robot, self._start)
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
        self.play_bar.advance(elapsed)
        self._do_as_asked()
        self.steering.picture.apply_to(self.scene)
        self.scene.camera.attend()
        state = (self.sample, self.scene.follow, self.scene.deformation_shape)
        if state != self._drawn:
            self.scene.draw(self.sample)
            self.steering.show_released(self.replay.is_released(self.index))
            self._drawn = state
        now = time.monotonic()
        if state != self._gauges_drawn and (
            now - self._gauges_time >= _GAUGES_PERIOD or elapsed == 0.0
        ):
            self.gauges.draw(self.sample, self.index)
            self._gauges_drawn, self._gauges_time = state, now

    def run(self) -> None:
        """Go on until interrupted."""
        before = time.monotonic()
        while True:
            now = time.monotonic()
            # Time stands still while a long recording is mapped anew.
            with drawing():
                self.tick(min(now - before, _LONGEST_TICK))
            before = now
            time.sleep(max(0.0, _PERIOD - (time.monotonic() - now)))

    def _do_as_asked(self) -> None:
        """Buttons first, then options.

        A slider that moves while the recording is mapped counts as it stands afterwards.
        """
        wishes, changes = self.steering.take_wishes(), self.steering.options.take_changes()
        self._changes |= changes
        self._is_behind |= bool(wishes or changes)
        for wish in wishes:
            if wish != "reset":
                self.replay.switches[self.index] = wish == "release"
            else:
                self.replay.switches.clear()
                self._changes.clear()
                self.steering.options.show(self._start)
        if not self._is_behind:
            return
        self.steering.say("mapping …")
        self.server.flush()
        self._is_behind = False
        try:
            self.replay.remap(*self._start.with_changes(self._changes))
        except HandmapError as error:
            self.steering.complain(error)
            return
        self.steering.complain(None)
        self._show_samples()

    def _show_samples(self) -> None:
        self.scene.align(self.replay.mapping)
        self.scene.foresee(self.replay.samples)
        self.gauges.set_rows([gauge_row(sample) for sample in self.replay.samples])
