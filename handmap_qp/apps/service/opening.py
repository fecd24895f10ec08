"""From an `open` request to the hands and the mapper of a session.

Loading and measuring take some 100 ms, so they run in a thread. Errors of the library become
refusals that name a field of the request.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
from msgspec import structs

from handmap_core.client.messages import Configure, Open, Step, with_changes
from handmap_core.errors import (
    HandError,
    HandmapError,
    InvalidInputError,
    InvalidOptionsError,
    RefusedError,
)
from handmap_core.options import Options
from handmap_core.se3 import Array
from handmap_qp.hands import (
    HUMAN_HANDS,
    Hand,
    HumanLengths,
    Mount,
    Side,
    Values,
    hand_files,
    joined,
    load_hand,
    load_robot,
    missing_hands,
    read_document,
    read_hand_spec,
    read_robot_spec,
    robot_files,
    sided_name,
)
from handmap_qp.human import (
    TOUCH_GAP,
    ContactGapMeter,
    HumanSample,
    Recording,
    Rule,
    check_length,
    clipped_gap,
    human_name,
    measure_hand,
    smallest_gap,
)
from handmap_qp.ik import PointIk
from handmap_qp.mapping import (
    IK_NAMES,
    Choice,
    FistTime,
    HandMapper,
    LandmarkReader,
    MeshShape,
    RobotMapper,
    find_alignment,
    fist_time,
    kept_options,
    known_options,
    parse_object,
    preset_choice,
    preset_with,
)
from handmap_qp.mapping.hand_pair import hand_pair
from handmap_qp.stream import (
    Follower,
    GripFollower,
    GripOptions,
    ObjectFollower,
    RobotFollower,
    RobotGripFollower,
    StreamGuard,
    gripping,
)
from handmap_qp.trackers import LAYOUTS, SIDES
from .safety import refuse_if

CALIBRATION_SAMPLES = 30
"""Number of landmark samples that the human hand is measured from."""
SOLVERS = ("daqp",)
"""Solvers that a client may choose. The time of others is not bounded, and all sessions would wait:
with a large weight, ProxQP took 97 s for one sample."""
MOST_ITERATIONS = 20
_CACHED_HANDS = 32
_PERIOD = 1.0 / 60.0
"""Usual time between the samples [s]; gaps are medians over 0.1 s."""
_LONGEST_MESSAGE = 400
_FIELDS = {"human_q": "q", "wrist_pose": "wrist", "method": "preset"} | {
    name: name for name in (*Open.__struct_fields__, *Step.__struct_fields__)
}
"""Fields of requests by the arguments and choices of the library that take them."""

_OF_ROBOT = {"input": "landmarks"} | dict.fromkeys(("mount", "robot_points", "object"))
"""The only values of fields that a robot with two hands may be opened with."""

Gripping = GripFollower | RobotGripFollower
AnyFollower = Follower | RobotFollower | Gripping | ObjectFollower
Defer = Callable[..., Future["Hands"]]
"""Runs a function with its arguments in another thread, as `Executor.submit` does."""


def refused(error: Exception, field: str = "") -> RefusedError:
    """Return an error of the library, or of a computation, as a refusal.

    Args:
        error: The error; its attributes name the argument or option at fault.
        field: The field at fault, if the error does not name another one.
    """
    if isinstance(error, RefusedError):
        return error
    message = str(error)
    if isinstance(error, HandError):
        # Clients must not learn the server's paths.
        message = f"{error.key}: {error.problem}" if error.key else error.problem
    elif isinstance(error, InvalidInputError | InvalidOptionsError):
        named = error.argument or error.option
        if own := _field_of(named):
            field = own
            message = message.removeprefix(f"{named}: ")
    elif not isinstance(error, HandmapError):
        message = f"cannot be used: {error}"
    message = " ".join(message.split())[:_LONGEST_MESSAGE]
    return RefusedError("invalid", message, field=field)


def _field_of(named: str) -> str:
    """Return the field of a request for an argument or option such as `human_q`, `points[3]`."""
    name, bracket, index = named.partition("[")
    if name in known_options():
        return f"{'ik' if name in IK_NAMES else 'options'}.{name}"
    return f"{_FIELDS[name]}{bracket}{index}" if name in _FIELDS else ""


@contextmanager
def naming_field(field: str) -> Iterator[None]:
    """Raise errors of the library as refusals of a field.

    Raises:
        RefusedError: With the field that the error names, or else `field`.
    """
    try:
        yield
    except (HandmapError, ValueError, ArithmeticError) as error:
        raise refused(error, field) from error


@contextmanager
def naming_option(robot: Hand, choice: Choice) -> Iterator[None]:
    """Raise errors of a mapper that is made or configured as refusals of options.

    Args:
        robot: The robot hand.
        choice: The options.

    Raises:
        RefusedError: With the option at fault. If the error names none: `ik` if the QP alone cannot
            be set up; else `options`.
    """
    try:
        with naming_field("options"):
            yield
    except RefusedError:
        with naming_field("ik"):
            PointIk(robot, choice.ik)
        raise


class HandCache:
    """The hands and robots that clients may open, by name.

    Sessions share a `Hand`, because it does not change. Threads may share the cache.

    Args:
        files: Further robot hands, and robots with two: paths of `hand.yaml` and `robot.yaml`
            files. Clients never name paths.

    Raises:
        HandError: If one cannot be read, or two have the same name.

    Attributes:
        robots: Names of the robot hands that are installed.
        missing: Why each hand that is not installed cannot be opened, by name.
        two_handed: Names of the robots with two hands.
    """

    def __init__(self, files: Sequence[Path] = ()) -> None:
        hands = hand_files()
        robots = robot_files()
        for name in HUMAN_HANDS:
            del hands[name]
        self.missing = missing_hands()
        for file in files:
            has_hands = "hands" in read_document(file)
            name = (read_robot_spec if has_hands else read_hand_spec)(file).name
            if name in {*hands, *robots} - self.missing.keys():
                problem = f"there is already a hand {name!r}"
                raise HandError(problem, file=file, key="name", value=name)
            (robots if has_hands else hands)[name] = file
            self.missing.pop(name, None)
        self.robots = tuple(name for name in hands if name not in self.missing)
        self.two_handed = tuple(robots)
        self._files = hands | robots
        self._load = lru_cache(maxsize=_CACHED_HANDS)(load_hand)
        self._load_robot = lru_cache(maxsize=_CACHED_HANDS)(load_robot)

    def robot(
        self,
        name: str,
        points: str | None,
        mount: Mount | None,
        side: Side | None = None,
    ) -> Hand:
        """Return a robot hand, or a robot with two.

        Args:
            name: Its name, or that of its family, such as `allegro`.
            points: Set of reference points; the hand's own if None, as a robot's always are.
            mount: How its wrist is mounted; as in the description if None, likewise.
            side: Which hand of a family; none of them is found if None.

        Raises:
            RefusedError: If no hand has this name, or it cannot be loaded so.
        """
        name = sided_name(name, side, self._files)
        known = self.robots + self.two_handed
        message = f"no hand {name!r:.80}; there are {', '.join(known)}"
        refuse_if(name not in self._files, message, "robot")
        file = self._files[name]
        with naming_field("robot"):
            if name in self.two_handed:
                return self._load_robot(file)
            return self._load(file, points=points, mount=mount)

    def human(
        self, side: Side, points: str | None, lengths: HumanLengths | None = None
    ) -> Hand:
        """Return a human hand, of the model's size without lengths."""
        load = self._load if lengths is None else load_hand
        return load(human_name(side), points=points, lengths=lengths)


