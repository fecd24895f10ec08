"""A running mapping in the browser: `LiveViewer` shows and steers a `LiveSource`."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Protocol

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hands.hand import Hand
from handmap_qp.mapping.options_file import options_text
from handmap_qp.mapping.presets import Choice, possible_presets
from handmap_qp.viewer.controls import DisplayControls, SteeringControls
from handmap_qp.viewer.export import ExportControls
from handmap_qp.viewer.frames import GAUGES_PERIOD, Throttle, run_frames
from handmap_qp.viewer.gauges import Gauges, gauge_row
from handmap_qp.viewer.page import make_page
from handmap_qp.viewer.panels import Panels
from handmap_qp.viewer.sample import Variant, ViewSample
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

# Length of the plots' time axis [s].
_SPAN = 10.0
# The view reports that no sample arrives after this time [s].
_SILENCE = 1.0


class LiveSource(Protocol):
    """A mapping that runs elsewhere.

    The thread that iterates carries out requests in order. The attributes show their outcome.

    Attributes:
        human: The human hand of the samples.
        robot: The robot hand.
        choice: Preset and options in force there, whichever client set them.
        is_shared: Whether it can be steered from here.
        is_released: Whether the robot is released.
        stop_number: Number of the emergency stop in force; 0 for none.
        is_outdated: Whether it has ended because other hands are mapped there now.
        last_error: Why the last request failed; None if it succeeded.
    """

    human: Hand
    robot: Hand
    choice: Choice
    is_shared: bool
    is_released: bool
    stop_number: int
    is_outdated: bool
    last_error: HandmapError | None

    @property
    def is_busy(self) -> bool:
        """Whether requests are pending."""
        ...

    def __iter__(self) -> Iterator[ViewSample]:
        """Yield samples as they arrive until the source ends; may raise `HandmapError`."""
        ...

    def release(self) -> None:
        """Request that the robot is released."""
        ...

    def clutch(self) -> None:
        """Request that mapping resumes."""
        ...

    def stop(self) -> None:
        """Request an emergency stop, which works also where nothing else can be steered."""
        ...

    def clear(self, stop_number: int) -> None:
        """Request that an emergency stop ends; the robot is then released."""
        ...

    def configure(self, changes: dict[str, Any]) -> None:
        """Request another preset or other values of some options, as of `Choice`."""
        ...

    def close(self) -> None:
        """Stop; a running iteration ends soon."""
        ...


class LiveViewer:
    """Show a mapping that runs elsewhere.

    Args:
        server: A running viser server.
        source: What to show; a thread reads it from here on.
        patience: How long to wait for the first sample [s].

    Attributes:
        scene: The hands.
        gauges: Numbers, plots and joint bars.
        sample: The newest one.
        rows: `gauge_row` of each sample of the last 10 s.
        recent: These samples.
        status_text: The sample rate, or that no sample arrives.
        stop: Button of the emergency stop.
        clear: Button that ends the stop in force; shown while there is one, for a source that can
            be steered.
        steering: Clutch and options; None if the source cannot be steered.
        display: What the scene shows.
        exports: Buttons that download files; the page is of the last 10 s.

    Raises:
        InvalidInputError: If no sample arrives within `patience`.
        HandmapError: Any error of the source.
    """

    def __init__(
        self, server: viser.ViserServer, source: LiveSource, *, patience: float = 10.0
    ) -> None:
        self._source = source
        self.rows: deque[tuple[float, ...]] = deque()
        self.recent: deque[ViewSample] = deque()
        self.sample: ViewSample
        self._has_sample, self._has_ended = threading.Event(), threading.Event()
        self._error: HandmapError | None = None
        self._last_arrival = 0.0
        self._thread = threading.Thread(
            target=self._read, name="handmap view: live source", daemon=True
        )
        self._thread.start()
        try:
            self._wait(patience)
        except BaseException:
            self.close()
            raise
        self._start = source.choice
        variant = self._variant()
        self._shown = self._start
        self.scene = HandScene(server, source.human, [variant])
        panels = Panels(server)
        self.gauges = Gauges(server, [variant])
        with panels.control:
            self.status_text = server.gui.add_markdown("")
            self.stop = server.gui.add_button(
                "Stop the robot",
                color="red",
                hint="Emergency stop: the robot holds until the stop is cleared",
            )
            self.stop.on_click(lambda _: source.stop())
            self.clear = server.gui.add_button(
                "Clear the stop",
                hint="End the emergency stop; the robot stays where it is until Clutch is pressed",
                visible=False,
            )
            self._stop_number = 0
            # The number that was shown, so that a later stop is not cleared unseen.
            self.clear.on_click(lambda _: source.clear(self._stop_number))
            self.steering = (
                SteeringControls(
                    server,
                    self._start,
                    possible_presets(source.human, source.robot),
                )
                if source.is_shared
                else None
            )
        with panels.show:
            self.display = DisplayControls(server)
        with panels.save:
            self.exports = ExportControls(server, lambda: options_text(source.choice), self._page)
        self._gauges_throttle = Throttle(GAUGES_PERIOD)

    def tick(self) -> None:
        """Pass on the user's requests, and draw the newest sample.

        Raises:
            HandmapError: Any error of the source.
        """
        if self._error is not None:
            raise self._error
        if self.steering is not None:
            self._steer(self.steering)
        sample, rows = self.sample, tuple(self.rows)
        self._show_choice()
        self._show_stop()
        self.display.apply_to(self.scene)
        is_gauges_due = self._gauges_throttle.is_due()
        if is_gauges_due:
            self.scene.make_room([sample])
        self.scene.draw([sample])
        self.scene.cameras.update()
        if is_gauges_due:
            self.gauges.set_rows(rows, latest=_SPAN)
            self.gauges.draw([sample], len(rows) - 1)
        if self._has_ended.is_set():
            self.status_text.content = "**The source has ended.**"
        elif time.monotonic() - self._last_arrival > _SILENCE:
            self.status_text.content = "**No sample arrives.**"
        else:
            self.status_text.content = f"{1.0 / max(_period(rows), 1e-6):.0f} samples per second"

    def run(self) -> None:
        """Draw frames until interrupted, until the source fails, or until its hands change."""
        run_frames(lambda _: self.tick(), lambda: self._source.is_outdated)

    def close(self) -> None:
        """Stop reading the source."""
        self._source.close()
        self._thread.join(timeout=2.0)

    def _steer(self, steering: SteeringControls) -> None:
        source = self._source
        steering.show_error(source.last_error)
        steering.show_released(source.is_released)
        # While requests are pending, the controls keep the requested values.
        if source.is_busy:
            return
        in_force, preset = source.choice, steering.take_preset()
        if preset is None:
            steering.show_choice(in_force)
        # Send only what was changed here: other clients may have changed other options.
        changes = steering.options.take_changes()
        if preset is not None and preset != in_force.preset:
            changes = {"preset": preset}
        for request in steering.take_requests():
            if request == "release":
                source.release()
            elif request == "clutch" or source.is_released:
                source.clutch()
            if request == "reset":
                changes = in_force.changes_to(self._start)
        if changes:
            source.configure(changes)

    def _variant(self) -> Variant:
        """Return the robot as it is moved now."""
        source, choice = self._source, self._source.choice
        return Variant(choice.preset, source.robot, choice, [self.sample])

    def _show_choice(self) -> None:
        """Show another preset or options, whichever client chose them."""
        if self._source.choice != self._shown:
            self._shown = self._source.choice
            variant = self._variant()
            self.scene.set_variants([variant])
            self.gauges.set_variants([variant])

    def _show_stop(self) -> None:
        """Offer to clear the stop in force."""
        self._stop_number = self._source.stop_number
        is_offered = self._stop_number != 0 and self._source.is_shared
        if self.clear.visible != is_offered:
            self.clear.visible = is_offered

    def _page(self) -> bytes:
        """Return the last 10 s as a page."""
        variant, source = self._variant(), self._source
        title = f"{source.robot.name}, {variant.label}"
        return make_page(title, source.human, [replace(variant, samples=tuple(self.recent))])

    def _read(self) -> None:
        try:
            for sample in self._source:
                self.sample = sample
                # `tick` copies `rows` in one operation, so no lock is needed.
                self.rows.append(gauge_row(sample))
                self.recent.append(sample)
                while not 0.0 <= sample.time - self.rows[0][0] <= _SPAN:
                    self.rows.popleft()
                    self.recent.popleft()
                self._last_arrival = time.monotonic()
                self._has_sample.set()
        except HandmapError as error:
            self._error = error
        finally:
            self._has_ended.set()

    def _wait(self, patience: float) -> None:
        """Wait for the first sample, an error, or the end of the source."""
        end = time.monotonic() + patience
        while not self._has_sample.wait(0.02):
            if self._error is not None:
                raise self._error
            if self._has_ended.is_set() or time.monotonic() > end:
                raise InvalidInputError(
                    f"no sample arrived within {patience:g} s",
                    advice="check that a client sends samples to this session",
                )


def show_live(
    server: viser.ViserServer, make_source: Callable[[LiveSource | None], LiveSource]
) -> None:
    """Show a mapping until interrupted, and restart the view whenever its hands change.

    Args:
        server: A running viser server.
        make_source: Creates the source; its argument is the previous source, None at first.

    Raises:
        HandmapError: If the source cannot be created or shown, or fails.
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
    """Return the mean period of the newest samples [s]."""
    newest = rows[-60:]
    return (newest[-1][0] - newest[0][0]) / max(len(newest) - 1, 1)
