"""Who knocks at ZeroMQ's doors and is not let in.

ZeroMQ itself says no word of it, neither to them nor here.
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
        context: The socket's, for asyncio.
        socket: The socket.
        metrics: Where to count.
    """
    address, failed = f"inproc://handshakes-{socket.FD}", Throttle()
    with context.socket(zmq.PAIR) as events:
        # No bound: ZeroMQ's own thread, which serves all connections, would wait for room.
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
    """Why a handshake has failed, as far as can be told."""
    if event == zmq.Event.HANDSHAKE_FAILED_AUTH:
        return "the client's key is not among the keys in clients/"
    if (
        event == zmq.Event.HANDSHAKE_FAILED_PROTOCOL
        and value == zmq.PROTOCOL_ERROR_ZMTP_CRYPTOGRAPHIC
    ):
        return "the client's server.key is another server's"
    return "the client has keys and the server none, or the other way round; or it speaks no ZeroMQ"
