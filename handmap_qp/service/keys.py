"""Secrets in files, for their owner alone: CURVE keys, and WebSocket's token.

Keys are `server.key_secret`, `server.key`, and for each client a pair, its public half also in
`clients/`.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from logging import INFO, WARNING
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from handmap_qp.errors import InvalidInputError
from handmap_qp.service.logs import Throttle, report

_KEY_LENGTH = 40
"""Of a key as Z85."""


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
    """The keys of the clients that may come in, as they lie in a folder.

    Pyzmq's authenticator asks it at every handshake.

    Args:
        folder: Where the public keys are, each in a file `*.key`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen: dict[Path, tuple[int, int, int]] = {}
        self._keys: frozenset[bytes] = frozenset()
        self._refusals = Throttle()

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
        is_known = key in self.read()
        if not is_known:
            self._refusals.report(WARNING, "refused_key", key=key.decode("ascii", "replace"))
        return is_known


def make_keys(folder: Path, clients: Sequence[str]) -> list[Path]:
    """Make keys; those that are there stay, and clients that were shut out come in again.

    Args:
        folder: Where to put them; made if it does not exist, for its owner alone.
        clients: Names of clients.

    Returns:
        The files written.

    Raises:
        InvalidInputError: On a name that makes no file name, or a folder that cannot be written.
    """
    for name in clients:
        if not name.replace("-", "").replace("_", "").isalnum() or name == "server":
            raise InvalidInputError(
                f"{name!r}: expected a name of letters, digits, - and _ that is not 'server'"
            )
    _check_folder(folder)
    written: list[Path] = []
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / "clients").mkdir(mode=0o700, exist_ok=True)
        for name in ("server", *clients):
            secret = folder / f"{name}.key_secret"
            if not secret.exists():
                # The secret is never readable by others, not even for a moment.
                secret.touch(mode=0o600)
                create_certificates(folder, name)
                secret.chmod(0o600)
                written += [folder / f"{name}.key", secret]
            admitted = folder / "clients" / f"{name}.key"
            if name != "server" and (secret in written or not admitted.exists()):
                admitted.write_bytes((folder / f"{name}.key").read_bytes())
                written.append(admitted)
    except OSError as error:
        raise InvalidInputError(f"{error.filename or folder}: {error.strerror}") from error
    return written


def read_server_keys(folder: Path) -> ServerKeys:
    """Read the server's pair.

    Raises:
        InvalidInputError: If it is not there, or readable by others.
    """
    _check_folder(folder)
    file = folder / "server.key_secret"
    try:
        _check_private(file)
        public, secret = load_certificate(file)
    except FileNotFoundError as error:
        raise InvalidInputError(f"{file}: is not there; handmap keys {folder} makes it") from error
    except OSError as error:
        raise InvalidInputError(f"{file}: cannot be read: {error.strerror}") from error
    except InvalidInputError:
        raise
    except ValueError:
        # Of pyzmq, where no line is a key.
        public, secret = b"", None
    if secret is None or not len(public) == len(secret) == _KEY_LENGTH:
        advice = f"delete it, and handmap keys {folder} makes a new pair, of which clients need server.key"
        raise InvalidInputError(
            f"{file}: expected a server's secret key, got something else; {advice}"
        )
    return ServerKeys(public, secret)


def read_token(file: Path) -> str:
    """Read the token that WebSocket clients must present.

    Raises:
        InvalidInputError: If it cannot be read, or can be by others.
    """
    try:
        _check_private(file)
        return file.read_text(encoding="utf-8").strip()
    except OSError as error:
        raise InvalidInputError(f"{file}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise InvalidInputError(
            f"{file}: cannot be read: expected a token, got bytes that are no text"
        ) from error


def _check_private(file: Path) -> None:
    """Refuse a file with a secret that others can read."""
    if file.stat().st_mode & 0o077:
        raise InvalidInputError(
            f"{file}: others can read it; chmod 600 it, and make a new secret if they may have"
        )


def _check_folder(folder: Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise InvalidInputError(
            f"{folder}: expected a folder of keys, as handmap keys FOLDER makes it; got a file"
        )


def _read_public(file: Path) -> bytes | None:
    """A client's public key; None, and a warning, where the file holds none.

    The other clients are not to suffer.
    """
    try:
        return load_certificate(file)[0]
    except (OSError, ValueError) as error:
        report(WARNING, "no_key", file=str(file), error=str(error))
        return None
