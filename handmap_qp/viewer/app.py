"""A recording in the browser: `ReplayViewer` joins scene, gauges and controls, and keeps them in step.

Callbacks of the browser come in threads of their own. They only leave their wish where `tick` finds it, so that mapping and
drawing happen in one thread.
"""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from handmap_qp.errors import HandmapError
from handmap_qp.viewer.controls import OptionControls, PictureControls, PlayBar
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
        controls: Sliders and lists.
        play_bar: Play, pause, scrub.
        picture: What the picture shows.
        clutch: The clutch button.
        message: Why the last change of options was not taken; empty where it was.
    """

    def __init__(self, server: viser.ViserServer, replay: Replay) -> None:
        self.server = server
        self.replay = replay
        self.scene = HandScene(server, replay.human, replay.robot, replay.samples[0], replay.mapping)
        self.gauges = Gauges(server, replay.robot)
        self.gauges.set_samples(replay.samples)
        gui = server.gui
        gui.main_panel.dock_right()
        gui.main_panel.set_width(330)
        self.play_bar = PlayBar(server, float(replay.time[-1]))
        self.clutch = gui.add_button("Release", hint="The robot holds still until you clutch; then it goes on from where it is")
        self.clutch.on_click(lambda _: self._wishes.append("clutch"))
        self.message = gui.add_markdown("", visible=False)
        self.picture = PictureControls(server)
        self.controls = OptionControls(server, replay.robot, replay.mapping, replay.ik)
        self.reset = gui.add_button("Reset options and clutch")
        self.reset.on_click(lambda _: self._wishes.append("reset"))
        self._wishes: list[str] = []
        self._asked = (replay.mapping, replay.ik)
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
        self._fulfil_wishes()
        self.play_bar.advance(elapsed)
        self._remap_if_asked()
        self.picture.apply_to(self.scene)
        state = (self.sample, self.scene.follow, self.scene.deformation_shape)
        if state != self._drawn:
            self.scene.draw(self.sample)
            self.clutch.label = "Clutch" if self.replay.is_released(self.index) else "Release"
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

    def _fulfil_wishes(self) -> None:
        while self._wishes:
            wish = self._wishes.pop(0)
            if wish == "clutch":
                self.replay.toggle_clutch(self.index)
            else:
                self.replay.switches.clear()
                self.controls.reset()
            self._asked = None

    def _remap_if_asked(self) -> None:
        try:
            options = self.controls.options()
            if options == self._asked:
                return
            self._asked = options
            self.replay.remap(*options)
        except HandmapError as error:
            self.message.content, self.message.visible = f"**Not possible:** {error}", True
            return
        self.message.visible = False
        self.scene.align(options[0])
        self.gauges.set_samples(self.replay.samples)
