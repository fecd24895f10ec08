"""Addresses that service and view listen on, and those that clients connect to."""

import ipaddress
import re
import socket
from contextlib import suppress

from handmap_core.errors import InvalidInputError, expect
from .refusals import naming

REQUESTS_PORT = 5570
"""Default port of requests to `handmap serve`."""


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a host, given as name or address."""
    return host == "localhost" or getattr(_address(host), "is_loopback", False)


def names_loopback(address: str) -> bool:
    """Return whether the `Host` of an HTTP request names this machine.

    Any site can make its own name resolve to this machine (DNS rebinding).

    Args:
        address: `HOST` or `HOST:PORT`.
    """
    return is_loopback(_unbracketed(re.sub(r":\d*$", "", address)))


def bare_host(name: str, host: str) -> str:
    """Return a host without the brackets that URLs have round IPv6.

    Args:
        name: Name of the argument, for the error.
        host: The host as given.

    Raises:
        InvalidInputError: If it is more than a host.
    """
    bare = _unbracketed(host)
    expect(
        bare and "/" not in bare and (":" not in bare or _address(bare)),
        name,
        "a host alone, such as 127.0.0.1 or ::1, and its port apart",
        value=host,
    )
    return bare


def url_host(host: str) -> str:
    """Return a host as URLs have it: IPv6 in brackets."""
    return f"[{host}]" if ":" in host else host


def _unbracketed(host: str) -> str:
    return re.sub(r"^\[(.*)\]\Z", r"\1", host)


def _address(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    with suppress(ValueError):
        return ipaddress.ip_address(host)
    return None


def check_port(name: str, port: int) -> None:
    """Reject a number that is not a port.

    ZeroMQ takes -1 for any port, and others fail late and in their own words.

    Args:
        name: Name of the argument, for the error.
        port: The port; 0 lets the system choose.

    Raises:
        InvalidInputError: If there is no such port.
    """
    expect(0 <= port <= 65535, name, "0 to 65535", value=port)


def service_address(name: str, host: str) -> str:
    """Return the ZeroMQ address of a mapping service.

    Args:
        name: Name of the argument, for the error.
        host: `HOST`, `HOST:PORT`, `IPv6` or `[IPv6]:PORT`, also after `tcp://`.

    Raises:
        InvalidInputError: If there is no such host or port.
    """
    text = host.removeprefix("tcp://")
    place, _, port = (
        text.rpartition(":")
        if ":" in text.rpartition("]")[2] and not _address(text)
        else (text, "", str(REQUESTS_PORT))
    )
    with naming(name, f"unknown host {place!r}", value=host):
        try:
            number = int(port if place.strip() else "")
            socket.getaddrinfo(place.strip("[]"), None)
        except ValueError as error:
            raise InvalidInputError(
                argument=name, expected="HOST or HOST:PORT", value=host
            ) from error
    check_port(name, number)
    return f"tcp://{place}:{number}"
