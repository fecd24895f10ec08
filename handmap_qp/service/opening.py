"""From an `open` request to the hands and the mapper of a session.

Runs in a thread, for it takes some 10 ms.
"""

from __future__ import annotations

import math
import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from handmap_qp.errors import HandError, HandmapError, InvalidInputError, RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import HUMAN_HANDS, hand_names, load_hand
from handmap_qp.hands.spec import Mount, Side, read_hand_spec
from handmap_qp.ik.options import IkOptions
from handmap_qp.ik.qp import PointIk
from handmap_qp.mapping.mapper import HandMapper
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.service.messages import Open
from handmap_qp.trackers.landmarks import LandmarkFitter, check_length, human_name, measure_hand
from handmap_qp.trackers.recording import Recording

SOLVERS = ("daqp",)
"""Solvers that a client may choose: the time of others is not bounded, and all sessions would wait.
With a large weight ProxQP was seen to take 97 s for one sample."""
MOST_ITERATIONS = 20
CALIBRATION_SAMPLES = 30
"""Landmark samples that the human hand is measured from."""
_CACHED_HANDS = 32
_T = TypeVar("_T")


@dataclass(frozen=True, slots=True, eq=False)
class Hands:
    """What a session maps with.

    Attributes:
        mapper: From the human hand to the robot's.
        fitter: From landmarks to the human hand; None where samples are joint angles or points.
        lengths: The human hand, measured; None for the model's own.
        needs_measuring: Whether the human hand is to be measured from the first landmarks, and is
            the model's own until then.
    """

    mapper: HandMapper
    fitter: LandmarkFitter | None
    lengths: HumanLengths | None
    needs_measuring: bool = False


Defer = Callable[[Callable[[], Hands]], "Future[Hands]"]
"""Runs slow work in another thread."""


class HandShelf:
    """The hands that clients may open, by name.

    Loaded once and shared, since a `Hand` does not change.

    Args:
        files: Further robot hands: paths of `hand.yaml` files. Clients never name paths.

    Raises:
        HandError: If one cannot be read, or two hands have one name.
    """

    def __init__(self, files: Sequence[Path] = ()) -> None:
        self._files: dict[str, Path | str] = {
            name: name for name in hand_names() if name not in HUMAN_HANDS
        }
        for file in files:
            spec = read_hand_spec(file)
            if spec.name in self._files:
                raise HandError(
                    f"there is already a hand {spec.name!r}", file=file, key="name", value=spec.name
                )
            self._files[spec.name] = file
        self._cache: OrderedDict[Hashable, Hand] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def robots(self) -> tuple[str, ...]:
        """Names of the robot hands."""
        return tuple(self._files)

    def robot(self, name: str, points: str | None, mount: Mount | None) -> Hand:
        """A robot hand.

        Raises:
            RefusedError: If there is none of this name, or it cannot be loaded so.
        """
        if name not in self._files:
            raise RefusedError(
                "invalid",
                f"no hand {name!r:.80}; there are {', '.join(self._files)}",
                field="robot",
            )
        file = self._files[name]
        return name_field(
            "robot",
            lambda: self._cached(
                (name, points, mount), lambda: load_hand(file, points=points, mount=mount)
            ),
        )

    def human(self, side: Side, points: str | None) -> Hand:
        """A human hand of the model's size."""
        name = human_name(side)
        return self._cached((name, points), lambda: load_hand(name, points=points))

    def _cached(self, key: Hashable, load: Callable[[], Hand]) -> Hand:
        with self._lock:
            if key in self._cache:
                self._cache.move_to_end(key)
                return self._cache[key]
        hand = load()
        with self._lock:
            self._cache[key] = hand
            if len(self._cache) > _CACHED_HANDS:
                self._cache.popitem(last=False)
        return hand


def prepare_hands(request: Open, shelf: HandShelf, lengths: HumanLengths | None = None) -> Hands:
    """Make the mapper of a session.

    Args:
        request: What the client wants.
        shelf: The hands there are.
        lengths: The human hand as it was measured from landmarks; what the request says if omitted.

    Returns:
        The mapper, and the fitter where landmarks come.

    Raises:
        RefusedError: Naming the field at fault.
    """
    if request.hand_length is not None and request.lengths is not None:
        raise RefusedError("invalid", "give hand_length or lengths, not both", field="lengths")
    mapping = read_options("mapping", request.mapping, MappingOptions)
    ik = read_ik(request.ik)
    robot = shelf.robot(request.robot, request.robot_points, request.mount)
    if lengths is None:
        lengths = name_field("lengths", lambda: _human_lengths(request))
    fitter = None
    if request.input == "landmarks":
        fitter = name_field("lengths", lambda: LandmarkFitter(request.side, lengths))
        human = name_field("human_points", lambda: fitter.human.with_points(request.human_points))
    elif lengths is None:
        human = name_field("human_points", lambda: shelf.human(request.side, request.human_points))
    else:
        name = human_name(request.side)
        human = name_field(
            "human_points", lambda: load_hand(name, points=request.human_points, lengths=lengths)
        )
    mapper = name_options(robot, ik, lambda: HandMapper(human, robot, mapping, ik=ik))
    return Hands(mapper, fitter, lengths, needs_measuring=fitter is not None and lengths is None)


