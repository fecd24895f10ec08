"""The scene as an HTML file that plays without a server: `write_page`."""

from __future__ import annotations

from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

from handmap_qp.output_files import check_output, replaced_file
from handmap_qp.viewer.replay import Replay
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

# Most samples per second in a page [1/s].
_RATE = 30.0


def check_page(path: Path) -> Path:
    """Check that a page can be written there, before any work is done.

    Raises:
        InvalidInputError: If it does not end in .html, is a folder, or its folder does not exist.
    """
    return check_output("--html", path, (".html", ".htm"))


def write_page(path: Path, server: viser.ViserServer, replay: Replay) -> None:
    """Write one HTML file that plays a recording in real time, without a server or the network.

    Args:
        path: The file.
        server: A running viser server whose scene is empty.
        replay: The recording; at most 30 samples of each second are written.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    samples = replay.samples
    scene = HandScene(server, replay.human, replay.robot, samples[0], replay.choice.alignment)
    scene.draw(samples[0])
    serializer = server.get_scene_serializer()
    shown = samples[0].time
    for sample in samples[1:]:
        # Tolerance of half a millisecond: the jitter of a 30 Hz recording must not drop every other
        # sample.
        if sample.time - shown >= 1.0 / _RATE - 5e-4 or sample is samples[-1]:
            serializer.insert_sleep(sample.time - shown)
            scene.draw(sample)
            shown = sample.time
    title = f"{replay.name} on {replay.robot.name}, {replay.choice.preset} - handmap view"
    page = serializer.as_html()
    page = page.replace("<title>Viser</title>", f"<title>{escape(title)}</title>", 1)
    with replaced_file(path, "--html") as file:
        file.write(page.encode())
