"""A simulated robot that follows a session of the mapping service, as a driver would: `StandIn`.

It watches a session of another client, receives the stream of commands, and simulates up to the
clock's time with the newest one. A command that holds the robot is followed too: it repeats the
last posture.
"""

from __future__ import annotations

import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from handmap_qp.client import Client, Command
from handmap_qp.errors import InvalidInputError
from handmap_qp.se3 import affine
from handmap_qp.simulation.pads import PadFinder
from handmap_qp.simulation.simulator import Simulator

# Longest wait for a command before the robot is simulated further with the last one [s].
_WAIT = 0.02
# The simulation never runs ahead of the clock, and skips more than this [s].
_LONGEST = 0.1
# Force of thumb and of another link at which the stand lets go [N].
_PRESSED = 0.2


@dataclass(frozen=True, slots=True)
class Report:
    """What the stand-in does, once a second.

    Attributes:
        time: Simulated time [s].
        commands: Number of commands received so far.
        epoch: The last command's epoch; commands are continuous within one.
        wrist_error: Distance of the wrist from its command [m].
        force: Sum of the normal forces on the object [N].
        touching: Number of joints whose links touch the object.
    """

    time: float
    commands: int
    epoch: int
    wrist_error: float
    force: float
    touching: int


class StandIn:
    """Follows the commands of a session.

    The object stands where the pads of thumb and index finger are at the first command, in the
    middle between them. It is let go when the thumb and another finger press on it.

    Args:
        simulator: The robot and its object.
        client: A client without a session of its own.
        session: Public name of the session to follow.

    Raises:
        InvalidInputError: If the hand has no thumb and index finger.
        ServiceError: If there is no such session.
        ServiceTimeoutError: If the service does not answer.
    """

    def __init__(self, simulator: Simulator, client: Client, session: str) -> None:
        self.simulator = simulator
        self._pads = PadFinder(simulator.hand, "index")
        self._client = client
        client.watch(session)
        self._goal: tuple[np.ndarray, np.ndarray | None] | None = None
        self._epoch, self._count = 0, 0
        self._is_standing = True

    def run(self, duration: float, report: Callable[[Report], None]) -> None:
        """Follow the session.

        Args:
            duration: Time to follow it [s]; infinity until interrupted.
            report: Called once a second while commands arrive.

        Raises:
            InvalidInputError: If the session drives a robot with other joints.
        """
        start = last = clock.monotonic()
        told = start
        while (now := clock.monotonic()) - start < duration:
            command = self._client.latest(_WAIT)
            if command is not None:
                self._accept(command)
            if self._goal is None:
                last = now
                continue
            self._advance(min(clock.monotonic() - last, _LONGEST))
            last = clock.monotonic()
            if last - told >= 1.0:
                report(self._report())
                told = last

    def _accept(self, command: Command) -> None:
        """Take a command as the goal; start at the first one, and again in a new epoch."""
        hand = self.simulator.hand
        index = {name: i for i, name in enumerate(command.joint_names)}
        if missing := [name for name in hand.joint_names if name not in index]:
            raise InvalidInputError(
                argument="--robot",
                expected=f"the robot of the session, with {', '.join(command.joint_names[:4])}",
                got=f"{hand.name}, with {missing[0]}",
            )
        q = np.array([command.q[index[name]] for name in hand.joint_names])
        wrist = None
        if hand.is_floating:
            wrist = np.eye(4) if command.wrist is None else command.wrist.matrix
        if self._goal is None or command.epoch != self._epoch:
            place = self._pads.middle(q, np.eye(4) if wrist is None else wrist)
            self.simulator.reset(q, wrist, affine(np.eye(3), place))
            self.simulator.set_stand(holds=True)
            self._is_standing = True
        self._goal, self._epoch = (q, wrist), command.epoch
        self._count += 1

    def _advance(self, duration: float) -> None:
        """Simulate towards the goal, and let the object go once it is pinched."""
        assert self._goal is not None
        if duration < self.simulator.physics.time_step:
            return
        self.simulator.follow(*self._goal, duration)
        if self._is_standing and self._pads.is_pinched(self.simulator, _PRESSED):
            self.simulator.set_stand(holds=False)
            self._is_standing = False

    def _report(self) -> Report:
        assert self._goal is not None
        contacts = self.simulator.contacts()
        normal = np.einsum("ci,ci->c", contacts.forces, contacts.normals)
        wrist = self._goal[1]
        error = 0.0 if wrist is None else np.linalg.norm((self.simulator.wrist - wrist)[:3, 3])
        return Report(
            self.simulator.time,
            self._count,
            self._epoch,
            float(error),
            float(normal.sum()),
            len(set(contacts.joints)),
        )
