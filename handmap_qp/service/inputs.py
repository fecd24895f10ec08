"""The kinds of samples: angles, points or landmarks, checked and mapped."""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np

from handmap_qp.errors import RefusedError
from handmap_qp.mapping.step import MapStep
from handmap_qp.service.convert import to_matrix
from handmap_qp.service.messages import Step
from handmap_qp.service.opening import Hands
from handmap_qp.service.refusals import with_field_errors

InputKind = Literal["q", "landmarks", "points"]
_KINDS: tuple[InputKind, ...] = ("q", "landmarks", "points")


class MappedSample(NamedTuple):
    """A mapped sample.

    Attributes:
        step: Every stage of the mapping.
        human_q: Joint angles of the human hand [rad], shape (n,); None if they are not known.
        human_wrist: Pose of the human's wrist, shape (4, 4); None if it is not known.
    """

    step: MapStep
    human_q: np.ndarray | None
    human_wrist: np.ndarray | None


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
    if expected == "landmarks":
        if sample.wrist is not None:
            raise RefusedError(
                "invalid", "it follows from the landmarks; leave it out", field="wrist"
            )
        if len(sample.landmarks or ()) != 21:
            raise RefusedError(
                "invalid",
                f"expected 21 points, got {len(sample.landmarks or ())}",
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
    if sample.landmarks is not None:
        return _map_landmarks(hands, np.array(sample.landmarks), dt)
    wrist = to_matrix(sample.wrist)
    if sample.points is not None:
        return MappedSample(hands.mapper.map_points(sample.points, wrist, dt=dt), None, wrist)
    q = np.array(sample.q, dtype=float)
    # `check_input` requires a wrist with q.
    step = hands.mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=dt)
    return MappedSample(step, q, wrist)


def _map_landmarks(hands: Hands, landmarks: np.ndarray, dt: float) -> MappedSample:
    """Map landmarks by way of the joint angles that fit them.

    Only this function knows how landmarks reach the mapper.
    """
    fitter = hands.fitter
    if fitter is None:
        raise RefusedError("invalid", "this session has no hand for landmarks", field="landmarks")
    q, wrist, _ = with_field_errors("landmarks", lambda: fitter.fit(landmarks))
    return MappedSample(hands.mapper.map_step(q, wrist, dt=dt), q, wrist)
