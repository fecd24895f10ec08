"""A session of the mapping service, as a `LiveSource`: `ServiceSession` shows it, and steers it where its client shares it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, TypeVar

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.human import HumanLengths
from handmap_qp.ik.options import IkOptions
from handmap_qp.library import load_hand
from handmap_qp.options import MappingOptions
from handmap_qp.trackers.landmarks import human_name
from handmap_qp.transform import pose_from_xyz_quat
from handmap_qp.viewer.samples import ViewSample

PORT = 5570
"""Where `handmap serve` takes requests, unless told otherwise."""
_TIMEOUT = 2.0
_LOOK = 0.1
_ASK_PERIOD = 0.2
_T = TypeVar("_T")


class ServiceSession:
    """One session of a mapping service.

    Args:
        host: `HOST` or `HOST:PORT` of the service's requests.
        session: Public name of the session; the only one that is open if omitted.
        robot: The robot hand, where its name does not lead to it here: the path of its hand.yaml.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service; None for a plain one.
        patience: How long to wait for the session, and for its human hand to be measured [s].

    Attributes:
        human: The human hand, of the lengths that the service knows.
        robot: The robot hand.
        mapping: The mapping's choices.
        ik: Weights and settings of the QP.
        is_shared: Whether it can be steered from here.
        is_released: Whether its client, or somebody here, has let go.

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
        self._troubles = (ServiceError, ServiceTimeoutError, zmq.ZMQError, msgspec.MsgspecError, OSError, ValueError, TypeError)
        self._is_closed = threading.Event()
        self._start: float | None = None
        self._detail: dict[str, Any] = {}
        self._asked = -np.inf
        # One to steer with, and one that a thread of its own reads the stream with.
        self._client, self._reader = self._try(lambda: [Client(_address(host), timeout=_TIMEOUT, keys=keys) for _ in range(2)])
        try:
            about = self._look_for(session, time.monotonic() + patience)
            self.is_shared: bool = about["is_shared"]
            if not (about["has_detail"] or self.is_shared):
                raise self._error("the session tells too little to be seen: open it with has_detail=True or is_shared=True")
            self.mapping = msgspec.convert(about["mapping"], MappingOptions)
            self.ik = msgspec.convert(about["ik"], IkOptions)
            lengths = about["lengths"] and HumanLengths(**{name: np.array(rows) for name, rows in about["lengths"].items()})
            self.human = load_hand(human_name(about["side"]), points=about["human_points"], lengths=lengths or None)
            self.robot = load_hand(robot or about["robot"], points=about["robot_points"], mount=about["mount"])
        except BaseException:
            self._client.close()
            raise
        self._human = self.human.rest, np.eye(4)

    def __iter__(self) -> Iterator[ViewSample]:
        """Samples as commands come, until `close`.

        Raises:
            InvalidInputError: If there is no such session any more, or it is of another robot.
        """
        with self._reader as reader:
            self._try(lambda: reader.watch(self.name))
            while not self._is_closed.is_set():
                try:
                    command = reader.latest(_LOOK)
                except self._refusal:
                    # Of a sample that the service could not use; its client has been told.
                    continue
                if command is not None and command.wrist is not None and (sample := self._sample(command)) is not None:
                    yield sample

    def close(self) -> None:
        """Stop reading."""
        self._is_closed.set()
        self._client.close()

    def toggle_clutch(self) -> None:
        """Let go, or take hold again.

        Raises:
            InvalidInputError: If the service does not do it.
        """
        self._try(self._client.clutch if self.is_released else self._client.release)
        self.is_released = not self.is_released

    def configure(self, mapping: MappingOptions, ik: IkOptions) -> None:
        """Change options.

        Raises:
            InvalidInputError: If the service does not do it.
        """
        self._try(lambda: self._client.configure(mapping=asdict(mapping), ik=asdict(ik)))
        self.mapping, self.ik = mapping, ik

    def _look_for(self, session: str | None, end: float) -> dict[str, Any]:
        """What the service says of the session, once there is one and its human hand is known."""
        while True:
            names = () if session else self._try(self._client.status).names
            if len(names) > 1:
                raise self._error(f"several sessions are open; choose one with --session: {', '.join(names)}")
            self.name = session or "".join(names)
            complaint = "no session is open there"
            if self.name:
                state = self._try(lambda: self._client.watch(self.name))
                self.is_released, about = state.mode == "released", state.about or {}
                if about["lengths"] is not None or about["input"] != "landmarks":
                    return about
                complaint = "the human hand has not been measured yet: do landmarks come?"
            if time.monotonic() > end:
                raise self._error(complaint)
            time.sleep(_LOOK)

    def _sample(self, command: Any) -> ViewSample | None:
        """What the view shows of a command; None where it shows nothing."""
        if command.joint_names != self.robot.joint_names:
            raise InvalidInputError(
                f"--robot {self.robot.name}: session {self.name} is of another hand, with {command.joint_names}"
            )
        self._take_detail(command)
        # The watchdog's commands say that the robot holds, and not for whom.
        if command.status not in ("hold", "returning"):
            self.is_released = command.status == "released"
        if not self._detail:
            return None
        if self._start is None:
            self._start = command.server_time
        detail, q, wrist = self._detail, np.array(command.q), _matrix(command.wrist)
        return ViewSample(
            time=command.server_time - self._start,
            human_q=self._human[0],
            human_wrist=self._human[1],
            human_points=np.array(detail["human_points"]),
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

    def _take_detail(self, command: Any) -> None:
        """Keep what is known of the human; a held robot's commands say nothing of it."""
        if command.detail is None:
            # A session that its client had to open anew has forgotten that it was asked for details.
            if command.point_error and self.is_shared and time.monotonic() - self._asked > _ASK_PERIOD:
                self._asked = time.monotonic()
                self._try(lambda: self._reader.configure(has_detail=True))
            return
        self._detail = command.detail
        q, wrist = self._detail.get("human_q"), self._detail.get("human_wrist")
        if q is not None and wrist is not None:
            self._human = np.array(q), _matrix(msgspec.convert(wrist, type(command.wrist)))

    def _try(self, call: Callable[[], _T]) -> _T:
        try:
            return call()
        except self._troubles as error:
            raise self._error(str(error)) from error

    def _error(self, message: str) -> InvalidInputError:
        return InvalidInputError(f"--live {self._host}: {message}", value=self._host)


def _matrix(pose: Any) -> np.ndarray:
    return pose_from_xyz_quat((*pose.position, *pose.quat_xyzw), "xyzw")


def _address(host: str) -> str:
    """The ZeroMQ address of `HOST`, `HOST:PORT` or `[IPv6]:PORT`."""
    has_port = ":" in host.rpartition("]")[2]
    return f"tcp://{host}" if has_port else f"tcp://{host}:{PORT}"
