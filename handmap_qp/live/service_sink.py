"""`ServiceSink`: a sink that leads a robot hand through the mapping service."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

from handmap_qp.addresses import service_address
from handmap_qp.errors import MissingExtraError
from handmap_qp.hands.spec import Side
from handmap_qp.human.person import Person
from handmap_qp.human.sample import HumanSample
from handmap_qp.live.service_errors import TIMEOUT, reported_as

try:
    import zmq

    from handmap_qp.client import Client, Command, ServiceError, ServiceTimeoutError
except ModuleNotFoundError as missing:
    raise MissingExtraError(str(missing.name), "service") from missing

_SILENCE = 1.0
"""Time without a command after which the service counts as silent [s]."""
_LAST_COMMAND = 0.5
"""Longest wait at the end for the command of the last sample [s]."""


class ServiceSink:
    """Sends samples to a session of the service, and reads its commands.

    The session is open from construction until the end of the block. Its commands carry every
    stage of the mapping, so that `handmap view --live` shows them. If the service restarts, the
    session is opened again.

    Args:
        host: `HOST`, `HOST:PORT` or `tcp://HOST:PORT` of the service's requests.
        robot: Name of a robot hand on the service.
        side: The human hand.
        session: Public name of the session; the service makes one if omitted.
        preset: What the mapping is for; the service decides if omitted.
        person: The measured person; the service measures the first samples if omitted.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service.

    Raises:
        InvalidInputError: If the service cannot be reached or refuses the session.
    """

    def __init__(
        self,
        host: str,
        robot: str,
        side: Side,
        *,
        session: str | None = None,
        preset: str | None = None,
        person: Person | None = None,
        keys: tuple[Path, Path] | None = None,
    ) -> None:
        address = service_address("--to", host)
        self._robot = robot
        with reported_as("--to", address, refused="--to"):
            self._client = Client(address, timeout=TIMEOUT, keys=keys)
            try:
                self.session = self._open(side, session, preset, person)
            except BaseException:
                self._client.close()
                raise
        self._sent = self._lost = self._unanswered = 0
        self._statuses: Counter[str] = Counter()
        self._flags: Counter[str] = Counter()
        self._refusals: Counter[str] = Counter()
        self._refusal = ""
        self._accepted = 0
        self._command: Command | None = None
        self._heard = self._told = time.monotonic()

    def __enter__(self) -> ServiceSink:
        return self

    def __exit__(self, *_: object) -> None:
        end = time.monotonic() + _LAST_COMMAND
        while self._told > self._heard and time.monotonic() < end:
            self._read(timeout=0.05)
        self._client.close()

    def put(self, sample: HumanSample) -> None:
        """Send a sample, and read what has been commanded meanwhile.

        A sample in which the hand was not seen is sent as such: the robot holds.
        """
        self._send(sample)
        self._lost += not sample.valid
        self._read()

    def status(self) -> str:
        """Return the state of the robot, as the service last said."""
        command, silence = self._command, time.monotonic() - self._heard
        if silence > _SILENCE:
            return f"{self._robot}: no answer for {silence:.0f} s"
        if command is None:
            return f"{self._robot}: {self._refusal or 'waiting'}"
        flags = f" ({', '.join(command.flags)})" if command.flags else ""
        return f"{self._robot}: {command.status}{flags}"

    def summary(self) -> dict[str, Any]:
        """Return counts of samples, commands, their states and flags, and refusals."""
        return {
            "robot": self._robot,
            "session": self.session,
            "sent": self._sent,
            "hand_lost": self._lost,
            "commands": sum(self._statuses.values()),
            "accepted": self._accepted,
            "statuses": dict(self._statuses),
            "flags": dict(self._flags),
            "refusals": dict(self._refusals),
            "last_refusal": self._refusal,
            "unanswered": self._unanswered,
            "reopened": self._client.reopened,
        }

    def _open(
        self,
        side: Side,
        session: str | None,
        preset: str | None,
        person: Person | None,
    ) -> str:
        """Open the session; return its name."""
        opened = self._client.open(
            self._robot,
            name=session,
            input="landmarks",
            side=side,
            preset=preset,
            has_detail=True,
            **({} if person is None else person.session_fields()),
        )
        return opened.name

    def _send(self, sample: HumanSample) -> None:
        try:
            self._client.send(
                landmarks=sample.landmarks if sample.valid else None,
                wrist=sample.wrist,
                time=sample.time,
                valid=bool(sample.valid),
                confidence=sample.confidence,
            )
            self._sent += 1
            self._told = time.monotonic()
        except ServiceError as error:
            self._note_refusal(error)
        except (ServiceTimeoutError, zmq.ZMQError):
            # The service is gone; `status` says so, and the next sample tries again.
            self._unanswered += 1

    def _read(self, timeout: float = 0.0) -> None:
        """Read the newest command, if there is one."""
        try:
            command = self._client.latest(timeout)
        except ServiceError as error:
            self._note_refusal(error)
            self._heard = time.monotonic()
            return
        if command is None:
            return
        self._heard, self._command = time.monotonic(), command
        if "watchdog" not in command.flags:
            self._statuses[command.status] += 1
            self._flags.update(command.flags)
            self._accepted += not command.rule

    def _note_refusal(self, error: ServiceError) -> None:
        """Count a refusal by code and field; keep its text."""
        code, field = error.error.code, error.error.field.partition("[")[0]
        self._refusals[f"{code} {field}".strip()] += 1
        self._refusal = str(error)