class Hands(NamedTuple):
    """The hands of a session and what maps between them.

    Attributes:
        mapper: Maps the human hand to the robot hand, or both to a robot.
        follower: Lets the mapper follow samples of landmarks, and grip or touch an object.
        robot: The robot hand with the reference points of the request; of two, the first.
        choice: Preset and options of the mapper.
        lengths: The measured human hand, of two one of them; None for the model's own.
        calibration: Measures the human hand from the first landmarks, if it is not known; until
            then it is the model's own.
        gap_meter: Measures the contact gap by touches, if nobody gave it.
        fist: How long the robot takes for a fist; None if the default preset cannot map to it.
    """

    mapper: HandMapper | RobotMapper
    follower: AnyFollower
    robot: Hand
    choice: Choice
    lengths: HumanLengths | None
    calibration: "Calibration | None"
    gap_meter: ContactGapMeter | None
    fist: FistTime | None = None


def prepare_hands(
    request: Open,
    cache: HandCache,
    measured: Mapping[Side, HumanLengths] = {},
    defer: Defer | None = None,
) -> Hands:
    """Make the mapper of a session.

    Args:
        request: The client's request.
        cache: The hands that clients may open.
        measured: The human hands as measured from landmarks, by side; one that is missing is as
            large as the other. The request decides if empty.
        defer: Runs a measurement, which takes some 200 ms, in another thread; nothing is measured
            if omitted.

    Raises:
        RefusedError: With the field at fault.
    """
    robot = cache.robot(
        request.robot, request.robot_points, request.mount, request.side
    )
    hands = {request.side: robot}
    if robot.parts:
        for field, only in _OF_ROBOT.items():
            message = f"expected {only or 'none'} for a robot with two hands"
            refuse_if(getattr(request, field) != only, message, field)
        hands = robot.by_side
    first, hand = next(iter(hands.items()))
    with naming_field("lengths"):
        lengths = next(iter(measured.values()), _human_lengths(request))
    points = request.human_points

    def load(side: Side) -> Hand:
        human = cache.human(side, points, measured.get(side, lengths))
        gap = request.contact_gap
        return human if gap is None else human.with_contact_gap(gap)

    has_landmarks = request.input == "landmarks"
    with naming_field("human_points"):
        humans = {side: load(side) for side in hands}
        human = humans[first]
        if has_landmarks:
            # Reject reference points that are no landmarks now, not at the first sample.
            LandmarkReader(human)
    choice = read_choice(request, human, hand)
    mapping: Any = partial(HandMapper, human, hand)
    following: Any = Follower
    if robot.parts:
        mapping, following = partial(RobotMapper, robot, humans), RobotFollower
    with naming_option(hand, choice):
        mapper = mapping(choice.method, ik=choice.ik)
    # `configure` may ask for it in the event loop; matching the hands takes some 100 ms.
    with suppress(HandmapError):
        for side in humans:
            hand_pair(humans[side], hands[side])
    fist = None
    with suppress(HandmapError):
        fist = fist_time(joined("human", *humans.values()), robot)
    rejoin = "clutch" if request.resume == "engage" else "glide"
    follower = _holding(following(mapper, rejoin=rejoin), request)
    calibration = None
    if has_landmarks and lengths is None and defer is not None:
        calibration = Calibration(request, cache, defer)
    is_known = request.contact_gap is not None or "contact_gap" in request.options
    gap = None if robot.parts or is_known else choice.method.values.get("contact_gap")
    gap_meter = None if gap is None else ContactGapMeter(gap)
    return Hands(mapper, follower, hand, choice, lengths, calibration, gap_meter, fist)


