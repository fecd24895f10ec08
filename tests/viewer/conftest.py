"""Shared by the tests of the view: a server for each file; meshes and presets are found once.

Where no browser draws them, meshes are boxes of the same size, which are sent in less time.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest

from handmap_qp.apps.viewer import figure, live, replay
from handmap_qp.apps.viewer.serving import serving
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.presets import possible_presets

_MESHES: dict[str, dict[str, list[Any]]] = {}
_READ = figure.link_meshes


def _meshes_once(hand: Hand) -> dict[str, list[Any]]:
    if hand.urdf_text not in _MESHES:
        _MESHES[hand.urdf_text] = _READ(hand)
    return _MESHES[hand.urdf_text]


def _boxes_once(hand: Hand) -> dict[str, list[Any]]:
    key = f"boxes {hand.urdf_text}"
    if key not in _MESHES:
        from trimesh.creation import box

        _MESHES[key] = {
            link: [box(bounds=mesh.bounds) for mesh in meshes]
            for link, meshes in _meshes_once(hand).items()
        }
    return _MESHES[key]


@cache
def _presets_once(human: Hand, robot: Hand) -> tuple[str, ...]:
    return possible_presets(human, robot)


@pytest.fixture(autouse=True)
def _found_once(
    request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_drawn = request.path.name == "test_page.py"
    meshes = _meshes_once if is_drawn else _boxes_once
    monkeypatch.setattr(figure, "link_meshes", meshes)
    monkeypatch.setattr(replay, "possible_presets", _presets_once)
    monkeypatch.setattr(live, "possible_presets", _presets_once)


@pytest.fixture(scope="module")
def _running() -> Iterator[Any]:
    with serving() as running:
        yield running


@pytest.fixture
def server(_running: Any) -> Iterator[Any]:
    """A server without controls and nodes."""
    yield _running
    _running.gui.reset()
    _running.scene.reset()
