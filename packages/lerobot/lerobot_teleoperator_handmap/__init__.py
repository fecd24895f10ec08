"""handmap_qp in LeRobot: the teleoperator `handmap` and the simulated robot `handmap_hand`.

LeRobot finds both by the name of this distribution:

    lerobot-record --teleop.type=handmap --teleop.session=lab --robot.type=handmap_hand ...
"""

from .robot import HandmapHand, HandmapHandConfig
from .teleoperator import Handmap, HandmapConfig

__all__ = ["Handmap", "HandmapConfig", "HandmapHand", "HandmapHandConfig"]
