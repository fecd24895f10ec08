"""What a session may do: states, watchdog, the gate of its robot, time granted, rates of events.

A client moves a session between waiting, following and released. While no samples arrive, the
watchdog moves it to a hold, and by option on to a return to the rest posture. An emergency stop
outlasts everything but its clearing, which leaves the robot released.

A mapper does not know how much time has really passed, that it was reset, that the former session
left the robot elsewhere, or that a client switched speed limits off. So the robot has a gate of its
own (`handmap_core.ik.gate`), and `SessionClock` limits the time that a command may account for.
"""

import math
import time
from collections.abc import Callable
from enum import Enum
from typing import Literal

import numpy as np
import pinocchio as pin

from handmap_core.client.messages import Open
from handmap_core.errors import RefusedError
from handmap_core.se3 import Array, frozen
from handmap_qp.hands import Hand
from handmap_qp.ik import (
    SHORTEST_DT,
    Gate,
    IkOptions,
    Motion,
    PointIk,
    When,
)
from handmap_qp.mapping import RobotCommand
from handmap_qp.stream import BEHIND

HEARTBEAT = 0.1
"""Time between commands that repeat a hold [s]."""
RETURN_PERIOD = 1.0 / 60.0
"""Time between commands on the way back to rest [s]."""
BURST = 0.25
"""Time whose events a rate limit permits at once, if it is not told otherwise [s]."""
START_TOLERANCE = 0.1
"""Distance outside its limits that a client may report for a robot's joint [rad].

Encoders do not read exactly what was commanded.
"""


class SessionState(Enum):
    """What a session does: its mode as clients read it, and whether it holds until `clutch`.

    Attributes:
        mode: The state as clients read it.
        is_released: Whether the robot holds until `clutch`: a client released it, or stopped it.
        is_silent: Whether the watchdog acts because samples stay away.
        is_stopped: Whether an emergency stop is in force.
        is_halted: Whether the robot was stopped, or did not follow.
    """

    # That of `Enum` runs in Python, in every sample.
    __hash__ = object.__hash__

    WAITING = "waiting", False  # no sample has arrived yet
    FOLLOWING = "following", False  # the robot follows the human
    RELEASED = "released", True  # it holds because a client released it
    HOLDING = "hold", False  # it holds without samples, and follows the next one
    HOLDING_RELEASED = "hold", True  # likewise, but the next one does not move it
    RETURNING = "returning", False  # it moves to rest because samples stay away
    LOST = "not_following", True  # it holds because its joints did not follow
    STOPPED = "stopped", True  # it holds because of an emergency stop, which is latched

    def __init__(self, mode: str, is_released: bool) -> None:
        self.mode = mode
        self.is_released = is_released
        self.is_silent = mode in ("hold", "returning")
        self.is_stopped = mode == "stopped"
        self.is_halted = self.is_stopped or mode == "not_following"


Event = Literal[
    "sample",  # one that can be used
    "clutch",
    "release",
    "reset",
    "silence",  # no sample for too long
    "return",  # the hold has lasted long enough
    "arrival",  # the robot is at its rest posture
    "loss",  # joints do not follow
    "stop",  # an emergency stop
    "clear",  # the emergency stop is cleared on purpose
]
"""What changes the state of a session; silence, return and arrival come from the watchdog."""

_TRANSITIONS = {
    (SessionState[state], event): SessionState[after]
    for state, event, after in map(
        str.split,
        """
        WAITING            sample   FOLLOWING
        WAITING            release  RELEASED
        FOLLOWING          release  RELEASED
        FOLLOWING          silence  HOLDING
        FOLLOWING          loss     LOST
        RELEASED           clutch   FOLLOWING
        RELEASED           reset    FOLLOWING
        RELEASED           silence  HOLDING_RELEASED
        HOLDING            sample   FOLLOWING
        HOLDING            reset    FOLLOWING
        HOLDING            release  HOLDING_RELEASED
        HOLDING            return   RETURNING
        HOLDING            loss     LOST
        HOLDING_RELEASED   sample   RELEASED
        HOLDING_RELEASED   reset    FOLLOWING
        HOLDING_RELEASED   clutch   HOLDING
        RETURNING          sample   FOLLOWING
        RETURNING          reset    FOLLOWING
        RETURNING          release  HOLDING_RELEASED
        RETURNING          arrival  HOLDING
        RETURNING          loss     LOST
        LOST               clutch   FOLLOWING
        LOST               reset    FOLLOWING
        STOPPED            clear    RELEASED
        """.strip().splitlines(),
    )
}
"""The state after an event in a state; other events change nothing."""


