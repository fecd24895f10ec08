"""The view of a mapping that runs elsewhere, with a source made for the purpose."""

from __future__ import annotations

import queue
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'handmap-qp[view]'")

from viewer_cases import make_replay

from handmap_qp import HandmapError, IkOptions, InvalidInputError, MappingOptions
from handmap_qp.viewer.live import LiveViewer
from handmap_qp.viewer.samples import ViewSample
from handmap_qp.viewer.scene import serving


class Source:
    """Gives what it is handed: samples, an error to raise, or None for the end."""

    def __init__(self) -> None:
        replay = make_replay()
        self.human, self.robot, self.samples = replay.human, replay.robot, replay.samples
        self.mapping, self.ik = replay.mapping, replay.ik
        self.is_shared, self.is_released = True, False
        self.given: queue.Queue[ViewSample | HandmapError | None] = queue.Queue()

    def __iter__(self) -> Iterator[ViewSample]:
        while (item := self.given.get()) is not None:
            if isinstance(item, HandmapError):
                raise item
            yield item

    def toggle_clutch(self) -> None:
        self.is_released = not self.is_released

    def configure(self, mapping: MappingOptions, ik: IkOptions) -> None:
        if mapping.scale > 2.0:
            raise InvalidInputError("the service does not want that")
        self.mapping, self.ik = mapping, ik

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
    for sample in source.samples[:39]:
        source.given.put(sample)
    viewer = LiveViewer(server, source)
    source.given.put(source.samples[39])
    wait_until(lambda: len(viewer.recent) == 40)
    viewer.tick()
    for i, point in enumerate(source.samples[39].robot_points):
        np.testing.assert_array_equal(server.scene.get_handle_by_name(f"/robot/points/{i}").position, point)
    ago = [sample.time - source.samples[39].time for sample in source.samples[:40]]
    np.testing.assert_allclose(viewer.gauges.error.data[0], ago)
    assert "30 samples a second" in viewer.news.content
    viewer.close()


def test_the_end_of_the_source_is_said_and_its_last_sample_stays(server: Any, source: Source) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    source.given.put(None)
    wait_until(lambda: not viewer._thread.is_alive())
    viewer.tick()
    assert "has ended" in viewer.news.content


def test_what_the_source_raises_reaches_the_user(server: Any, source: Source) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    source.given.put(InvalidInputError("the service has gone"))
    wait_until(lambda: not viewer._thread.is_alive())
    with pytest.raises(InvalidInputError, match="the service has gone"):
        viewer.tick()


def test_a_source_without_samples_is_given_up(server: Any, source: Source) -> None:
    with pytest.raises(InvalidInputError, match="no sample came"):
        LiveViewer(server, source, patience=0.1)


def test_a_source_that_says_only_commands_is_drawn_without_targets(server: Any, source: Source) -> None:
    source.given.put(replace(source.samples[-1], targets=None, deformation=None, pivot=None))
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert not server.scene.get_handle_by_name("/robot/targets/0").visible
    assert not server.scene.get_handle_by_name("/human/ellipsoid").visible
    assert server.scene.get_handle_by_name("/robot/points/0").visible
    viewer.close()


def press(button: Any) -> None:
    """What the browser does when a button is clicked."""
    button.value = True


def test_clutch_and_options_reach_a_shared_source(server: Any, source: Source) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    assert viewer.steering is not None
    press(viewer.steering.clutch)
    viewer.steering.options.handles["ridge"].value = 0.5
    viewer.tick()
    assert (source.is_released, source.mapping, viewer.steering.clutch.label) == (True, MappingOptions(ridge=0.5), "Clutch")
    viewer.steering.options.handles["scale"].value = 2.5
    viewer.tick()
    assert viewer.steering.message.visible
    assert "does not want that" in viewer.steering.message.content
    assert source.mapping == MappingOptions(ridge=0.5)
    press(viewer.steering.reset)
    viewer.tick()
    assert (source.is_released, source.mapping) == (False, MappingOptions())
    assert not viewer.steering.message.visible
    viewer.close()


def test_a_source_that_is_not_shared_is_looked_at_only(server: Any, source: Source) -> None:
    source.is_shared = False
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert viewer.steering is None
    viewer.close()
