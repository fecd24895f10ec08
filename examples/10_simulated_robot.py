"""A simulated robot that follows a session of the mapping service, as a driver would: `StandIn`.

It watches a session of another client, receives the stream of commands, and simulates up to the
clock's time with the newest one. A command that holds the robot is followed too: it repeats the
last posture. Once a second a line says how far the wrist is from its command, and how the links
press on the object. It says where its joints are, as a driver with encoders does, so that a shared
session grips the object.

    handmap serve                                                                  # the service
    handmap track replay pinch.npz --to 127.0.0.1 --robot allegro_right --session lab --shared
    python examples/10_simulated_robot.py lab --robot allegro_right --object sphere:0.04
"""

from __future__ import annotations

import argparse
import math
import time as clock
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from handmap_qp.apps.simulation.haptics import finger_forces
from handmap_qp.apps.simulation.pads import Pads
from handmap_qp.apps.simulation.physics import Physics
from handmap_qp.apps.simulation.simulator import Instant, Simulator
from handmap_qp.client import Client, Command
from handmap_qp.errors import InvalidInputError
from handmap_qp.hands.library import load_hand
from handmap_qp.mapping.objects import parse_object
from handmap_qp.se3 import affine

# Longest wait for a command before the robot is simulated further with the last one [s].
_WAIT = 0.02
# The simulation never runs ahead of the clock, and skips more than this [s].
_LONGEST = 0.1
# Time between two messages of what the fingers feel [s].
_TOUCH = 0.03
# The object before its place is known.
_FAR = affine(np.eye(3), np.array([0.0, 0.0, 100.0]))


class Report(NamedTuple):
    """What the stand-in does, once a second.

    Attributes:
        now: The simulation.
        commands: Number of commands received so far.
        epoch: The last command's epoch; commands are continuous within one.
        wrist_error: Distance of the wrist from its command [m].
    """

    now: Instant
    commands: int
    epoch: int
    wrist_error: float


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
        self._client = client
        self._pads = Pads(simulator.hand)
        client.watch(session)
        self._goal: np.ndarray | None = None
        # Joints of the last command, by name [rad].
        self._angles: dict[str, float] = {}
        self._wrist: np.ndarray | None = None
        self._epoch = 0
        self._count = 0
        self._is_standing = True
        self._touched = -math.inf

    def run(self, duration: float, report: Callable[[Report], None]) -> None:
        """Follow the session.

        Args:
            duration: Time to follow it [s]; infinity until interrupted.
            report: Called once a second while commands arrive.

        Raises:
            InvalidInputError: If the session drives a robot with other joints.
        """
        start = last = told = clock.monotonic()
        while clock.monotonic() - start < duration:
            command = self._client.latest(_WAIT)
            if command is not None:
                self._accept(command)
            now = clock.monotonic()
            if self._goal is None:
                last = told = now
            elif now - last >= self.simulator.physics.time_step:
                self._advance(self._goal, min(now - last, _LONGEST), now)
                last = now
                if now - told >= 1.0:
                    report(self._report())
                    told = now

    def _accept(self, command: Command) -> None:
        """Take a command as the goal; start at the first one, and again in a new epoch."""
        hand = self.simulator.hand
        angles = dict(zip(command.joint_names, command.q, strict=True))
        if missing := [name for name in hand.joint_names if name not in angles]:
            raise InvalidInputError(
                argument="--robot",
                expected=f"the robot of the session, with {', '.join(command.joint_names[:4])}",
                got=f"{hand.name}, with {missing[0]}",
            )
        q = np.array([angles[name] for name in hand.joint_names])
        pose = np.eye(4) if command.wrist is None else command.wrist.matrix
        wrist = pose if hand.is_floating else None
        goal = hand.configuration_vector(q, wrist)
        if self._goal is None or command.epoch != self._epoch:
            # The hand must be there before its pads are.
            self.simulator.reset(goal, _FAR)
            middle = self._pads.pair.middle(self._pads.places(self.simulator))
            self.simulator.reset(goal, affine(np.eye(3), middle))
            self.simulator.set_stand(holds=True)
            self._is_standing = True
        self._goal = goal
        self._angles = angles
        self._wrist = wrist
        self._epoch = command.epoch
        self._count += 1

    def _advance(self, goal: np.ndarray, duration: float, now: float) -> None:
        """Simulate towards the goal, and let the object go once it is pinched."""
        self.simulator.follow(goal, duration)
        names = self.simulator.hand.joint_names
        measured = dict(zip(names, self.simulator.q.tolist(), strict=True))
        self._client.measured([*(self._angles | measured).values()])
        if now - self._touched >= _TOUCH:
            self._client.touch(
                forces=finger_forces(self.simulator), time=self.simulator.time
            )
            self._touched = now
        if self._is_standing and self._pads.is_pinched(self.simulator):
            self.simulator.set_stand(holds=False)
            self._is_standing = False

    def _report(self) -> Report:
        now, wrist = self.simulator.instant(), self._wrist
        off = np.zeros(3) if wrist is None else (now.wrist - wrist)[:3, 3]
        return Report(now, self._count, self._epoch, float(np.linalg.norm(off)))


def show(report: Report) -> None:
    """Print a line about the simulation."""
    now = report.now
    print(
        f"{now.time:7.1f} s  {report.commands} commands, epoch {report.epoch}, wrist "
        f"{1e3 * report.wrist_error:.1f} mm off, {now.links_touching} links press with "
        f"{now.normal_force:.1f} N",
        flush=True,
    )


def main() -> None:
    """Follow a session until Ctrl-C."""
    parser = argparse.ArgumentParser(description="A simulated robot at the service.")
    parser.add_argument("session", help="name of the session to follow")
    parser.add_argument("--robot", default="three_finger", help="the session's robot")
    parser.add_argument("--object", default="box:0.03", help="as handmap simulate")
    parser.add_argument("--server", default="tcp://127.0.0.1:5570")
    parser.add_argument("--duration", type=float, default=math.inf, help="time [s]")
    given = parser.parse_args()
    # +y is up, as in a headset's world.
    physics = Physics(mass=0.05, gravity=(0.0, -9.81, 0.0))
    shape = parse_object(given.object)
    simulator = Simulator(load_hand(given.robot), shape, physics)
    with Client(given.server) as client:
        StandIn(simulator, client, given.session).run(given.duration, show)


if __name__ == "__main__":
    main()
