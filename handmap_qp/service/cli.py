"""`handmap serve` and `handmap keys`."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal

import tyro

from handmap_qp.addresses import bare_host
from handmap_qp.errors import InvalidInputError, MissingExtraError


@dataclass(frozen=True)
class Serve:
    """Serve the mapper to trackers and robots over ZeroMQ and WebSocket.

    Listens on loopback, prints one JSON line with its ports when it is ready, and logs JSON lines
    on stderr. `handmap serve --schema` describes the messages. The folder
    `handmap_qp/client` is a client to copy where you need it.

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
        hand: Further robot hands that clients may open: paths of hand.yaml files.
        sessions: Open sessions, at most 128.
        rate: Messages per second from one connection.
        idle: Time without a request after which a session is closed [s].
        simulated_time: Let sessions use their clients' time stamps for speed limits; not for real
            robots.
        log_level: Lowest level to log.
        schema: Print the description of all messages, and exit.
        json_schema: Print their JSON schema, and exit.
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
    sessions: int = 64
    rate: float = 2000.0
    idle: float = 60.0
    simulated_time: bool = False
    log_level: Literal["debug", "info", "warning", "error"] = "info"
    schema: bool = False
    json_schema: bool = False

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM."""
        if self.schema or self.json_schema:
            from handmap_qp.service.schema import json_schema, schema_text

            print(json_schema() if self.json_schema else schema_text())
            return
        try:
            from handmap_qp.service.run import run_server
            from handmap_qp.service.server import Settings
            from handmap_qp.service.websocket import WebSettings
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "service") from error
        from handmap_qp.service.caps import Caps
        from handmap_qp.service.keys import read_token

        self._check_web()
        web = None
        if self.web:
            token = None if self.web_token_file is None else read_token(self.web_token_file)
            web = WebSettings(
                bare_host("--web-host", self.web_host),
                self.web_port,
                token,
                self.web_certificate,
                self.web_key,
                self.web_origin,
            )
        settings = Settings(
            host=bare_host("--host", self.host),
            port=self.port,
            stream_port=self.stream_port,
            health_port=None if self.health_port == -1 else self.health_port,
            keys=self.keys,
            web=web,
            state=self.state,
            audit=self.audit,
            hands=self.hand,
            caps=Caps(
                sessions=self.sessions,
                rate=self.rate,
                idle=self.idle,
                supervisors=self.supervisor,
                allows_client_time=self.simulated_time,
            ),
        )
        run_server(settings, self.log_level)

    def _check_web(self) -> None:
        """Reject options of WebSocket without --web."""
        choices = [
            item
            for item in fields(self)
            if item.name.startswith("web_") and getattr(self, item.name) != item.default
        ]
        if choices and not self.web:
            names = ", ".join("--" + item.name.replace("_", "-") for item in choices)
            raise InvalidInputError(argument=names, problem="requires --web")


@dataclass(frozen=True)
class Keys:
    """Make the keys that `handmap serve --keys` needs; existing keys stay.

    Give each client its NAME.key_secret and server.key. A running server admits new keys at once.
    To shut a client out, delete clients/NAME.key; the same command with its name admits it again.
    Open connections stay until they end.

    Attributes:
        folder: Folder of the keys.
        client: Names of clients.
    """

    folder: tyro.conf.Positional[Path]
    client: tuple[str, ...] = field(default=("client",))

    def run(self) -> None:
        """Make the keys, and print the files written."""
        try:
            from handmap_qp.service.keys import make_keys
        except ModuleNotFoundError as error:
            raise MissingExtraError(str(error.name), "service") from error

        written = make_keys(self.folder, self.client)
        for file in written:
            is_back = file.parent.name == "clients" and self.folder / file.name not in written
            print(f"wrote {file}" + (f", which admits {file.stem} again" if is_back else ""))
        if not written:
            print("wrote nothing: all keys exist")
