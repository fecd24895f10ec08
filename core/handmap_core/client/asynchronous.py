"""`AsyncClient`: the methods of `Client` as coroutines. A test compares both files."""

import asyncio
from collections.abc import Mapping
from typing import Literal, Self, cast

import numpy.typing as npt
import zmq.asyncio

from .calls import (
    Call,
    Calls,
    Command,
    Hands,
    Options,
    PoseLike,
    Socket,
    State,
    T,
    Use,
    open_request,
    request_fields,
    sample_request,
)
from .messages import Error, Haptics, Lengths, Opened, Side


class AsyncClient(Calls):
    """Client for asyncio: `Client` with coroutines.

    Calls of several tasks take turns. Arguments, attributes and errors are those of `Client`.
    """

    _context = zmq.asyncio.Context

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def open(
        self,
        robot: str,
        *,
        name: str | None = None,
        input: Literal["q", "landmarks", "points"] | None = None,
        layout: str | None = None,
        upright: str | None = None,
        side: Side | None = None,
        hand_length: float | None = None,
        lengths: Lengths | Mapping[str, npt.ArrayLike] | None = None,
        contact_gap: float | None = None,
        human_points: str | None = None,
        robot_points: str | None = None,
        mount: Literal["floating", "fixed"] | None = None,
        preset: str | None = None,
        options: Options | None = None,
        mapping: Options | None = None,
        teleoperation: Options | None = None,
        ik: Options | None = None,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: PoseLike | None = None,
        restore: bool | None = None,
        is_released: bool | None = None,
        max_dt: float | None = None,
        time_from: Literal["server", "client"] | None = None,
        watchdog: float | None = None,
        return_after: float | None = None,
        return_speed: float | None = None,
        resume: Literal["follow", "engage", "clutch"] | None = None,
        has_detail: bool | None = None,
        is_shared: bool | None = None,
        following_error: float | None = None,
        following_time: float | None = None,
        grip: Options | bool | None = None,
        object: str | npt.ArrayLike | None = None,
    ) -> Opened:
        """Open a session: one human hand controls a robot hand, or both hands control a robot.

        A session that was open before stays open if the server refuses. A person's file has
        `lengths` and `contact_gap` (`Person.session_fields`).

        Args:
            robot: Name of a robot hand on the server, or of its family, such as `allegro`; then the
                hand of `side` is meant. Or of a robot with two hands; this one needs
                input=landmarks, and its samples have `hands`.
            name: Public name of the session and its stream; the server makes one if omitted.
            input: What samples hold; joint angles `q` if omitted.
            layout: Layout of the numbers in `values`, such as webxr25 (`handmap layouts` lists
                them); only with input=landmarks, whose 21 landmarks it replaces.
            upright: Axes of the samples' world that are up and forward; the layout's if omitted,
                else not known. For an arm, they set the option `alignment`.
            side: The human hand that controls a robot hand; the right one if omitted.
            hand_length: From wrist crease to middle fingertip [m].
            lengths: The measured hand, or both. With neither, the first landmarks measure it: each
                hand by its own, and a hand that was not seen enough is taken to be as large as the
                other.
            contact_gap: Distance of thumb and finger landmarks where the skin touches [m]. Without
                it, and without the option of teleoperation, touches measure it during the session.
            human_points: Set of reference points on the human hand.
            robot_points: Set of reference points on the robot hand.
            mount: Mount of the robot's wrist, in place of the hand's own.
            preset: What the mapping is for; see the list. If omitted: teleoperation if the robot's
                fingers have partners, else object, or fixed_wrist if its wrist is fixed; another
                one if `options` has what this one does not have.
            options: Options of the preset's method; others are the preset's.
            mapping: Former name of `options`; without `preset`, for the preset paper.
            teleoperation: Former name of `options` for the preset teleoperation.
            ik: Fields of IkOptions; others are the preset's. The solver must be daqp.
            robot_q: Joint angles where the robot is now [rad]; at rest if omitted.
            robot_wrist: Pose of its wrist; at the palm of the first sample if omitted.
            restore: Continue where the last session of this name left the robot: its owner in the
                same epoch, without keys others too, in a new one, when the owner is silent for 2 s.
            is_released: Start disengaged: the robot holds still until `engage`.
            max_dt: Longest time that one command may account for [s], about two samples; 1/30 if
                omitted.
            time_from: Clock for speed limits; the server's if omitted, and `client` needs
                --simulated-time.
            watchdog: Time without a sample after which the robot holds [s]; 0.25 if omitted.
            return_after: Time of a hold after which the robot returns to rest [s]; never if
                omitted.
            return_speed: Share of its speed limits that it returns at; 0.1 if omitted.
            resume: After a hold: follow the human, as if omitted, or `engage` again, which takes a
                new reference; `clutch` is its former name.
            has_detail: Whether commands carry every stage of the mapping.
            is_shared: Whether others may engage, disengage, configure and clear it by its name.
            following_error: Distance from all commands of the last 50 ms at which a measured joint
                does not follow [rad], at most half of its range. The robot then holds where it is
                (`not_following`) until `engage` or `reset`, as where measurements stay away for 150
                ms. If omitted, errors are only reported. An object in the hand stops joints, too.
            following_time: How long it must last [s]; 0.05 if omitted.
            grip: Fields of GripOptions: thumb and finger hold what they meet, by `measured_q` of
                samples or a driver's `measured`, or all press on an `object`. If omitted, they do
                so wherever joints are measured and the hand can; false: never. Only with
                input=landmarks, as is `object`.
            object: The object that the person holds: `box:0.05`, `box:0.03x0.04x0.1`,
                `sphere:0.04`, `cylinder:0.04x0.1`, or the vertices of its convex hull [m]; samples
                have `object_pose`.

        Returns:
            The session, also kept as `opened`.
        """
        request = open_request(
            {
                "robot": robot,
                "name": name,
                "input": input,
                "layout": layout,
                "upright": upright,
                "side": side,
                "hand_length": hand_length,
                "lengths": lengths,
                "contact_gap": contact_gap,
                "human_points": human_points,
                "robot_points": robot_points,
                "mount": mount,
                "preset": preset,
                "options": options,
                "mapping": mapping,
                "teleoperation": teleoperation,
                "ik": ik,
                "robot_q": robot_q,
                "robot_wrist": robot_wrist,
                "restore": restore,
                "is_released": is_released,
                "max_dt": max_dt,
                "time_from": time_from,
                "watchdog": watchdog,
                "return_after": return_after,
                "return_speed": return_speed,
                "resume": resume,
                "has_detail": has_detail,
                "is_shared": is_shared,
                "following_error": following_error,
                "following_time": following_time,
                "grip": grip,
                "object": object,
            }
        )
        return await self._run(self._call(request, Opened))

    async def step(
        self,
        *,
        time: float | None = None,
        q: npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        wrist: PoseLike | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
        base: PoseLike | None = None,
        hands: Hands | None = None,
        measured_q: npt.ArrayLike | None = None,
        object_centre: npt.ArrayLike | None = None,
        object_deviation: float | None = None,
        object_pose: PoseLike | None = None,
    ) -> Command:
        """Map one sample and wait for its command.

        Args:
            time: Time stamp of any clock of the client [s].
            q: Joint angles in the order of `human_joint_names` [rad].
            landmarks: 21 landmarks in MediaPipe's order [m]; may be omitted if `valid` is false.
            points: Reference points in the order of `human_point_names` [m].
            values: Numbers of the session's `layout`, row by row, in its axes and unit.
            wrist: The human's wrist: required with `q`; optional with `landmarks`, whose palm gives
                it otherwise; with `points`, required by teleoperation and rigid_from=wrist. With
                `values`, in the axes and unit of the layout.
            valid: Whether the tracker saw the hand; only with `landmarks`. If not, it holds.
            confidence: The tracker's own confidence; 0 counts as not seen.
            base: Where the floating base of a robot is in its world; as it was if omitted.
            hands: One or both hands by side, in place of all fields above but `time`; for a robot
                with two hands. Without one of them, its side of the robot goes on to what it was
                asked for last, and holds after 0.25 s.
            measured_q: Joint angles that the robot has now [rad], as in `measured`. With `grip`,
                either is required.
            object_centre: Middle of what the robot is to grip, in its world [m], if it is known:
                pads that close near it meet around it; only where joints are measured.
            object_deviation: Standard deviation of that along each axis [m]; 5 mm if omitted.
            object_pose: Pose of the person's `object`, in the axes of the landmarks; if it is
                omitted, the object is not seen.

        Returns:
            The command of this sample.

        Raises:
            ValueError: If a pose cannot be used.
        """
        sample = sample_request(
            "step",
            {
                "time": time,
                "q": q,
                "landmarks": landmarks,
                "points": points,
                "values": values,
                "wrist": wrist,
                "valid": valid,
                "confidence": confidence,
                "base": base,
                "hands": hands,
                "measured_q": measured_q,
                "object_centre": object_centre,
                "object_deviation": object_deviation,
                "object_pose": object_pose,
            },
        )
        return await self._run(self._call(sample, Command))

    async def send(
        self,
        *,
        time: float | None = None,
        q: npt.ArrayLike | None = None,
        landmarks: npt.ArrayLike | None = None,
        points: npt.ArrayLike | None = None,
        values: npt.ArrayLike | None = None,
        wrist: PoseLike | None = None,
        valid: bool | None = None,
        confidence: float | None = None,
        base: PoseLike | None = None,
        hands: Hands | None = None,
        measured_q: npt.ArrayLike | None = None,
        object_centre: npt.ArrayLike | None = None,
        object_deviation: float | None = None,
        object_pose: PoseLike | None = None,
    ) -> None:
        """Send a sample as in `step`, without waiting for its command.

        Read the command with `latest`. If several samples wait, the server maps the newest.

        Args:
            time: Time stamp of any clock of the client [s].
            q: Joint angles in the order of `human_joint_names` [rad].
            landmarks: 21 landmarks in MediaPipe's order [m]; may be omitted if `valid` is false.
            points: Reference points in the order of `human_point_names` [m].
            values: Numbers of the session's `layout`, row by row, in its axes and unit.
            wrist: The human's wrist: required with `q`; optional with `landmarks`, whose palm gives
                it otherwise; with `points`, required by teleoperation and rigid_from=wrist. With
                `values`, in the axes and unit of the layout.
            valid: Whether the tracker saw the hand; only with `landmarks`. If not, it holds.
            confidence: The tracker's own confidence; 0 counts as not seen.
            base: Where the floating base of a robot is in its world; as it was if omitted.
            hands: One or both hands by side, in place of all fields above but `time`; for a robot
                with two hands. Without one of them, its side of the robot goes on to what it was
                asked for last, and holds after 0.25 s.
            measured_q: Joint angles that the robot has now [rad], as in `measured`. With `grip`,
                either is required.
            object_centre: Middle of what the robot is to grip, in its world [m], if it is known:
                pads that close near it meet around it; only where joints are measured.
            object_deviation: Standard deviation of that along each axis [m]; 5 mm if omitted.
            object_pose: Pose of the person's `object`, in the axes of the landmarks; if it is
                omitted, the object is not seen.

        Raises:
            RuntimeError: If no session is open.
            ServiceError: If the server refused an earlier sample.
            ServiceTimeoutError: If a lost session cannot be reopened in time.
            ValueError: If a pose cannot be used.
        """
        sample = sample_request(
            "sample",
            {
                "time": time,
                "q": q,
                "landmarks": landmarks,
                "points": points,
                "values": values,
                "wrist": wrist,
                "valid": valid,
                "confidence": confidence,
                "base": base,
                "hands": hands,
                "measured_q": measured_q,
                "object_centre": object_centre,
                "object_deviation": object_deviation,
                "object_pose": object_pose,
            },
        )
        return await self._run(self._send(sample))

    async def latest(self, timeout: float = 0.0) -> Command | None:
        """Return the newest command of the stream.

        Args:
            timeout: Longest time to wait for one [s].

        Returns:
            None if no command has arrived since the last call, nor arrives in time.

        Raises:
            RuntimeError: If this client neither opened nor watches a session.
            ServiceError: If the server could not use a streamed sample.
        """
        return await self._run(self._latest(timeout), "stream")

    async def watch(self, name: str) -> State:
        """Watch another client's session; `latest` returns its commands.

        If the session is shared, `disengage`, `engage` and `configure` act on it.

        Args:
            name: Public name of the session.

        Raises:
            RuntimeError: If this client has a session of its own.
        """
        return await self._run(self._watch(name))

    async def measured(self, q: npt.ArrayLike) -> Error | None:
        """Say where the joints of a watched session's robot are, without waiting for an answer.

        The client that sends the samples of a session gives `measured_q` with its samples instead.

        Args:
            q: Joint angles that a driver reads [rad], in the order of `joint_names`.

        Returns:
            Why the server refused an earlier call, with the code `denied` if the session is of
            another client and not shared; None if no refusal has arrived.
        """
        return await self._run(self._tell({"type": "measured", "measured_q": q}))

    async def touch(
        self,
        *,
        forces: Mapping[str, float] | None = None,
        efforts: Mapping[str, float] | None = None,
        time: float = 0.0,
    ) -> Error | None:
        """Say what the fingers of the robot feel, without waiting for an answer.

        Say it at least every 0.1 s: what is older than 0.2 s no longer counts.

        Args:
            forces: Contact force of fingers by name [N].
            efforts: Load of fingers by name, as a share of the largest, 0 to 1.
            time: Time stamp of the sender [s].

        Returns:
            Why the server refused an earlier call; None if no refusal has arrived.
        """
        felt = {"forces": forces, "efforts": efforts, "time": time}
        return await self._run(self._touch(felt), "touches")

    async def haptics(self, timeout: float = 0.0) -> Haptics | None:
        """Return what the fingers of the robot feel, in the session opened or watched.

        The first call subscribes. Call it at least every 0.2 s: what may have waited longer is left
        out.

        Args:
            timeout: Longest time to wait for it [s].

        Returns:
            None if nothing has arrived since the last call, nor arrives in time.

        Raises:
            RuntimeError: If this client neither opened nor watches a session.
        """
        return await self._run(self._haptics(timeout), "haptics")

    async def engage(self) -> None:
        """Engage, or engage again: the next sample is the reference.

        The robot continues from where it is. With the presets `teleoperation` and `object`, its
        fingers then go to the human's posture.
        """
        # Servers of earlier versions know the former names of messages alone.
        return await self._run(self._do("clutch"))

    async def disengage(self) -> None:
        """Disengage: the robot holds its posture until `engage`."""
        return await self._run(self._do("release"))

    async def clutch(self) -> None:
        """Engage: the former name of `engage`."""
        return await self.engage()

    async def release(self) -> None:
        """Disengage: the former name of `disengage`."""
        return await self.disengage()

    async def stop(self, name: str | None = None, *, reason: str = "") -> None:
        """Stop the robot: it brakes and holds, whatever comes, until `clear`.

        Args:
            name: Public name of a session; the client's own or the watched one if omitted, and all
                sessions of the server if the client has none.
            reason: Reason for the server's log.
        """
        addressee = {} if name is None else {"session": "", "name": name}
        return await self._run(self._do("stop", reason=reason, **addressee))

    async def clear(self, stop: int) -> None:
        """Clear an emergency stop on purpose; the robot is then disengaged until `engage`.

        Args:
            stop: Its number, `status().stop`.
        """
        return await self._run(self._do("clear", stop=stop))

    async def reset(
        self,
        *,
        robot_q: npt.ArrayLike | None = None,
        robot_wrist: PoseLike | None = None,
    ) -> None:
        """Start again: the next sample is the reference.

        Args:
            robot_q: Joint angles where the robot is now [rad]. Without them, it stays where it is.
            robot_wrist: Pose of its wrist. Without both, the robot moves to rest within its speed
                limits.
        """
        request = request_fields({"robot_q": robot_q, "robot_wrist": robot_wrist})
        return await self._run(self._do("reset", **request))

    async def configure(
        self,
        *,
        preset: str | None = None,
        options: Options | None = None,
        mapping: Options | None = None,
        teleoperation: Options | None = None,
        ik: Options | None = None,
        has_detail: bool | None = None,
        grip: Options | None = None,
    ) -> None:
        """Change options; options that are not named, and the reference, stay as they are.

        Args:
            preset: Another preset, with its own options where none are given here.
                `max_acceleration` and `avoids_self_collision` stay.
            options: Options of the preset's method; without `preset`, others stay as they are.
            mapping: Former name of `options`.
            teleoperation: Former name of `options`.
            ik: Fields of IkOptions; without `preset`, others stay as they are.
            has_detail: Whether commands carry every stage of the mapping.
            grip: Fields of GripOptions, of a session that has a grip; others stay as they are.
        """
        request = request_fields(
            {
                "preset": preset,
                "options": options,
                "mapping": mapping,
                "teleoperation": teleoperation,
                "ik": ik,
                "has_detail": has_detail,
                "grip": grip,
            }
        )
        return await self._run(self._do("configure", **request))

    async def status(self) -> State:
        """Return the state of the session; of the server if no session is open."""
        return await self._run(self._call({"type": "status"}, State))

    async def close(self) -> None:
        """End the session if the server can be reached, and close the sockets."""
        return await self._run(self._close())

    async def _is_ready(self, socket: Socket, event: int, milliseconds: int) -> bool:
        if int(socket.EVENTS) & event:
            return True
        # Closing the socket cancels this future. `wait` keeps that apart from a cancelled task.
        polling = cast("asyncio.Future[int]", socket.poll(milliseconds, event))
        polled = asyncio.ensure_future(polling)
        try:
            await asyncio.wait([polled])
            is_closed = polled.cancelled() or socket.closed
            return not is_closed and bool(polled.result())
        finally:
            polled.cancel()

    async def _run(self, call: Call[T], turn: Use = "requests") -> T:
        try:
            async with self._turns[turn]:
                return await call
        finally:
            call.close()
