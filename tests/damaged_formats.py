"""Formats whose reading fails as that of a damaged file may, to test the reading process."""

from __future__ import annotations

import os
import signal
from pathlib import Path

from handmap_qp.trackers.formats.npz import NpzFormat


class DamagedFormat(NpzFormat):
    """Files of which some methods never return an answer."""

    def recognises(self, path: Path) -> bool:
        """Return whether the reading process is another one than that of the tests."""
        return str(os.getpid()) != path.name

    def entries(self, path: Path) -> tuple[()]:
        """Crash, as libhdf5 does on some files."""
        os.kill(os.getpid(), signal.SIGSEGV)
        return ()

    def unread(self, path: Path) -> tuple[()]:
        """Walk in circles."""
        while True:
            pass

    def losses(self, recordings: object) -> tuple[str, ...]:
        """Ask for more memory than there is."""
        return (str(len(bytearray(1 << 40))),)
