"""What every view has in the browser: hands, gauges, display controls, files to save (`Window`)."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

from handmap_qp.apps.viewer.controls import DisplayControls, ExportControls
from handmap_qp.apps.viewer.gauges import Gauges
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.apps.viewer.scene import HandScene
from handmap_qp.hands.hand import Hand

if TYPE_CHECKING:
    import viser

# Least time between two updates of plots and joint bars [s]; they cost more than poses.
_GAUGES_PERIOD = 0.1
_PANEL_WIDTH = 300


class Window:
    """The browser window of a view.

    The gauges are on the left, in viser's main panel, because only that one can be folded away for
    one browser (`BrowserCameras`). The tabs are on the right.

    Args:
        human: The human hand.
        variants: The robots.
        options_text: Returns the text of the file of options.
        page: Returns the page; may raise `HandmapError`.

    Attributes:
        scene: The hands.
        gauges: Numbers, plots and joint bars.
        control: The tab for what moves the robots, which is empty.
        display: What the scene shows.
        exports: Buttons that download files.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        human: Hand,
        variants: Sequence[Variant],
        options_text: Callable[[], str],
        page: Callable[[], bytes],
    ) -> None:
        self.scene = HandScene(server, human, variants)
        gui = server.gui
        gui.set_panel_label("handmap view: gauges")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(_PANEL_WIDTH)
        # Controls that are added outside the tabs go to the main panel.
        panel = gui.add_panel()
        names = ("Control", "Show", "Save")
        self.control, show, save = (panel.add_tab(name) for name in names)
        panel.dock_right()
        panel.set_width(_PANEL_WIDTH)
        self.gauges = Gauges(server, variants, human)
        with show:
            self.display = DisplayControls(server)
        with save:
            self.exports = ExportControls(server, options_text, page)
        self._drawn: tuple[object, ...] = ()
        self._gauges_due = 0.0

    def set_variants(self, variants: Sequence[Variant]) -> None:
        """Show these robots."""
        self._drawn = ()
        self.scene.set_variants(variants)
        self.gauges.set_variants(variants)

    def draw(self, samples: Sequence[ViewSample]) -> None:
        """Draw one sample of each robot, unless it is drawn as the display controls ask for."""
        self.display.apply_to(self.scene)
        state = (tuple(samples), self.scene.display)
        if state != self._drawn:
            self.scene.draw(samples)
            self._drawn = state
        self.scene.cameras.update()

    def is_time_for_gauges(self) -> bool:
        """Return whether the gauges are due, and count them as updated then."""
        now = time.monotonic()
        if is_due := now >= self._gauges_due:
            self._gauges_due = now + _GAUGES_PERIOD
        return is_due
