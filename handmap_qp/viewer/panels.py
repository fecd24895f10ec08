"""Where the view's controls are: gauges on the left, controls on the right (`Panels`)."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import viser

_WIDTH = 300


class Panels:
    """The panels beside the hands.

    The gauges are in viser's main panel, because only that one can be folded away for one browser
    (`BrowserCameras`). Controls that are added outside the tabs go there.

    Args:
        server: A running viser server.

    Attributes:
        control: Tab of the play bar, the preset and its options.
        show: Tab of what the scene shows.
        save: Tab of the files.
    """

    def __init__(self, server: viser.ViserServer) -> None:
        gui = server.gui
        gui.set_panel_label("handmap view: gauges")
        gui.main_panel.dock_left()
        gui.main_panel.set_width(_WIDTH)
        panel = gui.add_panel()
        self.control = panel.add_tab("Control")
        self.show = panel.add_tab("Show")
        self.save = panel.add_tab("Save")
        panel.dock_right()
        panel.set_width(_WIDTH)
