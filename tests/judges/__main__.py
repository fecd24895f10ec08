"""Run a judge: `python tests/judges NAME [options]`; without a name, list them.

The suite runs a short form of each, `make judges` the long one.
"""

import sys
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = map(str, [HERE, HERE.parent / "support"])

from named_scripts import run_named  # noqa: E402

if __name__ == "__main__":
    run_named("python tests/judges", [HERE], sys.argv[1:])