def next_state(state: SessionState, event: Event) -> SessionState:
    """Return the state after an event; an event that is not in the table changes nothing.

    An emergency stop applies in every state.
    """
    if event == "stop":
        return SessionState.STOPPED
    return _TRANSITIONS.get((state, event), state)


class SessionClock:
    """Turn elapsed time into events of a session, and grant time to its commands.

    It keeps times only; the session keeps the state. Times are of one monotonic clock [s].

    With `time_from="server"`, a command may account for the time since the last one, and at most
    `max_dt`. Time stamps are only compared with it. So neither a jump of the client's clock nor a
    burst of samples nor a pause makes the robot exceed its speed limits. With `"client"`, for
    simulated time, the time stamps count. A stamp that is late by up to `BEHIND` takes (nearly) no
    time. The next stamp takes the time by which it is later than all before.

    Each command has an instant of its own, also where the watchdog acts at the instant of a sample:
    the next one is later by `SHORTEST_DT` at least. So readers of a stream can order its commands,
    and limits hold by the instants that they read.

    Args:
        request: The request that opened the session, which has its times.
        now: The present [s].
        waited: Time since the robot's last command [s].

    Attributes:
        last_sample: Time of the last sample that could be used, or of the last reset [s]. Set it to
            count silence from there on.
        waited: Time since the last command, of which no more than `max_dt` is granted to the next
            one [s].
    """

    def __init__(self, request: Open, now: float, waited: float = 0.0) -> None:
        self._request = request
        self.waited = 0.0
        self._held_since = self._last_command = self.last_sample = now
        self._arrival = now
        self._commanded_at = now - waited
        # Instant of the command in progress, up to which time was granted.
        self._instant = max(now, self._commanded_at)
        self._stamp = None

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
        since_sample = now - self._arrival
        stamped = since_sample if self._stamp is None else stamp - self._stamp
        is_ours = self._request.time_from == "server"
        flags = []
        if stamped <= 0.0 and self._stamp is not None:
            flags.append("time_backwards")
        elif abs(stamped - since_sample) > 1.0 and is_ours:
            flags.append("time_jump")
        elapsed = self._begin_command(now)
        wanted = elapsed if is_ours else stamped
        if wanted > self._request.max_dt:
            flags.append("dt_clamped")
        is_late = -BEHIND <= stamped <= 0.0 and not is_ours
        if self._stamp is None or not is_late:
            self._stamp = stamp
        self._arrival = now
        self.waited = self._instant - self._commanded_at if is_ours else stamped
        return self._limited(wanted), flags

    def _begin_command(self, now: float) -> float:
        """Find the instant of a command; return the time since that of the one before [s]."""
        before = self._instant
        earliest = before + SHORTEST_DT
        self._instant = now if now > earliest else earliest
        return self._instant - before

    def since_command(self, now: float) -> float:
        """Return the time since the last command [s]."""
        return now - self._commanded_at

    def note_command(self) -> float:
        """Note that the command in progress is made; return its instant [s]."""
        self._commanded_at = self._instant
        return self._instant

    def feed(self, now: float) -> None:
        """Note a sample that can be used, and the command that answers it."""
        self.last_sample = self._last_command = now

    def event(self, state: SessionState, now: float) -> Event | None:
        """Return the event that elapsed time brings about, if any.

        Call again after the transition, until nothing is due. A return of a robot that is at rest
        has no effect.
        """
        is_active = state in (SessionState.FOLLOWING, SessionState.RELEASED)
        if is_active and now - self.last_sample > self._request.watchdog:
            self._held_since = now
            self.hasten()
            return "silence"
        wait = self._request.return_after
        has_waited = wait is not None and now - self._held_since >= wait
        return "return" if has_waited and state is SessionState.HOLDING else None

    def due(self, state: SessionState) -> float:
        """Return when time may matter next if no request comes [s]; in the past for at once."""
        if state is not SessionState.FOLLOWING:
            return -math.inf
        return self.last_sample + min(self._request.watchdog, self._patience)

    @property
    def _patience(self) -> float:
        """Time without a sample after which a robot that follows brakes, if it moves [s]."""
        # A sample may be a little late.
        return 2.0 * self._request.max_dt

    def hasten(self) -> None:
        """Make the next command due at once."""
        self._last_command = -math.inf

    def take_turn(self, state: SessionState, now: float, robot: Gate) -> float:
        """Return the time granted to a command that answers no sample [s]; 0 if none is due.

        Args:
            state: State of the session.
            now: The present [s].
            robot: The robot, which must still come to a stop if it is braking.
        """
        is_led = now - self.last_sample <= self._patience
        is_led &= state is SessionState.FOLLOWING
        is_braking = not is_led and robot.motion.is_braking
        if not (state.is_silent or state.is_halted or is_braking):
            return 0.0
        is_moving = is_braking or state is SessionState.RETURNING
        period = RETURN_PERIOD if is_moving else HEARTBEAT
        if now - self._last_command < period:
            return 0.0
        elapsed = self._begin_command(now)
        self.waited = self._instant - self._commanded_at
        self._last_command = now
        return self._limited(elapsed)

    def will_return(self, state: SessionState) -> bool:
        """Return whether silence would make the robot return to rest from this state."""
        is_led = not state.is_released and state is not SessionState.WAITING
        return is_led and self._request.return_after is not None

    def _limited(self, dt: float) -> float:
        longest = self._request.max_dt
        if dt > longest:
            return longest
        return dt if dt > SHORTEST_DT else SHORTEST_DT


