"""The robot to try it with: a hand in MuJoCo, and a camera."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
from lerobot.robots import Robot, RobotConfig

from handmap_qp.apps.drawing.hands import load_shape
from handmap_qp.apps.drawing.raster import Camera, render
from handmap_qp.apps.simulation.simulator import Simulator
from handmap_qp.mapping.objects import parse_object
from handmap_qp.se3 import affine
from .actions import Action, OfHand, action_of, command_of, features

# The simulation's object stands aside [m]: the hand is to be seen alone.
_ASIDE = affine(np.eye(3), np.array([0.0, 0.0, 100.0]))
# What the camera sees around the hand [m].
_SIGHT = 0.09
# The longest time that is simulated at once [s]: more is lost, as it is while a process sleeps.
_LONGEST = 0.5


@RobotConfig.register_subclass("handmap_hand")
@dataclass(kw_only=True)
class HandmapHandConfig(RobotConfig):
    """The simulated hand and its camera.

    Attributes:
        hand: Name of the robot hand, or path of its hand.yaml.
        width: Width of the camera's picture [pixel].
        height: Height of the camera's picture [pixel].
    """

    hand: str = "allegro_right"
    width: int = 160
    height: int = 120


class HandmapHand(OfHand, Robot):
    """A robot hand with position control, simulated in real time.

    The first action puts the hand where it says, as a robot that is where its teleoperator is.
    """

    config_class = HandmapHandConfig
    name = "handmap_hand"
    config: HandmapHandConfig

    def __init__(self, config: HandmapHandConfig) -> None:
        super().__init__(config)
        self.config = config
        # LeRobot counts them, to write their pictures.
        self.cameras: dict[str, Any] = {"front": self}
        self._simulator: Simulator | None = None
        self._told: float | None = None

    @property
    def observation_features(self) -> dict[str, Any]:
        """Names of the measured numbers, and the shape of the camera's picture."""
        return features(self.hand) | {
            "front": (self.config.height, self.config.width, 3)
        }

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._simulator is not None

    def connect(self, calibrate: bool = True) -> None:
        """Begin the simulation."""
        self._simulator = Simulator(self.hand, parse_object("sphere:0.04"))
        self._shape = load_shape(self.hand)
        self._put(self.hand.rest, np.eye(4) if self.hand.is_floating else None)
        self._told = None

    def get_observation(self) -> dict[str, Any]:
        """Return the measured joints, the wrist's pose and the camera's picture."""
        simulator = self._simulated()
        q, wrist = simulator.q, simulator.wrist
        place = wrist if self.hand.is_floating else None
        middle = self.hand.frame_pose("palm", q, place)[:3, 3]
        corners = np.array([-_SIGHT * np.ones(3), _SIGHT * np.ones(3)])
        size = self.config.width, self.config.height
        picture = render(
            self._shape.triangles(q, place),
            Camera.framing(middle + corners, size),
            supersampling=1,
        )
        on_white = 1.0 - picture[..., 3:] * (1.0 - picture[..., :3])
        front = np.rint(255.0 * on_white).astype(np.uint8)
        return action_of(self.hand, q, wrist) | {"front": front}

    def send_action(self, action: Action) -> Action:
        """Simulate up to now with an action as the command; return what was commanded."""
        simulator = self._simulated()
        q, wrist = command_of(self.hand, action)
        now = time.monotonic()
        if self._told is None:
            self._put(q, wrist)
        else:
            goal = self.hand.configuration_vector(q, wrist)
            simulator.follow(goal, min(now - self._told, _LONGEST))
        self._told = now
        return action_of(self.hand, q, wrist)

    def disconnect(self) -> None:
        """End the simulation."""
        self._simulator = None

    def _simulated(self) -> Simulator:
        if self._simulator is None:
            raise ConnectionError("connect the robot first")
        return self._simulator

    def _put(self, q: np.ndarray, wrist: np.ndarray | None) -> None:
        simulator = self._simulated()
        simulator.reset(self.hand.configuration_vector(q, wrist), _ASIDE)
        simulator.set_stand(holds=True)
