"""Client of the mapping service (`handmap serve`).

This folder needs numpy, msgspec and pyzmq, and nothing else: copy it to where you need it.

    with Client() as client:
        client.open("allegro_right", preset="teleoperation")
        command = client.step(q=human_q, wrist=wrist_pose)    # wait for the answer to each sample
        client.send(q=human_q, wrist=wrist_pose)              # or send without waiting,
        command = client.latest(timeout=0.1)                  # and read the newest command

In another process, such as the robot's driver, call `watch` with the name of the session and then
`latest`. `AsyncClient` has the same methods as coroutines. A call raises `ServiceTimeoutError` if
no answer arrives in time, and `ServiceError` if the server refuses the request. If the server was
restarted, the client reopens its session where the robot is. Units are SI and radians; `messages`
describes all fields. Use one client per thread or per event loop.
"""

from . import messages
from .asynchronous import AsyncClient
from .blocking import Client
from .calls import (
    ADDRESS,
    Command,
    HandFields,
    Hands,
    KeyFiles,
    Options,
    PoseLike,
    ServiceError,
    ServiceTimeoutError,
    State,
)
from .messages import PROTOCOL, Error, Lengths, Opened, Pose

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
