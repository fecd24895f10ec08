"""Pictures of a simulation by the software renderer (`film`, `picture`), and its page.

The page plays in a browser without a server, as that of `handmap view` does.
"""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import numpy as np

from handmap_core.errors import require
from handmap_core.se3 import Array, affine
from handmap_qp.apps.drawing.hands import UPRIGHT, load_shape, solid
from handmap_qp.apps.drawing.raster import Camera, Triangles, merged, render
from handmap_qp.apps.tables import progress
from handmap_qp.apps.viewer.page import make_page
from handmap_qp.apps.viewer.sample import Variant, ViewSample
from handmap_qp.apps.viewer.scene import Display
from handmap_qp.mapping import surface
from handmap_qp.output_files import replaced_file
from .physics import turn_up
from .simulator import Episode, Instant

_OBJECT_COLOUR = (0.93, 0.55, 0.15)
_PAPER = (0.965, 0.97, 0.975)
_SIZE = (480, 360)


def frames(
    episode: Episode, instants: Iterable[int], *, supersampling: int = 1
) -> Iterator[Array]:
    """Render instants of a simulation, turned so that gravity points down.

    The camera sees the hand's whole motion, and the object at first.

    Args:
        episode: The simulation.
        instants: Indices of the instants.
        supersampling: See `render`.

    Yields:
        Red, green and blue in 0..255, shape (height, width, 3), for each instant.
    """
    at = episode.at
    shape = load_shape(episode.hand)
    held = solid(surface(episode.shape), _OBJECT_COLOUR)
    turn = affine(turn_up(episode.physics.up))
    wrists = at.wrist if episode.hand.is_floating else [None] * len(at.time)

    def scene(i: int, of_object: int) -> Triangles:
        hand = shape.triangles(at.q[i], wrists[i])
        return merged([hand, held.moved(at.object_pose[of_object])]).moved(turn)

    # An object that is lost falls far, and must not make the hand small.
    some = range(0, len(at.time), max(1, len(at.time) // 8))
    seen = merged([scene(i, 0) for i in some]).vertices.reshape(-1, 3)
    camera = Camera.framing(seen[::7], _SIZE)
    for i in instants:
        image = render(scene(i, i), camera, supersampling=supersampling)
        colour = _PAPER + image[..., 3:] * (image[..., :3] - _PAPER)
        yield np.round(255.0 * colour).astype(np.uint8)


def film(episode: Episode, path: Path, *, rate: float = 15.0) -> None:
    """Write a simulation as a moving picture, in real time.

    Args:
        episode: The simulation.
        path: The file: `.gif`, `.webp` or `.png` (an animated PNG).
        rate: Pictures of each second.

    Raises:
        MissingExtraError: If Pillow is not installed.
        InvalidInputError: If the file cannot be written.
    """
    pillow = require("PIL.Image", "plot", "pillow")
    time = episode.at.time
    times = np.arange(time[0], time[-1], 1.0 / rate)
    nearest = np.abs(time - times[:, None]).argmin(axis=1)
    pictures = []
    with progress("rendering", len(nearest)) as advance:
        for frame in frames(episode, nearest):
            pictures.append(pillow.fromarray(frame))
            advance(len(pictures))
    first, *others = pictures
    with replaced_file(path, "--film") as file:
        first.save(
            file,
            format=path.suffix.removeprefix(".").upper(),
            save_all=True,
            append_images=others,
            duration=1e3 / rate,
            loop=0,
        )


def picture(episode: Episode, path: Path, *, count: int = 4) -> None:
    """Write instants of a simulation side by side.

    Args:
        episode: The simulation.
        path: The file, PNG.
        count: Number of instants, evenly spread.

    Raises:
        MissingExtraError: If Pillow is not installed.
        InvalidInputError: If the file cannot be written.
    """
    pillow = require("PIL.Image", "plot", "pillow")
    chosen = np.linspace(0, len(episode.at.time) - 1, count).round().astype(int)
    strip = np.hstack(list(frames(episode, chosen, supersampling=2)))
    with replaced_file(path, "--picture") as file:
        pillow.fromarray(strip).save(file, format="PNG", optimize=True)


def write_page(path: Path, episodes: Mapping[str, Episode], title: str) -> None:
    """Write one HTML file that plays simulations side by side, in real time.

    Args:
        path: The file.
        episodes: What happened, by the name to show; with the same end. A simulation that starts
            later waits in its first posture.
        title: Title of the page.

    Raises:
        MissingExtraError: If viser is not installed.
        InvalidInputError: If the file cannot be written.
    """
    variants = []
    longest = max(episodes.values(), key=lambda episode: len(episode.at.time))
    times = longest.at.time.tolist()
    for name, episode in episodes.items():
        # From +z up, as in pictures, to +y up and seen along +z, as in the view.
        axes = UPRIGHT[:3, :3] @ turn_up(episode.physics.up)
        held = surface(episode.shape)
        hand = episode.hand
        instants = list(map(Instant, *episode.at))
        waiting = [instants[0]] * (len(times) - len(instants))
        samples = [
            ViewSample(
                time=time,
                robot_q=at.q,
                robot_wrist=at.wrist,
                robot_points=hand.points(at.q, at.wrist if hand.is_floating else None),
                object_pose=at.object_pose,
                note=f"{at.normal_force:.1f} N, {at.links_touching} links touch",
            )
            for time, at in zip(times, waiting + instants, strict=True)
        ]
        variants.append(Variant(name, hand, None, samples, held, axes))
    page = make_page(title, None, variants, display=Display("world"))
    with replaced_file(path, "--html") as file:
        file.write(page)
