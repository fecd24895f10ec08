"""A session of the mapping service as a sink (`ServiceSink`) or as a source (`ServiceSource`)."""

from collections import Counter
from collections.abc import Iterator
from time import monotonic

import numpy as np

from handmap_core.client import Command, KeyFiles, ServiceError, ServiceTimeoutError
from handmap_core.errors import InvalidInputError, expect
from handmap_qp.apps.connection import GONE, connected, only_session
from handmap_qp.hands import Side, Values
from handmap_qp.human import HumanSample, Person
from .source import Sink, Source

_SILENCE = 1.0
"""Time without a command after which the service counts as silent [s]."""
_LAST_COMMAND = 0.5
"""Longest wait at the end for the command of the last sample [s]."""
_WAIT = 0.25
"""Time without a command after which the session's state is asked for [s]."""


class ServiceSink(Sink):
    """Sends samples to a session of the service, and reads its commands.

    The session is open from construction until the end of the block. Its commands carry every
    stage of the mapping, so that `handmap view --live` shows them. If the service restarts, the
    session is opened again.

    Args:
        host: `HOST`, `HOST:PORT` or `tcp://HOST:PORT` of the service's requests.
        robot: Name of a robot hand on the service.
        side: The human hand.
        person: The measured person; the service measures the first samples if omitted.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service.
        name: Public name of the session; the service makes one if omitted.
        preset: What the mapping is for; the service's default for the hands if omitted.
        is_shared: Whether other clients may engage, disengage, configure and clear the session.
        upright: Axes of the samples' world that are up and forward, such as `+y up, -z forward`.

    Attributes:
        command: The newest command; None before the first.

    Raises:
        InvalidInputError: If the service cannot be reached or refuses the session.
    """

    def __init__(
        self,
        host: str,
        robot: str,
        side: Side,
        *,
        person: Person | None = None,
        keys: KeyFiles | None = None,
        name: str | None = None,
        preset: str | None = None,
        is_shared: bool | None = None,
        upright: str | None = None,
    ) -> None:
        measured = person.session_fields() if person else {}
        with connected("--to", host, keys, refused="--to") as self._client:
            self.session = self._client.open(
                robot,
                input="landmarks",
                side=side,
                has_detail=True,
                name=name,
                preset=preset,
                is_shared=is_shared,
                upright=upright,
                **measured,
            ).name
        self._robot = robot
        self._counts = Counter(
            sent=0, hand_lost=0, commands=0, accepted=0, unanswered=0
        )
        self._said = {
            name: Counter[str]() for name in ("statuses", "flags", "refusals")
        }
        self._refusal = ""
        self.command: Command | None = None
        self._heard = self._sent = monotonic()

    def __exit__(self, *_: object) -> None:
        end = monotonic() + _LAST_COMMAND
        while self._sent > self._heard and monotonic() < end:
            self._read(timeout=0.05)
        self._client.close()

    def put(self, sample: HumanSample) -> None:
        """Send a sample, and read what has been commanded meanwhile.

        A sample in which the hand was not seen is sent as such: the robot holds.
        """
        self._counts["hand_lost"] += not sample.valid
        try:
            self._client.send(
                landmarks=sample.landmarks if sample.valid else None,
                wrist=sample.wrist,
                time=sample.time,
                valid=bool(sample.valid),
                confidence=sample.confidence,
            )
            self._counts["sent"] += 1
            self._sent = monotonic()
        except ServiceError as error:
            self._note_refusal(error)
        except GONE:
            # The service is gone; `status` says so, and the next sample tries again.
            self._counts["unanswered"] += 1
        self._read()

    def status(self) -> str:
        """Return the state of the robot, as the service last said."""
        silence = monotonic() - self._heard
        if silence > _SILENCE:
            return f"{self._robot}: no answer for {silence:.0f} s"
        if not (command := self.command):
            return f"{self._robot}: {self._refusal or 'waiting'}"
        flags = f" ({', '.join(command.flags)})" if command.flags else ""
        pair = (command.detail or {}).get("held_by")
        held = f", held by {' and '.join(pair)}" if pair else ""
        return f"{self._robot}: {command.status}{flags}{held}"

    def summary(self) -> Values:
        """Return counts of samples, commands, their states and flags, and refusals."""
        return {
            "robot": self._robot,
            "session": self.session,
            **self._counts,
            **self._said,
            "last_refusal": self._refusal,
            "reopened": self._client.reopened,
        }

    def _read(self, timeout: float = 0.0) -> None:
        """Read the newest command, if there is one."""
        try:
            command = self._client.latest(timeout)
        except ServiceError as error:
            self._note_refusal(error)
            self._heard = monotonic()
            return
        if not command:
            return
        self._heard = monotonic()
        self.command = command
        if "watchdog" not in command.flags:
            self._counts.update(commands=1, accepted=not command.rule)
            self._said["statuses"][command.status] += 1
            self._said["flags"].update(command.flags)

    def _note_refusal(self, error: ServiceError) -> None:
        """Count a refusal by code and field; keep its text."""
        code = error.error.code
        field = error.error.field.partition("[")[0]
        self._said["refusals"][f"{code} {field}".strip()] += 1
        self._refusal = str(error)


class ServiceSource(Source):
    """Watches a session, whichever program or page controls it, and yields its landmarks.

    Samples are those that the service mapped: at a rate above its own, the newest ones. Samples
    that it measures the hand from, the first 30, are missing. The source ends with the session.

    Args:
        host: `HOST`, `HOST:PORT` or `tcp://HOST:PORT` of the service's requests.
        session: Public name of the session; the only open one if omitted.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service.

    Attributes:
        name: Public name of the session.
        side: The session's human hand.
        upright: See `Recording`.
        rate: 0: only its client knows.

    Raises:
        InvalidInputError: If the service cannot be reached, there is no such session, several are
            open and none was named, or its commands do not carry landmarks.
    """

    rate: float = 0.0

    def __init__(
        self,
        host: str,
        *,
        session: str | None = None,
        keys: KeyFiles | None = None,
    ) -> None:
        with connected("--from", host, keys, refused="--session") as self._client:
            self.name = only_session(self._client, session)
            if not self.name:
                raise InvalidInputError(
                    f"no session is open at {self._client.address}",
                    argument="--from",
                    advice="start a client that opens one, such as handmap track replay",
                )
            about: Values = self._client.watch(self.name).about or {}
            expect(
                about["input"] == "landmarks",
                "--session",
                "a session of landmarks",
                got=f"one of {about['input']}",
                value=self.name,
            )
            expect(
                about["has_detail"],
                "--session",
                "one whose client opened it with has_detail",
                got="one whose commands do not carry landmarks",
                value=self.name,
            )
            self.side = about["side"]
            self.upright = about.get("upright", "")

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield the landmarks of each command that answers a mapped sample."""
        with self._client as client:
            heard = monotonic()
            while True:
                if command := client.latest(_WAIT):
                    heard = monotonic()
                    if landmarks := (command.detail or {}).get("landmarks"):
                        yield HumanSample(command.time, self.side, np.array(landmarks))
                elif monotonic() - heard > _WAIT:
                    try:
                        client.status()
                    except ServiceTimeoutError:
                        # A service that restarts may open the session again.
                        continue
                    except ServiceError:
                        return