class CommandedRobot(Gate):
    """A robot as last commanded.

    Let it `follow` what the gate of a mapper with the same limits admitted.

    Args:
        robot: The robot hand.
        q: Joint angles where it is now, at rest [rad], shape (n,).
        wrist: Pose of its wrist, shape (4, 4); None if it is not known yet. Ignored if the wrist is
            fixed.
        time: Instant on its clock [s].

    Attributes:
        is_placed: Whether the pose of its wrist is known.
    """

    def __init__(
        self, robot: Hand, q: Array, wrist: Array | None = None, time: float = 0.0
    ) -> None:
        self.is_placed = wrist is not None or not robot.is_floating
        self._placed = robot.configuration()
        vector = robot.configuration_vector(q, wrist if robot.is_floating else None)
        super().__init__(robot, Motion.at_rest(vector, len(robot.active_columns), time))
        self._has_free_wrist = robot.is_floating and robot.wrist_frame.parentJoint == 1
        can_move = robot.is_floating or robot.moves_wrist.any()
        self._fixed_wrist: Array | None = None
        if not can_move:
            self._fixed_wrist = self._wrist_at(vector)
        # The posture that was asked for last, and the stamp of the command that led there.
        self._known: tuple[int, Array, Array] | None = None

    def follow_command(self, gate: Gate, command: RobotCommand) -> None:
        """Move as a mapper's gate with the same limits has admitted.

        Args:
            gate: The gate.
            command: The posture that the gate admitted last.
        """
        self.core.follow(gate.core)
        self._known = self.core.stamp, command.q, command.wrist

    def obey(self, ik: PointIk) -> None:
        """Take over the acceleration limit of a mapper's QP, and the links that it keeps apart."""
        options = IkOptions(max_acceleration=ik.options.max_acceleration)
        super().__init__(ik.hand, self.motion, options, ik.gate.collisions)

    @property
    def q(self) -> Array:
        """Joint angles last commanded [rad], shape (n,)."""
        return self.posture[0]

    @property
    def wrist(self) -> Array | None:
        """Pose of the wrist last commanded, shape (4, 4); None if it is not known yet."""
        return self.posture[1]

    @property
    def posture(self) -> tuple[Array, Array | None]:
        """Joint angles and wrist last commanded, as in `q` and `wrist`."""
        if self._known is None or self._known[0] != self.core.stamp:
            vector = self.motion.q
            q = frozen(vector[self.hand.q_indices])
            self._known = self.core.stamp, q, self._wrist_at(vector)
        _, q, wrist = self._known
        return q, wrist if self.is_placed else None

    def _wrist_at(self, vector: Array) -> Array:
        """Return the pose of the wrist at a configuration of Pinocchio, shape (nq,)."""
        if self._fixed_wrist is not None:
            return self._fixed_wrist
        if self._has_free_wrist:
            # The first coordinates of the configuration are the wrist's own.
            wrist = pin.XYZQUATToSE3(vector[:7]) * self.hand.wrist_frame.placement
            return wrist.homogeneous
        self._placed.place(vector)
        return self._placed.wrist.homogeneous

    def move_to(
        self,
        q: Array,
        wrist: Array | None,
        when: When,
        share: float = 1.0,
        *,
        stops: bool = False,
    ) -> bool:
        """Move towards a posture as far as the gate admits.

        Args:
            q: Target joint angles [rad], shape (n,).
            wrist: Target pose of the wrist, shape (4, 4); None keeps it. The first one places it.
            when: Time since the last command [s], or the instant of this one.
            share: Share of the speed limits to use.
            stops: Whether the robot must be able to stop there at once.

        Returns:
            Whether the posture is reached. If it is not finite, the robot brakes.
        """
        if not np.isfinite(np.append(q, 0.0 if wrist is None else wrist)).all():
            self.brake(when)
            return False
        if not self.is_placed and wrist is not None:
            self.place(self.hand.configuration_vector(self.q, wrist))
            self.is_placed = True
        goal = self._at(q, wrist)
        return self.advance(goal, when, share, stops=stops)

    def _at(self, q: Array, wrist: Array | None) -> Array:
        """Return a configuration, with the wrist where it is if none is given."""
        there = self.wrist if wrist is None else wrist
        wrists = [there] * self.hand.is_floating
        return self.hand.configuration_vector(q, *wrists)


