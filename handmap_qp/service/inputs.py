"""The kinds of samples: angles, points or landmarks, checked and mapped."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from handmap_qp.errors import RefusedError
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.convert import to_matrix
from handmap_qp.service.messages import Step
from handmap_qp.service.opening import Hands
from handmap_qp.trackers.recording import LANDMARK_COUNT

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
        if not is_given and kind == expected:
            raise RefusedError("invalid", "missing; this session was opened for it", field=kind)
    if expected == "q" and sample.wrist is None:
        raise RefusedError("invalid", "missing; it must come with q", field="wrist")
    if expected == "landmarks" and len(sample.landmarks or ()) != LANDMARK_COUNT:
        raise RefusedError(
            "invalid",
            f"expected {LANDMARK_COUNT} points, got {len(sample.landmarks or ())}",
            field="landmarks",
        )


def map_sample(hands: Hands, sample: Step, dt: float) -> MappedSample:
    """Map a sample that `check_input` accepted.

    Args:
        hands: The hands of the session.
        sample: The sample.
        dt: Time that the command may account for [s].

    Raises:
        HandmapError: If the sample cannot be used; the mapper is then unchanged.
    """
    wrist = to_matrix(sample.wrist)
    if sample.landmarks is not None:
        return _map_landmarks(hands, np.array(sample.landmarks), wrist, dt)
    if sample.points is not None:
        return MappedSample(hands.mapper.map_points(sample.points, wrist, dt=dt))
    q = np.array(sample.q, dtype=float)
    # `check_input` requires a wrist with q.
    step = hands.mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=dt)
    return MappedSample(step, human_q=q)


def _map_landmarks(
    hands: Hands, landmarks: np.ndarray, wrist: np.ndarray | None, dt: float
) -> MappedSample:
    """Map landmarks as they were measured."""
    if hands.palm is not None:
        hands.palm.check(landmarks)
    step = hands.mapper.map_landmarks(landmarks, wrist, dt=dt)
    return MappedSample(step, landmarks=landmarks)
