"""Faults of and around the mapping service; commands, not tests, because they take minutes.

Each scenario disturbs the service while well-behaved clients work. Then it checks: did any call
take longer than its timeout, did any command exceed the robot's speed limits, has memory grown, did
the service log a failure? The exit code is 1 if so.

    python tests/judges service_faults --json faults.json
    python tests/judges service_faults --only restarts fuzz --quick
    sudo python tests/judges service_faults --only openings subscriptions --realtime

On a machine with other programs, gaps are theirs too. With `--realtime`, the service and the
well-behaved clients run before them.
"""

from __future__ import annotations

import os
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import common
import msgspec
import numpy as np
import zmq
from service_clients import TIMEOUT, Honest, HumanMotion, honest, summary
from service_fuzz import fuzz
from service_process import MemoryWatch, ServiceProcess, serving

from handmap_qp.apps.service.sessions import LEASE
from handmap_qp.apps.service.settings import Settings
from handmap_qp.client import Client, KeyFiles, ServiceError, ServiceTimeoutError

_LONGEST_GAP = 0.05
"""Time between two commands of a client at 60 Hz, at most [s]."""
_ELSEWHERE = ("chrt", "--other", "0", "nice", "-n", "15")
"""Attackers stand for programs on other machines: they must not take this one's processor."""
_STOP_TIME = 2.0
"""Time from SIGTERM to the end of the process, at most [s]."""


def restarts(duration: float) -> dict[str, Any]:
    """Kill the service under load every three seconds, and start it again.

    Three clients wait for each answer. Two only send, with drivers of their own that listen. One
    has released its robot.
    """
    with (
        tempfile.TemporaryDirectory() as folder,
        serving(state=Path(folder) / "state") as service,
    ):
        restored, outages, end = 0, [], time.monotonic() + duration
        with (
            honest(service, 3) as asking,
            honest(service, 2, first=100, streams=True) as streaming,
            honest(service, 1, first=200, releases=True) as released,
        ):
            clients = [*asking, *streaming, *released]
            while time.monotonic() < end:
                time.sleep(3.0)
                service.kill()
                killed, counts = (
                    time.monotonic(),
                    [client.answered for client in clients],
                )
                service.start()
                while any(
                    client.answered == before
                    for client, before in zip(clients, counts, strict=True)
                ):
                    if time.monotonic() - killed > 15.0:
                        break
                    time.sleep(0.01)
                outages.append(time.monotonic() - killed)
        # A new client that restores the session must get exactly the last posture, after the lease.
        last = asking[0].last
        service.kill()
        service.start()
        time.sleep(LEASE + 0.5)
        with Client(service.address, timeout=TIMEOUT) as fresh:
            opened = fresh.open("three_finger", name="honest-0", restore=True)
            restored = int(last is not None and opened.q == last.q)
        reopened = sum(client.client.reopened for client in clients)
        offset = max(client.start_offset for client in clients)
        numbers = {
            "kills": len(outages),
            "reopened": reopened,
            "longest_outage_s": max(outages),
            "restored": restored,
        }
        found = summary(clients, **numbers, start_offset=offset)
        if found["epochs"]:
            found["wrong"].append("a session did not continue from the one before")
        if not restored:
            found["wrong"].append("the posture was not restored")
        return found


