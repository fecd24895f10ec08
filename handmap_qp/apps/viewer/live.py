"""A running mapping in the browser: `LiveViewer` shows and steers a `ServiceSession`."""

from __future__ import annotations

import threading
import time
from collections import deque
from concurrent.futures import ThreadPoolExecutor, wait
from typing import TYPE_CHECKING

from handmap_core.errors import InvalidInputError
from handmap_qp.mapping import options_text, possible_presets
from .controls import SteeringControls, Window, add_controls, say
from .page import make_page
from .sample import Variant, ViewSample
from .serving import ViserServer

if TYPE_CHECKING:
    from .remote import ServiceSession

# Length of the plots' time axis [s].
_SPAN = 10.0
# The view reports that no sample arrives after this time [s].
_SILENCE = 1.0
# Number of samples that the rate is measured over.
_RATE_SAMPLES = 60


class LiveViewer(Window):
    """Show a mapping that runs elsewhere.

    Args:
        source: What to show; a thread reads it from here on, until it is closed.
        patience: How long to wait for the first sample [s].

    Attributes:
        recent: The samples of the last 10 s.
        status_text: The sample rate, or that no sample arrives.
        slow_text: Whether the robot's joints are slower than a person, or are held by assumed
            speeds; hidden if not.
        stop: Button of the emergency stop.
        clear: Button that ends the stop in force; shown while there is one, for a source that can
            be steered.
        steering: Clutch and options; None if the source cannot be steered.

    Raises:
        InvalidInputError: If no sample arrives within `patience`.
        HandmapError: Any error of the source.
    """

    latest = _SPAN

    def __init__(
        self,
        server: ViserServer,
        source: ServiceSession,
        *,
        patience: float = 10.0,
    ) -> None:
        self._source = source
        self.recent = deque[ViewSample]()
        self._last_arrival = 0.0
        self._arrived = threading.Event()
        reader = ThreadPoolExecutor(1, thread_name_prefix="handmap view: live source")
        self._reading = reader.submit(self._read)
        self._reading.add_done_callback(lambda _: self._arrived.set())
        reader.shutdown(wait=False)
        self._arrived.wait(patience)
        if not self.recent:
            if self._reading.done():
                self._reading.result()
            raise InvalidInputError(
                f"no sample arrived within {patience:g} s",
                advice="check that a client sends samples to this session",
            )
        self._start = self._shown = source.choice
        super().__init__(
            server,
            source.human,
            [self._variant()],
            lambda: options_text(source.choice),
            self._page,
        )
        with self.control:
            self.status_text = server.gui.add_markdown("")
            self.slow_text = server.gui.add_markdown("", visible=False)
            say(self.slow_text, source.slow_note)
            self.stop, self.clear = add_controls(server.gui, "stopping")
            self.stop.on_click(lambda _: source.request("stop"))
            self._stop_number = 0
            # The number that was shown, so that a later stop is not cleared unseen.
            self.clear.on_click(lambda _: source.request("clear", self._stop_number))
            self.steering = None
            if source.is_shared:
                presets = possible_presets(source.human, source.robot)
                self.steering = SteeringControls(server, self._start, presets)

    @property
    def sample(self) -> ViewSample:
        """The newest sample."""
        return self.recent[-1]

    def tick(self, _: float = 0.0) -> None:
        """Pass on the user's requests, and draw the newest sample.

        Raises:
            HandmapError: Any error of the source.
        """
        source = self._source
        if has_ended := self._reading.done():
            self._reading.result()
        if self.steering:
            self._steer(self.steering)
        variant = self._variant()
        if source.choice != self._shown:
            # Another preset or options, whichever client chose them.
            self._shown = source.choice
            self.set_variants([variant._replace(samples=[self.sample])])
        self._stop_number = source.stop_number
        self.clear.visible = self._stop_number != 0 and source.is_shared
        self.scene.make_room(variant.samples[-1])
        self.draw([variant], -1)
        latest = variant.samples[-_RATE_SAMPLES:]
        rate = (len(latest) - 1) / max(latest[-1].time - latest[0].time, 1e-6)
        text = f"{rate:.0f} samples per second"
        if has_ended:
            text = "**The source has ended.**"
        elif time.monotonic() - self._last_arrival > _SILENCE:
            text = "**No sample arrives.**"
        self.status_text.content = text
        # How often assumed speeds hold the robot changes.
        if self.slow_text.content != source.slow_note:
            say(self.slow_text, source.slow_note)

    def close(self) -> None:
        """Stop reading the source."""
        self._source.close()
        wait([self._reading], timeout=2.0)

    def _steer(self, steering: SteeringControls) -> None:
        source = self._source
        say(steering.message, source.last_error)
        steering.show_released(source.is_released)
        # While requests are pending, the controls keep the requested values.
        if source.is_busy:
            return
        in_force = source.choice
        steering.show_choice(in_force)
        # Send only what was changed here: other clients may have changed other options.
        changes = steering.take_changes()
        if "preset" in changes:
            changes = {"preset": changes["preset"]}
        for request in steering.take_requests():
            if request != "reset":
                source.request(request)
                continue
            if source.is_released:
                source.request("clutch")
            changes = in_force.changes_to(self._start)
        if changes:
            source.configure(changes)

    def _variant(self) -> Variant:
        """Return the robot as it is moved now, with its samples of the last 10 s."""
        choice = self._source.choice
        # The copy is one operation, so the thread that reads needs no lock.
        return Variant(choice.preset, self._source.robot, choice, tuple(self.recent))

    def _page(self) -> bytes:
        """Return the last 10 s as a page."""
        variant = self._variant()
        title = f"{variant.robot.name}, {variant.label}"
        return make_page(title, self._source.human, [variant])

    def _read(self) -> None:
        for sample in self._source:
            self.recent.append(sample)
            while not 0.0 <= sample.time - self.recent[0].time <= _SPAN:
                self.recent.popleft()
            self._last_arrival = time.monotonic()
            self._arrived.set()
