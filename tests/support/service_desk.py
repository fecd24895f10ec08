"""A dispatcher of the service without sockets, with a clock of the test."""

from __future__ import annotations

from typing import Any

import msgspec
from service_tools import CACHE, Sampler

from handmap_qp.apps.service.dispatch import Dispatcher
from handmap_qp.apps.service.logs import Metrics
from handmap_qp.apps.service.sessions import Sessions
from handmap_qp.apps.service.settings import Settings
from handmap_qp.apps.service.store import PostureStore
from handmap_qp.client.messages import Request, Step


class Desk:
    """A dispatcher with its clock and the messages of its streams.

    Args:
        store: Record of the postures; in memory if omitted.
        **caps: Limits of what clients may do.
    """

    def __init__(self, store: PostureStore | None = None, **caps: Any) -> None:
        self.now = 0.0
        self.published: list[dict[str, Any]] = []
        self.metrics, self.store = Metrics(), store or PostureStore(None)
        self.sessions = Sessions(
            Settings(**caps),
            CACHE,
            self.metrics,
            store=self.store,
            clock=lambda: self.now,
        )
        self.dispatcher = Dispatcher(self.sessions)
        self.sessions.publish.append(
            lambda name, payload: self.published.append(msgspec.msgpack.decode(payload))
        )

    def take(self, request: Request, peer: str = "one") -> list[dict[str, Any]]:
        """Send a request; return its immediate answers: one or none."""
        answers: list[bytes] = []
        self.dispatcher.receive(msgspec.msgpack.encode(request), peer, answers.append)
        return [msgspec.msgpack.decode(answer) for answer in answers]

    def wait(self, seconds: float) -> None:
        """Let time pass."""
        self.now += seconds
        self.dispatcher.tick()


def secret_of(name: str) -> str:
    """Return the secret of a session."""
    return f"the-secret-of-{name}"


def sample_of(name: str, sampler: Sampler, now: float) -> Step:
    """Return a sample of a session."""
    return msgspec.structs.replace(sampler(now), session=secret_of(name))