def vanishing(duration: float) -> dict[str, Any]:
    """Drop connections in the middle of a message on all ports, and kill clients."""
    code = (
        "import sys, numpy as np\nfrom handmap_qp.client import Client\n"
        "client = Client(sys.argv[1]); client.open('three_finger')\n"
        "print('open', flush=True)\nwhile True: client.step(q=np.full(20, 0.1), wrist=np.eye(4))"
    )
    halves = {
        "requests": [
            b"",
            b"\xff",
            _GREETING[:20],
            _GREETING,
            _GREETING + _READY,
            _GREETING + _READY + b"\x00\xc8" + b"x" * 50,
        ],
        "stream": [_GREETING, _GREETING + _READY[:9]],
        "web": [
            b"GET / HTTP/1.1\r\nHost:",
            b"GET / HTTP/1.1\r\n\r\n",
            b"\x16\x03\x01\x02\x00",
        ],
        "health": [b"GET /metr", b"\x00" * 100],
    }
    with (
        serving(web=True, web_port=0, idle=2.0) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
    ):
        files, vanished, killed, end = (
            service.files(),
            0,
            0,
            time.monotonic() + duration,
        )
        while time.monotonic() < end:
            vanished += _touch(service, halves)
            if killed < duration / 5.0:
                process = subprocess.Popen(
                    [sys.executable, "-c", code, service.address],
                    stdout=subprocess.PIPE,
                )
                if process.stdout is not None and process.stdout.readline():
                    process.send_signal(signal.SIGKILL)
                    killed += 1
                process.wait()
        # Sessions and connections of killed clients must end by themselves.
        time.sleep(8.0)
        with Client(service.address) as client:
            state = client.status()
        found = {
            "vanished": vanished,
            "killed": killed,
            "files": service.files() - files,
            "sessions_left": len(state.names) - 2,
        }
    return summary(clients, **memory.found(), failures=len(service.failures), **found)


def _touch(service: ServiceProcess, halves: dict[str, list[bytes]]) -> int:
    """Connect, send part of a message, and drop the connection."""
    count = 0
    for port, payloads in halves.items():
        for payload in payloads:
            with (
                suppress(OSError),
                socket.create_connection(
                    ("127.0.0.1", service.ports[port]), timeout=1.0
                ) as connection,
            ):
                # Reset the connection when it closes (linger of zero).
                connection.setsockopt(
                    socket.SOL_SOCKET,
                    socket.SO_LINGER,
                    b"\x01\x00\x00\x00\x00\x00\x00\x00",
                )
                connection.sendall(payload)
            count += 1
    return count


def resets(duration: float) -> dict[str, Any]:
    """Ask over WebSocket, and reset the connection with the answers outstanding, 10,000 times.

    A short run resets 2,000.
    """
    count = 2_000 if duration < 30.0 else 10_000
    with (
        serving(web=True, web_port=0, rate=1e7) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
    ):
        files, rejected = service.files(), 0
        for number in range(count):
            rejected += not ask_and_reset(service.ports["web"], number)
        time.sleep(2.0)
        left = service.files() - files
    found = summary(
        clients,
        **memory.found(),
        failures=len(service.failures),
        resets=count,
        rejected=rejected,
        files_left=left,
    )
    if rejected:
        found["wrong"].append("a connection was rejected")
    if left > 2:
        found["wrong"].append("connections were left")
    return found


def ask_and_reset(port: int, number: int) -> bool:
    """Ask several times, read nothing, and reset; return whether the handshake was accepted."""
    status = msgspec.msgpack.encode(
        {"type": "status", "protocol": 1, "seq": 1, "session": ""}
    )
    frame = bytes([0x82, 0x80 | len(status)]) + bytes(4) + status
    with socket.create_connection(("127.0.0.1", port), timeout=5.0) as connection:
        connection.sendall(_HANDSHAKE)
        is_accepted = b" 101 " in connection.recv(4096)
        with suppress(OSError):
            connection.sendall(frame * (1 + number % 20))
        # Reset the connection when it closes (linger of zero).
        connection.setsockopt(
            socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
        )
    return is_accepted


_HANDSHAKE = (
    b"GET / HTTP/1.1\r\nHost: localhost\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
    b"Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\nSec-WebSocket-Version: 13\r\n\r\n"
)


