"""The kinds of samples: angles, points or landmarks, checked and mapped."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from handmap_qp.errors import RefusedError
from handmap_qp.hands.spec import Side
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.convert import to_matrix
from handmap_qp.service.messages import Step
from handmap_qp.service.opening import Hands
from handmap_qp.trackers.landmarks import PalmShape
from handmap_qp.trackers.sample import LANDMARK_COUNT, HumanSample

InputKind = Literal["q", "landmarks", "points"]
_KINDS: tuple[InputKind, ...] = ("q", "landmarks", "points")


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


def check_input(expected: InputKind, sample: Step) -> None:
    """Reject a sample of another kind than the session was opened for.

    Raises:
        RefusedError: With the field that is missing or must be left out.
    """
    for kind in _KINDS:
        is_given = getattr(sample, kind) is not None
        if is_given and kind != expected:
            raise RefusedError("invalid", f"this session was opened for {expected}", field=kind)
        if not is_given and kind == expected and (sample.valid or kind != "landmarks"):
            raise RefusedError("invalid", "missing; this session was opened for it", field=kind)
    if not sample.valid and expected != "landmarks":
        raise RefusedError("invalid", "only landmarks may be invalid", field="valid")
    if expected == "q" and sample.wrist is None:
        raise RefusedError("invalid", "missing; it must come with q", field="wrist")
    is_short = sample.landmarks is not None and len(sample.landmarks) != LANDMARK_COUNT
    if expected == "landmarks" and is_short:
        raise RefusedError(
            "invalid",
            f"expected {LANDMARK_COUNT} points, got {len(sample.landmarks or ())}",
            field="landmarks",
        )


def map_sample(hands: Hands, sample: Step, side: Side, dt: float) -> MappedSample:
    """Map a sample that `check_input` accepted.

    Args:
        hands: The hands of the session.
        sample: The sample.
        side: The human hand.
        dt: Time that the command may account for [s].

    Raises:
        HandmapError: If the sample cannot be used; the mapper is then unchanged.
    """
    if hands.palm is not None:
        return _map_landmarks(hands, hands.palm, human_sample(sample, side), dt)
    wrist = to_matrix(sample.wrist)
    if sample.points is not None:
        return MappedSample(hands.mapper.map_points(sample.points, wrist, dt=dt))
    q = np.array(sample.q, dtype=float)
    # `check_input` requires a wrist with q.
    step = hands.mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=dt)
    return MappedSample(step, human_q=q)


def human_sample(sample: Step, side: Side) -> HumanSample:
    """Convert a sample of landmarks that `check_input` accepted."""
    landmarks = _UNSEEN if sample.landmarks is None else np.array(sample.landmarks)
    return HumanSample(
        sample.time, side, landmarks, to_matrix(sample.wrist), sample.valid, sample.confidence
    )


def _map_landmarks(hands: Hands, palm: PalmShape, sample: HumanSample, dt: float) -> MappedSample:
    """Map landmarks as they were measured, or hold where they make no sense."""
    step = hands.mapper.map_sample(sample, dt=dt)
    if step.rule == "size":
        # Other units than metres are a mistake of the client, which must know.
        palm.check(sample.landmarks)
    return MappedSample(step, landmarks=sample.landmarks)


_UNSEEN = np.full((LANDMARK_COUNT, 3), np.nan)
