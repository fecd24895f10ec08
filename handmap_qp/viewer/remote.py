"""A session of the mapping service, as a `LiveSource`.

`ServiceSession` shows it, and steers it where its client shares it.
"""

from __future__ import annotations

import socket
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from handmap_qp.addresses import check_port
from handmap_qp.errors import HandmapError, InvalidInputError, MissingExtraError
from handmap_qp.hands.hand import Hand
from handmap_qp.hands.human import HumanLengths
from handmap_qp.hands.library import hand_names, load_hand
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.options import MappingOptions
from handmap_qp.trackers.landmarks import human_name
from handmap_qp.transform import rigid_fit
from handmap_qp.viewer.option_controls import Options, split_changes
from handmap_qp.viewer.replay import ViewSample

PORT = 5570
"""Where `handmap serve` takes requests, unless told otherwise."""
_TIMEOUT = 1.0
# A service that is still starting, or busy, gets longer for the first answers [s].
_FIRST_TIMEOUT = 3.0
# Between two looks at what the session is [s], and the longest that a wish waits for the next
# command.
_LOOK_PERIOD, _WAIT = 1.0, 0.02
# What the hands of the view, and whether it can steer, follow from.
_HANDS = ("robot", "side", "input", "lengths", "human_points", "robot_points", "mount", "is_shared")
_T = TypeVar("_T")


