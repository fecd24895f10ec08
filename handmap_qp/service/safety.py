"""Speed and acceleration limits of the commands that leave a session.

A mapper respects its limits between its own steps only. It does not know how much time has really
passed, that it was reset, that the former session left the robot elsewhere, or that a client
switched speed limits off. So every command passes a `SpeedGuard`, which owns the posture last
commanded and its velocity, and `StepClock` limits the time that the next command may account for.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_qp.errors import RefusedError
from handmap_qp.hands.hand import Hand
from handmap_qp.ik.limits import braking_displacement
from handmap_qp.ik.qp import PointIk
from handmap_qp.ik.slewing import ClearSlew
from handmap_qp.service.convert import to_matrix
from handmap_qp.service.messages import Pose

START_TOLERANCE = 0.1
"""Distance outside its limits that a client may report for a robot's joint [rad].

Encoders do not read exactly what was commanded.
"""
SHORTEST_DT = 1e-6
"""Time granted if none has passed [s].

The robot practically stands still, and the mapper needs a number > 0.
"""
_ROUNDING = 1e-9


class SpeedGuard:
    """The posture last commanded, and the speed limits of the next one.

    Between two commands, no joint moves farther than its speed limit times the time granted. The
    displacement of a floating wrist (its twist in body axes, as in the QP) respects the limits of
    `hand.yaml`. With an acceleration limit, no coordinate's velocity changes faster, and a posture
    is approached only as fast as the robot can brake. Where the mapper keeps links apart, so does
    the way to a posture.

    Args:
        robot: The robot hand.
        q: Joint angles where it is now [rad], shape (n,).
        wrist: Pose of its wrist, shape (4, 4); None if it is not known yet. Ignored if the wrist is
            fixed.

    Attributes:
        q: Joint angles last commanded [rad], shape (n,).
        max_acceleration: Limit of every coordinate [rad/s^2, m/s^2]; None for none.
    """

    def __init__(self, robot: Hand, q: np.ndarray, wrist: np.ndarray | None = None) -> None:
        self.max_acceleration: float | None = None
        self._slew: ClearSlew | None = None
        # Coordinates of a group come to a stop together.
        self._groups = (np.ones(robot.model.nv, dtype=bool),)
        self._robot = robot
        self._workspace = robot.configuration()
        # Mimic joints are limited through their leaders.
        self._speed = np.full(robot.model.nv, np.inf)
        self._speed[robot.v_indices] = robot.velocity_limits
        if robot.is_floating:
            self._speed[:3] = robot.spec.wrist.max_linear_speed
            self._speed[3:6] = robot.spec.wrist.max_angular_speed
        self.q = q.copy()
        self._wrist = wrist.copy() if wrist is not None and robot.is_floating else None
        self._last, self._wanted = np.empty(robot.model.nq), np.empty(robot.model.nq)
        self._is_written = False
        self._velocity = np.zeros(robot.model.nv)

    def obey(self, ik: PointIk) -> None:
        """Take over the acceleration limit of a mapper's QP, and the links that it keeps apart."""
        self.max_acceleration = ik.options.max_acceleration
        self._slew, columns = None, np.ones(self._robot.model.nv, dtype=bool)
        if ik.collisions is not None:
            self._slew = ClearSlew(ik.hand, ik.collisions, self.max_acceleration)
            columns = self._slew.columns
        self._groups = tuple(group for group in (columns, ~columns) if group.any())

    @property
    def is_moving(self) -> bool:
        """Whether the last command moved, and acceleration limits keep the robot from standing."""
        return self.max_acceleration is not None and bool(self._velocity.any())

    @property
    def wrist(self) -> np.ndarray | None:
        """Pose of the wrist last commanded, shape (4, 4).

        None if a floating wrist has not been placed yet.
        """
        if self._robot.is_floating:
            return self._wrist
        self._robot.write_configuration(self._last, self.q, np.eye(4))
        self._workspace.place_frames(self._last)
        return self._workspace.wrist.homogeneous

    def advance(
        self,
        q: np.ndarray,
        wrist: np.ndarray | None,
        dt: float,
        share: float = 1.0,
        *,
        is_clear: bool = False,
    ) -> bool:
        """Move towards a posture as far as the limits allow.

        Args:
            q: Target joint angles [rad], shape (n,).
            wrist: Target pose of the wrist, shape (4, 4); None keeps it. The first one places it.
            dt: Time since the last command [s].
            share: Share of the speed limits to use.
            is_clear: Whether the whole way was found to be clear of overlaps already.

        Returns:
            Whether the posture is reached. A target that is not finite is ignored.
        """
        if not (np.isfinite(q).all() and (wrist is None or np.isfinite(wrist).all())):
            return False
        if self._robot.is_floating and self._wrist is None and wrist is not None:
            self._wrist, self._is_written = wrist.copy(), False
        start = np.eye(4) if self._wrist is None else self._wrist
        goal = start if wrist is None else wrist
        if not self._is_written:
            self._robot.write_configuration(self._last, self.q, start)
        self._robot.write_configuration(self._wanted, q, goal)
        change = pin.difference(self._robot.model, self._last, self._wanted)
        lower, upper = self._box(change, dt, share)
        slack = _ROUNDING * (upper - lower) + (1e-12 if self.max_acceleration else _ROUNDING)
        is_near = bool(((change <= upper + slack) & (change >= lower - slack)).all())
        wanted = change if is_near else self._on_the_way(change, lower, upper, dt, share)
        if self._slew is not None and not (is_near and is_clear):
            wanted = self._slew.admit(self._last, self._velocity, wanted, dt)
        if wanted is change:
            self._velocity = change / dt
            self.q = q.copy()
            self._wrist = None if self._wrist is None else goal.copy()
            # Reuse the configuration: the next motion starts here.
            self._last, self._wanted, self._is_written = self._wanted, self._last, True
            return True
        self._displace(wanted, dt)
        return False

    def brake(self, dt: float) -> None:
        """Come to a stop: at once, or on a straight line within the acceleration limit.

        Where links are kept apart, the mapper has found that line to be clear.

        Args:
            dt: Time since the last command [s].
        """
        if not self.is_moving:
            self._velocity = np.zeros_like(self._velocity)
            return
        if not self._is_written:
            start = np.eye(4) if self._wrist is None else self._wrist
            self._robot.write_configuration(self._last, self.q, start)
        kept = np.zeros_like(self._velocity)
        for group in self._groups:
            stop = float(np.abs(self._velocity[group]).max()) / (self.max_acceleration or math.inf)
            kept[group] = max(0.0, 1.0 - dt / stop) if stop > 0.0 else 0.0
        self._displace(kept * self._velocity * dt, dt)

    def _box(self, change: np.ndarray, dt: float, share: float) -> tuple[np.ndarray, np.ndarray]:
        """Return the bounds of the next displacement from speed and acceleration limits."""
        limit = self._speed * (dt * share)
        if self.max_acceleration is None:
            return -limit, limit
        reach = self.max_acceleration * dt**2
        middle = np.where(np.isfinite(self._speed), self._velocity * dt, 0.0)
        # Coordinates without a speed of their own follow their leaders.
        reach = np.where(np.isfinite(self._speed), reach, np.inf)
        full = self._speed * dt
        # The speed before may exceed the share; braking from there has priority.
        upper = np.clip(np.maximum(limit, middle - reach), middle - reach, middle + reach)
        lower = np.clip(np.minimum(-limit, middle + reach), middle - reach, middle + reach)
        return np.maximum(lower, -full), np.minimum(upper, full)

    def _on_the_way(
        self, change: np.ndarray, lower: np.ndarray, upper: np.ndarray, dt: float, share: float
    ) -> np.ndarray:
        """Return the displacement towards a posture that is too far for one command."""
        allowed = change
        if self.max_acceleration is not None:
            most = braking_displacement(np.abs(change), self.max_acceleration * dt**2)
            allowed = np.where(np.isfinite(self._speed), np.sign(change) * most, change)
        if self._robot.is_floating:
            # Scale all six coordinates alike, so that the wrist stays on its path.
            limit = self._speed[:6] * (dt * share)
            part = (limit / np.maximum(np.abs(allowed[:6]), 1e-300)).min(initial=1.0)
            allowed = np.concatenate([part * allowed[:6], allowed[6:]])
        return np.clip(allowed, lower, upper)

    def _displace(self, displacement: np.ndarray, dt: float) -> None:
        """Move the posture last commanded, whose configuration is written."""
        self._velocity = displacement / dt
        reached = pin.integrate(self._robot.model, self._last, displacement)
        self._is_written = False
        self.q = reached[self._robot.q_indices].copy()
        if self._wrist is not None:
            self._workspace.place_frames(reached)
            self._wrist = self._workspace.wrist.homogeneous.copy()


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

    def __init__(self, max_dt: float, time_from: Literal["server", "client"], now: float) -> None:
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