def read_grip(request: Open) -> GripOptions | None:
    """Read how a session grips, if it may; errors are as in `read_choice`.

    It does so by default, but for an `object`, whose fingers press only where it is asked for.
    """
    given = request.grip
    if given is False or (given is None and request.object is not None):
        return None
    is_given = isinstance(given, dict)
    return _changed("grip", GripOptions(), given if is_given else {})


def _holding(follower: Follower | RobotFollower, request: Open) -> AnyFollower:
    """Let a follower grip if it can, or touch and press the object of a request."""
    given = request.object
    options = read_grip(request)
    if given is not None:
        refuse_if(request.input != "landmarks", "needs input=landmarks", "object")
        with naming_field("object"):
            is_named = isinstance(given, str)
            shape = (
                parse_object(given, "object")
                if is_named
                else MeshShape(np.array(given))
            )
            # A robot with two hands was refused before.
            single = cast(Follower, follower)
            return ObjectFollower(single, shape, grip=options)
    is_asked = bool(request.grip) or request.grip == {}
    has_landmarks = request.input == "landmarks"
    refuse_if(is_asked and not has_landmarks, "needs input=landmarks", "grip")
    if options is None or not has_landmarks:
        return follower
    try:
        return gripping(follower, options)
    except InvalidInputError as error:
        if is_asked:
            raise refused(error, "grip") from error
        return follower


def _human_lengths(request: Open) -> HumanLengths | None:
    """Return the measured hand if the request has one."""
    given = request.lengths
    length = request.hand_length
    if given is None:
        return None if length is None else HumanLengths.from_hand_length(length)
    refuse_if(length is not None, "give hand_length or lengths, not both", "lengths")
    return HumanLengths(**structs.asdict(given))


def read_choice(request: Open, human: Hand, robot: Hand) -> Choice:
    """Read preset and options from a request.

    Args:
        request: The request, with the changes of all `configure` since.
        human: The hand that leads.
        robot: The hand that follows.

    Raises:
        RefusedError: With the field at fault.
    """
    name = request.preset or preset_with(request.options, human, robot)
    with naming_field("preset"):
        start = preset_choice(name, human)
    found = find_alignment(start.method, robot, upright_of(request))
    method = _changed("options", start.method, found | request.options)
    ik = _changed("ik", start.ik, request.ik)
    message = f"expected one of {', '.join(SOLVERS)}, got {ik.solver!r:.40}"
    refuse_if(ik.solver not in SOLVERS, message, "ik.solver")
    message = f"expected at most {MOST_ITERATIONS}, got {ik.max_iterations}"
    refuse_if(ik.max_iterations > MOST_ITERATIONS, message, "ik.max_iterations")
    return Choice(name, method, ik)


