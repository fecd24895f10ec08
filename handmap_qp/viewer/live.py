"""A running mapping in the browser: `LiveViewer` shows whatever a `LiveSource` tells, and steers it where it may."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol

from handmap_qp.errors import HandmapError, InvalidInputError
from handmap_qp.hand import Hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.options import MappingOptions
from handmap_qp.viewer.controls import PictureControls, SteeringControls, dock_main_panel
from handmap_qp.viewer.gauges import Gauges
from handmap_qp.viewer.samples import ViewSample
from handmap_qp.viewer.scene import HandScene

if TYPE_CHECKING:
    import viser

_PERIOD = 1.0 / 30.0
_GAUGES_PERIOD = 0.1
# Time that the plots show [s], and the most samples in them.
_SPAN = 10.0
_LENGTH = 1200
# Without a sample for so long, the view says so [s].
_SILENCE = 1.0


class LiveSource(Protocol):
    """Somewhere that a mapping runs.

    Attributes:
        human: The human hand that its samples speak of.
        robot: The robot hand.
        mapping: The mapping's choices.
        ik: Weights and settings of the QP.
        is_shared: Whether it can be steered from here.
        is_released: Whether the robot was let go.
    """

    human: Hand
    robot: Hand
    mapping: MappingOptions
    ik: IkOptions
    is_shared: bool
    is_released: bool

    def __iter__(self) -> Iterator[ViewSample]:
        """Samples as they come, ending where the source ends; may raise `HandmapError`."""
        ...

    def toggle_clutch(self) -> None:
        """Let go, or take hold again; may raise `HandmapError`."""
        ...

    def configure(self, mapping: MappingOptions, ik: IkOptions) -> None:
        """Change options; may raise `HandmapError`."""
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
        recent: The samples in the plots.
        news: What is amiss, or how many samples come.
        steering: Clutch and options; None where the source cannot be steered.
        picture: What the picture shows.

    Raises:
        InvalidInputError: If no sample comes.
        HandmapError: Whatever the source raised.
    """

    def __init__(self, server: viser.ViserServer, source: LiveSource, *, patience: float = 10.0) -> None:
        self._source = source
        self.recent: deque[ViewSample] = deque(maxlen=_LENGTH)
        self._has_sample, self._has_ended = threading.Event(), threading.Event()
        self._error: HandmapError | None = None
        self._heard = 0.0
        self._thread = threading.Thread(target=self._read, name="handmap view: live source", daemon=True)
        self._thread.start()
        try:
            self._wait(patience)
        except BaseException:
            self.close()
            raise
        first = self.recent[0]
        self.scene = HandScene(server, source.human, source.robot, first, source.mapping)
        self.gauges = Gauges(server, source.robot)
        dock_main_panel(server)
        self.news = server.gui.add_markdown("")
        self.steering = SteeringControls(server, source.robot, source.mapping, source.ik) if source.is_shared else None
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
        samples = tuple(self.recent)
        self.picture.apply_to(self.scene)
        self.scene.draw(samples[-1])
        now = time.monotonic()
        if now - self._gauges_time >= _GAUGES_PERIOD:
            self.gauges.set_samples(samples, latest=_SPAN)
            self.gauges.draw(samples[-1], len(samples) - 1)
            self._gauges_time = now
        if self._has_ended.is_set():
            self.news.content = "**The source has ended.**"
        elif now - self._heard > _SILENCE:
            self.news.content = "**No sample comes.**"
        else:
            self.news.content = f"{1.0 / max(_period(samples), 1e-6):.0f} samples a second"

    def run(self) -> None:
        """Go on until interrupted, or until the source fails."""
        while True:
            started = time.monotonic()
            self.tick()
            time.sleep(max(0.0, _PERIOD - (time.monotonic() - started)))

    def close(self) -> None:
        """Stop reading."""
        self._source.close()
        self._thread.join(timeout=2.0)

    def _steer(self, steering: SteeringControls) -> None:
        source = self._source
        try:
            wishes, options = steering.take_wishes(), steering.take_options()
            for wish in wishes:
                if wish == "clutch" or source.is_released:
                    source.toggle_clutch()
            if options is not None:
                source.configure(*options)
                self.scene.align(options[0])
            if wishes or options is not None:
                steering.complain(None)
        except HandmapError as error:
            steering.complain(error)
        steering.show_released(source.is_released)

    def _read(self) -> None:
        try:
            for sample in self._source:
                self.recent.append(sample)
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
                raise InvalidInputError(f"no sample came within {patience:g} s: is anything being mapped there?")


def _period(samples: tuple[ViewSample, ...]) -> float:
    """Mean time between the newest samples [s]."""
    newest = samples[-60:]
    return (newest[-1].time - newest[0].time) / max(len(newest) - 1, 1)
