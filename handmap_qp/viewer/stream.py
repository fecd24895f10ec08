"""The mapping service's stream of commands, as a `LiveSource`: `ServiceStream` looks on without taking part.

Commands speak of the robot alone. What the human did, and what was made of it, comes with those of sessions that were opened with
`has_detail`, which is what a view needs.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.hand import Hand
from handmap_qp.transform import pose_from_xyz_quat
from handmap_qp.viewer.samples import ViewSample

STREAM_PORT = 5571
"""Where `handmap serve` publishes commands, unless told otherwise."""
_LOOK_MS = 100


class ServiceStream:
    """Commands of one session of a mapping service.

    Args:
        host: `HOST` or `HOST:PORT` of the stream.
        human: The human hand to draw.
        robot: The robot hand that the session was opened for.
        session: Public name of the session; the first one heard if omitted.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service; None for a plain one.

    Attributes:
        human: The human hand.
        robot: The robot hand.

    Raises:
        InvalidInputError: If the address or the keys cannot be used.
        MissingExtraError: If the service's packages are not installed.
    """

    def __init__(
        self, host: str, human: Hand, robot: Hand, *, session: str | None = None, keys: tuple[Path, Path] | None = None
    ) -> None:
        try:
            import zmq
        except ImportError as error:
            raise MissingExtraError("pyzmq", "service") from error
        from handmap_qp.client import Command, CurveKeys, Error

        self.human, self.robot = human, robot
        self._session = session
        self._is_closed = threading.Event()
        self._decode = msgspec.msgpack.Decoder(Command | Error).decode
        self._start: float | None = None
        self._detail: dict[str, Any] = {}
        self._human = human.rest, np.eye(4)
        self._again = zmq.Again
        self._socket = zmq.Context.instance().socket(zmq.SUB)
        try:
            self._socket.linger, self._socket.rcvtimeo = 0, _LOOK_MS
            if keys is not None:
                pair = CurveKeys.read(*keys)
                self._socket.curve_publickey, self._socket.curve_secretkey = pair.public, pair.secret
                self._socket.curve_serverkey = pair.server
            self._socket.subscribe(b"" if session is None else session.encode() + b"\0")
            self._socket.connect(_address(host))
        except (zmq.ZMQError, OSError, ValueError) as error:
            self._socket.close()
            raise InvalidInputError(f"--live {host}: {error}", value=host) from error

    def __iter__(self) -> Iterator[ViewSample]:
        """Samples as commands come, until `close`.

        Raises:
            InvalidInputError: If a message is none of the service's, or the session is of another robot or without details.
        """
        try:
            while not self._is_closed.is_set():
                try:
                    topic, _, payload = self._socket.recv().partition(b"\0")
                except self._again:
                    continue
                name = topic.decode(errors="replace")
                self._session = self._session or name
                if name == self._session and (sample := self._sample(payload)) is not None:
                    yield sample
        finally:
            self._socket.close()

    def close(self) -> None:
        """Stop reading."""
        self._is_closed.set()

    def _sample(self, payload: bytes) -> ViewSample | None:
        """What the view shows of a message; None where it shows nothing."""
        from handmap_qp.client import Command

        try:
            command = self._decode(payload)
        except msgspec.MsgspecError as error:
            raise InvalidInputError(f"--live: the stream holds something else than commands: {error}") from error
        if not isinstance(command, Command) or command.wrist is None:
            return None
        if command.joint_names != self.robot.joint_names:
            raise InvalidInputError(
                f"--robot {self.robot.name}: session {command.name} is of another hand, with {command.joint_names}"
            )
        self._take_detail(command)
        if not self._detail:
            return None
        if self._start is None:
            self._start = command.server_time
        q, wrist = np.array(command.q), _matrix(command.wrist)
        return ViewSample(
            time=command.server_time - self._start,
            human_q=self._human[0],
            human_wrist=self._human[1],
            human_points=np.array(self._detail["human_points"]),
            robot_q=q,
            robot_wrist=wrist,
            robot_points=self.robot.points(q, wrist if self.robot.is_floating else None),
            targets=np.array(self._detail["targets"]),
            deformation=np.array(self._detail["motion_deformation"])[:3, :3],
            # The stream does not tell the pivot: the usual one is the middle of the points.
            pivot=np.array(self._detail["human_points"]).mean(axis=0),
            at_limit=np.array([name in command.at_limit for name in self.robot.joint_names]),
            status=command.status,
            duration=command.solve_time,
            is_seen=command.detail is not None,
        )

    def _take_detail(self, command: Any) -> None:
        """Keep what is known of the human; a held robot's commands say nothing of it."""
        if command.detail is None:
            if not self._detail and command.point_error:
                raise InvalidInputError(f"--live: session {command.name} tells too little to be seen: open it with has_detail=True")
            return
        self._detail = command.detail
        q, wrist = self._detail.get("human_q"), self._detail.get("human_wrist")
        if q is not None and wrist is not None and len(q) == len(self.human.joint_names):
            self._human = np.array(q), _matrix(msgspec.convert(wrist, type(command.wrist)))


def _matrix(pose: Any) -> np.ndarray:
    return pose_from_xyz_quat((*pose.position, *pose.quat_xyzw), "xyzw")


def _address(host: str) -> str:
    """The ZeroMQ address of `HOST`, `HOST:PORT` or `[IPv6]:PORT`."""
    has_port = ":" in host.rpartition("]")[2]
    return f"tcp://{host}" if has_port else f"tcp://{host}:{STREAM_PORT}"
