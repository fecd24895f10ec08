"""A session of the mapping service, shown and steered from here: `ServiceSession`."""

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import partial
from itertools import count
from operator import itemgetter, or_
from pathlib import Path
from time import monotonic, sleep
from typing import Any

import msgspec
import numpy as np

from handmap_core.client import Command, KeyFiles
from handmap_core.client.messages import Pose, State
from handmap_core.errors import HandmapError, InvalidInputError
from handmap_core.se3 import rigid_fit
from handmap_qp.apps.connection import FAILURES, connected, only_session
from handmap_qp.hands import (
    Hand,
    HumanLengths,
    Values,
    hand_files,
    joined,
    load_whole,
    robot_files,
)
from handmap_qp.human import LandmarkFitter
from handmap_qp.mapping import (
    IK_NAMES,
    Choice,
    assumed_note,
    preset_choice,
    slow_note,
)
from .sample import HumanView, ViewSample

# Longest wait for an answer once the session is shown [s].
_TIMEOUT = 1.0
# Period of status requests [s].
_STATUS_PERIOD = 1.0
# Longest wait for a command, and so the longest delay of a request [s].
_WAIT = 0.02
# Session properties that determine the view's hands and whether it can steer.
_HANDS = itemgetter(
    "robot",
    "side",
    "input",
    "lengths",
    "human_points",
    "robot_points",
    "mount",
    "is_shared",
)
# Numbers of a human hand in a command's detail, where they are known.
_ARRAYS = (
    "human_points",
    "human_q",
    "landmarks",
    "motion_deformation",
    "pivot",
)


