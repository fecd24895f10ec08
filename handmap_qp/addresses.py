"""Checks of where service and view listen, shared by their doors."""

from __future__ import annotations

import ipaddress
import re

from handmap_qp.errors import InvalidInputError


def is_loopback(host: str) -> bool:
    """Whether a host, as a name or address, is this machine and cannot be reached from another."""
    try:
        return host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


def names_loopback(asked: str) -> bool:
    """Whether the `Host` of an HTTP request names this machine.

    Any site's name can be made to lead here.

    Args:
        asked: `HOST` or `HOST:PORT`.
    """
    return is_loopback(_unbracketed(re.sub(r":\d*$", "", asked)))


def bare_host(name: str, host: str) -> str:
    """A host without the brackets that URLs have round IPv6.

    Args:
        name: What the host is called.
        host: The host as it was given.

    Raises:
        InvalidInputError: If more was given than a host.
    """
    bare = _unbracketed(host)
    if not bare or "/" in bare or (":" in bare and not _is_address(bare)):
        raise InvalidInputError(
            f"{name}: expected a host alone, such as 127.0.0.1 or ::1, and its port apart; got {host!r}"
        )
    return bare


def _unbracketed(host: str) -> str:
    return host[1:-1] if host.startswith("[") and host.endswith("]") else host


def _is_address(host: str) -> bool:
    try:
        ipaddress.ip_address(host)
    except ValueError:
        return False
    return True


def check_port(name: str, port: int) -> None:
    """Refuse a number that is no port.

    ZeroMQ takes -1 for any port, and others fail late and in their own words.

    Args:
        name: What the port is called.
        port: The port; 0 lets the system choose.

    Raises:
        InvalidInputError: If there is no such port.
    """
    if not 0 <= port <= 65535:
        raise InvalidInputError(f"{name}: expected 0 to 65535, got {port}", value=port)
