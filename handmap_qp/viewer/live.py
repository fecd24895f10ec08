"""A running mapping in the browser.

`LiveViewer` shows whatever a `LiveSource` tells, and steers it where it may.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Protocol

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.viewer.controls import PictureControls, SteeringControls, dock_main_panel
from handmap_qp.viewer.gauges import Gauges, gauge_row
from handmap_qp.viewer.option_controls import Options
from handmap_qp.viewer.replay import ViewSample
from handmap_qp.viewer.scene import HandScene
from handmap_qp.viewer.serving import drawing

if TYPE_CHECKING:
    import viser

_PERIOD = 1.0 / 30.0
_GAUGES_PERIOD = 0.1
# Time that the plots show [s].
_SPAN = 10.0
# Without a sample for so long, the view says so [s].
_SILENCE = 1.0


class LiveSource(Protocol):
    """Somewhere that a mapping runs.

    Wishes are carried out in turn by the thread that iterates, and what became of them is seen in
    the attributes.

    Attributes:
        human: The human hand that its samples speak of.
        robot: The robot hand.
        options: What is in force there, whoever asked for it.
        is_shared: Whether it can be steered from here.
        is_released: Whether the robot was let go.
        is_outdated: Whether it has ended because other hands are mapped there now.
        trouble: Why the last wish was not fulfilled; None where it was.
    """

    human: Hand
    robot: Hand
    options: Options
    is_shared: bool
    is_released: bool
    is_outdated: bool
    trouble: HandmapError | None

    @property
    def is_busy(self) -> bool:
        """Whether wishes are still to be carried out."""
        ...

    def __iter__(self) -> Iterator[ViewSample]:
        """Samples as they come, ending where the source ends; may raise `HandmapError`."""
        ...

    def release(self) -> None:
        """Wish to let go of the robot."""
        ...

    def clutch(self) -> None:
        """Wish to take hold of it again."""
        ...

    def configure(self, changes: dict[str, Any]) -> None:
        """Wish for other values of some options."""
        ...

    def close(self) -> None:
        """Stop: a running iteration ends soon."""
        ...


class LiveViewer:
    """Shows a mapping that runs elsewhere.

    Args:
        server: A running viser server.
        source: What to read; a thread does so from here on.
        patience: How long to wait for the first sample [s].

    Attributes:
        scene: The hands.
        gauges: Plots and joint bars.
        sample: The newest one.
        rows: What the plots show of the samples of the last seconds.
        news: What is amiss, or how many samples come.
        steering: Clutch and options; None where the source cannot be steered.
        picture: What the picture shows.

    Raises:
        InvalidInputError: If no sample comes.
        HandmapError: Whatever the source raised.
    """

    def __init__(
        self, server: viser.ViserServer, source: LiveSource, *, patience: float = 10.0
    ) -> None:
        self._source = source
        self.rows: deque[tuple[float, ...]] = deque()
        self.sample: ViewSample
        self._has_sample, self._has_ended = threading.Event(), threading.Event()
        self._error: HandmapError | None = None
        self._heard = 0.0
        self._thread = threading.Thread(
            target=self._read, name="handmap view: live source", daemon=True
        )
        self._thread.start()
        try:
            self._wait(patience)
        except BaseException:
            self.close()
            raise
        self._start = source.options
        self._alignment = self._start.mapping.alignment
        self.scene = HandScene(server, source.human, source.robot, self.sample, self._start.mapping)
        self.gauges = Gauges(server, source.robot)
        dock_main_panel(server)
        self.news = server.gui.add_markdown("")
        self.steering = (
            SteeringControls(server, source.robot, self._start) if source.is_shared else None
        )
        self.picture = PictureControls(server) if self.steering is None else self.steering.picture
        self._gauges_time = 0.0

    def tick(self) -> None:
        """Do what the user asked for, and draw the newest sample.

        Raises:
            HandmapError: Whatever the source raised.
        """
        if self._error is not None:
            raise self._error
        if self.steering is not None:
            self._steer(self.steering)
        sample, rows = self.sample, tuple(self.rows)
        self.picture.apply_to(self.scene)
        self.scene.draw(sample)
        self.scene.camera.attend()
        now = time.monotonic()
        if now - self._gauges_time >= _GAUGES_PERIOD:
            self.gauges.set_rows(rows, latest=_SPAN)
            self.gauges.draw(sample, len(rows) - 1)
            self._gauges_time = now
        if self._has_ended.is_set():
            self.news.content = "**The source has ended.**"
        elif now - self._heard > _SILENCE:
            self.news.content = "**No sample comes.**"
        else:
            self.news.content = f"{1.0 / max(_period(rows), 1e-6):.0f} samples a second"

    def run(self) -> None:
        """Go on until interrupted, until the source fails, or until other hands are mapped there."""
        while not self._source.is_outdated:
            started = time.monotonic()
            with drawing():
                self.tick()
            time.sleep(max(0.0, _PERIOD - (time.monotonic() - started)))

    def close(self) -> None:
        """Stop reading."""
        self._source.close()
        self._thread.join(timeout=2.0)

    def _steer(self, steering: SteeringControls) -> None:
        source = self._source
        steering.complain(source.trouble)
        steering.show_released(source.is_released)
        # Meanwhile, the controls keep what is wished for.
        if source.is_busy:
            return
        in_force = source.options
        steering.options.show(in_force)
        if in_force.mapping.alignment != self._alignment:
            self.scene.align(in_force.mapping)
            self._alignment = in_force.mapping.alignment
        # Nothing but what was changed here is sent, for others may have changed other options.
        changes = steering.options.take_changes()
        for wish in steering.take_wishes():
            if wish == "release":
                source.release()
            elif wish == "clutch" or source.is_released:
                source.clutch()
            if wish == "reset":
                changes |= in_force.changes_to(self._start)
        if changes:
            source.configure(changes)

    def _read(self) -> None:
        try:
            for sample in self._source:
                self.sample = sample
                # The other thread takes all rows at once.
                self.rows.append(gauge_row(sample))
                while not 0.0 <= sample.time - self.rows[0][0] <= _SPAN:
                    self.rows.popleft()
                self._heard = time.monotonic()
                self._has_sample.set()
        except HandmapError as error:
            self._error = error
        finally:
            self._has_ended.set()

    def _wait(self, patience: float) -> None:
        """Wait for the first sample, or for what comes in its place."""
        end = time.monotonic() + patience
        while not self._has_sample.wait(0.02):
            if self._error is not None:
                raise self._error
            if self._has_ended.is_set() or time.monotonic() > end:
                raise InvalidInputError(
                    f"no sample came within {patience:g} s: is anything being mapped there?"
                )


def show_live(
    server: viser.ViserServer, make_source: Callable[[LiveSource | None], LiveSource]
) -> None:
    """Show a mapping until interrupted, and begin anew whenever other hands are mapped there.

    Args:
        server: A running viser server.
        make_source: Makes the source; given the one before, if there was one.

    Raises:
        HandmapError: If the source cannot be made or shown, or fails.
    """
    source = None
    while True:
        source = make_source(source)
        viewer = LiveViewer(server, source)
        try:
            viewer.run()
        finally:
            viewer.close()
        server.gui.reset()
        server.scene.reset()


def _period(rows: tuple[tuple[float, ...], ...]) -> float:
    """Mean time between the newest samples [s]."""
    newest = rows[-60:]
    return (newest[-1][0] - newest[0][0]) / max(len(newest) - 1, 1)
