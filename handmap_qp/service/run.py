"""The service as a process: signals, logs, and the line that says it is ready."""

from __future__ import annotations

import asyncio
import gc
import json
import resource
import signal
import sys

from handmap_qp.service.logs import log_to_stderr
from handmap_qp.service.server import Server, Settings

# A thread that loads a hand gives way to one that answers after so long [s]; Python's own choice is
# ten times that.
_SWITCH_INTERVAL = 5e-4
# Connections that do nothing must not use up the descriptors that clients need.
_MOST_FILES = 65536


def run_server(settings: Settings, log_level: str = "info") -> None:
    """Serve until SIGINT or SIGTERM.

    Args:
        settings: Where to listen and what to take.
        log_level: What to log.

    Raises:
        InvalidInputError: If an address or file cannot be used.
    """
    log_to_stderr(log_level)
    sys.setswitchinterval(_SWITCH_INTERVAL)
    _raise_file_limit()
    asyncio.run(_serve(settings))


async def _serve(settings: Settings) -> None:
    ended = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)
    server = Server(settings)
    try:
        await server.start()
        # What exists now stays: collections need not look at it again.
        gc.collect()
        gc.freeze()
        hosts = {"host": settings.host} | (
            {} if settings.web is None else {"web_host": settings.web.host}
        )
        print(json.dumps({"ready": True, **hosts, "ports": server.ports}), flush=True)
        await ended.wait()
    finally:
        await server.stop()


def _raise_file_limit() -> None:
    """Let the process open as many files as the system allows it, within reason."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = _MOST_FILES if hard == resource.RLIM_INFINITY else min(hard, _MOST_FILES)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
