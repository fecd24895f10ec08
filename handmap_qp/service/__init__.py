"""The mapper as a process that trackers, robots and viewers connect to: `handmap serve`.

Messages:
    messages    types of requests and replies, decoding and checks
    schema      their description
    convert     arrays to the values of messages and back

One session, without input or output:
    session     steps, reset, options
    states      states and transitions
    watchdog    effects of silence
    safety      posture last commanded, speed limits, time granted
    inputs      kinds of samples
    opening     hands and mapper from a request; hand_cache, calibration
    refusals    errors as refusals that name a field

All sessions:
    dispatch    requests, rate limits, repeated requests, answers
    sessions    open, find and end sessions
    caps        limits of what clients may do
    store       postures that outlive sessions

Transports:
    server      ZeroMQ; websocket, metrics (HTTP)
    keys        CURVE keys and tokens; handshakes
    run, cli    process and commands; logs
"""
