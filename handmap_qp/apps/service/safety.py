"""The robot of a session as commanded, and the time that its commands account for.

A mapper does not know how much time has really passed, that it was reset, that the former session
left the robot elsewhere, or that a client switched speed limits off. So the robot has a gate of its
own (`handmap_qp.ik.gate`), and `StepClock` limits the time that the next command may account for.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from handmap_qp.apps.service.samples import to_matrix
from handmap_qp.client.messages import Pose
from handmap_qp.errors import RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.gate import Gate, Motion
from handmap_qp.ik.limits import SHORTEST_DT
from handmap_qp.ik.qp import PointIk

START_TOLERANCE = 0.1
"""Distance outside its limits that a client may report for a robot's joint [rad].

Encoders do not read exactly what was commanded.
"""


class CommandedRobot:
    """A robot as last commanded.

    Args:
        robot: The robot hand.
        q: Joint angles where it is now, at rest [rad], shape (n,).
        wrist: Pose of its wrist, shape (4, 4); None if it is not known yet. Ignored if the wrist is
            fixed.

    Attributes:
        is_placed: Whether the pose of its wrist is known.
    """

    def __init__(
        self, robot: Hand, q: np.ndarray, wrist: np.ndarray | None = None
    ) -> None:
        self._robot, self._workspace = robot, robot.configuration()
        self.is_placed = wrist is not None or not robot.is_floating
        vector = robot.configuration_vector(q, wrist if robot.is_floating else None)
        self._gate = Gate(robot, Motion.at_rest(vector, self._workspace.nv))

    def obey(self, ik: PointIk) -> None:
        """Take over the acceleration limit of a mapper's QP, and the links that it keeps apart."""
        limit = ik.options.max_acceleration
        self._gate = Gate(
            ik.hand, self.motion, max_acceleration=limit, collisions=ik.collisions
        )

    @property
    def motion(self) -> Motion:
        """How the robot moves. Set it to what the gate of a mapper with these limits admitted."""
        return self._gate.motion

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self._gate.motion, self.is_placed = motion, True

    @property
    def q(self) -> np.ndarray:
        """Joint angles last commanded [rad], shape (n,)."""
        return self.motion.q[self._robot.q_indices]

    @property
    def wrist(self) -> np.ndarray | None:
        """Pose of the wrist last commanded, shape (4, 4); None if it is not known yet."""
        if not self.is_placed:
            return None
        if self._workspace.q.tobytes() != self.motion.q.tobytes():
            self._workspace.place_frames(self.motion.q)
        return self._workspace.wrist.homogeneous

    def advance(
        self,
        q: np.ndarray,
        wrist: np.ndarray | None,
        dt: float,
        share: float = 1.0,
        *,
        stops: bool = False,
    ) -> bool:
        """Move towards a posture as far as the gate admits.

        Args:
            q: Target joint angles [rad], shape (n,).
            wrist: Target pose of the wrist, shape (4, 4); None keeps it. The first one places it.
            dt: Time since the last command [s].
            share: Share of the speed limits to use.
            stops: Whether the robot must be able to stop there at once.

        Returns:
            Whether the posture is reached. If it is not finite, the robot brakes.
        """
        if not (np.isfinite(q).all() and (wrist is None or np.isfinite(wrist).all())):
            self.brake(dt)
            return False
        if not self.is_placed and wrist is not None:
            self._gate.place(self._robot.configuration_vector(self.q, wrist))
            self.is_placed = True
        goal = self.motion.q.copy()
        self._robot.write_configuration(goal, q, wrist)
        return self._gate.approach(goal, dt, share, stops=stops)

    def brake(self, dt: float) -> None:
        """Come to a stop: at once, or within the acceleration limit.

        Args:
            dt: Time since the last command [s].
        """
        self._gate.brake(dt)


class StepClock:
    """The time that a command may account for.

    With `time_from="server"`, it is the time since the last command on the server's monotonic
    clock, and at most `max_dt`. Time stamps are only compared with it. So neither a jump of the
    client's clock nor a burst of samples nor a pause makes the robot exceed its speed limits. With
    `"client"`, for simulated time, the time stamps count.

    Args:
        max_dt: Longest time that one command may account for [s].
        time_from: Clock that counts.
        now: The present [s].
    """

    def __init__(
        self, max_dt: float, time_from: Literal["server", "client"], now: float
    ) -> None:
        self._max_dt = max_dt
        self._time_from = time_from
        self._last = now
        self._last_sample = now
        self._stamp: float | None = None

    def grant(self, stamp: float, now: float) -> tuple[float, list[str]]:
        """Grant time to the command that answers a sample.

        Args:
            stamp: Time stamp of the sample [s].
            now: The present [s].

        Returns:
            The time [s], and flags. `time_backwards`: the time stamp is not later than the last
            one. `time_jump`: since the last sample, the two clocks differ by more than a second.
            `dt_clamped`: more time has passed than is granted.
        """
        elapsed, since_sample = now - self._last, now - self._last_sample
        stamped = since_sample if self._stamp is None else stamp - self._stamp
        flags = []
        if stamped <= 0.0 and self._stamp is not None:
            flags.append("time_backwards")
        elif abs(stamped - since_sample) > 1.0 and self._time_from == "server":
            flags.append("time_jump")
        self._stamp, self._last_sample, self._last = stamp, now, now
        wanted = elapsed if self._time_from == "server" else stamped
        if wanted > self._max_dt:
            flags.append("dt_clamped")
        return min(max(wanted, SHORTEST_DT), self._max_dt), flags

    def grant_tick(self, now: float) -> float:
        """Grant time to a command of the watchdog, which answers no sample [s]."""
        elapsed, self._last = now - self._last, now
        return min(max(elapsed, SHORTEST_DT), self._max_dt)


def start_angles(robot: Hand, robot_q: tuple[float, ...] | None) -> np.ndarray:
    """Return the joint angles that a client reports, or the rest posture [rad], shape (n,).

    Raises:
        RefusedError: If the robot cannot be there.
    """
    if robot_q is None:
        return robot.rest.copy()
    if len(robot_q) != len(robot.joint_names):
        raise RefusedError(
            "invalid",
            f"expected {len(robot.joint_names)} angles, got {len(robot_q)}",
            field="robot_q",
        )
    q = np.array(robot_q)
    outside = np.maximum(robot.lower_limits - q, q - robot.upper_limits)
    worst = int(np.argmax(outside))
    if outside[worst] > START_TOLERANCE:
        limits = f"[{robot.lower_limits[worst]:.6g}, {robot.upper_limits[worst]:.6g}]"
        message = (
            f"{robot.joint_names[worst]} is {q[worst]:.6g} rad, "
            f"expected within {START_TOLERANCE:g} rad of {limits}"
        )
        raise RefusedError("invalid", message, field=f"robot_q[{worst}]")
    return q


def start_wrist(robot: Hand, robot_wrist: Pose | None) -> np.ndarray | None:
    """Return the pose of the wrist that a client reports, shape (4, 4), or None.

    Raises:
        RefusedError: If the wrist is fixed.
    """
    if robot_wrist is not None and not robot.is_floating:
        raise RefusedError(
            "invalid",
            f"{robot.name} has a fixed wrist: leave it out",
            field="robot_wrist",
        )
    return to_matrix(robot_wrist)
