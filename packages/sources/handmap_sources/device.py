"""`DeviceSource`: what sources share whose samples are in a layout."""

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from tyro.conf import Suppress

from handmap_qp.apps.live.cli import Target, TargetFlags
from handmap_qp.apps.live.source import Source
from handmap_qp.errors import InvalidInputError, warn
from handmap_qp.hands import HumanLengths, Side, Values
from handmap_qp.human import UNSEEN, HumanSample, read_person
from handmap_qp.trackers import Layout, load_layout


@dataclass(eq=False, kw_only=True)
class DeviceSource(Source):
    """A device whose samples are in a layout, as a command: a subclass yields its samples.

    What cannot be mapped is left out and counted by kind. The first of each kind is told on stderr.

    Attributes:
        layout: Layout of the device; a subclass says which.
        side: The hand to track.
        target: Where the samples go.
        name: Name to show; a subclass says which.
        rate: 0: the device decides.
        troubles: Number of each kind of trouble.
    """

    layout: Suppress[str]
    side: Side = "right"
    target: TargetFlags = Target()

    rate = 0.0

    def __post_init__(self) -> None:
        self.troubles = Counter[str]()

    # Not at the start, where a mistake would be one of the parser.
    @cached_property
    def _layout(self) -> Layout:
        return load_layout(self.layout)

    @cached_property
    def _lengths(self) -> HumanLengths | None:
        person = self.target.person
        return read_person(person).lengths if person else None

    @cached_property
    def upright(self) -> str:
        """Axes of the samples' world, as in the layout."""
        return self._layout.upright

    def run(self) -> None:
        """Track until Ctrl-C."""
        self.target.check()
        self.target.send(self)

    def summary(self) -> Values:
        """Return the troubles by kind."""
        return {"troubles": dict(self.troubles)}

    def note(self, trouble: str, text: str) -> None:
        """Count a trouble; tell the first of its kind."""
        self.troubles[trouble] += 1
        if self.troubles[trouble] == 1:
            warn(f"{self.name}: {text}; more of this is counted only")

    def read(self, values: Any, time: float, **more: Any) -> HumanSample | None:
        """Return the sample of values in the layout; None, after a note, if they are not.

        Args:
            values: See `Layout.read`.
            time: Instant [s].
            **more: Further arguments of `Layout.read`.
        """
        side, lengths = self.side, self._lengths
        try:
            return self._layout.read(
                values, time=time, side=side, lengths=lengths, **more
            )
        except InvalidInputError as error:
            return self.note("damaged", str(error))

    def unseen(self, time: float) -> HumanSample:
        """Return the sample of a hand that the device does not see."""
        return HumanSample(time, self.side, UNSEEN, valid=False)
