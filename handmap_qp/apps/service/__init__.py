"""The mapper as a process that trackers, robots and viewers connect to: `handmap serve`.

Its messages are the types of `handmap_qp.client.messages`.

One session, without sockets:
    session     samples become commands; options, reset, stop
    safety      states, watchdog, the gate of the robot, time granted, rates
    opening     hands and mapper from a request; measurement of the human hand

All sessions:
    dispatch    messages are read, checked, answered; rate limits, repeated requests
    sessions    open, find and end sessions; their owners
    store       postures that outlive sessions
    settings    addresses, files, limits of what clients may do

Transports:
    server      ZeroMQ sockets, and the process; connection_gate in front of them
    websocket   WebSocket; pages (HTTP)
    keys        CURVE keys and tokens

What users and operators see:
    cli         commands; messages.md and .json describe the messages
    logs        logs, the audit log, metrics

Modules of `__init__.pyi` need ZeroMQ, and are imported at their first use.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
