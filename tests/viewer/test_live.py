"""The view of a running mapping, with a fake source."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

pytest.importorskip(
    "viser", reason="viser is not installed: pip install 'handmap-qp[view]'"
)

from patience import PATIENCE, wait_until
from viewer_cases import make_replay, option_handles, plotted, press

from handmap_qp import HandmapError, InvalidInputError, MappingOptions
from handmap_qp.apps.viewer.cli import View
from handmap_qp.apps.viewer.gauges import FIRST
from handmap_qp.apps.viewer.live import LiveViewer
from handmap_qp.apps.viewer.sample import ViewSample
from handmap_qp.mapping.presets import preset_choice
from handmap_qp.se3 import rotation_from_quat_wxyz

# Processes, sockets, pictures or whole hands: not for the fast suite.
pytestmark = pytest.mark.slow


def with_human(sample: ViewSample, **changes: Any) -> ViewSample:
    (human,) = sample.humans
    return replace(sample, humans=[human._replace(**changes)])


QUARTER_TURN = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))


class Source:
    """Yield the items of `given`: samples, an error to raise, or None to end."""

    def __init__(self, robot: str = "three_finger") -> None:
        replay = make_replay(robot)
        self.human, self.robot, self.samples = (
            replay.human,
            replay.variant.robot,
            replay.variant.samples,
        )
        self.choice = replay.choice
        self.is_shared, self.is_released, self.is_busy, self.is_outdated = (
            True,
            False,
            False,
            False,
        )
        self.is_stopped = False
        self.stop_number = 0
        self.slow_note = ""
        self.last_error: HandmapError | None = None
        self.asked: list[dict[str, Any]] = []
        self.given: queue.Queue[ViewSample | HandmapError | None] = queue.Queue()

    def __iter__(self) -> Iterator[ViewSample]:
        while (item := self.given.get()) is not None:
            if isinstance(item, HandmapError):
                raise item
            yield item

    def request(self, name: str, *values: int) -> None:
        if name == "stop":
            self.is_stopped, self.stop_number = True, 7
        elif name == "clear":
            self.stop_number -= values[0]
        else:
            self.is_released = name == "release"

    def configure(self, changes: dict[str, Any]) -> None:
        self.asked.append(changes)
        choice = self.choice.with_changes(changes)
        self.last_error = (
            InvalidInputError("the service refuses that")
            if getattr(choice.method, "scale", 0.0) > 2.0
            else None
        )
        self.choice = self.choice if self.last_error else choice

    def close(self) -> None:
        self.given.put(None)


@pytest.fixture
def source() -> Iterator[Source]:
    source = Source()
    yield source
    source.close()


def test_the_newest_sample_is_drawn_and_all_are_plotted(
    server: Any, source: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("handmap_qp.apps.viewer.live._SILENCE", PATIENCE)
    for sample in source.samples[:39]:
        source.given.put(sample)
    viewer = LiveViewer(server, source)
    source.given.put(source.samples[39])
    wait_until(lambda: len(viewer.recent) == 40)
    viewer.tick()
    for i, point in enumerate(source.samples[39].robot_points):
        np.testing.assert_array_equal(
            server.scene.get_handle_by_name(f"/robot/points/{i}").position, point
        )
    ago = [sample.time - source.samples[39].time for sample in source.samples[:40]]
    is_known = [np.isfinite(s.point_error).all() for s in source.samples[:40]]
    time, _ = plotted(viewer.gauges.error.content, FIRST)
    np.testing.assert_allclose(time, np.array(ago)[is_known], atol=0.01)
    assert "30 samples per second" in viewer.status_text.content
    viewer.close()


@pytest.mark.slow
def test_missing_samples_are_reported(
    server: Any, source: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    monkeypatch.setattr("handmap_qp.apps.viewer.live._SILENCE", 0.0)
    viewer.tick()
    assert "No sample arrives" in viewer.status_text.content
    viewer.close()


def test_the_end_of_the_source_is_reported_and_its_last_sample_stays(
    server: Any, source: Any
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    source.given.put(None)
    wait_until(viewer._reading.done)
    viewer.tick()
    assert "has ended" in viewer.status_text.content


def test_what_the_source_raises_reaches_the_user(server: Any, source: Any) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    source.given.put(InvalidInputError("the service has gone"))
    wait_until(viewer._reading.done)
    with pytest.raises(InvalidInputError, match="the service has gone"):
        viewer.tick()


def test_a_source_without_samples_is_given_up(server: Any, source: Any) -> None:
    with pytest.raises(InvalidInputError, match="no sample arrived"):
        LiveViewer(server, source, patience=0.1)


@pytest.mark.slow
def test_a_source_of_commands_only_is_drawn_without_targets(
    server: Any, source: Any
) -> None:
    source.given.put(
        with_human(
            replace(source.samples[-1], targets=None),
            motion_deformation=None,
            pivot=None,
        )
    )
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert server.scene.get_handle_by_name("/robot/targets/0") is None
    assert not server.scene.get_handle_by_name("/human/ellipsoid").visible
    assert server.scene.get_handle_by_name("/robot/points/0").visible
    viewer.close()


@pytest.mark.parametrize("is_shared", [True, False])
def test_a_stop_reaches_every_source(server: Any, source: Any, is_shared: bool) -> None:
    source.is_shared = is_shared
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert not viewer.clear.visible
    press(viewer.stop)
    assert source.is_stopped
    viewer.tick()
    assert viewer.clear.visible == is_shared
    # A stop that came later has not been seen.
    source.stop_number = 8
    press(viewer.clear)
    assert source.stop_number == 1
    viewer.tick()
    press(viewer.clear)
    viewer.tick()
    assert not viewer.clear.visible
    viewer.close()


def test_clutch_and_options_reach_a_shared_source(server: Any, source: Any) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    assert viewer.steering is not None
    handles = option_handles(viewer.steering)
    press(viewer.steering.release)
    handles["ridge"].value = 0.5
    viewer.tick()
    viewer.tick()
    assert (source.is_released, source.choice.method) == (
        True,
        MappingOptions(ridge=0.5),
    )
    assert (viewer.steering.release.disabled, viewer.steering.clutch.disabled) == (
        True,
        False,
    )
    press(viewer.steering.release)
    viewer.tick()
    assert source.is_released, (
        "Release must not clutch a robot that another client has just released"
    )
    handles["scale"].value = 2.5
    viewer.tick()
    viewer.tick()
    assert viewer.steering.message.visible
    assert "refuses that" in viewer.steering.message.content
    assert source.choice.method == MappingOptions(ridge=0.5)
    assert handles["scale"].value == 1.0, "the value in force"
    press(viewer.steering.reset)
    viewer.tick()
    viewer.tick()
    assert (source.is_released, source.choice.method) == (False, MappingOptions())
    assert not viewer.steering.message.visible
    assert handles["ridge"].value == 0.1
    viewer.close()


def test_the_preset_reaches_a_shared_source_and_that_of_others_is_shown(
    server: Any, source: Any
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    steering = viewer.steering
    assert steering is not None
    viewer.tick()
    steering.controls["preset"].handle.value = "teleoperation"
    viewer.tick()
    assert source.asked == [{"preset": "teleoperation"}]
    viewer.tick()
    assert (steering.controls["preset"].handle.value, source.asked[1:]) == (
        "teleoperation",
        [],
    )
    option_handles(steering)["pinch_weight"].value = 2.0
    viewer.tick()
    assert source.asked[1:] == [{"pinch_weight": 2.0}]
    source.choice = preset_choice("object")
    viewer.tick()
    assert steering.controls["preset"].handle.value == "object"
    assert "rigid_from" in option_handles(steering)
    press(steering.reset)
    viewer.tick()
    viewer.tick()
    assert source.asked[2:] == [{"preset": "paper"}]
    assert (source.choice, steering.controls["preset"].handle.value) == (
        preset_choice("paper"),
        "paper",
    )
    viewer.close()


def test_a_preset_that_the_source_refuses_is_explained(
    server: Any, source: Any
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    steering = viewer.steering
    assert steering is not None

    def refuse(changes: dict[str, Any]) -> None:
        source.last_error = InvalidInputError(f"the service refuses {changes}")

    source.configure = refuse
    steering.controls["preset"].handle.value = "object"
    viewer.tick()
    viewer.tick()
    assert "the service refuses" in steering.message.content
    assert steering.controls["preset"].handle.value == "paper"
    viewer.close()


def test_only_own_changes_are_sent_and_changes_of_others_are_shown(
    server: Any, source: Any
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    assert viewer.steering is not None
    handles = option_handles(viewer.steering)
    theirs = {
        "ridge": 7.0,
        "max_acceleration": 50.0,
        "alignment": QUARTER_TURN,
        "pivot": "point",
        "pivot_point": (0.0, 1.0, 0.0),
    }
    source.choice = source.choice.with_changes(theirs)
    viewer.tick()
    assert {name: handles[name].value for name in theirs} == theirs | {
        "alignment": "as given",
        "pivot_point": "0.0, 1.0, 0.0",
    }
    assert source.asked == []
    handles["scale"].value = 1.5
    viewer.tick()
    viewer.tick()
    assert source.asked == [{"scale": 1.5}]
    viewer.close()


def test_controls_keep_requested_values_while_the_source_is_busy(
    server: Any, source: Any
) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    assert viewer.steering is not None
    source.is_busy = True
    for value in (0.2, 0.3, 0.4):
        option_handles(viewer.steering)["ridge"].value = value
        viewer.tick()
    assert source.asked == []
    source.is_busy = False
    viewer.tick()
    assert source.asked == [{"ridge": 0.4}]
    viewer.close()


@pytest.mark.slow
def test_the_plots_hold_the_last_seconds_whatever_the_rate(
    server: Any, source: Any
) -> None:
    for i in range(1200):
        source.given.put(
            replace(
                source.samples[0], time=0.01 * i, duration=1.0 if i == 700 else 1e-4
            )
        )
    viewer = LiveViewer(server, source)
    wait_until(lambda: viewer.sample.time >= 11.985)
    viewer.tick()
    time, step = plotted(viewer.gauges.timing.content, FIRST)
    assert len(time) <= 600
    assert (time[0], time[-1]) == pytest.approx((-10.0, 0.0), abs=0.05)
    # Cut off at three times the median, 100 µs; decimation must keep the worst step.
    assert step.max() == pytest.approx(300.0, rel=0.01)
    assert "largest 1000000 (cut off)" in viewer.gauges.timing_note.content
    viewer.close()


@pytest.mark.slow
def test_hands_that_travel_stay_in_the_picture(server: Any, source: Any) -> None:
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    viewer.display.follow.value = "world"
    viewer.tick()
    near = np.linalg.norm(server.initial_camera.position)
    shift = np.array([0.8, 0.0, 0.0])
    (human,) = source.samples[0].humans
    far = np.array(human.wrist)
    far[:3, 3] += shift
    source.given.put(
        with_human(
            replace(source.samples[0], time=0.1), wrist=far, points=human.points + shift
        )
    )
    wait_until(lambda: viewer.sample.time == 0.1)
    viewer.tick()
    assert np.linalg.norm(server.initial_camera.position) > near + 0.5
    viewer.close()


def test_a_hand_of_unknown_posture_is_not_drawn(server: Any, source: Any) -> None:
    points = source.samples[0].humans[0].points + 3.0
    first = with_human(source.samples[0], q=None, points=points)
    source.given.put(first)
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert not server.scene.get_handle_by_name("/human/body").visible
    human = server.scene.get_handle_by_name("/human")
    turn = rotation_from_quat_wxyz(human.wxyz)
    middle = turn @ points.mean(axis=0) + human.position
    assert abs(middle[0]) < 0.3, "the points are beside the robot"
    # The middle of the points' box is there, not their mean.
    np.testing.assert_allclose(middle[1:], 0.0, atol=0.02)
    viewer.close()


@pytest.mark.slow
def test_the_view_restarts_when_the_hands_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made: list[Any] = []

    def make_source(host: str, session: str | None, **_: Any) -> Any:
        assert (host, session) == ("lab-pc", "lab" if made else None)
        if len(made) == 2:
            raise InvalidInputError("enough")
        made.append(Source("three_finger" if made else "allegro_right"))
        made[-1].given.put(made[-1].samples[0])
        # The view ends as soon as it runs.
        made[-1].is_outdated, made[-1].name = True, "lab"
        return made[-1]

    monkeypatch.setattr("handmap_qp.apps.viewer.remote.ServiceSession", make_source)
    with pytest.raises(InvalidInputError, match="enough"):
        View(live="lab-pc", port=0).run()
    assert [source.robot.name for source in made] == ["allegro_right", "three_finger"]


@pytest.mark.slow
@pytest.mark.parametrize("note", ["", "This hand needs 1.3 s for a fist."])
def test_a_slow_hand_has_a_line(server: Any, source: Any, note: str) -> None:
    source.slow_note = note
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert viewer.slow_text.content == note
    assert viewer.slow_text.visible == bool(note)
    # The service counts on.
    source.slow_note = "Assumed speed limits held a joint."
    viewer.tick()
    assert viewer.slow_text.content == source.slow_note
    assert viewer.slow_text.visible
    viewer.close()


def test_a_source_that_is_not_shared_has_no_controls(server: Any, source: Any) -> None:
    source.is_shared = False
    source.given.put(source.samples[0])
    viewer = LiveViewer(server, source)
    viewer.tick()
    assert viewer.steering is None
    viewer.close()
