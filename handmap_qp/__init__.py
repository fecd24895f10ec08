"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)

Public names are those of `__init__.pyi`. They are imported at their first use: `import handmap_qp`
and the command line load no more than they need.
"""

from typing import Any

import lazy_loader

_find, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> Any:
    """Import a public name at its first use (PEP 562)."""
    if name == "__version__":
        from importlib.metadata import version

        return version("handmap-qp")
    value = globals()[name] = _find(name)
    return value