class Calibration:
    """Measures the human hand from the first landmarks, and makes a session's hands anew with its lengths.

    Args:
        request: What the client opened the session with.
        shelf: The hands there are.
        defer: Runs what takes some 50 ms elsewhere.
    """

    def __init__(self, request: Open, shelf: HandShelf, defer: Defer) -> None:
        self._request = request
        self._shelf = shelf
        self._defer = defer
        self._landmarks: list[np.ndarray] = []
        self._work: Future[Hands] | None = None

    def add(self, landmarks: np.ndarray) -> Hands | None:
        """Take one more sample.

        Args:
            landmarks: Shape (21, 3) [m].

        Returns:
            The hands, once they are ready.

        Raises:
            RefusedError: If the sample is of no hand, and then as if it had not come; or if the
                samples so far do not make a hand, and the next ones are gathered anew.
        """
        name_field("landmarks", lambda: check_length(landmarks[None]))
        if self._work is None:
            self._landmarks.append(landmarks)
            if len(self._landmarks) >= CALIBRATION_SAMPLES:
                gathered, self._landmarks = np.array(self._landmarks), []
                self._work = self._defer(lambda: self._make(gathered))
        if self._work is None or not self._work.done():
            return None
        work, self._work = self._work, None
        return work.result()

    def _make(self, landmarks: np.ndarray) -> Hands:
        count = len(landmarks)
        is_valid = np.ones(count, dtype=bool)
        recording = Recording(
            "calibration", np.arange(count, dtype=float), landmarks, is_valid, self._request.side
        )
        lengths = name_field("landmarks", lambda: measure_hand(recording))
        return prepare_hands(self._request, self._shelf, lengths)


def read_options(field: str, values: dict[str, Any], kind: type[_T]) -> _T:
    """Options from what a client sent, strictly.

    Args:
        field: What the client calls them.
        values: Names and values.
        kind: The dataclass.

    Raises:
        RefusedError: Naming the option that is unknown, mistyped or out of range.
    """
    known = [item.name for item in fields(kind)]  # type: ignore[arg-type]
    for name in values:
        if name not in known:
            raise RefusedError(
                "invalid",
                f"no such option; there are {', '.join(known)}",
                field=f"{field}.{name:.64}",
            )
    try:
        return msgspec.convert(values, kind, strict=True)
    except msgspec.ValidationError as error:
        message, _, place = str(error).partition(" - at `$")
        name = place.rstrip("`").lstrip(".")
        if not name:
            head, _, rest = message.partition(":")
            name, message = (head, rest.strip()) if head in known else ("", message)
        raise RefusedError(
            "invalid", message, field=f"{field}.{name}" if name else field
        ) from error
    except (TypeError, OverflowError) as error:
        raise RefusedError("invalid", str(error), field=field) from error


def read_ik(values: dict[str, Any]) -> IkOptions:
    """The QP's options from what a client sent, within what a server can carry out in time.

    Raises:
        RefusedError: Naming the option at fault.
    """
    ik = read_options("ik", values, IkOptions)
    if ik.solver not in SOLVERS:
        raise RefusedError(
            "invalid",
            f"expected one of {', '.join(SOLVERS)}; got {ik.solver!r:.40}",
            field="ik.solver",
        )
    if ik.max_iterations > MOST_ITERATIONS:
        raise RefusedError(
            "invalid",
            f"expected at most {MOST_ITERATIONS}, got {ik.max_iterations}",
            field="ik.max_iterations",
        )
    return ik


def name_options(robot: Hand, ik: IkOptions, make: Callable[[], _T]) -> _T:
    """What `make` makes of options for mapping and QP.

    What it raises as a refusal of those that are at fault.

    Args:
        robot: The robot hand.
        ik: The QP's options.
        make: Makes or configures a mapper.

    Raises:
        RefusedError: Naming the option, or else `ik` where the QP cannot be set up by itself, and
            `mapping` where it can.
    """
    try:
        return name_field("mapping", make)
    except RefusedError:
        name_field("ik", lambda: PointIk(robot, ik))
        raise


def refused(error: HandmapError, field: str = "") -> RefusedError:
    """An error of the library as a refusal.

    The field is the name that the message begins with, as clients call it.
    """
    if isinstance(error, RefusedError):
        return error
    # The server's paths are no business of its clients.
    message = " ".join(str(error).replace(f"{getattr(error, 'file', None)}: ", "", 1).split())
    head, colon, rest = message.partition(": ")
    own = (
        (f"{field}.{head}" if head in _OPTIONS.get(field, ()) else _FIELDS.get(head, ""))
        if colon
        else ""
    )
    return RefusedError("invalid", (rest if own else message)[:400], field=own or field)


_FIELDS = {
    "human_q": "q",
    "wrist_pose": "wrist",
    "points": "points",
    "landmarks": "landmarks",
    "robot_q": "robot_q",
    "robot_wrist": "robot_wrist",
}
"""What clients call the arguments of `HandMapper`."""
_OPTIONS = {"mapping": MappingOptions.__slots__, "ik": IkOptions.__slots__}
"""Names of options by what clients call the whole of them."""


def name_field(field: str, make: Callable[[], _T]) -> _T:
    """What `make` makes; what it raises as a refusal of a field."""
    try:
        return make()
    except HandmapError as error:
        raise refused(error, field) from error
    except (ValueError, ArithmeticError, np.linalg.LinAlgError) as error:
        raise RefusedError("invalid", f"cannot be used: {error}"[:400], field=field) from error


def _human_lengths(request: Open) -> HumanLengths | None:
    """The hand's lengths as the client knows them."""
    lengths = request.lengths
    if lengths is None:
        return (
            None
            if request.hand_length is None
            else HumanLengths.from_hand_length(request.hand_length)
        )
    if not all(0.0 < math.hypot(*row) < 1.0 for row in (*lengths.bases, *lengths.segments)):
        raise InvalidInputError("expected lengths between 0 and 1 m")
    return HumanLengths(np.array(lengths.bases), np.array(lengths.segments))
