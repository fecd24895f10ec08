"""Secrets in files that only their owner can read: CURVE keys, and the WebSocket token.

A folder of keys holds `server.key_secret` and `server.key`, and such a pair for each client. The
public keys of admitted clients are also in `clients/`.
"""

import re
from collections.abc import KeysView, Sequence
from contextlib import suppress
from logging import INFO, WARNING
from pathlib import Path

from zmq.auth import create_certificates, load_certificate

from handmap_core.errors import InvalidInputError, InvalidOptionsError, expect
from handmap_qp.apps.refusals import naming
from .logs import Throttle, report

_KEY_LENGTH = 40
"""Length of a key as Z85."""


class ClientKeys:
    """The public keys of admitted clients, as they are in a folder.

    pyzmq's authenticator asks it at every handshake.

    Args:
        folder: Folder of the public keys, each in a file `*.key`.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._seen = {}
        self._admitted: dict[bytes, str] = {}
        # Names stay when a client is shut out, because its connections stay too.
        self._names: dict[bytes, str] = {}
        self._refusals = Throttle()

    def read(self) -> KeysView[bytes]:
        """Return the keys, Z85; read the files again only if the folder has changed."""
        seen = {}
        for file in self._folder.glob("*.key"):
            # A file that was deleted meanwhile admits no one.
            with suppress(OSError):
                status = file.stat()
                seen[file] = (status.st_ino, status.st_mtime_ns, status.st_size)
        if seen != self._seen:
            keys = {key: file.stem for file in seen if (key := _read_public(file))}
            self._seen = seen
            self._admitted = keys
            self._names |= keys
            report(INFO, "keys", clients=len(keys))
        return self._admitted.keys()

    def name_of(self, key: str) -> str:
        """Return the name of a client by its public key, Z85; the key if it was never read."""
        return self._names.get(key.encode(), key)

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client is admitted; pyzmq gives the method its name.

        Args:
            domain: Not used; all clients share one.
            key: Public key of the client, Z85.
        """
        is_known = key in self.read()
        if not is_known:
            self._refusals.report(
                WARNING, "refused_key", key=key.decode("ascii", "replace")
            )
        return is_known


def make_keys(folder: Path, clients: Sequence[str]) -> list[Path]:
    """Make keys; existing ones stay, and clients whose admission was deleted are admitted again.

    Args:
        folder: Folder of the keys. It is made if it does not exist, readable for its owner only.
        clients: Names of clients.

    Returns:
        The files written.

    Raises:
        InvalidInputError: If a name cannot be a file name, or the folder cannot be written.
    """
    for name in clients:
        expect(
            re.fullmatch(r"[\w-]*[^\W_][\w-]*", name) and name != "server",
            "client",
            "a name of letters, digits, - and _ that is not 'server'",
            value=name,
        )
    _check_folder(folder)
    written: list[Path] = []
    with naming():
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        (folder / "clients").mkdir(mode=0o700, exist_ok=True)
        for name in ("server", *clients):
            secret = folder / f"{name}.key_secret"
            public = folder / f"{name}.key"
            admitted = folder / "clients" / f"{name}.key"
            is_new = not secret.exists()
            if is_new:
                # Create the file with its mode, so that others can never read the secret.
                secret.touch(mode=0o600)
                create_certificates(folder, name)
                secret.chmod(0o600)
                written += [public, secret]
            if name != "server" and (is_new or not admitted.exists()):
                admitted.write_bytes(public.read_bytes())
                written.append(admitted)
    return written


def read_server_keys(folder: Path) -> tuple[bytes, bytes]:
    """Read the server's public and secret key, Z85.

    Raises:
        InvalidInputError: If they do not exist, or others can read them.
    """
    _check_folder(folder)
    file = folder / "server.key_secret"
    if not file.exists():
        raise InvalidInputError(
            "does not exist",
            argument=str(file),
            advice=f"handmap keys {folder} makes it",
        )
    _read_private(file)
    # pyzmq raises these errors if the file has no key.
    with suppress(ValueError, IndexError):
        public, secret = load_certificate(file)
        if secret and len(public) == len(secret) == _KEY_LENGTH:
            return public, secret
    raise InvalidInputError(
        argument=str(file),
        expected="a server's secret key",
        got="something else",
        advice=f"delete it and run handmap keys {folder}; "
        "then give all clients the new server.key",
    )


def read_token(file: Path) -> str:
    """Read the token that WebSocket clients must present.

    Raises:
        InvalidInputError: If it cannot be read, or if others can read it.
        InvalidOptionsError: If it is not a token.
    """
    token = _read_private(file).strip()
    if not re.fullmatch(r"[A-Za-z0-9_-]{16,256}", token):
        raise InvalidOptionsError(
            option="web_token_file",
            expected="a token of 16 to 256 letters, digits, - and _",
        )
    return token


def _read_private(file: Path) -> str:
    """Read a file with a secret; reject one that others can read."""
    with naming(file, "cannot be read"):
        is_open = file.stat().st_mode & 0o077
        text = file.read_text(encoding="utf-8", errors="replace")
    if is_open:
        raise InvalidInputError(
            "others can read it",
            argument=str(file),
            advice="chmod 600 it, and make a new secret if they may have",
        )
    return text


def _check_folder(folder: Path) -> None:
    expect(
        folder.is_dir() or not folder.exists(),
        str(folder),
        "a folder of keys",
        got="a file",
        advice="handmap keys FOLDER makes one",
    )


def _read_public(file: Path) -> bytes | None:
    """Return a client's public key; log a warning and return None if the file has none."""
    try:
        return load_certificate(file)[0]
    except (OSError, ValueError, IndexError) as error:
        report(WARNING, "no_key", file=str(file), error=str(error))
        return None