class ServiceSession:
    """One session of a mapping service.

    Args:
        host: `HOST` or `HOST:PORT` of the service's requests.
        session: Public name of the session; the only one that is open if omitted.
        robot: The robot hand, where its name does not lead to it here: the path of its hand.yaml.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service; None for a plain
            one.
        patience: How long to wait for the session, and for its human hand to be measured [s].

    Attributes:
        name: Public name of the session.
        human: The human hand, of the lengths that the service knows.
        robot: The robot hand.
        options: What was in force at the last look.
        is_shared: Whether it can be steered from here.
        is_released: Whether its client, or somebody here, has let go.
        is_outdated: Whether the session is of other hands by now.
        trouble: Why the last wish was not fulfilled; None where it was.

    Raises:
        InvalidInputError: If the service cannot be reached, or the session cannot be shown.
        HandError: If the robot hand is not known here.
        MissingExtraError: If the service's packages are not installed.
    """

    def __init__(
        self,
        host: str,
        *,
        session: str | None = None,
        robot: str | Path | None = None,
        keys: tuple[Path, Path] | None = None,
        patience: float = 10.0,
    ) -> None:
        try:
            import zmq

            from handmap_qp.client import Client, ServiceError, ServiceTimeoutError
        except ImportError as error:
            raise MissingExtraError("pyzmq", "service") from error
        self._host = host
        self._refusal = ServiceError
        self._troubles = (
            ServiceError,
            ServiceTimeoutError,
            zmq.ZMQError,
            msgspec.MsgspecError,
            OSError,
            ValueError,
            TypeError,
        )
        self._is_closed, self._is_read = threading.Event(), False
        self._start: float | None = None
        self._detail: dict[str, Any] = {}
        self._wishes: deque[Callable[[], Any]] = deque()
        self.is_outdated, self.is_released = False, False
        self.trouble: HandmapError | None = None
        address = _address(host)
        self._client = self._try(lambda: Client(address, timeout=_FIRST_TIMEOUT, keys=keys))
        try:
            about = self._look_for(session, time.monotonic() + patience)
            self.is_shared: bool = about["is_shared"]
            if not (about["has_detail"] or self.is_shared):
                raise self._error(
                    "the session tells too little to be seen: open it with has_detail=True or is_shared=True"
                )
            self._about = {name: about[name] for name in _HANDS}
            self.options = _options(about)
            lengths = about["lengths"] and HumanLengths(
                **{name: np.array(rows) for name, rows in about["lengths"].items()}
            )
            self.human = load_hand(
                human_name(about["side"]), points=about["human_points"], lengths=lengths or None
            )
            self.robot = self._load_robot(robot or about["robot"], about)
        except BaseException:
            self._client.close()
            raise
        self._client.timeout = _TIMEOUT
        self._rest_points = self.human.points(self.human.rest, np.eye(4))

    def __iter__(self) -> Iterator[ViewSample]:
        """Samples as commands come, until `close`, or until the session is of other hands.

        Carries out wishes meanwhile.

        Raises:
            InvalidInputError: If the session is of another robot than `robot`.
        """
        self._is_read, next_look = True, -np.inf
        with self._client as client:
            while not self._is_closed.is_set():
                self._fulfil_wishes()
                if time.monotonic() >= next_look:
                    self._look()
                    next_look = time.monotonic() + _LOOK_PERIOD
                try:
                    command = client.latest(_WAIT)
                except self._refusal:
                    # Of a sample that the service could not use; its client has been told.
                    continue
                if command is None or command.wrist is None:
                    continue
                if not self._is_as_before(command):
                    self._look()
                    if not self.is_outdated and command.joint_names != self.robot.joint_names:
                        raise InvalidInputError(
                            f"--robot {self.robot.name}: session {self.name} is of another hand, with {command.joint_names}"
                        )
                if self.is_outdated:
                    return
                sample = self._sample(command)
                if sample is not None:
                    yield sample

    @property
    def is_busy(self) -> bool:
        """Whether wishes are still to be carried out."""
        return bool(self._wishes)

    def close(self) -> None:
        """Stop reading."""
        self._is_closed.set()
        if not self._is_read:
            self._client.close()

    def release(self) -> None:
        """Wish to let go of the robot."""
        self._wishes.append(self._client.release)

    def clutch(self) -> None:
        """Wish to take hold of it again."""
        self._wishes.append(self._client.clutch)

    def configure(self, changes: dict[str, Any]) -> None:
        """Wish for other values of some options."""
        mapping, ik = split_changes(changes)
        self._wishes.append(lambda: self._client.configure(mapping=mapping, ik=ik))

    def _fulfil_wishes(self) -> None:
        """Carry out what was wished for, and see what came of it."""
        while self._wishes:
            try:
                self._try(self._wishes[0])
                self.trouble = None
            except InvalidInputError as error:
                self.trouble = error
            self._look()
            # Not before its outcome is known.
            self._wishes.popleft()

    def _look(self) -> None:
        """See what the session is now, if the service answers.

        Whoever opened it may have opened another one.
        """
        try:
            state = self._client.status()
            about = state.about or {}
            if self.is_shared and about["is_shared"] and not about["has_detail"]:
                self._client.configure(has_detail=True)
            self.is_outdated = {name: about[name] for name in _HANDS} != self._about
            self.options = _options(about)
        except (*self._troubles, LookupError):
            return
        self.is_released = state.is_released

    def _look_for(self, session: str | None, end: float) -> dict[str, Any]:
        """What the service says of the session, once there is one and its human hand is known."""
        while True:
            names = () if session else self._try(self._client.status).names
            if len(names) > 1:
                raise self._error(
                    f"several sessions are open; choose one with --session: {', '.join(names)}"
                )
            self.name = session or "".join(names)
            complaint = "no session is open there"
            if self.name:
                state = self._try(lambda: self._client.watch(self.name))
                self.is_released = state.is_released
                about = state.about or {}
                if about["lengths"] is not None or about["input"] != "landmarks":
                    return about
                complaint = "the human hand has not been measured yet: do landmarks come?"
            if time.monotonic() > end:
                raise self._error(complaint)
            time.sleep(0.1)

    def _load_robot(self, robot: str | Path, about: dict[str, Any]) -> Hand:
        """The robot hand, from a name or file of this side."""
        if robot == about["robot"] and robot not in hand_names():
            raise self._error(
                f"the session's hand {robot!r} is one of the service's own; give its hand.yaml here: --robot FILE"
            )
        return load_hand(robot, points=about["robot_points"], mount=about["mount"])

    def _is_as_before(self, command: Any) -> bool:
        """Whether a command can be of the session that was last looked at."""
        if command.detail is None and command.point_error and self.is_shared:
            # One that its client had to open anew has forgotten that it was asked for details.
            return False
        points = () if command.detail is None else command.detail["human_points"]
        return (
            command.joint_names == self.robot.joint_names
            and len(points) in (0, len(self.human.reference_points))
            and len(command.point_error) in (0, len(self.robot.reference_points))
        )

    def _sample(self, command: Any) -> ViewSample | None:
        """What the view shows of a command; None where it shows nothing."""
        self.is_released = "released" in command.flags
        # A held robot's commands say nothing of the human.
        self._detail = command.detail or self._detail
        if not self._detail:
            return None
        if self._start is None:
            self._start = command.server_time
        detail, q, wrist = self._detail, np.array(command.q), command.wrist.matrix
        human_points, human_q, human_wrist = (
            detail[name] for name in ("human_points", "human_q", "human_wrist")
        )
        human_points = np.array(human_points)
        return ViewSample(
            time=command.server_time - self._start,
            human_q=None if human_q is None else np.array(human_q),
            human_wrist=self._lay_on(human_points)
            if human_wrist is None
            else msgspec.convert(human_wrist, type(command.wrist)).matrix,
            human_points=human_points,
            robot_q=q,
            robot_wrist=wrist,
            robot_points=self.robot.points(q, wrist if self.robot.is_floating else None),
            targets=None if self.is_released else np.array(detail["targets"]),
            deformation=np.array(detail["motion_deformation"])[:3, :3],
            pivot=np.array(detail["pivot"]),
            at_limit=np.array([name in command.at_limit for name in self.robot.joint_names]),
            status=command.status,
            duration=command.solve_time,
            is_seen=command.detail is not None,
        )

    def _lay_on(self, points: np.ndarray) -> np.ndarray:
        """About where the wrist is of which only points are known (n, 3), shape (4, 4).

        Where it is in the hand at rest.
        """
        return rigid_fit(self._rest_points, points)

    def _try(self, call: Callable[[], _T]) -> _T:
        try:
            return call()
        except self._troubles as error:
            raise self._error(str(error)) from error

    def _error(self, message: str) -> InvalidInputError:
        return InvalidInputError(f"--live {self._host}: {message}", value=self._host)


def _options(about: dict[str, Any]) -> Options:
    return Options(
        msgspec.convert(about["mapping"], MappingOptions), msgspec.convert(about["ik"], IkOptions)
    )


def _address(host: str) -> str:
    """The ZeroMQ address of `HOST`, `HOST:PORT` or `[IPv6]:PORT`.

    Raises:
        InvalidInputError: If there is no such host or port.
    """
    name, _, port = (
        host.rpartition(":") if ":" in host.rpartition("]")[2] else (host, "", str(PORT))
    )
    try:
        number = int(port if name.strip() else "")
        socket.getaddrinfo(name.strip("[]"), None)
    except ValueError as error:
        raise InvalidInputError(
            f"--live: expected HOST or HOST:PORT, got {host!r}", value=host
        ) from error
    except OSError as error:
        raise InvalidInputError(
            f"--live {host}: there is no host {name!r}: {error.strerror}", value=host
        ) from error
    check_port(f"--live {host}", number)
    return f"tcp://{name}:{number}"