def slow_readers(duration: float) -> dict[str, Any]:
    """Connect twenty readers of each kind that ask and never read."""
    from websockets.sync.client import connect

    with (
        serving(web=True, web_port=0) as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
        zmq.Context() as context,
    ):
        step = msgspec.msgpack.encode(
            {"type": "status", "protocol": 1, "seq": 1, "session": ""}
        )
        deaf, webs = [], []
        for _ in range(20):
            listener = context.socket(zmq.SUB)
            listener.linger, listener.rcvhwm = 0, 1
            listener.connect(f"tcp://127.0.0.1:{service.ports['stream']}")
            listener.subscribe(b"")
            asker = context.socket(zmq.DEALER)
            asker.linger, asker.rcvhwm, asker.sndhwm = 0, 1, 10
            asker.connect(service.address)
            deaf += [listener, asker]
            web = connect(
                f"ws://127.0.0.1:{service.ports['web']}",
                compression=None,
                max_queue=1,
                ping_interval=None,
            )
            web.send(
                msgspec.msgpack.encode(
                    {"type": "subscribe", "protocol": 1, "seq": 1, "name": "honest-0"}
                )
            )
            webs.append(web)
        asked, end = 0, time.monotonic() + duration
        while time.monotonic() < end:
            for asker in deaf[1::2]:
                with suppress(zmq.Again):
                    asker.send(step, zmq.NOBLOCK)
                    asked += 1
            for web in webs:
                with suppress(Exception):
                    web.socket.setblocking(False)
                    web.socket.send(b"\x82\x80\x00\x00\x00\x00" * 50)
            time.sleep(0.005)
        for each in deaf:
            each.close()
        for web in webs:
            web.socket.close()
    return summary(
        clients,
        **memory.found(),
        failures=len(service.failures),
        readers=60,
        unread=asked,
    )


def clock_jumps(duration: float) -> dict[str, Any]:
    """Let time stamps jump back and forth by years."""
    with serving() as service, honest(service, 3, jumps=True) as clients:
        time.sleep(duration)
    flags = sorted(set().union(*(client.driver.flags for client in clients)))
    found = summary(clients, failures=len(service.failures), flags=flags)
    if not {"time_backwards", "time_jump"} <= set(flags):
        found["wrong"].append("jumps were not flagged")
    return found


def wrong_keys(duration: float) -> dict[str, Any]:
    """Connect without keys, with keys that are not admitted, and with another server's key."""
    from handmap_qp.apps.service.keys import make_keys

    with tempfile.TemporaryDirectory() as folder:
        ours, others = Path(folder) / "ours", Path(folder) / "others"
        make_keys(ours, ["admitted"])
        make_keys(others, ["stranger"])
        admitted = (ours / "admitted.key_secret", ours / "server.key")
        stranger = (others / "stranger.key_secret", ours / "server.key")
        elsewhere = (ours / "admitted.key_secret", others / "server.key")
        with (
            serving(keys=ours) as service,
            honest(service, 2, keys=admitted) as clients,
            MemoryWatch(service) as memory,
        ):
            attempts, admitted_count, end = 0, 0, time.monotonic() + duration
            while time.monotonic() < end:
                for keys in (None, stranger, elsewhere):
                    with Client(
                        service.address, timeout=0.3, attempts=1, keys=keys
                    ) as client:
                        attempts += 1
                        with suppress(ServiceTimeoutError):
                            client.status()
                            admitted_count += 1
        found = summary(
            clients,
            **memory.found(),
            failures=len(service.failures),
            attempts=attempts,
            admitted_count=admitted_count,
        )
    if admitted_count:
        found["wrong"].append("a wrong key was admitted")
    return found


def sessions_come_and_go(duration: float) -> dict[str, Any]:
    """Open, use and close sessions: their memory must be freed."""
    with (
        serving() as service,
        honest(service) as clients,
        MemoryWatch(service) as memory,
    ):
        opened, end = 0, time.monotonic() + duration
        motion = HumanMotion()
        while time.monotonic() < end:
            with (
                Client(service.address, timeout=TIMEOUT) as client,
                suppress(ServiceTimeoutError),
            ):
                try:
                    client.open(
                        "three_finger", hand_length=0.15 + 0.0001 * (opened % 1000)
                    )
                    client.step(**motion(0.0))
                    opened += 1
                except ServiceError:
                    # The server limits openings per second.
                    time.sleep(0.05)
    return summary(
        clients, **memory.found(), failures=len(service.failures), opened=opened
    )


