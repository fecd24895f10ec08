"""CURVE keys in files: `server.key_secret`, `server.key`, and for each client a pair, its public half also in `clients/`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from handmap_qp.errors import InvalidInputError


@dataclass(frozen=True, slots=True)
class ServerKeys:
    """What a server needs.

    Attributes:
        public: Its public key, Z85.
        secret: Its secret key, Z85.
        has_clients: Whether any client may come in.
    """

    public: bytes
    secret: bytes
    has_clients: bool


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
    return ServerKeys(public, secret, any((folder / "clients").glob("*.key")))
