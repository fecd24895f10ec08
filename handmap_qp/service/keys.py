"""CURVE keys in files: `server.key_secret`, `server.key`, and for each client a pair, its public half also in `clients/`."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from logging import INFO, WARNING
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from handmap_qp.errors import InvalidInputError
from handmap_qp.service.logs import report


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """What a server needs.

    Attributes:
        public: Its public key, Z85.
        secret: Its secret key, Z85.
    """

    public: bytes
    secret: bytes


class ClientKeys:
    """The keys of the clients that may come in, as they lie in a folder: pyzmq's authenticator asks it at every handshake.

    Args:
        folder: Where the public keys are, each in a file `*.key`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: dict[Path, tuple[int, int, int]] = {}
        self._keys: frozenset[bytes] = frozenset()

    def read(self) -> frozenset[bytes]:
        """The keys, Z85. Files are read again only if one has come, gone or changed."""
        seen = {}
        for file in self._folder.glob("*.key"):
            # What cannot be looked at has gone meanwhile, and lets nobody in.
            with suppress(OSError):
                status = file.stat()
                seen[file] = (status.st_ino, status.st_mtime_ns, status.st_size)
        if seen != self._seen:
            self._seen, self._keys = seen, frozenset(filter(None, map(_read_public, seen)))
            report(INFO, "keys", clients=len(self._keys))
        return self._keys

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether a client may come in; pyzmq's name for it.

        Args:
            domain: Not used: there is one for all.
            key: The client's public key, Z85.
        """
        return key in self.read()


def make_keys(folder: Path, clients: Sequence[str]) -> list[Path]:
    """Make keys; those that are there stay.

    Args:
        folder: Where to put them; made if it does not exist, for its owner alone.
        clients: Names of clients.

    Returns:
        The files written.

    Raises:
        InvalidInputError: On a name that makes no file name, or a folder that cannot be written.
    """
    written: list[Path] = []
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / "clients").mkdir(mode=0o700, exist_ok=True)
        for name in ("server", *clients):
            if not name.replace("-", "").replace("_", "").isalnum() or (name == "server" and name in clients):
                raise InvalidInputError(f"{name!r}: expected a name of letters, digits, - and _ that is not 'server'")
            secret = folder / f"{name}.key_secret"
            if secret.exists():
                continue
            # The secret is never readable by others, not even for a moment.
            secret.touch(mode=0o600)
            public, _ = create_certificates(folder, name)
            secret.chmod(0o600)
            written += [Path(public), secret]
            if name != "server":
                admitted = folder / "clients" / f"{name}.key"
                admitted.write_bytes(Path(public).read_bytes())
                written.append(admitted)
    except OSError as error:
        raise InvalidInputError(f"{error.filename or folder}: {error.strerror}") from error
    return written


def read_server_keys(folder: Path) -> ServerKeys:
    """Read the server's pair.

    Raises:
        InvalidInputError: If it is not there, or readable by others.
    """
    file = folder / "server.key_secret"
    try:
        if file.stat().st_mode & 0o077:
            raise InvalidInputError(f"{file}: others can read it; chmod 600 it, or make new keys if they may have")
        public, secret = load_certificate(file)
    except (OSError, ValueError) as error:
        if isinstance(error, InvalidInputError):
            raise
        raise InvalidInputError(f"{file}: cannot be read; handmap keys {folder} makes it") from error
    if secret is None:
        raise InvalidInputError(f"{file}: holds no secret key")
    return ServerKeys(public, secret)


def _read_public(file: Path) -> bytes | None:
    """A client's public key; None, and a warning, where the file holds none: the other clients are not to suffer."""
    try:
        return load_certificate(file)[0]
    except (OSError, ValueError) as error:
        report(WARNING, "no_key", file=str(file), error=str(error))
        return None
