"""The mapper as a process that trackers, robots and viewers connect to: `handmap serve`.

Its messages are the types of `handmap_qp.client.messages`.

One session, without sockets: `session`, `safety`, and `opening` from a request. All sessions:
`dispatch` reads and answers messages; `sessions`, `store`, `settings`. Transports: `server`, with
`listening`, `direct` and `zmtp` (ZeroMQ), `connection_gate` and `keys` (encrypted), `websocket` and
`pages`. What operators see: `cli`, `logs`.
"""
