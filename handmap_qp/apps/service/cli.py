"""`handmap serve` and `handmap keys`."""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from tyro.conf import Positional

from handmap_core.errors import MissingExtraError
from .settings import Settings

SCHEMAS = {
    "schema": Path(__file__).with_name("messages.md"),
    "json_schema": Path(__file__).with_name("messages.json"),
}
"""What the options of that name print; `docs/messages.py` writes the files."""


@dataclass(frozen=True)
class Serve(Settings):
    """Serve the mapper to trackers and robots over ZeroMQ and WebSocket.

    Listens on loopback, prints one JSON line with its ports when it is ready, and logs JSON lines
    on stderr. `handmap serve --schema` describes the messages. `handmap_core.client` is a client:
    install `handmap-core[client]`, or copy its folder to where you need it.

    Attributes:
        log_level: Lowest level to log.
        schema: Print the description of all messages, and exit.
        json_schema: Print their JSON schema, and exit.
    """

    log_level: Literal["debug", "info", "warning", "error"] = "info"
    schema: bool = False
    json_schema: bool = False

    def run(self) -> None:
        """Serve until SIGINT or SIGTERM."""
        for option, file in SCHEMAS.items():
            if getattr(self, option):
                print(file.read_text(encoding="utf-8"), end="")
                return
        with _needing_extra():
            from .server import run_server
        run_server(self, self.log_level)
        # All is closed. Python would wait for a thread that loads a hand, maybe for seconds.
        sys.stdout.flush()
        os._exit(0)


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

    folder: Positional[Path]
    client: tuple[str, ...] = ("client",)

    def run(self) -> None:
        """Make the keys, and print the files written."""
        with _needing_extra():
            from .keys import make_keys
        written = make_keys(self.folder, self.client)
        for file in written:
            is_back = (
                file.parent.name == "clients" and self.folder / file.name not in written
            )
            back = f", which admits {file.stem} again" * is_back
            print(f"wrote {file}{back}")
        if not written:
            print("wrote nothing: all keys exist")


@contextmanager
def _needing_extra() -> Iterator[None]:
    """Say what to install where an import in the block lacks a package of the extra."""
    try:
        yield
    except ModuleNotFoundError as error:
        raise MissingExtraError(str(error.name), "service") from error
