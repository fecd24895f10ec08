"""Samples of clients: their kinds, and the way through the mapper to the values of commands."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from handmap_qp.apps.service.opening import Hands
from handmap_qp.client.messages import Detail, Lengths, Open, Pose, Step
from handmap_qp.errors import RefusedError
from handmap_qp.hands.human import HumanLengths
from handmap_qp.human.sample import LANDMARK_COUNT, HumanSample
from handmap_qp.mapping.step import MapStep
from handmap_qp.trackers.layouts import LAYOUTS
from handmap_qp.trackers.layouts.base import Layout
from handmap_qp.trackers.layouts.tables import load_layout

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


class SampleForm:
    """What the samples of a session hold.

    Args:
        request: The request that opened the session.

    Raises:
        RefusedError: If there is no such layout, or it is given with another kind of samples.
    """

    def __init__(self, request: Open) -> None:
        self._kind, self._side = request.input, request.side
        self._field, self._layout = request.input, _layout_of(request)
        if self._layout is not None:
            self._field = "values"

    def check(self, sample: Step) -> None:
        """Reject a sample of another kind than the session was opened for.

        Raises:
            RefusedError: With the field that is missing or must be left out.
        """
        for field in _FIELDS:
            is_given = getattr(sample, field) is not None
            if is_given != (field == self._field):
                self._check_field(field, sample)
        if not sample.valid and self._kind != "landmarks":
            raise _invalid("valid", "only landmarks may be invalid")
        if self._kind == "q" and sample.wrist is None:
            raise _invalid("wrist", "missing; it must come with q")
        if sample.landmarks is not None and len(sample.landmarks) != LANDMARK_COUNT:
            message = f"expected {LANDMARK_COUNT} points, got {len(sample.landmarks)}"
            raise _invalid("landmarks", message)

    def _check_field(self, field: str, sample: Step) -> None:
        """Refuse a field that should not be given, or that is missing where it is needed."""
        if field != self._field:
            wanted = (
                self._kind if self._layout is None else f"values of {self._layout.name}"
            )
            raise _invalid(field, f"this session was opened for {wanted}")
        if sample.valid or self._kind != "landmarks":
            raise _invalid(field, "missing; this session was opened for it")

    def human_sample(self, sample: Step) -> HumanSample:
        """Convert a sample of landmarks that `check` accepted.

        Raises:
            HandmapError: If the numbers are not of the layout.
        """
        wrist = to_matrix(sample.wrist)
        if sample.values is not None and self._layout is not None:
            return self._layout.read(
                np.array(sample.values),
                time=sample.time,
                side=self._side,
                wrist=wrist,
                valid=sample.valid,
                confidence=sample.confidence,
            )
        landmarks = _UNSEEN if sample.landmarks is None else np.array(sample.landmarks)
        return HumanSample(
            sample.time, self._side, landmarks, wrist, sample.valid, sample.confidence
        )

    def map(
        self, hands: Hands, sample: Step, dt: float, arrival: float | None = None
    ) -> MappedSample:
        """Map a sample that `check` accepted.

        Args:
            hands: The hands of the session.
            sample: The sample.
            dt: Time that the command may account for [s].
            arrival: When it arrived, on a monotonic clock [s]; None for simulated time.

        Raises:
            HandmapError: If the sample cannot be used; the mapper is then unchanged.
        """
        if hands.palm is not None:
            human = self.human_sample(sample)
            step = hands.follower.map_sample(human, dt=dt, arrival=arrival)
            if step.rule == "size":
                # Other units than metres are a mistake of the client, which must know.
                hands.palm.check(human.landmarks)
            return MappedSample(step, landmarks=human.landmarks)
        wrist = to_matrix(sample.wrist)
        if sample.points is not None:
            return MappedSample(hands.mapper.map_points(sample.points, wrist, dt=dt))
        q = np.array(sample.q, dtype=float)
        # `check` requires a wrist with q.
        step = hands.mapper.map_step(q, np.eye(4) if wrist is None else wrist, dt=dt)
        return MappedSample(step, human_q=q)


def _layout_of(request: Open) -> Layout | None:
    name = request.layout
    if name is None:
        return None
    if request.input != "landmarks":
        raise _invalid("layout", "needs input=landmarks")
    # Only layouts of the package: a name must not open files of the server.
    if name not in LAYOUTS:
        raise _invalid("layout", f"no layout {name!r}; there are {', '.join(LAYOUTS)}")
    return load_layout(name)


def _invalid(field: str, message: str) -> RefusedError:
    return RefusedError("invalid", message, field=field)


def to_row(values: np.ndarray) -> tuple[float, ...]:
    """Convert an array (n,) to floats."""
    return tuple(values.tolist())


def to_pose(matrix: np.ndarray | None) -> Pose | None:
    """Convert a pose (4, 4), if there is one, to position and quaternion."""
    return None if matrix is None else Pose.from_matrix(matrix)


def to_matrix(pose: Pose | None) -> np.ndarray | None:
    """Convert a pose of a message, if there is one, to (4, 4)."""
    return None if pose is None else pose.matrix


def to_lengths(lengths: HumanLengths | None) -> Lengths | None:
    """Convert a measured hand to rows of numbers."""
    if lengths is None:
        return None
    return Lengths(
        *(getattr(lengths, name).tolist() for name in Lengths.__struct_fields__)
    )


def to_detail(mapped: MappedSample) -> Detail | None:
    """Convert every stage of a step; None if its method has no T."""
    step, results = mapped.step, mapped.step.diagnostics
    if "motion" not in results:
        return None
    arrays = {
        "human_points": step.human_points,
        "human_q": mapped.human_q,
        "landmarks": mapped.landmarks,
        "pivot": results["pivot_image"],
        "targets": step.targets,
        "points": step.points,
    }
    for name in ("motion", "motion_rigid", "motion_deformation", "stretches"):
        arrays[name] = results[name]
    rows: dict[str, Any] = {
        name: None if array is None else array.tolist()
        for name, array in arrays.items()
    }
    return Detail(human_wrist=to_pose(step.human_wrist), **rows)


_UNSEEN = np.full((LANDMARK_COUNT, 3), np.nan)
