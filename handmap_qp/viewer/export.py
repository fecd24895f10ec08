"""Buttons that send files to the browser: options, picture, page (`ExportControls`)."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from handmap_qp.errors import HandmapError

if TYPE_CHECKING:
    import viser

# How long a browser may take to draw a picture [s].
_PATIENCE = 60.0


class ExportControls:
    """Buttons that download what the view shows.

    Args:
        server: A running viser server.
        options_text: Returns the text of the file of options.
        page: Returns the page; may raise `HandmapError`.

    Attributes:
        options: Button that downloads preset and options as a file for `--options`.
        picture: Button that downloads the hands as the browser shows them.
        page: Button that downloads a page that plays without a server.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        options_text: Callable[[], str],
        page: Callable[[], bytes],
    ) -> None:
        self._options_text, self._page = options_text, page
        gui = server.gui
        self.options = gui.add_button(
            "Save options", hint="Download preset and options, for --options of the commands"
        )
        self.picture = gui.add_button(
            "Save picture", hint="Download the hands as they are shown, without the panels"
        )
        self.page = gui.add_button(
            "Save page", hint="Download a page that plays the motion without a server"
        )
        self._message = gui.add_markdown("", visible=False)
        self.options.on_click(self.send_options)
        self.picture.on_click(self.send_picture)
        self.page.on_click(self.send_page)

    def send_options(self, event: viser.GuiEvent[Any]) -> None:
        """Send the file of options to the browser that asked for it."""
        if event.client is not None:
            event.client.send_file_download("options.yaml", self._options_text().encode())

    def send_picture(self, event: viser.GuiEvent[Any]) -> None:
        """Let the browser draw the hands, and send the picture back to it."""
        client = event.client
        if client is None:
            return
        camera = client.camera
        image = client.get_render(
            camera.image_height,
            camera.image_width,
            transport_format="png",
            timeout=_PATIENCE,
        )
        client.send_file_download("handmap.png", on_white(image))

    def send_page(self, event: viser.GuiEvent[Any]) -> None:
        """Write the page, and send it to the browser that asked for it."""
        if event.client is None:
            return
        self._say("writing the page …")
        try:
            event.client.send_file_download("handmap.html", self._page())
        except HandmapError as error:
            self._say(f"**Not possible:** {error}")
            return
        self._say("")

    def _say(self, text: str) -> None:
        self._message.visible, self._message.content = text != "", text


def on_white(image: np.ndarray) -> bytes:
    """Return a picture as a PNG file on a white background.

    Args:
        image: Red, green, blue and opacity, 0 to 255, shape (rows, columns, 4).
    """
    import imageio.v3 as imageio

    opacity = image[..., 3:] / 255.0
    opaque = image[..., :3] * opacity + 255.0 * (1.0 - opacity)
    return bytes(imageio.imwrite("<bytes>", opaque.round().astype(np.uint8), extension=".png"))