# Each value is valid, and so is every combination.
_WILD: dict[str, dict[str, tuple[Any, ...]]] = {
    "mapping": {
        "scale": (0.0, 0.1, 1.0, 30.0, 1e6, 1e18),
        "pivot": ("centroid", "palm", "world"),
        "alignment": ("world", "palm"),
        "reference": ("first", "previous"),
        "rigid_from": ("points", "wrist", "none"),
        "deformation_gain": (0.0, 0.5, 1.0, 10.0),
    },
    "teleoperation": {
        "residual_gain": (0.0, 1.0),
        "extension_weight": (0.0, 1.0, 1e3),
        "thumb_extension_weight": (0.0, 1e3),
        "pinch_weight": (0.0, 5.0, 1e3),
        "contact_gap": (0.0, 0.04),
        "ridge": (1e-9, 0.1, 1e3),
        "avoids_contact": (True, False),
    },
    "ik": {
        "rest_weight": (0.0, 0.2, 1e3, 1e9),
        "wrist_position_weight": (0.0, 3.0, 1e9),
        "max_iterations": (1, 3, 20),
        "step_tolerance": (0.0, 0.1),
        "has_velocity_limits": (True, False),
    },
}


def steering(duration: float) -> dict[str, Any]:
    """Clutch, release and configure shared sessions at full speed, with extreme valid options."""
    # Only the cap on changes of options must slow them down.
    with (
        serving(rate=1e7) as service,
        honest(service, is_shared=True) as clients,
        MemoryWatch(service) as memory,
    ):
        started = time.monotonic()
        with ThreadPoolExecutor(4) as pool:
            answers = sum(
                pool.map(
                    lambda seed: _steer(service, seed, started + duration), range(4)
                ),
                Counter[str](),
            )
        most = Settings().configures * (time.monotonic() - started + 0.25) + 1.0
    found = summary(
        clients,
        **memory.found(),
        failures=len(service.failures),
        answers=dict(answers.most_common()),
    )
    if not answers["configure: rate"] or answers["configure: done"] > most:
        found["wrong"].append("changes of options were not capped")
    if not set(answers) <= {
        "release: done",
        "clutch: done",
        "configure: done",
        "configure: rate",
    }:
        found["wrong"].append("a valid request was refused, or not answered")
    return found


def _steer(service: ServiceProcess, seed: int, end: float) -> Counter[str]:
    """Steer the session of a well-behaved client by its name, mostly by its options.

    Returns:
        Numbers of answers by their kind.
    """
    generator, answers = np.random.default_rng(seed), Counter[str]()
    with Client(service.address, timeout=TIMEOUT) as client:
        client.watch(f"honest-{seed % 2}")
        while time.monotonic() < end:
            kind = str(
                generator.choice(
                    ["release", "clutch", "configure"], p=[0.01, 0.02, 0.97]
                )
            )
            changes = _wild_changes(generator) if kind == "configure" else {}
            try:
                getattr(client, kind)(**changes)
                answers[f"{kind}: done"] += 1
            except ServiceError as error:
                answers[f"{kind}: {error.error.code}"] += 1
            except ServiceTimeoutError:
                answers[f"{kind}: timeout"] += 1
    return answers


def _wild_changes(generator: np.random.Generator) -> dict[str, Any]:
    """Draw a preset and about a third of its options, each with any of its values."""
    preset = str(generator.choice(["teleoperation", "object", "paper"]))
    changes: dict[str, Any] = {
        "has_detail": bool(generator.integers(2)),
        "preset": preset,
    }
    own = "teleoperation" if preset == "teleoperation" else "mapping"
    for field, options in ((field, _WILD[field]) for field in (own, "ik")):
        drawn = [name for name in options if generator.random() < 1.0 / 3.0]
        changes[field] = {
            name: options[name][int(generator.integers(len(options[name])))]
            for name in drawn
        }
    return changes


def subscriptions(duration: float) -> dict[str, Any]:
    """Subscribe to long topics as fast as the stream takes them, from four connections."""
    code = (
        "import os, sys, zmq\ncontext = zmq.Context()\nsockets = []\n"
        "for _ in range(4):\n    socket = context.socket(zmq.XSUB)\n    socket.linger = 0\n"
        "    socket.sndhwm = 1000\n    socket.connect(sys.argv[1])\n    sockets.append(socket)\n"
        "while True:\n    for socket in sockets:\n        socket.send(b'\\x01' + os.urandom(15000))"
    )
    with (
        serving() as service,
        honest(service) as asking,
        honest(service, 1, first=100, streams=True) as streaming,
        MemoryWatch(service) as memory,
    ):
        clients = [*asking, *streaming]
        quiet = _longest_gap(service, clients, min(10.0, duration))
        before = service.cpu()
        flood = subprocess.Popen(
            [
                *_ELSEWHERE,
                sys.executable,
                "-c",
                code,
                f"tcp://127.0.0.1:{service.ports['stream']}",
            ]
        )
        during = _longest_gap(service, clients, duration)
        share = (service.cpu() - before) / duration
        flood.kill()
        flood.wait()
    return _judge_gaps(
        summary(
            clients, **memory.found(), failures=len(service.failures), cpu_share=share
        ),
        quiet,
        during,
    )


