"""`ServiceSource`: the human samples that lead a session of the mapping service, as a source."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from handmap_qp.addresses import service_address
from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.hands.spec import Side
from handmap_qp.human.sample import HumanSample
from handmap_qp.live.service_errors import TIMEOUT, reported_as

try:
    from handmap_qp.client import Client, Command, ServiceError, ServiceTimeoutError, State
except ModuleNotFoundError as missing:
    raise MissingExtraError(str(missing.name), "service") from missing

_WAIT = 0.25
"""Time without a command after which the session's state is asked for [s]."""


class ServiceSource:
    """Watches a session, whichever program or page leads it, and yields its landmarks.

    Samples are those that the service mapped: at a rate above its own, the newest ones. Samples
    that it measures the hand from, the first 30, are missing. The source ends with the session.

    Args:
        host: `HOST`, `HOST:PORT` or `tcp://HOST:PORT` of the service's requests.
        session: Public name of the session; the only open one if omitted.
        keys: Files `NAME.key_secret` and `server.key` of an encrypted service.

    Raises:
        InvalidInputError: If the service cannot be reached, there is no such session, several are
            open and none was named, or its commands do not carry landmarks.
    """

    def __init__(
        self,
        host: str,
        *,
        session: str | None = None,
        keys: tuple[Path, Path] | None = None,
    ) -> None:
        address = service_address("--from", host)
        with reported_as("--from", address, refused="--session"):
            self._client = Client(address, timeout=TIMEOUT, keys=keys)
            try:
                self.name = session or self._only_session(address)
                self._side: Side = self._side_of(self._client.watch(self.name))
            except BaseException:
                self._client.close()
                raise

    @property
    def side(self) -> Side:
        """The session's human hand."""
        return self._side

    @property
    def rate(self) -> float:
        """0: only its client knows."""
        return 0.0

    def __iter__(self) -> Iterator[HumanSample]:
        """Yield the landmarks of each command until the session ends."""
        with self._client as client:
            heard = time.monotonic()
            while True:
                try:
                    command = client.latest(_WAIT)
                except ServiceError:
                    # The service refused a sample of the session's client.
                    continue
                if command is None:
                    if time.monotonic() - heard > _WAIT and not self._is_open():
                        return
                    continue
                heard = time.monotonic()
                sample = self._sample(command)
                if sample is not None:
                    yield sample

    def _sample(self, command: Command) -> HumanSample | None:
        """Return the landmarks of a command; None if it does not answer a mapped sample."""
        landmarks = (command.detail or {}).get("landmarks")
        if landmarks is None:
            return None
        return HumanSample(command.time, self._side, np.array(landmarks))

    def _is_open(self) -> bool:
        try:
            self._client.status()
        except ServiceError:
            return False
        except ServiceTimeoutError:
            # The service may be restarting; its client will open the session again.
            return True
        return True

    def _side_of(self, state: State) -> Side:
        """Return the human hand of a session, whose commands must carry its landmarks."""
        about: dict[str, Any] = state.about or {}
        if about["input"] != "landmarks":
            raise InvalidInputError(
                argument="--session",
                expected="a session led by landmarks",
                got=f"one led by {about['input']}",
                value=self.name,
            )
        if not about["has_detail"]:
            raise InvalidInputError(
                argument="--session",
                problem=f"commands of {self.name} do not carry landmarks",
                value=self.name,
                advice="its client must open it with has_detail",
            )
        return about["side"]

    def _only_session(self, address: str) -> str:
        state = self._client.status()
        if len(state.names) == 1:
            return state.names[0]
        if state.names:
            problem = f"several sessions are open: {', '.join(state.names)}"
            raise InvalidInputError(
                argument="--session", problem=problem, advice="name one with --session"
            )
        raise InvalidInputError(
            argument="--from",
            problem=f"no session is open at {address}",
            advice="start a client that opens one, such as handmap track replay",
        )
