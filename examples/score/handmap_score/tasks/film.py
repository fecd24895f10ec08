"""Films of attempts: MuJoCo draws the recorded states, as an animated WebP.

Drawing needs OpenGL; without a screen, MUJOCO_GL=egl takes that of the system's EGL.
"""

import io
import os
import sys

import numpy as np
from PIL import Image

from handmap_qp.errors import HandmapError
from .task import Record, Task

_WIDTH, _HEIGHT = 240, 180
_FRAMES = 40
_SLOWNESS = 2.0
"""Time of the film by time of the attempt."""
_CAMERA = "vil_camera"
"""The camera of a scene, if it has one of this name; else a view of the whole."""


class FilmError(HandmapError):
    """Films cannot be drawn on this machine."""


def film_of(task: Task, record: Record) -> bytes:
    """Return the film of an attempt.

    Args:
        task: A task of the same name and hand; its state is changed.
        record: The attempt.

    Raises:
        FilmError: If there is no OpenGL.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        os.environ.setdefault("MUJOCO_GL", "egl")
    import mujoco

    model = task.model
    model.body_pos[:] = record.body_pos
    model.site_pos[:] = record.site_pos
    cameras = [model.camera(i).name for i in range(model.ncam)]
    camera = _CAMERA if _CAMERA in cameras else -1
    data = mujoco.MjData(model)
    count = min(_FRAMES, len(record.qpos))
    chosen = np.linspace(0, len(record.qpos) - 1, count).round().astype(int)
    frames = []
    try:
        renderer = mujoco.Renderer(model, _HEIGHT, _WIDTH)
    # PyOpenGL and EGL raise errors of many types where a library is missing.
    except Exception as error:
        raise FilmError(f"no films, because OpenGL is missing: {error}") from error
    with renderer:
        for i in chosen:
            data.qpos[:] = record.qpos[i]
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            frames.append(Image.fromarray(renderer.render()))
    span = float(record.times[-1] - record.times[0])
    duration = round(1e3 * _SLOWNESS * span / max(1, count - 1))
    file = io.BytesIO()
    first, *rest = frames
    first.save(
        file,
        "webp",
        save_all=True,
        append_images=rest,
        duration=max(20, duration),
        loop=0,
        quality=60,
    )
    return file.getvalue()