def upright_of(request: Open) -> str:
    """Return the axes of the samples' world that are up and forward; empty if not known."""
    layout = LAYOUTS.get(request.layout or "")
    return request.upright or (layout.upright if layout else "")


def _changed(field: str, start: Options, values: Values) -> Any:
    """Return options with the values of a field of a request."""
    try:
        return start.replaced(**values)
    except InvalidOptionsError as error:
        message = ": ".join(filter(None, (error.what, error.advice)))
        place = f"{field}.{error.option:.64}"
        raise RefusedError("invalid", message, field=place) from error


def reopened(request: Open, preset: str, changes: Configure) -> Open:
    """Return the request that opens a session with changed options.

    Args:
        request: The request, with all changes before.
        preset: The preset in force.
        changes: The changes. Without a preset, options that are not named stay as they are.

    Raises:
        RefusedError: If there is no such preset, or no grip to change.
    """
    is_alien = read_grip(request) is None and changes.grip
    refuse_if(is_alien, "this session was opened without it", "grip")
    opened = structs.asdict(request) | {"preset": preset}
    if changes.grip and opened["grip"] is True:
        opened["grip"] = {}
    if changes.preset is not None:
        with naming_field("preset"):
            opened["options"] = kept_options(request.options, changes.preset)
    return structs.replace(request, **with_changes(opened, structs.asdict(changes)))


@dataclass(eq=False)
class Calibration:
    """Measure the human hands from landmarks, and prepare the hands of the session with them.

    Attributes are as in `prepare_hands`.
    """

    request: Open
    cache: HandCache
    defer: Defer

    def __post_init__(self) -> None:
        """Begin without samples."""
        self._guards = {s: StreamGuard(self.cache.human(s, None)) for s in SIDES}
        self._landmarks: dict[Side, list[Array]] = {side: [] for side in SIDES}
        self._work = None

    def add(self, sample: HumanSample) -> Rule:
        """Take one more sample of a hand, unless it makes no sense.

        Args:
            sample: The sample.

        Returns:
            What is wrong with the sample, which is then ignored; empty if nothing.

        Raises:
            RefusedError: If the landmarks are not a hand in metres; the sample is then ignored.
        """
        verdict = self._guards[sample.side].check(sample)
        if verdict.rule in ("missing", "zero"):
            return verdict.rule
        landmarks = sample.landmarks
        with naming_field("landmarks"):
            check_length(landmarks[None])
        # The person may be much larger or smaller than the model.
        if verdict.is_held and verdict.rule != "size":
            return verdict.rule
        if self._work is None:
            self._landmarks[sample.side].append(landmarks)
        return ""

    def result(self) -> Hands | None:
        """Return the hands, once they are ready.

        Raises:
            RefusedError: If the samples so far cannot be measured; then new ones are collected.
        """
        collected = self._landmarks
        if max(map(len, collected.values())) >= CALIBRATION_SAMPLES:
            self._landmarks = {side: [] for side in collected}
            self._work = self.defer(self._prepare, collected)
        if self._work is None or not self._work.done():
            return None
        work = self._work
        self._work = None
        return work.result()

    def _prepare(self, collected: dict[Side, list[Array]]) -> Hands:
        measured = {
            side: _measured(side, np.array(landmarks))
            for side, landmarks in collected.items()
            if len(landmarks) > CALIBRATION_SAMPLES // 2
        }
        return prepare_hands(self.request, self.cache, measured)


def _measured(side: Side, landmarks: Array) -> HumanLengths:
    """Measure a hand from its landmarks [m], shape (n, 21, 3)."""
    time = _PERIOD * np.arange(len(landmarks))
    is_valid = np.ones(len(landmarks), dtype=bool)
    recording = Recording("calibration", time, landmarks, is_valid, side)
    with naming_field("landmarks"):
        lengths = measure_hand(recording)
    # Without a touch, nothing was measured: the preset's own gap is the better guess.
    smallest = smallest_gap(time, landmarks)
    if smallest < TOUCH_GAP:
        lengths = structs.replace(lengths, contact_gap=clipped_gap(smallest))
    return lengths
