"""The kinds of samples: angles, points or landmarks, checked and mapped."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from handmap_qp.errors import RefusedError
from handmap_qp.hands.spec import Side
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.convert import to_matrix
from handmap_qp.service.messages import Open, Step
from handmap_qp.service.opening import Hands
from handmap_qp.trackers.landmarks import PalmShape
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import Layout
from handmap_qp.trackers.layouts.tables import load_layout
from handmap_qp.trackers.sample import LANDMARK_COUNT, HumanSample

InputKind = Literal["q", "landmarks", "points"]
_FIELDS = ("q", "landmarks", "points", "values")


class MappedSample(NamedTuple):
    """A mapped sample.

    Attributes:
        step: Every stage of the mapping.
        human_q: Joint angles of the human hand [rad], shape (n,); None if the sample had none.
        landmarks: Landmarks [m], shape (21, 3); None if the sample had none.
    """

    step: MapStep
    human_q: np.ndarray | None = None
    landmarks: np.ndarray | None = None


@dataclass(frozen=True, slots=True)
class SampleForm:
    """What the samples of a session hold.

    Attributes:
        kind: Angles, landmarks or points.
        side: The human hand.
        layout: Layout of the numbers that stand for landmarks; None for landmarks themselves.
    """

    kind: InputKind
    side: Side
    layout: Layout | None = None

    @classmethod
    def of(cls, request: Open) -> SampleForm:
        """Return what the client that opens a session will send.

        Raises:
            RefusedError: If there is no such layout, or it is given with another kind of samples.
        """
        name = request.layout
        if name is None:
            return cls(request.input, request.side)
        if request.input != "landmarks":
            raise RefusedError("invalid", "needs input=landmarks", field="layout")
        # Only layouts of the package: a name must not open files of the server.
        if name not in LAYOUTS:
            message = f"no layout {name!r}; there are {', '.join(LAYOUTS)}"
            raise RefusedError("invalid", message, field="layout")
        return cls(request.input, request.side, load_layout(name))

    @property
    def field(self) -> str:
        """Field of a sample that holds the hand."""
        return self.kind if self.layout is None else "values"

    def check(self, sample: Step) -> None:
        """Reject a sample of another kind than the session was opened for.

        Raises:
            RefusedError: With the field that is missing or must be left out.
        """
        for field in _FIELDS:
            is_given = getattr(sample, field) is not None
            if is_given and field != self.field:
                wanted = self.kind if self.layout is None else f"values of {self.layout.name}"
                raise RefusedError("invalid", f"this session was opened for {wanted}", field=field)
            is_needed = sample.valid or self.kind != "landmarks"
            if not is_given and field == self.field and is_needed:
                raise RefusedError(
                    "invalid", "missing; this session was opened for it", field=field
                )
        if not sample.valid and self.kind != "landmarks":
            raise RefusedError("invalid", "only landmarks may be invalid", field="valid")
        if self.kind == "q" and sample.wrist is None:
            raise RefusedError("invalid", "missing; it must come with q", field="wrist")
        if sample.landmarks is not None and len(sample.landmarks) != LANDMARK_COUNT:
            message = f"expected {LANDMARK_COUNT} points, got {len(sample.landmarks)}"
            raise RefusedError("invalid", message, field="landmarks")

    def human_sample(self, sample: Step) -> HumanSample:
        """Convert a sample of landmarks that `check` accepted.

        Raises:
            HandmapError: If the numbers are not of the layout.
        """
        wrist = to_matrix(sample.wrist)
        if sample.values is not None and self.layout is not None:
            return self.layout.read(
                np.array(sample.values),
                time=sample.time,
                side=self.side,
                wrist=wrist,
                valid=sample.valid,
                confidence=sample.confidence,
            )
        landmarks = _UNSEEN if sample.landmarks is None else np.array(sample.landmarks)
        return HumanSample(
            sample.time, self.side, landmarks, wrist, sample.valid, sample.confidence
        )


def map_sample(
    hands: Hands, sample: Step, form: SampleForm, dt: float, arrival: float | None = None
) -> MappedSample:
    """Map a sample that `SampleForm.check` accepted.

    Args:
        hands: The hands of the session.
        sample: The sample.
        form: What the session's samples hold.
        dt: Time that the command may account for [s].
        arrival: When it arrived, on a monotonic clock [s]; None for simulated time.

    Raises:
        HandmapError: If the sample cannot be used; the mapper is then unchanged.
    """
    if hands.palm is not None:
        return _map_landmarks(hands, hands.palm, form.human_sample(sample), dt, arrival)
    wrist = to_matrix(sample.wrist)
    if sample.points is not None:
        return MappedSample(hands.mapper.map_points(sample.points, wrist, dt=dt))
    q = np.array(sample.q, dtype=float)
    # `SampleForm.check` requires a wrist with q.
    step = hands.mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=dt)
    return MappedSample(step, human_q=q)


def _map_landmarks(
    hands: Hands, palm: PalmShape, sample: HumanSample, dt: float, arrival: float | None
) -> MappedSample:
    """Map landmarks as they were measured, or hold where they make no sense."""
    step = hands.mapper.map_sample(sample, dt=dt, arrival=arrival)
    if step.rule == "size":
        # Other units than metres are a mistake of the client, which must know.
        palm.check(sample.landmarks)
    return MappedSample(step, landmarks=sample.landmarks)


_UNSEEN = np.full((LANDMARK_COUNT, 3), np.nan)
