"""Shared by the tests of the view: one server for each file, and meshes that are read once."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from handmap_qp.hands.hand import Hand
from handmap_qp.viewer import figure
from handmap_qp.viewer.serving import serving

_MESHES: dict[str, dict[str, list[Any]]] = {}
_READ = figure.link_meshes


def _meshes_once(hand: Hand) -> dict[str, list[Any]]:
    if hand.urdf_text not in _MESHES:
        _MESHES[hand.urdf_text] = _READ(hand)
    return _MESHES[hand.urdf_text]


@pytest.fixture(autouse=True)
def _known_meshes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(figure, "link_meshes", _meshes_once)


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
