"""Count and log failed ZeroMQ handshakes.

libzmq reports them only through a socket monitor, neither to the server nor to the client.
"""

from __future__ import annotations

from logging import INFO

import zmq
import zmq.asyncio
from zmq.utils.monitor import recv_monitor_message

from handmap_qp.service.logs import Throttle
from handmap_qp.service.metrics import Metrics

_FAILURES = (
    zmq.Event.HANDSHAKE_FAILED_NO_DETAIL,
    zmq.Event.HANDSHAKE_FAILED_PROTOCOL,
    zmq.Event.HANDSHAKE_FAILED_AUTH,
)


async def report_handshakes(
    context: zmq.asyncio.Context, socket: zmq.Socket, metrics: Metrics
) -> None:
    """Count and log the handshakes that fail on a socket, until cancelled.

    Args:
        context: Context of the socket, for asyncio.
        socket: The socket to monitor.
        metrics: Counters.
    """
    address, failed = f"inproc://handshakes-{socket.FD}", Throttle()
    with context.socket(zmq.PAIR) as events:
        # No high-water mark: libzmq's I/O thread, which serves all connections, would block.
        events.linger = events.rcvhwm = 0
        socket.monitor(address, sum(_FAILURES))
        try:
            events.connect(address)
            while True:
                event = await recv_monitor_message(events)
                metrics.refusals["handshake"] += 1
                failed.report(INFO, "handshake", reason=_reason(event["event"], event["value"]))
        finally:
            socket.disable_monitor()


def _reason(event: int, value: int) -> str:
    """Return why a handshake failed, as far as libzmq reports it."""
    if event == zmq.Event.HANDSHAKE_FAILED_AUTH:
        return "the client's key is not among the keys in clients/"
    if (
        event == zmq.Event.HANDSHAKE_FAILED_PROTOCOL
        and value == zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
    ):
        return "the client's server.key is another server's"
    return "only one of client and server uses keys, or the client does not speak ZeroMQ"