class Bucket:
    """A rate limit that permits short bursts (token bucket).

    Args:
        rate: Events per second.
        burst: Events at once; those of a quarter of a second if omitted.
        clock: Monotonic clock [s].
    """

    def __init__(
        self,
        rate: float = 1.0,
        burst: float | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._rate = rate
        self._burst = self._left = max(1.0, BURST * rate if burst is None else burst)
        self._clock = clock
        self._then = clock()

    def take(self) -> bool:
        """Count an event; return whether it is allowed."""
        # Not by `charge`: each message of the service takes from a bucket.
        now = self._clock()
        left = self._left + (now - self._then) * self._rate
        self._then = now
        if left > self._burst:
            left = self._burst
        is_allowed = left >= 1.0
        self._left = left - 1.0 if is_allowed else left
        return is_allowed

    def charge(self, count: float) -> float:
        """Count events that have happened; return how many are left, negative for a debt.

        Args:
            count: Number of events; negative to take them back.
        """
        now = self._clock()
        refilled = min(self._burst, self._left + (now - self._then) * self._rate)
        self._left = min(self._burst, refilled - count)
        self._then = now
        return self._left


def refuse_if(
    is_wrong: object, message: str, field: str = "", code: str = "invalid"
) -> None:
    """Refuse a request.

    Raises:
        RefusedError: If something is wrong.
    """
    if is_wrong:
        raise RefusedError(code, message, field=field)
