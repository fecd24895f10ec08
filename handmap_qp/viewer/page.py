"""The scene as a page that plays by itself: `write_page`."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

from handmap_qp.errors import InvalidInputError
from handmap_qp.viewer.replay import Replay
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

_RATE = 30.0


def check_page(path: Path) -> Path:
    """Refuse a file that cannot be written, before any work is done.

    Raises:
        InvalidInputError: If it does not end in .html, is a folder, or its folder does not exist.
    """
    if path.suffix not in (".html", ".htm"):
        raise InvalidInputError(f"--html {path}: expected a file that ends in .html")
    if not path.parent.is_dir():
        raise InvalidInputError(f"--html {path}: there is no folder {path.parent}")
    if path.is_dir():
        raise InvalidInputError(f"--html {path}: is a folder")
    return path


def write_page(path: Path, server: viser.ViserServer, replay: Replay) -> None:
    """Write one HTML file that shows a recording in its own time, without a server or the network.

    Args:
        path: The file.
        server: A running viser server whose scene is empty.
        replay: What to play; at most 30 samples of each second are taken.

    Raises:
        InvalidInputError: If the file cannot be written.
    """
    samples = replay.samples
    scene = HandScene(server, replay.human, replay.robot, samples[0], replay.mapping)
    scene.draw(samples[0])
    serializer = server.get_scene_serializer()
    shown = samples[0].time
    for sample in samples[1:]:
        # Half a millisecond of grace, so that the jitter of a 30 Hz recording does not drop every
        # other sample.
        if sample.time - shown >= 1.0 / _RATE - 5e-4 or sample is samples[-1]:
            serializer.insert_sleep(sample.time - shown)
            scene.draw(sample)
            shown = sample.time
    # Whole or not at all.
    try:
        handle, temporary = tempfile.mkstemp(suffix=".html", dir=path.parent)
        try:
            with os.fdopen(handle, "w", encoding="utf-8") as file:
                file.write(
                    serializer.as_html().replace(
                        "<title>Viser</title>", "<title>handmap view</title>", 1
                    )
                )
            Path(temporary).chmod(0o644)
            Path(temporary).replace(path)
        except BaseException:
            Path(temporary).unlink(missing_ok=True)
            raise
    except OSError as error:
        raise InvalidInputError(f"{path}: cannot be written: {error.strerror or error}") from error
