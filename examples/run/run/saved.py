"""`load` and `load_robot`: followers of what `handmap hands save` has written."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from handmap_core.hands.pad import Pad
from handmap_core.ik.options import IkOptions
from handmap_core.ik.tasks import PointDistances
from handmap_core.mapping.estimation import MotionEstimator
from handmap_core.stream.hand_grip import GripOptions
from handmap_core.stream.rejoin import RejoinKind
from handmap_core.stream.smoothing import Smoothing
from handmap_qp import __version__, mapping
from handmap_qp.errors import HandError
from handmap_qp.mapping.hand_mapper import HandMapper
from handmap_qp.mapping.methods import homogeneous, teleoperation
from handmap_qp.models import DistancesModel, EstimatorModel, TeleoperationModel
from handmap_qp.stream.follower import Follower
from .form import HAND, KIND, ROBOT, File, decode
from .gripping import GrippingFollower
from .hands import KINDS, Record
from .trackers.layouts import LAYOUTS, Layout

if TYPE_CHECKING:
    from .robot_gripping import GrippingRobotFollower

_MAKERS: dict[str, type] = {
    "DistancesModel": DistancesModel,
    "EstimatorModel": EstimatorModel,
    "Homogeneous": homogeneous.Homogeneous,
    "IkOptions": IkOptions,
    "Pad": Pad,
    "Teleoperation": teleoperation.Teleoperation,
    "TeleoperationModel": TeleoperationModel,
}
"""Kinds that are made of their fields by a call."""
_KINDS: dict[str, type] = {
    "BoundHomogeneous": homogeneous.BoundHomogeneous,
    "BoundTeleoperation": teleoperation.BoundTeleoperation,
    "MotionEstimator": MotionEstimator,
    "PointDistances": PointDistances,
    **KINDS,
}
_FORMS = {HAND: ("one hand", "load"), ROBOT: ("a robot with two hands", "load_robot")}
"""What files of each form have, and what reads them."""
_AGAIN = f"save it again, by handmap-qp {__version__}"


class _Method:
    """The method of saved hands, which is bound already."""

    def __init__(self, hands: Sequence[Any]) -> None:
        self._bound = {each.robot.side: each.bound for each in hands}

    def bind(self, human: Any, robot: Any) -> Any:
        del human
        return self._bound[robot.side]


def load(
    path: Path | str,
    *,
    rejoin: RejoinKind = "glide",
    smoothing: Smoothing | None = Smoothing(),
    grip: GripOptions | None = GripOptions(),
) -> GrippingFollower:
    """Return a follower of a saved hand; its first sample is the reference.

    Args:
        path: The file.
        rejoin: As of `Follower`.
        smoothing: As of `Follower`.
        grip: How the hand holds what it meets, where samples come with measured joints; None to
            hold nothing.

    Raises:
        HandError: If the file is not a saved hand, is damaged, or is of another version.
        OSError: If it cannot be read.
        InvalidInputError: If `smoothing` or `grip` is something else.
        InvalidOptionsError: If `rejoin` is.
    """
    with _opened(Path(path), HAND) as saved:
        mapper = HandMapper(saved.human, saved.robot, **_options([saved]))
    follower = Follower(mapper, rejoin=rejoin, smoothing=smoothing)
    return GrippingFollower(follower, grip)


def load_robot(
    path: Path | str,
    *,
    rejoin: RejoinKind = "glide",
    smoothing: Smoothing | None = Smoothing(),
    grip: GripOptions | None = GripOptions(),
) -> GrippingRobotFollower:
    """Return a follower of a saved robot with two hands; arguments and errors as of `load`.

    The first sample of each hand is its reference.
    """
    # Most programs have one hand.
    from handmap_qp.stream.robot_follower import RobotFollower
    from .robot_gripping import GrippingRobotFollower

    with _opened(Path(path), ROBOT) as saved:
        robot = saved.robot
        robot.parts = tuple(each.robot for each in saved.hands)
        for part in robot.parts:
            part.whole = robot
        humans = {each.robot.side: each.human for each in saved.hands}
        options = _options(saved.hands)
        mapper = mapping.RobotMapper(robot, humans, turns_in=saved.turns_in, **options)
    follower = RobotFollower(mapper, rejoin=rejoin, smoothing=smoothing)
    return GrippingRobotFollower(follower, grip)


def _options(hands: Sequence[Any]) -> dict[str, Any]:
    """Return what a mapper of saved hands is made of."""
    for each in hands:
        each.bound.human = each.human
        each.bound.robot = each.robot
    first = hands[0]
    LAYOUTS.update({name: Layout(order) for name, order in first.orders.items()})
    names = "ik", "dt", "joint_tolerance", "quat_order"
    return {"method": _Method(hands)} | {name: getattr(first, name) for name in names}


@contextmanager
def _opened(path: Path, form: int) -> Iterator[Any]:
    """Open a file, to make a mapper of what it has."""
    body = _read(path, form)
    try:
        yield _made(decode(body))
    except (AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        problem = f"it does not fit this version ({error}); {_AGAIN}"
        raise HandError(problem, file=path) from error


def _read(path: Path, form: int) -> bytes:
    """Read the body of a file, and check that it is whole, and of a form."""
    try:
        file = msgspec.msgpack.decode(path.read_bytes(), type=File)
    except msgspec.MsgspecError:
        file = None
    if file is None or file.kind != KIND:
        made = (
            "expected a saved hand (handmap hands save), got another or a damaged file"
        )
        raise HandError(made, file=path)
    if file.form not in _FORMS:
        newer = f"it is of form {file.form}, expected {max(_FORMS)} or less"
        raise HandError(f"{newer}; install a newer handmap-run", file=path)
    if file.version != __version__:
        other = f"it is of version {file.version}, expected {__version__}"
        raise HandError(f"{other}; {_AGAIN}", file=path)
    if zlib.crc32(file.body) != file.checksum:
        raise HandError("it is damaged; copy it again", file=path)
    if file.form != form:
        name, function = _FORMS[file.form]
        raise HandError(f"it is {name}; {function} reads it", file=path)
    return file.body


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
    if kind in _MAKERS:
        return _MAKERS[kind](**fields)
    # The core knows the shapes by the names of their kinds.
    found = object.__new__(_KINDS.get(kind) or type(kind, (Record,), {}))
    vars(found).update(fields)
    return found