def openings(duration: float) -> dict[str, Any]:
    """Open sessions with expensive hands and self-collision as fast as the caps allow."""
    hands = (
        "allegro_right",
        "hey5",
        "ur5_allegro",
        "tiago_arm",
        "g1_right",
        "romeo_left",
    )
    # Memory is not judged here: the caches of hands fill.
    with serving() as service, honest(service) as clients:
        quiet = _longest_gap(service, clients, min(10.0, duration))
        code = (
            "import itertools, sys\nfrom handmap_qp.client import Client\n"
            f"for i in itertools.count():\n    client = Client(sys.argv[1], timeout=20.0)\n"
            f"    robot = {hands!r}[i % {len(hands)}]\n"
            "    try:\n        client.open(robot, hand_length=0.15 + 0.0001 * (i % 1000))\n"
            "        print(robot, flush=True)\n"
            "    except Exception as error: print('failed', error, flush=True)\n"
            "    client.close()"
        )
        openers = [
            subprocess.Popen(
                [*_ELSEWHERE, sys.executable, "-c", code, service.address],
                stdout=subprocess.PIPE,
                text=True,
            )
            for _ in range(2)
        ]
        during = _longest_gap(service, clients, duration)
        for opener in openers:
            opener.kill()
        answers = Counter(
            line.split()[0]
            for opener in openers
            for line in opener.communicate()[0].splitlines()
        )
    found = summary(clients, failures=len(service.failures), opened=dict(answers))
    return _judge_gaps(found, quiet, during)


def _longest_gap(
    service: ServiceProcess, clients: Sequence[Honest], duration: float
) -> tuple[float, float]:
    """Return the longest gap of a client at 60 Hz during some time, and the server's part in it.

    The gap is the time between two commands [s]. The server's part is the longest CPU time of all
    its threads between two turns of its event loop [s].
    """
    before, busy = [len(client.gaps) for client in clients], 0.0
    end = time.monotonic() + duration
    while time.monotonic() < end:
        time.sleep(0.5)
        with suppress(OSError):
            busy = max(busy, service.busy())
    gap = max(
        max(client.gaps[count + 1 :], default=np.inf)
        for client, count in zip(clients, before, strict=True)
    )
    return gap, busy


def _judge_gaps(
    found: dict[str, Any], quiet: tuple[float, float], during: tuple[float, float]
) -> dict[str, Any]:
    found |= {"longest_gap_quiet_s": quiet[0], "longest_gap_s": during[0]}
    found |= {"longest_busy_quiet_s": quiet[1], "longest_busy_s": during[1]}
    # On a machine that runs other programs, their share is in the gap of the quiet time too.
    if during[0] > max(_LONGEST_GAP, 2.0 * quiet[0]):
        found["wrong"].append("running sessions were delayed")
    return found


_RAW = """
import socket, sys, time
while True:
    try:
        with socket.create_connection(("127.0.0.1", int(sys.argv[1])), timeout=5.0) as raw:
            for part in OPENING:
                raw.sendall(part)
                raw.recv(4096)
            raw.sendall(FLOOD)
            print(flush=True)
    except OSError:
        print(flush=True)
"""
_ZEROMQ = """
import sys, zmq
from zmq.auth import load_certificate
socket = zmq.Context().socket(zmq.DEALER)
socket.linger, socket.sndhwm = 0, 1
socket.curve_publickey, socket.curve_secretkey = load_certificate(sys.argv[2])
socket.curve_serverkey = load_certificate(sys.argv[3])[0]
socket.connect(f"tcp://127.0.0.1:{sys.argv[1]}")
message = [bytes(SIZE)] * NUMBER
while True:
    socket.send_multipart(message)
    print(flush=True)
"""
_IDLE = f"""
import socket, sys, time
idle = []
while True:
    raw = socket.create_connection(("127.0.0.1", int(sys.argv[1])))
    raw.sendall({_HANDSHAKE!r})
    idle = [*idle, raw][-400:]
    time.sleep(0.01)
    print(flush=True)
"""
_GREETING = b"\xff" + bytes(8) + b"\x7f\x03\x00NULL" + bytes(48)
_READY = b"\x04\x1c\x05READY\x0bSocket-Type" + b"\x00\x00\x00\x06DEALER"


