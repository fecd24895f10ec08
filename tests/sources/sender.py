"""Senders of the tests, as programs of their own: `python sender.py KIND ADDRESS FILE`.

    udp, zmq: every line of the file is a packet in hexadecimal digits, `wait` or `from HOST`.
    avp: arrays `wrists` (n, 4, 4) and `joints` (n, 29, 4, 4) of an .npz, as the app's server.

It imports nothing of handmap_qp, and what the app sends it writes by field numbers.
"""

from __future__ import annotations

import socket
import struct
import sys
import time
from collections.abc import Iterator
from concurrent import futures
from pathlib import Path

import numpy as np

PERIOD = 0.004


def send_datagrams(address: str, lines: list[str]) -> None:
    host, port = address.split(":")
    sender = socket.socket(type=socket.SOCK_DGRAM)
    for line in lines:
        match line.split():
            case ["wait"]:
                time.sleep(0.5)
            case ["from", own]:
                sender = socket.socket(type=socket.SOCK_DGRAM)
                sender.bind((own, 0))
            case words:
                sender.sendto(bytes.fromhex("".join(words)), (host, int(port)))
        time.sleep(PERIOD)


def publish(address: str, lines: list[str]) -> None:
    import zmq

    with zmq.Context() as context, context.socket(zmq.XPUB) as sender:
        sender.bind(f"tcp://{address}")
        # Somebody has subscribed.
        sender.recv()
        for line in lines:
            sender.send_multipart([b"topic", bytes.fromhex(line)])
            time.sleep(PERIOD)
        time.sleep(0.2)


def field(number: int, content: bytes) -> bytes:
    """Return a field of a message within a message."""
    size = len(content)
    length = bytes([size & 127 | 128, size >> 7]) if size > 127 else bytes([size])
    return bytes([number << 3 | 2]) + length + content


def matrix(pose: np.ndarray) -> bytes:
    """Return a matrix: sixteen floats by rows, numbered from 1."""
    entries = enumerate(pose.ravel(), start=1)
    wire = [(n << 3 | 5, x) for n, x in entries]
    return b"".join(
        (bytes([tag]) if tag < 128 else bytes([tag & 127 | 128, tag >> 7]))
        + struct.pack("<f", x)
        for tag, x in wire
    )


def update(wrist: np.ndarray, joints: np.ndarray, hand: int) -> bytes:
    """Return a message of the app: 1 is the left hand, 2 the right one, 3 the head."""
    skeleton = b"".join(field(1, matrix(joint)) for joint in joints)
    shape = field(1, matrix(wrist)) + field(2, skeleton)
    return field(hand, shape) + field(3, matrix(np.eye(4)))


def serve(address: str, file: Path) -> None:
    import grpc

    data = np.load(file)
    hand = {"left": 1, "right": 2}[str(data["side"])]
    samples = [
        update(wrist, joints, hand)
        for wrist, joints in zip(data["wrists"], data["joints"], strict=True)
    ]
    asked: futures.Future[bytes] = futures.Future()
    done: futures.Future[None] = futures.Future()

    def stream(request: bytes, context: grpc.ServicerContext) -> Iterator[bytes]:
        if not asked.done():
            asked.set_result(request)
        # Nobody is seen at first, and the app repeats what it has.
        for sample in [update(np.eye(4), np.tile(np.eye(4), (25, 1, 1)), hand)] * 3:
            yield sample
        for sample in samples:
            for _ in range(2):
                yield sample
                time.sleep(PERIOD)
        for _ in range(int(data["rests"])):
            yield samples[-1]
            time.sleep(PERIOD)
        if not done.done():
            done.set_result(None)
        if not data["ends"]:
            while context.is_active():
                yield samples[-1]
                time.sleep(PERIOD)

    handler = grpc.unary_stream_rpc_method_handler(stream)
    name = "handtracking.HandTrackingService"
    service = grpc.method_handlers_generic_handler(name, {"StreamHandUpdates": handler})
    server = grpc.server(futures.ThreadPoolExecutor(4))
    server.add_generic_rpc_handlers((service,))
    server.add_insecure_port(address)
    server.start()
    print("ready", flush=True)
    print(asked.result().hex(), flush=True)
    done.result()
    server.stop(0.2).wait()


def main() -> None:
    kind, address, file = sys.argv[1:]
    if kind == "avp":
        serve(address, Path(file))
    else:
        send = send_datagrams if kind == "udp" else publish
        send(address, Path(file).read_text().splitlines())


if __name__ == "__main__":
    main()
