"""What a server is started with: addresses, files, and limits of what clients may do."""

from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Self

from tyro.conf import Suppress

from handmap_core.errors import InvalidInputError, InvalidOptionsError
from handmap_qp.apps.addresses import bare_host, check_port, is_loopback

MOST_WORKERS = 64
"""Largest number of worker processes."""
MOST_SESSIONS = 128
"""Largest number of open sessions; the store keeps at least as many postures of each owner."""


@dataclass(frozen=True)
class Settings:
    """Addresses, files and limits of a server.

    Attributes:
        host: Address to listen on; any but loopback requires --keys.
        port: Port of requests and samples; 0 lets the system choose, as for the other ports.
        stream_port: Port of the stream of commands.
        health_port: Port of /metrics and /health, on loopback; -1 for none.
        keys: Folder that `handmap keys` made. Connections are encrypted, and only its clients are
            admitted.
        supervisor: Clients of --keys that may clear every emergency stop.
        web: Listen on WebSocket too, and serve the page for a headset's browser at the same port.
            It streams hands to the service; browsers need https, or http://localhost.
        web_host: Its address; any but loopback requires --web-token-file, --web-certificate and
            --web-key.
        web_port: Its port.
        web_token_file: File with the token that WebSocket clients must present: 16 to 256 letters,
            digits, - and _, readable for its owner only. Clients send it as the header
            `Authorization: Bearer TOKEN`; pages in browsers, which cannot set headers, offer the
            subprotocols `["handmap.v1", "bearer.TOKEN"]`.
        web_certificate: PEM file of the TLS certificate.
        web_key: PEM file of its key.
        web_origin: Further origins of pages that may connect.
        state: File that keeps the postures last commanded, so that sessions can be restored after a
            restart.
        audit: File of the audit log: one JSON line for each session that a client opens, engages,
            releases, changes, stops or closes, with the client's name and address.
        hand: Further robot hands that clients may open, and robots with two: paths of hand.yaml and
            robot.yaml files.
        workers: Processes that map, behind the one address; each session is in one. 0 maps in the
            process that serves, which is the quickest for a few sessions.
        sessions: Open sessions, at most 128. A client with a key, or over WebSocket, may open
            another one while more are free than it has.
        rate: Messages per second from one connection.
        max_load: Share of its time that the server may work before it refuses further sessions as
            `busy`. If samples wait too long all the same, it answers those of the sessions opened
            last `busy`, and their robots hold. 1 does neither.
        idle: Time without a request after which a session is closed [s].
        simulated_time: Let sessions use their clients' time stamps for speed limits; not for real
            robots.
        opens: Sessions that one client opens per second, after a burst of `sessions`. A client that
            restores its own session is not limited.
        configures: Changes of options per second, in all sessions together; one client with a key,
            or over WebSocket, may make a half of them. Each takes about 1 ms; a change to
            teleoperation takes up to 10 ms on hands with many links.
        message_size: Length of a message [bytes].
    """

    host: str = "127.0.0.1"
    port: int = 5570
    stream_port: int = 5571
    health_port: int = 5573
    keys: Path | None = None
    supervisor: tuple[str, ...] = ()
    web: bool = False
    web_host: str = "127.0.0.1"
    web_port: int = 5572
    web_token_file: Path | None = None
    web_certificate: Path | None = None
    web_key: Path | None = None
    web_origin: tuple[str, ...] = ()
    state: Path | None = None
    audit: Path | None = None
    hand: tuple[Path, ...] = ()
    workers: int = 0
    sessions: int = 64
    rate: float = 2000.0
    max_load: float = 0.9
    idle: float = 60.0
    simulated_time: bool = False
    opens: Annotated[float, Suppress] = 20.0
    configures: Annotated[float, Suppress] = 60.0
    message_size: Annotated[int, Suppress] = 16384

    def checked(self) -> Self:
        """Return the settings with hosts as sockets take them.

        Raises:
            InvalidInputError: If there is no such address or port, or `web` is missing.
            InvalidOptionsError: If a number is out of range, or others could move the robot.
        """
        host = bare_host("--host", self.host)
        web_host = bare_host("--web-host", self.web_host)
        for name in ("port", "stream_port", "web_port", "health_port"):
            if name != "health_port" or self.health_port != -1:
                check_port(name, getattr(self, name))
        if not 1 <= self.sessions <= MOST_SESSIONS:
            expected = f"1 to {MOST_SESSIONS}"
            raise InvalidOptionsError(
                option="sessions", expected=expected, value=self.sessions
            )
        if not 0 <= self.workers <= MOST_WORKERS:
            expected = f"0 to {MOST_WORKERS}"
            raise InvalidOptionsError(
                option="workers", expected=expected, value=self.workers
            )
        for name in ("rate", "opens", "configures", "message_size", "idle"):
            value = getattr(self, name)
            # `not a > b` also rejects NaN.
            if not value > 0.0:
                raise InvalidOptionsError(
                    option=name, expected="a number > 0", value=value
                )
        if not 0.0 < self.max_load <= 1.0:
            raise InvalidOptionsError(
                option="max_load", expected="above 0, up to 1", value=self.max_load
            )
        if not is_loopback(host) and self.keys is None:
            raise _exposed("host", host, "keys (handmap keys FOLDER makes them)")
        self._check_web(web_host)
        return replace(self, host=host, web_host=web_host)

    def _check_web(self, host: str) -> None:
        given = [
            f"--{item.name.replace('_', '-')}"
            for item in fields(self)
            if item.name.startswith("web_") and getattr(self, item.name) != item.default
        ]
        if given and not self.web:
            raise InvalidInputError("requires --web", argument=", ".join(given))
        if (self.web_certificate is None) != (self.web_key is None):
            raise InvalidOptionsError(
                "certificate and key go together",
                option="web_certificate" if self.web_certificate is None else "web_key",
                advice="give both or neither",
            )
        if not is_loopback(host) and None in (
            self.web_token_file,
            self.web_certificate,
        ):
            raise _exposed("web_host", host, "a token, a certificate and its key")


def _exposed(option: str, host: str, missing: str) -> InvalidOptionsError:
    return InvalidOptionsError(
        f"others could move the robot on {host}",
        option=option,
        value=host,
        advice=f"off loopback, give {missing}",
    )