def _raw(flood: str, *opening: bytes) -> str:
    """Return a program that sends some bytes after a handshake, again and again."""
    return _RAW.replace("OPENING", repr(opening)).replace("FLOOD", flood)


_FRAMES = {
    "fragments": _raw(
        r"b'\x02\x80' + bytes(4) + (b'\0\x80' + bytes(4)) * 200_000", _HANDSHAKE
    ),
    "pings": _raw(r"(b'\x89\x80' + bytes(4)) * 200_000", _HANDSHAKE),
    "empty_messages": _raw(r"(b'\x82\x80' + bytes(4)) * 200_000", _HANDSHAKE),
    "idle_connections": _IDLE,
}
_PARTS = {
    "hundred_parts": _raw(r"(b'\1\0' * 99 + b'\0\0') * 10_000", _GREETING, _READY),
    "parts_of_10_kB": _raw(
        r"(b'\3' + (10**4).to_bytes(8) + bytes(10**4)) * 1000 + b'\0\0'",
        _GREETING,
        _READY,
    ),
    "million_parts": _raw(r"b'\1\0' * 10**6 + b'\0\0'", _GREETING, _READY),
}
_PARTS_WITH_KEYS = {
    "parts_of_10_kB": _ZEROMQ.replace("SIZE", "10**4").replace("NUMBER", "1000"),
    "million_parts": _ZEROMQ.replace("SIZE", "0").replace("NUMBER", "10**6"),
}


def shapes(duration: float) -> dict[str, Any]:
    """Flood the service with messages of shapes that no client sends, and measure stops meanwhile.

    Stops are sent over ZeroMQ and over new WebSockets in turn.
    """
    from handmap_qp.apps.service.keys import make_keys

    delays: dict[str, float] = {}
    found: dict[str, Any] = {"stops": 0, "failures": 0, "wrong": []}
    runs = 2 + len(_FRAMES) + len(_PARTS) + len(_PARTS_WITH_KEYS)
    with tempfile.TemporaryDirectory() as folder:
        make_keys(Path(folder), ["admitted"])
        keys = (Path(folder) / "admitted.key_secret", Path(folder) / "server.key")
        for ours in (None, keys):
            kind = "with_keys" if ours else "open"
            attacks = {"quiet": "print(flush=True)"}
            attacks |= _PARTS_WITH_KEYS if ours else {**_FRAMES, **_PARTS}
            with ExitStack() as attackers:
                with (
                    serving(
                        web=True, web_port=0, keys=Path(folder) if ours else None
                    ) as service,
                    honest(service, keys=ours) as clients,
                    MemoryWatch(service) as memory,
                ):
                    for name, code in attacks.items():
                        # The last attack goes on while SIGTERM ends the service.
                        attackers.close()
                        port = service.ports["web" if name in _FRAMES else "requests"]
                        attackers.enter_context(_attack(code, port, *(ours or ())))
                        times = _stops(service, ours, duration / runs)
                        delays[f"{name}, {kind}"] = max(times)
                        found["stops"] += len(times)
                    ended = service.metric('handmap_refusals_total{code="requests"}')
                found[f"memory_{kind}_MB"] = memory.found()["memory_end_MB"]
                found[f"connections_ended_{kind}"] = ended
                found["failures"] += len(service.failures)
                found["wrong"] += summary(clients)["wrong"]
    quiet = max(delays["quiet, open"], delays["quiet, with_keys"])
    if max(delays.values()) > max(_LONGEST_GAP, 2.0 * quiet):
        found["wrong"].append("a stop was delayed")
    if found["failures"]:
        found["wrong"].append("the service failed")
    return found | {"longest_stop_s": delays, "load": os.getloadavg()[0]}


