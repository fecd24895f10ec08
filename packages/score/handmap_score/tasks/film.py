"""Films of attempts: MuJoCo draws the recorded states, as an animated WebP.

Drawing needs OpenGL. MuJoCo chooses its kind once, when it is imported, so films are drawn in
processes of their own.
"""

import io
import multiprocessing
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from typing import NamedTuple

import mujoco
import numpy as np
from PIL import Image

from handmap_qp.errors import HandmapError, reason_of
from handmap_qp.hands import Names
from .catalogue import CATALOGUE
from .table import CAMERA
from .task import Record

_WIDTH, _HEIGHT = 320, 240
_FRAMES = 40
_SLOWNESS = 2.0
"""Time of the film by time of the attempt."""
_SHORTEST = 20
"""Shortest time of a frame that browsers show [ms]."""
_CAMERAS = ("vil_camera", CAMERA)
"""Cameras of scenes, of the maker and of ours; a scene without one is seen as a whole."""
_KIND = "MUJOCO_GL"
"""Variable of the environment that names the kind of OpenGL."""


class FilmError(HandmapError):
    """Films cannot be drawn on this machine."""


class FilmJob(NamedTuple):
    """A film to draw.

    Attributes:
        task: Name of the task.
        hand: The robot hand, as name or path of its hand.yaml.
        record: The attempt.
        objects: Objects of the task by name; all if empty.
    """

    task: str
    hand: str
    record: Record
    objects: Names = ()


def draw_films(jobs: Sequence[FilmJob], processes: int) -> Iterator[bytes]:
    """Yield the films in the order of the jobs, as WebP files.

    Args:
        jobs: The films.
        processes: Processes that draw.

    Raises:
        FilmError: If there is no OpenGL.
    """
    if sys.platform == "linux" and not os.environ.get("DISPLAY"):
        # Without a screen, EGL draws; the processes take over the environment.
        os.environ.setdefault(_KIND, "egl")
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(processes, mp_context=context) as pool:
        yield from pool.map(film_of, jobs)


def film_of(job: FilmJob) -> bytes:
    """Return the film of an attempt.

    Raises:
        FilmError: If there is no OpenGL.
    """
    record = job.record
    task = CATALOGUE[job.task].make(job.hand, job.objects)
    task.reset(record.seed)
    model = task.model
    model.body_pos[:] = record.body_pos
    model.site_pos[:] = record.site_pos
    count = min(_FRAMES, len(record.qpos))
    chosen = np.linspace(0, len(record.qpos) - 1, count).round().astype(int)
    try:
        frames = _frames(model, record.qpos[chosen])
    # PyOpenGL, EGL and MuJoCo raise errors of many types where a library is missing.
    except Exception as error:
        reason = f"no films, because OpenGL is missing: {reason_of(error)}"
        raise FilmError(reason) from error
    span = float(record.times[-1] - record.times[0])
    duration = round(1e3 * _SLOWNESS * span / max(1, count - 1))
    return _webp(frames, max(_SHORTEST, duration))


def _frames(model: mujoco.MjModel, states: np.ndarray) -> list[Image.Image]:
    """Draw states, shape (n, nq)."""
    cameras = [model.camera(i).name for i in range(model.ncam)]
    camera = next((name for name in _CAMERAS if name in cameras), -1)
    data = mujoco.MjData(model)
    frames = []
    # Shadows and reflections take most of the time without a graphics card.
    with mujoco.Renderer(model, _HEIGHT, _WIDTH) as renderer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        for state in states:
            data.qpos[:] = state
            mujoco.mj_forward(model, data)
            renderer.update_scene(data, camera)
            frames.append(Image.fromarray(renderer.render()))
    return frames


def _webp(frames: Sequence[Image.Image], duration: int) -> bytes:
    """Return frames as an animation that repeats, each shown for so many milliseconds."""
    file = io.BytesIO()
    first, *rest = frames
    first.save(
        file,
        "webp",
        save_all=True,
        append_images=rest,
        duration=duration,
        loop=0,
        quality=60,
    )
    return file.getvalue()