class ServiceSession:
    """One session of a mapping service.

    Args:
        host: `HOST` or `HOST:PORT` of the service's requests.
        session: Public name of the session; the only open session if omitted.
        robot: Path of its hand.yaml or robot.yaml, if its name is not known on this machine.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service; None for a plain
            one.
        patience: How long to wait for the session, and for its human hand to be measured [s].

    Attributes:
        name: Public name of the session.
        human: The human hand, with the lengths that the service has measured.
        robot: The robot hand, with the reference points that the method in force moves.
        choice: Preset and options in force at the last status request.
        is_shared: Whether it can be steered from here.
        is_released: Whether the robot is released, by its client or by a view.
        stop_number: Number of the emergency stop in force; 0 for none.
        is_outdated: Whether the session has changed to other hands.
        last_error: Why the last request failed; None if it succeeded.
        slow_note: Lines if the robot's joints are slower than a person, or if assumed speed limits
            hold them, at the last status request; empty if not, or if the service does not know.

    Raises:
        InvalidInputError: If the service cannot be reached, or the session cannot be shown.
        HandError: If the robot hand is not known on this machine.
        MissingExtraError: If the service's packages are not installed.
    """

    _start = 0.0
    _is_read = _is_closed = is_outdated = is_released = False
    stop_number = 0
    slow_note = ""
    last_error: HandmapError | None = None

    def __init__(
        self,
        host: str,
        *,
        session: str | None = None,
        robot: str | Path | None = None,
        keys: KeyFiles | None = None,
        patience: float = 10.0,
    ) -> None:
        self._host = host
        self._details = [{}, {}]
        self._requests = deque[Callable[[], Any]]()
        with connected("--live", host, keys, refused="--live") as self._client:
            about = self._find_session(session, monotonic() + patience)
            self.is_shared = about["is_shared"]
            if not (about["has_detail"] or self.is_shared):
                raise self._error(
                    "the session does not send enough detail to be shown",
                    "open it with has_detail=True or is_shared=True",
                )
            self._about = _HANDS(about)
            self.choice = _choice(about)
            robot = str(robot or about["robot"])
            if robot == about["robot"] and robot not in hand_files() | robot_files():
                raise self._error(
                    f"the session's hand {robot!r} is not known on this machine",
                    "give its hand.yaml or robot.yaml with --robot",
                )
            self._load_hands(robot, about)
        self._client.timeout = _TIMEOUT

    def __iter__(self) -> Iterator[ViewSample]:
        """Yield a sample per command until `close` or until the hands change; carry out requests.

        Raises:
            InvalidInputError: If the session's robot is not `robot`.
        """
        self._is_read = True
        next_status = -np.inf
        with self._client as client:
            while not self._is_closed:
                self._carry_out_requests()
                if monotonic() >= next_status:
                    self._update_status()
                    next_status = monotonic() + _STATUS_PERIOD
                if not (command := client.latest(_WAIT)):
                    continue
                if not self._is_as_before(command):
                    self._update_status()
                if self.is_outdated:
                    return
                if command.joint_names != self.robot.joint_names:
                    raise InvalidInputError(
                        f"session {self.name} is of another hand than {self.robot.name}, "
                        f"with the joints {', '.join(command.joint_names)}",
                        argument="--robot",
                        value=self.robot.name,
                    )
                if sample := self._sample(command):
                    yield sample

    @property
    def is_busy(self) -> bool:
        """Whether requests are pending."""
        return bool(self._requests)

    def close(self) -> None:
        """Stop reading."""
        self._is_closed = True
        if not self._is_read:
            self._client.close()

    def request(self, name: str, *values: Any, **fields: Any) -> None:
        """Request what a method of `Client` does, such as `disengage`, `stop` or `configure`.

        A stop works also where nothing else can be steered. After `clear`, the robot is disengaged.
        """
        self._requests.append(partial(getattr(self._client, name), *values, **fields))

    def configure(self, changes: Values) -> None:
        """Request another preset or other values of some options, as in `Choice`."""
        rest = dict(changes)
        preset = rest.pop("preset", None)
        ik = {name: rest.pop(name) for name in rest.keys() & IK_NAMES}
        self.request("configure", preset=preset, options=rest, ik=ik)

    def _carry_out_requests(self) -> None:
        """Carry out pending requests and record their outcome."""
        while self._requests:
            self.last_error = None
            try:
                self._requests[0]()
            except FAILURES as error:
                self.last_error = self._error(str(error))
            self._update_status()
            # Remove it only now, so that `is_busy` holds until the outcome is known.
            self._requests.popleft()

    def _update_status(self) -> None:
        """Read the session's status if the service answers; its client may have reopened it."""
        try:
            state = self._client.status()
            about = state.about or {}
            if self.is_shared and about["is_shared"] and not about["has_detail"]:
                self._client.configure(has_detail=True)
            self.is_outdated = _HANDS(about) != self._about
            before = self.choice
            self.choice = _choice(about)
            if type(before.method) is not type(self.choice.method):
                self.robot = self._with_method_points()
        except (*FAILURES, LookupError):
            return
        self.is_released = state.is_released
        self.stop_number = state.stop
        self.slow_note = _slow_lines(state)

    def _find_session(self, session: str | None, end: float) -> Values:
        """Wait until a session is open and its human hand is measured; return its properties."""
        while True:
            self.name = only_session(self._client, session)
            problem = "no session is open there"
            advice = "start a client that opens one"
            if self.name:
                state = self._client.watch(self.name)
                self.is_released = state.is_released
                self.slow_note = _slow_lines(state)
                about = state.about or {}
                if about["lengths"] is not None or about["input"] != "landmarks":
                    return about
                problem = "the human hand has not been measured yet"
                advice = "check that its client sends landmarks"
            if monotonic() > end:
                raise self._error(problem, advice)
            sleep(0.1)

    def _load_hands(self, robot: str, about: Values) -> None:
        """Load the hands of the session."""
        points = about["robot_points"]
        self._given_robot = load_whole(
            robot, points, side=about["side"], mount=about["mount"]
        )
        sides = [hand.side for hand in self._given_robot.parts] or [about["side"]]
        measured = about["lengths"]
        lengths = measured and HumanLengths(**measured)
        # Landmarks are mapped as they are; joint angles are fitted for drawing only.
        self._fitters = [LandmarkFitter(side, lengths) for side in sides]
        points = about["human_points"]
        humans = [fitter.human.with_points(points) for fitter in self._fitters]
        self.human = joined("human", *humans)
        self.robot = self._with_method_points()

    def _with_method_points(self) -> Hand:
        """Return the robot hand with the reference points that the method in force moves."""
        given = self._given_robot
        bound = map(self.choice.method.bind, self.human.hands, given.hands)
        hands = [each.robot for each in bound]
        return joined(given.name, *hands) if given.parts else hands[0]

    def _is_as_before(self, command: Command) -> bool:
        """Return whether a command fits the session properties read last."""
        details = self._details_of(command)
        if command.point_error and self.is_shared and not any(details):
            # The client reopened the session, which lost the request for details.
            return False
        count = len(self.human.hands[0].reference_points)
        return (
            command.joint_names == self.robot.joint_names
            and all(len(each["human_points"]) == count for each in details if each)
            and len(command.point_error) in (0, len(self.robot.reference_points))
        )

    def _details_of(self, command: Command) -> list[Values]:
        """Return the detail of each hand of a command; empty where there is none."""
        states = [command.hands.get(hand.side, command) for hand in self.robot.hands]
        return [msgspec.to_builtins(each.detail) or {} for each in states]

    def _sample(self, command: Command) -> ViewSample | None:
        """Convert a command to a sample; None if it has nothing to show."""
        self.is_released = "released" in command.flags
        found = self._details_of(command)
        # Commands of a held robot have no detail: keep the last one.
        self._details = details = [*map(or_, self._details, found)]
        if not any(details) or command.wrist is None:
            return None
        self._start = self._start or command.server_time
        robot = self.robot
        q = np.array(command.q)
        wrist = command.wrist.matrix
        targets = [row for each in details for row in each.get("targets", ())]
        # The last detail of a held robot may be of another method.
        is_led = not self.is_released and len(targets) == len(robot.reference_points)
        return ViewSample(
            time=command.server_time - self._start,
            robot_q=q,
            robot_wrist=wrist,
            robot_points=robot.points(q, wrist if robot.is_floating else None),
            targets=np.array(targets) if is_led else None,
            is_limited=np.isin(robot.joint_names, command.at_limit),
            status=command.status,
            held_by=max(each.get("held_by", ()) for each in details),
            rule=command.rule,
            duration=command.solve_time,
            is_seen=any(found),
            humans=[*map(self._human, details, count())],
        )

    def _human(self, detail: Values, k: int) -> HumanView:
        """Return the k-th human hand by the detail of a command."""
        if not detail:
            return HumanView()
        rows = {
            name.removeprefix("human_"): np.array(detail[name])
            for name in _ARRAYS
            if detail.get(name)
        }
        shown = HumanView(**rows)
        if shown.landmarks is not None:
            with suppress(InvalidInputError):
                q, wrist = self._fitters[k].fit(shown.landmarks)
                return shown._replace(q=q, wrist=wrist)
        if given := detail["human_wrist"]:
            wrist = msgspec.convert(given, Pose).matrix
        else:
            # Estimate it by a rigid fit of the hand at rest.
            human = self.human.hands[k]
            wrist = rigid_fit(human.points(human.rest, np.eye(4)), rows["points"])
        return shown._replace(wrist=wrist)

    def _error(self, problem: str, advice: str = "") -> InvalidInputError:
        return InvalidInputError(
            f"{self._host}: {problem}",
            argument="--live",
            value=self._host,
            advice=advice,
        )


def _slow_lines(state: State) -> str:
    """Return what people must know of the robot's speeds; servers before a field do not send it."""
    lines = [
        slow_note(state.fist) if state.fist else "",
        assumed_note(state.assumed_speed) if state.assumed_speed else "",
    ]
    return "\n\n".join(filter(None, lines))


def _choice(about: Values) -> Choice:
    return preset_choice(about["preset"]).with_changes(about["options"] | about["ik"])
