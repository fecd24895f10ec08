"""The mapper as a process of its own that trackers, robots and viewers talk to: `handmap serve`.

messages    what travels, as types, and the schema made of them
session     one human hand and one robot hand: steps, watchdog, reset; no input or output of its own
safety      the robot's last commanded posture, and the only way to the next one
dispatch    all sessions: who asks what, caps, answers
server      ZeroMQ; websocket, metrics: the other doors
"""
