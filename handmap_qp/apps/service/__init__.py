"""The mapper as a process that trackers, robots and viewers connect to: `handmap serve`.

Its messages are the types of `handmap_qp.client.messages`.

Messages:
    decoding    requests, their checks, and replies
    schema      description of the messages
    refusals    errors as refusals that name a field

One session, without input or output:
    session     steps, reset, options
    states      states and transitions, watchdog, owner
    safety      posture last commanded, speed limits, time granted
    samples     kinds of samples, and the values of commands
    opening     hands and mapper from a request; measurement of the human hand

All sessions:
    dispatch    requests, rate limits, repeated requests, answers
    sessions    open, find and end sessions
    settings    addresses, files, limits of what clients may do; rate_limit
    store       postures that outlive sessions

Transports:
    server      ZeroMQ sockets, and the process; connection_gate in front of them
    websocket   WebSocket; pages, metrics (HTTP)
    keys        CURVE keys and tokens
    cli         commands
    logs        logs, and the audit log
"""
