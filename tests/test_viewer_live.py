"""The view of a mapping that runs elsewhere, with a source made for the purpose."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest

pytest.importorskip("viser", reason="viser is not installed: pip install 'handmap-qp[view]'")

from viewer_cases import make_replay

from handmap_qp import HandmapError, InvalidInputError, MappingOptions
from handmap_qp.transform import affine, quat_wxyz_from_rotation
from handmap_qp.viewer.live import LiveViewer
from handmap_qp.viewer.samples import ViewSample
from handmap_qp.viewer.scene import serving
from handmap_qp.viewer.stream import ServiceStream


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
    ago = [sample.time - source.samples[39].time for sample in source.samples[:40]]
    np.testing.assert_allclose(viewer.gauges.error.data[0], ago)
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
    source.given.put(replace(source.samples[-1], targets=None, deformation=None, pivot=None))
    viewer = LiveViewer(server, source, MappingOptions())
    viewer.tick()
    assert not server.scene.get_handle_by_name("/robot/targets/0").visible
    assert not server.scene.get_handle_by_name("/human/ellipsoid").visible
    assert server.scene.get_handle_by_name("/robot/points/0").visible
    viewer.close()


# -- the mapping service's stream ---------------------------------------------------------------------------------------


@pytest.fixture
def publisher() -> Iterator[Any]:
    """A PUB socket like the service's, and its port."""
    zmq = pytest.importorskip("zmq", reason="pyzmq is not installed: pip install 'handmap-qp[service]'")
    with zmq.Context() as context, context.socket(zmq.PUB) as socket:
        socket.linger = 0
        yield socket, socket.bind_to_random_port("tcp://127.0.0.1")


def command_of(sample: ViewSample, joint_names: tuple[str, ...], *, name: str = "lab", has_detail: bool = True) -> bytes:
    """A command as the service's stream holds it, which stands here in full: the view must read what is on the wire."""
    wrist, human_wrist = (
        {"position": pose[:3, 3].tolist(), "quat_xyzw": np.roll(quat_wxyz_from_rotation(pose[:3, :3]), -1).tolist()}
        for pose in (sample.robot_wrist, sample.human_wrist)
    )
    assert sample.deformation is not None
    assert sample.targets is not None
    detail = {
        "human_points": sample.human_points.tolist(),
        "human_q": sample.human_q.tolist(),
        "human_wrist": human_wrist,
        "motion_deformation": affine(sample.deformation, np.zeros(3)).tolist(),
        "targets": sample.targets.tolist(),
        "points": sample.robot_points.tolist(),
    }
    held = [joint for joint, is_held in zip(joint_names, sample.at_limit, strict=True) if is_held]
    command = {
        "type": "command",
        "name": name,
        "time": 5.0,
        "server_time": 1000.0 + sample.time,
        "joint_names": joint_names,
        "q": sample.robot_q.tolist(),
        "wrist": wrist,
        "status": sample.status,
        "point_error": sample.point_error.tolist(),
        "at_limit": held,
        "solve_time": sample.duration,
        "detail": detail if has_detail else None,
    }
    return name.encode() + b"\0" + msgspec.msgpack.encode(command)


def listen(publisher: Any, source: Source, messages: list[bytes], **choices: Any) -> Iterator[ViewSample]:
    """Samples of a stream that says these messages again and again."""
    socket, port = publisher
    stream = ServiceStream(f"127.0.0.1:{port}", source.human, source.robot, **choices)
    is_over = threading.Event()

    def speak() -> None:
        while not is_over.wait(0.02):
            for message in messages:
                socket.send(message)

    thread = threading.Thread(target=speak)
    thread.start()
    try:
        yield from stream
    finally:
        stream.close()
        is_over.set()
        thread.join()


def test_the_stream_tells_the_samples_that_were_mapped(publisher: Any, source: Source) -> None:
    names, sent = source.robot.joint_names, source.samples[50]
    messages = [command_of(source.samples[0], names, name="other"), command_of(sent, names)]
    sample = next(listen(publisher, source, messages, session="lab"))
    for field in ("human_q", "human_points", "robot_q", "robot_points", "targets", "deformation", "at_limit"):
        np.testing.assert_allclose(getattr(sample, field), getattr(sent, field), atol=1e-9, err_msg=field)
    for field in ("human_wrist", "robot_wrist"):
        np.testing.assert_allclose(getattr(sample, field), getattr(sent, field), atol=1e-9, err_msg=field)
    assert (sample.time, sample.status, sample.duration) == (0.0, sent.status, sent.duration)


def test_a_held_robot_is_shown_with_the_human_last_seen(publisher: Any, source: Source) -> None:
    names = source.robot.joint_names
    messages = [command_of(source.samples[40], names), command_of(source.samples[41], names, has_detail=False)]
    held = next(sample for sample in listen(publisher, source, messages) if not sample.is_seen)
    np.testing.assert_allclose(held.human_q, source.samples[40].human_q)
    np.testing.assert_allclose(held.robot_q, source.samples[41].robot_q)


@pytest.mark.parametrize(
    ("message", "complaint"),
    [
        pytest.param(lambda source: command_of(source.samples[0], ("a",) * 8), "of another hand", id="another robot"),
        pytest.param(
            lambda source: command_of(source.samples[5], source.robot.joint_names, has_detail=False), "has_detail", id="no detail"
        ),
        pytest.param(lambda source: b"lab\0{}", "something else", id="no command"),
    ],
)
def test_a_stream_that_cannot_be_shown_is_explained(publisher: Any, source: Source, message: Any, complaint: str) -> None:
    with pytest.raises(InvalidInputError, match=complaint):
        next(listen(publisher, source, [message(source)]))
