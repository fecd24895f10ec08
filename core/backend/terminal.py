"""What a build tells whoever waits for it.

pip keeps what a build prints, unless it is given -v, and a compilation takes minutes. So what
matters goes to the terminal, too, if there is one.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress


def tell(line: str) -> None:
    """Print a line, and write it to the terminal where another program takes what is printed.

    Below make, which shows the lines of a build, nothing is written twice.
    """
    print(line, flush=True)
    if sys.stdout.isatty() or "MAKELEVEL" in os.environ:
        return
    with suppress(OSError), open("/dev/tty", "w", encoding="utf-8") as terminal:
        terminal.write(f"\n{line}\n")
