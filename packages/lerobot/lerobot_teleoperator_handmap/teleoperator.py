"""The teleoperator: commands of a session of `handmap serve`, or of a recording."""

import time
from dataclasses import dataclass
from typing import Any

import numpy as np
import pinocchio as pin
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from handmap_qp import HandMapper, read_recording
from handmap_qp.apps.offline.trajectory import map_recording
from handmap_qp.client import ADDRESS, Client, Command
from handmap_qp.human import scaled_human
from .actions import Action, OfHand, action_of


@TeleoperatorConfig.register_subclass("handmap")
@dataclass(kw_only=True)
class HandmapConfig(TeleoperatorConfig):
    """Where commands come from.

    Attributes:
        hand: Name of the robot hand, or path of its hand.yaml; that of the session.
        session: Name of the session of `handmap serve` whose commands are taken.
        address: Address of the service.
        recording: Without a session: the recording that is mapped, to and fro.
        timeout: How long to wait for the session's first command [s].
    """

    hand: str = "allegro_right"
    session: str | None = None
    address: str = ADDRESS
    recording: str = "demo"
    timeout: float = 10.0


class Handmap(OfHand, Teleoperator):
    """A person's hand, mapped to a robot hand by handmap_qp.

    Stops of the session stop this too: `get_action` repeats the last command, as the session's own
    stream does while it holds.
    """

    config_class = HandmapConfig
    name = "handmap"
    config: HandmapConfig

    def __init__(self, config: HandmapConfig) -> None:
        super().__init__(config)
        self.config = config
        self._source: _Session | _Recording | None = None

    @property
    def feedback_features(self) -> dict[str, type]:
        """None: a hand without a glove feels nothing."""
        return {}

    @property
    def is_connected(self) -> bool:
        """Whether `connect` was called."""
        return self._source is not None

    def connect(self, calibrate: bool = True) -> None:
        """Join the session, or map the recording."""
        config = self.config
        self._source = (
            _Session(self.hand, config.session, config)
            if config.session
            else _Recording(self.hand, config)
        )

    def get_action(self) -> Action:
        """Return the newest command."""
        if self._source is None:
            raise ConnectionError("connect the teleoperator first")
        return self._source.action()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        """Do nothing."""

    def disconnect(self) -> None:
        """Leave the session."""
        if self._source is not None:
            self._source.close()
        self._source = None


class _Session:
    """The commands of a session of the service."""

    def __init__(self, hand: Any, session: str, config: HandmapConfig) -> None:
        self._hand = hand
        self._client = Client(config.address)
        try:
            self._client.watch(session)
            self._command = self._first(config)
        except BaseException:
            self._client.close()
            raise

    def _first(self, config: HandmapConfig) -> Command:
        """Wait for the first command, and look whose joints it has."""
        command = self._client.latest(config.timeout)
        session = f"session {config.session!r}"
        if command is None:
            raise ConnectionError(f"{session} sent no command in {config.timeout:g} s")
        if tuple(command.joint_names) != tuple(self._hand.joint_names):
            raise ValueError(
                f"{session} drives a hand with the joints "
                f"{', '.join(command.joint_names)}; {self._hand.name} has "
                f"{', '.join(self._hand.joint_names)}"
            )
        return command

    def action(self) -> Action:
        self._command = self._client.latest() or self._command
        wrist = self._command.wrist
        return action_of(
            self._hand, self._command.q, None if wrist is None else wrist.matrix
        )

    def close(self) -> None:
        self._client.close()


class _Recording:
    """A recording, mapped once and played to and fro, so that the robot never jumps."""

    def __init__(self, hand: Any, config: HandmapConfig) -> None:
        recording = read_recording(config.recording, hand.side)
        human = scaled_human(recording, points="landmarks")
        self._hand = hand
        self._motion = map_recording(
            HandMapper(human, hand, "teleoperation"), recording
        )
        self._start = time.monotonic()

    def action(self) -> Action:
        motion = self._motion
        instants = motion.time - motion.time[0]
        length = instants[-1]
        now = length - abs((time.monotonic() - self._start) % (2.0 * length) - length)
        i = np.searchsorted(instants[1:-1], now, "right")
        share = (now - instants[i]) / (instants[i + 1] - instants[i])
        q = motion.q[i] + share * (motion.q[i + 1] - motion.q[i])
        ends = map(pin.SE3, motion.wrist[i : i + 2])
        wrist = pin.SE3.Interpolate(*ends, share).homogeneous
        return action_of(self._hand, q, wrist)

    def close(self) -> None:
        pass
