"""The kinds of files that the package reads: how to write a small valid one, and how to read it."""

from __future__ import annotations

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh
import yaml

from handmap_core.human.recording import Recording
from handmap_qp import load_hand
from handmap_qp.apps.datasets.manifest import Line, open_manifest, read_manifests
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.migrate import read_dex_configuration
from handmap_qp.apps.service.keys import (
    ClientKeys,
    make_keys,
    read_server_keys,
    read_token,
)
from handmap_qp.apps.service.store import PostureStore, Record
from handmap_qp.hands.collision_shapes import read_collision_shapes
from handmap_qp.hands.mjcf import ConvertedMjcf
from handmap_qp.hands.sources import urdf_directory
from handmap_qp.human.person import person_text, read_person
from handmap_qp.mapping.options_file import read_options
from handmap_qp.stream.measurement import measure_person
from handmap_qp.trackers.formats import format_to_write, list_sources, read_recording
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.tables import load_layout, table_text

_SAMPLES = 12
_MJCF = """<mujoco model="claw">
  <worldbody>
    <body name="palm">
      <geom type="box" size="0.04 0.04 0.01"/>
      <body name="left" pos="0.03 0.04 0">
        <joint name="left" type="hinge" axis="1 0 0" range="-0.2 1.2"/>
        <geom type="capsule" size="0.008" fromto="0 0 0 0 0.05 0"/>
      </body>
      <body name="right" pos="-0.03 0.04 0">
        <joint name="right" type="hinge" axis="1 0 0" range="-0.2 1.2"/>
        <geom type="capsule" size="0.008" fromto="0 0 0 0 0.05 0"/>
      </body>
    </body>
  </worldbody>
  <equality><joint joint1="left" joint2="right" polycoef="0 1 0 0 0"/></equality>
</mujoco>
"""


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of file.

    Attributes:
        name: Its name.
        write: Writes valid files into a folder that does not exist yet.
        read: Reads the files of such a folder.
        altered: Pattern of the names of the files that are altered.
    """

    name: str
    write: Callable[[Path], None]
    read: Callable[[Path], object]
    altered: str = "*"


def _demo() -> Recording:
    """Return a few samples of the package's own recording."""
    whole = read_recording("demo::right")
    chosen = np.flatnonzero(whole.valid)[:_SAMPLES]
    return Recording(
        name="demo",
        time=whole.time[chosen],
        landmarks=whole.landmarks[chosen],
        valid=whole.valid[chosen],
        side=whole.side,
    )


def _recording(name: str, file: str) -> Kind:
    """Return the kind of a format of recordings."""

    def write(folder: Path) -> None:
        folder.mkdir()
        format_to_write(Path(file), name).write([_demo()], folder / file)

    return Kind(
        name,
        write,
        lambda folder: [each.read() for each in list_sources(folder / file)],
    )


def _text(
    name: str, file: str, text: Callable[[], str], read: Callable[[Path], object]
) -> Kind:
    """Return the kind of a text file."""

    def write(folder: Path) -> None:
        folder.mkdir()
        (folder / file).write_text(text(), encoding="utf-8")
        (folder / file).chmod(0o600)

    return Kind(name, write, lambda folder: read(folder / file))


def _write_hand(folder: Path) -> None:
    shutil.copytree(urdf_directory() / "three_finger", folder)
    for file in folder.iterdir():
        if file.suffix not in (".urdf", ".yaml"):
            file.unlink()


def _read_hand(folder: Path) -> None:
    read_collision_shapes(load_hand(folder / "hand.yaml"))


def _write_keys(folder: Path) -> None:
    make_keys(folder, ["alice"])


def _read_keys(folder: Path) -> None:
    read_server_keys(folder)
    ClientKeys(folder / "clients").read()


def _write_state(folder: Path) -> None:
    folder.mkdir()
    with PostureStore(folder / "state") as store:
        for i in range(5):
            store.note(Record(f"session-{i}", "three_finger", (0.1,) * 8, None, i))


def _read_state(folder: Path) -> None:
    with PostureStore(folder / "state") as store:
        for i in range(5):
            store.find(f"session-{i}", "three_finger", 8)


def _options() -> str:
    return yaml.safe_dump({"preset": "teleoperation", "ridge": 0.2, "rest_weight": 0.1})


def _mesh(suffix: str) -> Kind:
    """Return the kind of a hand with one mesh."""

    def write(folder: Path) -> None:
        _write_hand(folder)
        trimesh.creation.icosphere(1, 0.01).export(folder / f"tip.{suffix}")
        urdf = folder / "hand.urdf"
        text, shape = (
            urdf.read_text(encoding="utf-8"),
            f'<mesh filename="tip.{suffix}"/>',
        )
        urdf.write_text(
            _COLLISION.sub(rf"\1{shape}\2", text, count=1), encoding="utf-8"
        )

    def read(folder: Path) -> None:
        read_collision_shapes(load_hand(folder / "hand.yaml"))

    return Kind(f"{suffix.upper()} mesh", write, read, f"*.{suffix}")


_COLLISION = re.compile(r"(<collision[^>]*>.*?<geometry>).*?(</geometry>)", re.DOTALL)


def _write_manifest(folder: Path) -> None:
    folder.mkdir()
    with open_manifest(folder) as append:
        for i in range(5):
            append(
                Line(
                    f"key-{i}", "done", f"{i}.npz", 100, i, "digest", metrics={"a": 1.0}
                )
            )


_DEX = """retargeting:
  type: vector
  urdf_path: hand.urdf
  target_origin_link_names: [palm, palm]
  target_task_link_names: [thumb_tip, index_tip]
  target_link_human_indices: [[0, 0], [4, 8]]
"""


KINDS = (
    _recording("npz", "demo.npz"),
    _recording("csv", "demo.csv"),
    _recording("robomimic", "demo.hdf5"),
    _recording("egodex", "demo.hdf5"),
    _recording("mcap", "demo.mcap"),
    _recording("mano", "demo.npz"),
    Kind("hand.yaml and URDF", _write_hand, _read_hand),
    _text(
        "URDF alone",
        "hand.urdf",
        lambda: (urdf_directory() / "three_finger" / "hand.urdf").read_text(
            encoding="utf-8"
        ),
        detect,
    ),
    _text("MJCF", "hand.xml", lambda: _MJCF, ConvertedMjcf),
    _text(
        "person",
        "person.yaml",
        lambda: person_text(measure_person(_demo())),
        read_person,
    ),
    _text("options", "options.yaml", _options, read_options),
    _text(
        "layout", "layout.yaml", lambda: table_text(next(iter(LAYOUTS))), load_layout
    ),
    _text("token", "token", lambda: "a-token-of-the-tests-0123456789\n", read_token),
    Kind("keys", _write_keys, _read_keys),
    Kind("state", _write_state, _read_state),
    _mesh("stl"),
    _mesh("obj"),
    _mesh("dae"),
    Kind("manifest of a batch", _write_manifest, read_manifests),
    _text("dex-retargeting", "config.yaml", lambda: _DEX, read_dex_configuration),
)
"""All kinds."""
