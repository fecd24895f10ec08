"""Beside packages of robot learning, really installed: each is imported, and the demo runs.

`tests/core/test_resolution.py` resolves many more. These are small ones without torch, whose wheel
on PyPI takes several GB.
"""

from __future__ import annotations

from paths.fresh import Fresh

NEIGHBOURS = (
    (("gymnasium-robotics", "mujoco"), ("mujoco", "gymnasium_robotics")),
    (("pin-pink", "daqp==0.8.5"), ("pink", "daqp")),
    (("rerun-sdk", "numpy<2.3"), ("rerun", "numpy")),
)
"""Requirements and modules of each. daqp as isaaclab 3.0 pins it, numpy as lerobot has it."""
_IMPORT = """
import sys
from importlib import import_module
for name in sys.argv[1:]:
    import_module(name)
"""


def main() -> None:
    """Go the path with each neighbour."""
    for requirements, modules in NEIGHBOURS:
        with Fresh(f"Beside {' and '.join(requirements)}", "plot") as path:
            path.install(*requirements)
            path.handmap("demo")
            with path.step(
                f"import {', '.join(modules)} and the package in one program"
            ):
                path.python(_IMPORT, *modules, "handmap_qp")


if __name__ == "__main__":
    main()
