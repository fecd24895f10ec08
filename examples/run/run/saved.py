"""`load`: a follower of a hand that `handmap hands save` has written."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import msgspec

from handmap_qp import __version__
from handmap_qp.errors import HandError
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.tasks import PointDistances
from handmap_qp.mapping.estimation import MotionEstimator
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.methods import homogeneous, teleoperation
from handmap_qp.options import Options
from handmap_qp.stream.follower import Follower, RejoinKind, Smoothing
from .form import KIND, File, decode
from .hands import KINDS, Record
from .trackers.layouts import LAYOUTS, Layout

_OPTIONS: dict[str, type[Options]] = {
    "Homogeneous": homogeneous.Homogeneous,
    "IkOptions": IkOptions,
    "Teleoperation": teleoperation.Teleoperation,
}
_KINDS: dict[str, type] = {
    "BoundHomogeneous": homogeneous.BoundHomogeneous,
    "BoundTeleoperation": teleoperation.BoundTeleoperation,
    "MotionEstimator": MotionEstimator,
    "PointDistances": PointDistances,
    **KINDS,
}
_AGAIN = f"save it again, by handmap-qp {__version__}"


class _Method:
    """The method of a saved hand, which is bound already."""

    def __init__(self, bound: Any) -> None:
        self._bound = bound

    def bind(self, human: Any, robot: Any) -> Any:
        del human, robot
        return self._bound


def load(
    path: Path | str,
    *,
    rejoin: RejoinKind = "glide",
    smoothing: Smoothing | None = Smoothing(),
) -> Follower:
    """Return a follower of a saved hand; its first sample is the reference.

    Args:
        path: The file.
        rejoin: As of `Follower`.
        smoothing: As of `Follower`.

    Raises:
        HandError: If the file is not a saved hand, is damaged, or is of another version.
        OSError: If it cannot be read.
        InvalidOptionsError: If `rejoin` is something else.
    """
    path = Path(path)
    file = _read(path)
    try:
        saved = _made(decode(file.body))
        LAYOUTS.update({name: Layout(order) for name, order in saved.orders.items()})
        bound = saved.bound
        bound.human = saved.human
        bound.robot = saved.robot
        mapper = HandMapper(
            saved.human,
            saved.robot,
            _Method(bound),
            ik=saved.ik,
            dt=saved.dt,
            joint_tolerance=saved.joint_tolerance,
            quat_order=saved.quat_order,
        )
    except (AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        problem = f"it does not fit this version ({error}); {_AGAIN}"
        raise HandError(problem, file=path) from error
    return Follower(mapper, rejoin=rejoin, smoothing=smoothing)


def _read(path: Path) -> File:
    """Read a file, and check that it is whole and of this form."""
    try:
        file = msgspec.msgpack.decode(path.read_bytes(), type=File)
    except msgspec.MsgspecError:
        file = None
    if file is None or file.kind != KIND:
        made = (
            "expected a saved hand (handmap hands save), got another or a damaged file"
        )
        raise HandError(made, file=path)
    if file.version != __version__:
        other = f"it is of version {file.version}, expected {__version__}"
        raise HandError(f"{other}; {_AGAIN}", file=path)
    if zlib.crc32(file.body) != file.checksum:
        raise HandError("it is damaged; copy it again", file=path)
    return file


def _made(value: Any) -> Any:
    """Return the objects of what was saved: a mapping with the key "" has a kind."""
    if isinstance(value, tuple):
        return tuple(map(_made, value))
    if not isinstance(value, dict):
        return value
    fields = {name: _made(each) for name, each in value.items() if name}
    kind = value.get("")
    if kind is None:
        return fields
    if kind in _OPTIONS:
        return _OPTIONS[kind](**fields)
    # The core knows the shapes by the names of their kinds.
    found = object.__new__(_KINDS.get(kind) or type(kind, (Record,), {}))
    vars(found).update(fields)
    return found
