"""The service as a process: signals, logs, and the line that reports readiness."""

from __future__ import annotations

import asyncio
import gc
import importlib
import json
import os
import resource
import signal
import sys

from handmap_qp.service.logs import log_to_stderr
from handmap_qp.service.server import Server, Settings

# Interval after which a thread that loads a hand yields to the one that answers [s]. Python's
# default is ten times longer.
_SWITCH_INTERVAL = 5e-4
# Idle connections must not use up the descriptors that clients need.
_MOST_FILES = 65536


def run_server(settings: Settings, log_level: str = "info") -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: Addresses, limits and files.
        log_level: Lowest level to log.

    Raises:
        InvalidInputError: If an address or file cannot be used.
    """
    log_to_stderr(log_level)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    _raise_file_limit()
    if asyncio.run(_serve(settings)):
        # Python would wait for the thread that loads a hand, for seconds if the hand is large.
        sys.stdout.flush()
        os._exit(0)


async def _serve(settings: Settings) -> bool:
    """Serve; return whether a hand was being loaded at the end."""
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    # The first hand with meshes would import it, which delays running sessions. Leases count from
    # when the server is made.
    importlib.import_module("scipy.spatial")
    server = Server(settings)
    try:
        await server.start()
        # Exclude the objects that exist now from garbage collection: they stay.
        gc.collect()
        gc.freeze()
        hosts = {"host": settings.host} | (
            {} if settings.web is None else {"web_host": settings.web.host}
        )
        print(json.dumps({"ready": True, **hosts, "ports": server.ports}), flush=True)
        await ended.wait()
    finally:
        await server.stop()
    return server.dispatcher.sessions.is_preparing


def _raise_file_limit() -> None:
    """Raise the limit of open files to the system's maximum, at most 65536."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
