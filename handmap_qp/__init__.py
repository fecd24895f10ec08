"""Maps the motion of a human hand onto any robotic hand: homogeneous transformations and a QP.

from handmap_qp import HandMapper, load_hand

mapper = HandMapper(load_hand("human"), load_hand("three_finger"))
step = mapper.map_step(human_q, wrist_pose)

Public names are those of `__init__.pyi`. They are imported at their first use: `import handmap_qp`
and the command line load no more than they need.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
