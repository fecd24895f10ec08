"""The view of a mapping that runs elsewhere, with a source made for the purpose."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'handmap-qp[view]'")

from viewer_cases import make_replay

from handmap_qp import HandmapError, InvalidInputError, MappingOptions
from handmap_qp.viewer.live import LiveViewer
from handmap_qp.viewer.samples import ViewSample
from handmap_qp.viewer.scene import serving


class Source:
    """Gives what it is handed: samples, an error to raise, or None for the end."""

    def __init__(self) -> None:
        replay = make_replay()
        self.human, self.robot, self.samples = replay.human, replay.robot, replay.samples
        self.given: queue.Queue[ViewSample | HandmapError | None] = queue.Queue()

    def __iter__(self) -> Iterator[ViewSample]:
        while (item := self.given.get()) is not None:
            if isinstance(item, HandmapError):
                raise item
            yield item

    def close(self) -> None:
        self.given.put(None)


@pytest.fixture
def source() -> Iterator[Source]:
    source = Source()
    yield source
    source.close()


@pytest.fixture
def server() -> Iterator[Any]:
    with serving() as running:
        yield running


def wait_until(is_done: Any) -> None:
    end = time.monotonic() + 5.0
    while not is_done():
        assert time.monotonic() < end, "nothing happens"
        time.sleep(0.005)


def test_the_newest_sample_is_drawn_and_all_are_plotted(server: Any, source: Source) -> None:
    for sample in source.samples[:40]:
        source.given.put(sample)
    viewer = LiveViewer(server, source, MappingOptions())
    wait_until(lambda: len(viewer.recent) == 40)
    viewer.tick()
    for i, point in enumerate(source.samples[39].robot_points):
        np.testing.assert_array_equal(server.scene.get_handle_by_name(f"/robot/points/{i}").position, point)
    assert viewer.gauges.error.data[0].tolist() == [sample.time for sample in source.samples[:40]]
    assert "30 samples a second" in viewer.message.content
    viewer.close()


def test_the_end_of_the_source_is_said_and_its_last_sample_stays(server: Any, source: Source) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source, MappingOptions())
    source.given.put(None)
    wait_until(lambda: not viewer._thread.is_alive())
    viewer.tick()
    assert "has ended" in viewer.message.content


def test_what_the_source_raises_reaches_the_user(server: Any, source: Source) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source, MappingOptions())
    source.given.put(InvalidInputError("the service has gone"))
    wait_until(lambda: not viewer._thread.is_alive())
    with pytest.raises(InvalidInputError, match="the service has gone"):
        viewer.tick()


def test_a_source_without_samples_is_given_up(server: Any, source: Source) -> None:
    with pytest.raises(InvalidInputError, match="no sample came"):
        LiveViewer(server, source, MappingOptions(), patience=0.1)


def test_a_source_that_says_only_commands_is_drawn_without_targets(server: Any, source: Source) -> None:
    from dataclasses import replace

    source.given.put(replace(source.samples[-1], targets=None, deformation=None, pivot=None))
    viewer = LiveViewer(server, source, MappingOptions())
    viewer.tick()
    assert not server.scene.get_handle_by_name("/robot/targets/0").visible
    assert not server.scene.get_handle_by_name("/human/ellipsoid").visible
    assert server.scene.get_handle_by_name("/robot/points/0").visible
    viewer.close()
