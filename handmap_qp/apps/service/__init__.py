"""The mapper as a process that trackers, robots and viewers connect to: `handmap serve`.

Its messages are the types of `handmap_qp.client.messages`.

One session, without sockets: `session`, `safety`, and `opening` from a request. All sessions:
`dispatch` reads and answers messages; `sessions`, `store`, `settings`. Transports: `server` and
`connection_gate` (ZeroMQ), `websocket` and `pages`, `keys`. What operators see: `cli`, `logs`.
"""
