"""The service as a process: signals, logs, and the line that says it is ready."""

from __future__ import annotations

import asyncio
import gc
import json
import signal
import sys

from handmap_qp.service.logs import log_to_stderr
from handmap_qp.service.server import Server, Settings

# A thread that loads a hand gives way to one that answers after so long [s]; Python's own choice is ten times that.
_SWITCH_INTERVAL = 5e-4


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
        hosts = {"host": settings.host} | ({} if settings.web is None else {"web_host": settings.web.host})
        print(json.dumps({"ready": True, **hosts, "ports": server.ports}), flush=True)
        await ended.wait()
    finally:
        await server.stop()
