"""The client of the mapping service, under its public name; see `handmap_core.client`."""

from handmap_core.client import (
    ADDRESS,
    PROTOCOL,
    AsyncClient,
    Client,
    Command,
    Error,
    HandFields,
    Hands,
    KeyFiles,
    Lengths,
    Opened,
    Options,
    Pose,
    PoseLike,
    ServiceError,
    ServiceTimeoutError,
    State,
)
from . import messages

__all__ = [
    "ADDRESS",
    "PROTOCOL",
    "AsyncClient",
    "Client",
    "Command",
    "Error",
    "HandFields",
    "Hands",
    "KeyFiles",
    "Lengths",
    "Opened",
    "Options",
    "Pose",
    "PoseLike",
    "ServiceError",
    "ServiceTimeoutError",
    "State",
    "messages",
]
