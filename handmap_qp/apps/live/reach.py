"""How another device reaches the service: its address, a certificate and a token, and a QR code."""

import io
import ipaddress
import os
import secrets
import shutil
import socket
import subprocess
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from handmap_core.errors import InvalidInputError, require
from handmap_qp.apps.addresses import bare_host
from handmap_qp.output_files import make_folder

_DAYS = 365
"""How long a certificate is valid [days]."""
_REST = 2 * 24 * 3600
"""Time before its end at which it is made again [s]."""
_ELSEWHERE = "192.0.2.1", 9
"""An address of no host (RFC 5737): the way to it shows which of ours others see."""


class Reach(NamedTuple):
    """What the service needs so that a device in the network may connect.

    Attributes:
        host: Address of this machine.
        certificate: PEM file of the TLS certificate for this address.
        key: PEM file of its key.
        token_file: File with the token that the page must present.
    """

    host: str
    certificate: Path
    key: Path
    token_file: Path

    @property
    def token(self) -> str:
        """The token."""
        return self.token_file.read_text(encoding="utf-8").strip()

    @property
    def options(self) -> list[str]:
        """What `handmap serve --web` needs."""
        return [
            *("--web-host", self.host),
            *("--web-certificate", str(self.certificate)),
            *("--web-key", str(self.key)),
            *("--web-token-file", str(self.token_file)),
        ]


def network_reach(host: str | None = None) -> Reach:
    """Return what lets devices of the network connect; make the certificate and token if needed.

    They are kept in `handmap/live` in the user's data, so that a headset asks about the certificate
    once.

    Args:
        host: Address of this machine; that of the way out if omitted.

    Raises:
        InvalidInputError: If this machine has no address, openssl is missing, or a file cannot be
            written.
    """
    host = bare_host("--address", host or _own_address())
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local/share"
    folder = Path(data, "handmap/live")
    make_folder(folder, "--network")
    name = host.replace(":", "_")
    certificate, key = folder / f"{name}.cert.pem", folder / f"{name}.key.pem"
    if not _is_valid(certificate, key):
        _make_certificate(host, certificate, key)
    token_file = folder / "token"
    if not token_file.is_file():
        # Only its owner can read it, from the first moment.
        with os.fdopen(
            os.open(token_file, os.O_CREAT | os.O_WRONLY, 0o600), "w"
        ) as file:
            file.write(secrets.token_urlsafe(24))
    return Reach(host, certificate, key, token_file)


def qr_code(text: str) -> str:
    """Return a text as a QR code for a terminal, two rows of the code in each line.

    Raises:
        MissingExtraError: If segno is not installed.
    """
    segno = require("segno", "service")
    page = io.StringIO()
    segno.make_qr(text, error="l").terminal(page, compact=True, border=2)
    return page.getvalue().rstrip("\n")


def _own_address() -> str:
    """Return the address that others see; nothing is sent."""
    with suppress(OSError), socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as way:
        way.connect(_ELSEWHERE)
        return str(way.getsockname()[0])
    raise InvalidInputError(
        "this machine is in no network",
        argument="--network",
        advice="join one, or name an address of it by --address",
    )


def _is_valid(certificate: Path, key: Path) -> bool:
    """Return whether both files are there and the certificate does not end soon."""
    if not (certificate.is_file() and key.is_file()):
        return False
    check = ["x509", "-in", str(certificate), "-noout", "-checkend", str(_REST)]
    return _openssl(check).returncode == 0


def _make_certificate(host: str, certificate: Path, key: Path) -> None:
    try:
        ipaddress.ip_address(host)
        name = f"IP:{host}"
    except ValueError:
        name = f"DNS:{host}"
    request = ["req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", str(_DAYS)]
    files = ["-keyout", str(key), "-out", str(certificate)]
    subject = ["-subj", "/CN=handmap", "-addext", f"subjectAltName={name}"]
    result = _openssl([*request, *files, *subject])
    if result.returncode:
        lines = result.stderr.strip().splitlines() or ["no message"]
        raise InvalidInputError(
            f"openssl made no certificate: {lines[-1]}", argument="--network"
        )
    key.chmod(0o600)


def _openssl(words: list[str]) -> subprocess.CompletedProcess[str]:
    if not (program := shutil.which("openssl")):
        raise InvalidInputError(
            "the program openssl is missing, which makes the certificate",
            argument="--network",
            advice="install it, or use a cable without --network",
        )
    return subprocess.run(
        [program, *words], capture_output=True, text=True, check=False
    )
