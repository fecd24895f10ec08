"""Files that once ended in a traceback: each ends in one line."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from handmap_core.human.recording import Recording
from handmap_qp.apps.onboarding.detect import detect
from handmap_qp.apps.onboarding.migrate import read_dex_configuration
from handmap_qp.apps.service.keys import ClientKeys, make_keys, read_server_keys
from handmap_qp.errors import HandmapError
from handmap_qp.hands.mjcf import ConvertedMjcf
from handmap_qp.trackers.formats import format_to_write, list_sources

URDF = Path(__file__).parents[2] / "urdf"


def bag(folder: Path) -> Path:
    """Write a bag of two samples."""
    pytest.importorskip("rosbags")
    landmarks = 0.01 * np.random.default_rng(0).normal(size=(2, 21, 3))
    recording = Recording(
        "a", np.array([0.0, 0.1]), landmarks, np.ones(2, dtype=bool), "right"
    )
    format_to_write(folder / "a.mcap").write([recording], folder / "a.mcap")
    return folder / "a.mcap"


def broken_encapsulation(folder: Path) -> None:
    file = bag(folder)
    # The first four bytes of every message tell how it is encoded.
    file.write_bytes(
        file.read_bytes().replace(b"\x00\x01\x00\x00", b"\x09\x09\x00\x00")
    )
    [source.read() for source in list_sources(file)]


def broken_text(folder: Path) -> None:
    file = bag(folder)
    content = file.read_bytes()
    frame = content.index(b"\x00\x01\x00\x00") + 12
    file.write_bytes(content[:frame] + b"\xff\xff\xff\x7f" + content[frame + 4 :])
    [source.read() for source in list_sources(file)]


def key_without_value(folder: Path) -> None:
    make_keys(folder / "keys", ["alice"])
    file = folder / "keys" / "server.key_secret"
    file.write_text('    public-key\n    secret-key = "a"\n', encoding="utf-8")
    read_server_keys(folder / "keys")


def name_of_other_encoding(folder: Path) -> None:
    file = folder / "hand.xml"
    body = b'<body name="l\xff"><joint/><geom size="0.01"/></body>'
    file.write_bytes(b"<mujoco><worldbody>" + body + b"</worldbody></mujoco>")
    ConvertedMjcf(file)


def box_of_four_numbers(folder: Path) -> None:
    file = folder / "hand.urdf"
    content = (URDF / "three_finger" / "hand.urdf").read_text(encoding="utf-8")
    sizes = 'size="0.026 0.03 0.024"', 'size="0.026 0.03 0. 24"'
    assert sizes[0] in content
    file.write_text(content.replace(*sizes), encoding="utf-8")
    detect(file)


def vectors_that_only_begin(folder: Path) -> None:
    file = folder / "hand.yml"
    lines = (
        "retargeting:",
        "  type: vector",
        "  urdf_path: hand.urdf",
        "  target_task_link_names: [a, b]",
        "  target_link_human_indices: [[0, 8]]",
    )
    file.write_text("\n".join(lines), encoding="utf-8")
    read_dex_configuration(file)


@pytest.mark.parametrize(
    "read",
    [
        broken_encapsulation,
        broken_text,
        key_without_value,
        name_of_other_encoding,
        box_of_four_numbers,
        vectors_that_only_begin,
    ],
)
def test_it_ends_in_one_line(read: Callable[[Path], None], tmp_path: Path) -> None:
    with pytest.raises(HandmapError) as raised:
        read(tmp_path)
    assert str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_clients_key_without_value_admits_the_others(tmp_path: Path) -> None:
    make_keys(tmp_path / "keys", ["alice", "bob"])
    file = tmp_path / "keys" / "clients" / "alice.key"
    file.write_text("    public-key\n", encoding="utf-8")
    assert len(ClientKeys(tmp_path / "keys" / "clients").read()) == 1