@contextmanager
def _attack(code: str, *words: object) -> Iterator[None]:
    """Run a program that floods the service, from its first flood to the end of the block."""
    command = ["chrt", "--other", "0", sys.executable, "-c", code, *map(str, words)]
    attack = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    try:
        assert attack.stdout is not None
        attack.stdout.readline()
        yield
    finally:
        attack.kill()
        attack.communicate()


def _stops(
    service: ServiceProcess, keys: KeyFiles | None, duration: float
) -> list[float]:
    """Return how long stops take, over ZeroMQ and over a new WebSocket in turn [s]."""
    from websockets.sync.client import connect

    times, end = [], time.monotonic() + duration
    stop = msgspec.msgpack.encode(
        {"type": "stop", "protocol": 2, "seq": 1, "name": "lab"}
    )
    with Client(service.address, timeout=20.0, keys=keys) as client:
        client.open("three_finger", name="lab", restore=True, robot_q=np.zeros(8))
        while time.monotonic() < end:
            started = time.monotonic()
            client.stop("lab")
            times.append(time.monotonic() - started)
            with connect(
                f"ws://127.0.0.1:{service.ports['web']}", compression=None
            ) as page:
                # The time of the handshake is not counted: a page is connected before.
                started = time.monotonic()
                page.send(stop)
                page.recv(20.0)
                times.append(time.monotonic() - started)
            time.sleep(0.005)
    return times


SCENARIOS: dict[str, Callable[[float], dict[str, Any]]] = {
    "restarts": restarts,
    "vanishing": vanishing,
    "fuzz": fuzz,
    "resets": resets,
    "slow_readers": slow_readers,
    "clock_jumps": clock_jumps,
    "wrong_keys": wrong_keys,
    "sessions": sessions_come_and_go,
    "subscriptions": subscriptions,
    "openings": openings,
    "steering": steering,
    "shapes": shapes,
}


def _flat(found: dict[str, Any]) -> Iterator[tuple[str, Any]]:
    """Yield values by name, including those of inner dictionaries."""
    for key, value in found.items():
        if isinstance(value, dict):
            yield from ((f"{key}: {inner}", each) for inner, each in value.items())
        else:
            yield key, ", ".join(value) if isinstance(value, list) else value


def _run(name: str, duration: float) -> dict[str, Any]:
    """Run a scenario, and check that SIGTERM ended its service in time."""
    ServiceProcess.stop_times.clear()
    found = SCENARIOS[name](duration)
    found["sigterm_s"] = max(ServiceProcess.stop_times)
    if found["sigterm_s"] > _STOP_TIME:
        found["wrong"].append("SIGTERM did not end the service in time")
    return found


def main(words: Sequence[str] | None = None) -> None:
    """Run the scenarios."""
    parser = common.make_parser(
        "Faults of and around the mapping service.", draws=False
    )
    parser.add_argument(
        "--duration",
        type=float,
        default=60.0,
        metavar="S",
        help="time of each scenario [s]; 60 by default",
    )
    parser.add_argument(
        "--only",
        nargs="+",
        choices=SCENARIOS,
        default=list(SCENARIOS),
        help="scenarios to run; all by default",
    )
    parser.add_argument(
        "--realtime",
        action="store_true",
        help="run service and well-behaved clients under SCHED_FIFO; needs root",
    )
    arguments = common.parse_arguments(parser, words)
    if arguments.realtime:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))
        except PermissionError:
            parser.error(
                "argument --realtime: expected the right to use SCHED_FIFO: run as root"
            )
    results = {}
    with common.progress("scenarios", len(arguments.only)) as advance:
        for name in arguments.only:
            results[name] = _run(name, 12.0 if arguments.quick else arguments.duration)
            advance()
    for name, found in results.items():
        wrong = found.pop("wrong")
        rows = [{"what": key, "value": value} for key, value in _flat(found)]
        common.print_table(
            f"{name}: {', '.join(wrong) or 'all well'}",
            rows,
            to_stderr=arguments.json == "-",
        )
        found["wrong"] = wrong
    common.write_json(arguments.json, "service_faults", {"scenarios": results})
    if any(found["wrong"] for found in results.values()):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
