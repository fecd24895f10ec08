"""The seam of mappings, and those that the command line can name.

    unmapped            the operator's own joints; for an operator on its own hand
    straight            all fingers straight: what a task gives away for nothing
    open                the operator's own joints in the open hand, for an operator on its own hand:
                        the same control where straight fingers are so near that they enclose things
    NAME                a preset, such as `teleoperation` or `finger-vectors`
    NAME+grip           such a preset with thumb and finger holding what they meet, by the robot's
                        measured joints; `+grip+place` and `+grip+place5` know the object's place
                        too, exactly or with an error of 5 mm an axis (`gripping.py`)
    dexi-dexpilot       a peer as published, by its name in `handmap compare`; with `+limits` at the
                        end, clipped by the robot's limits of position and speed
    FILE.py:NAME        of a user (`handmap_qp.apps.offline.user_file`): a method (it has `bind`), a
                        function from landmarks to joint angles, or a callable that takes the
                        person's hand and the robot and returns one of these, or a mapping (it has
                        `reset` and `map`)
    FILE.npz            a trajectory, as `handmap retarget --out` writes, whatever the person does

Mappings run live in the loop: what the robot does with a command is what the operator sees next.
"""

import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Protocol, cast, runtime_checkable

import numpy as np

from handmap_qp.apps.offline.compare import (
    UserCodeError,
    UserMapping,
    is_user_file,
    read_user_mapping,
)
from handmap_qp.apps.offline.comparison import is_peer
from handmap_qp.apps.simulation.commands import GripName
from handmap_qp.errors import HandmapError, InvalidInputError, did_you_mean, expect
from handmap_qp.hands import Hand, Names
from handmap_qp.human import Recording, mirrored, scaled_human
from handmap_qp.mapping import (
    PRESETS,
    CustomMethod,
    HandMapper,
    LandmarkFunction,
    Method,
    Preset,
    joint_positions,
)
from handmap_qp.se3 import Array
from handmap_qp.stream import gripping_presets
from .gripping import Gripping
from .operator import OTHER, HumanHand, Joints, Operator
from .outside import check_peer, outside_mapping
from .task import Scene

UNMAPPED = "unmapped"
STRAIGHT = "straight"
OPEN = "open"


@runtime_checkable
class Mapping(Protocol):
    """Turns human hands into commands of a robot's joints, one attempt after another."""

    def reset(self) -> None:
        """Begin an attempt: forget all samples."""
        ...

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the command for one sample.

        Args:
            hand: The operator's hand.
            dt: Time since the sample before [s].
        """
        ...


@runtime_checkable
class SensingMapping(Mapping, Protocol):
    """A mapping that measures the robot and the object too."""

    def draw_errors(self, seed: int) -> None:
        """Draw the errors of what is measured in this attempt; called after `reset`.

        Args:
            seed: Seed of the attempt.
        """
        ...

    def sense(self, scene: Scene) -> None:
        """Take what is measured before the next call of `map`.

        Args:
            scene: The robot and the object now.
        """
        ...


class Unmapped:
    """The operator's own joints."""

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the operator's joints."""
        return hand.joints


class Straight:
    """All joints of the fingers at 0, or at the limit next to it."""

    def __init__(self, robot: Hand) -> None:
        self._command = straight_joints(robot)

    def reset(self) -> None:
        """Do nothing: there is no state."""

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the same posture for any hand."""
        return self._command


def straight_joints(robot: Hand) -> dict[str, float]:
    """Return all joints of a hand at 0, or at the limit next to it, by name [rad or m]."""
    straight = np.clip(np.zeros(len(robot.joint_names)), *robot.limits)
    return dict(zip(robot.joint_names, straight.tolist(), strict=True))


class Open:
    """The operator's own joints as they are at first, in the open hand, whatever follows."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget the open hand."""
        self._joints: Joints = {}

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the joints of the first sample."""
        self._joints = self._joints or hand.joints
        return self._joints


class Mapped:
    """A method of the package, or one that fits its seam.

    Every attempt begins with the mapper as it was made: at the robot's rest, without a reference.
    """

    def __init__(self, human: Hand, robot: Hand, method: str | Method | Preset) -> None:
        if isinstance(method, CustomMethod) and method.human_points:
            human = human.with_points(method.human_points)
        self._human = human
        self._robot = robot
        self._method = method
        self.reset()

    def reset(self) -> None:
        """Make a new mapper."""
        method = self._method
        ik = method.ik if isinstance(method, Preset) else None
        chosen = method.method if isinstance(method, Preset) else method
        self._mapper = HandMapper(self._human, self._robot, chosen, ik=ik)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Map the landmarks; the palm is fitted to them."""
        step = self._mapper.map_landmarks(hand.landmarks, dt=dt)
        names = self._mapper.robot.joint_names
        return dict(zip(names, step.command.q.tolist(), strict=True))


class BothHands:
    """One mapping for each hand of a person.

    Args:
        mapping: That of the hand, as in a task of one hand.
        other: That of the other hand.
    """

    def __init__(self, mapping: Mapping, other: Mapping) -> None:
        self._mapping = mapping
        self._other = other

    def reset(self) -> None:
        """Begin an attempt with both hands."""
        self._mapping.reset()
        self._other.reset()

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Map both hands; joints of the other hand have names that begin with `OTHER`."""
        joints = dict(self._mapping.map(hand, dt))
        if hand.other is not None:
            others = self._other.map(hand.other, dt)
            joints |= {OTHER + name: value for name, value in others.items()}
        return joints


class Replayed:
    """A trajectory that plays whatever the operator shows.

    Args:
        time: Instants, increasing [s], shape (T,).
        q: Joint positions [rad or m], shape (T, n).
        names: Names of the n joints.
    """

    def __init__(self, time: Array, q: Array, names: Names) -> None:
        self._time = time - time[0]
        self._q = q
        self._names = names
        self.reset()

    def reset(self) -> None:
        """Play from the beginning."""
        self._now = 0.0

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the posture at this instant, linearly between samples; at last the last one."""
        posture = [np.interp(self._now, self._time, column) for column in self._q.T]
        self._now += dt
        return dict(zip(self._names, map(float, posture), strict=True))


class Called:
    """A function from landmarks to joint angles.

    Args:
        robot: The robot hand.
        function: The function.
    """

    def __init__(self, robot: Hand, function: LandmarkFunction) -> None:
        self._robot = robot
        self._function = function

    def reset(self) -> None:
        """Do nothing: a function has no state that is known here."""

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the joints that the function returns."""
        q = joint_positions(self._function(hand.landmarks.copy()), self._robot)
        return dict(zip(self._robot.joint_names, q.tolist(), strict=True))


class OfUser:
    """A mapping of a user, whose errors end its own attempts and not those of others.

    Args:
        user: What the user's file defines.
        mapping: The mapping.
    """

    def __init__(self, user: UserMapping, mapping: Mapping) -> None:
        self._user = user
        self._mapping = mapping

    def reset(self) -> None:
        """Begin an attempt.

        Raises:
            UserCodeError: If the user's code raises an error.
        """
        self._user.run(self._mapping.reset)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the command.

        Raises:
            UserCodeError: If the user's code raises an error, or returns a number that is not
                finite.
        """
        try:
            command = {
                joint: float(value)
                for joint, value in self._mapping.map(hand, dt).items()
            }
        except HandmapError as error:
            raise UserCodeError(self._user.name, str(error)) from error
        except Exception as error:
            raise self._user.failed(error) from error
        for joint, value in command.items():
            if not math.isfinite(value):
                raise UserCodeError(self._user.name, f"{joint} is {value}")
        return command


def file_of(name: str) -> Path | None:
    """Return the file of a user's mapping or of a trajectory; None of others."""
    if name.endswith((".npz", ".py")):
        return Path(name)
    file, _, _ = name.rpartition(":")
    return Path(file) if file.endswith(".py") else None


def check_mapping(name: str) -> None:
    """Reject a name that no mapping has, before any attempt.

    Raises:
        InvalidInputError: If there is no such mapping or file.
    """
    if file := file_of(name):
        expect(file.is_file(), "--methods", "a file that exists", got=str(file))
        return
    if is_peer(name):
        check_peer(name)
        return
    able = gripping_presets()
    grip = GripName.parse(name)
    if grip and grip.preset in PRESETS:
        wanted = f"a preset that can grip ({', '.join(able)})"
        expect(grip.preset in able, "--methods", wanted, got=name)
        return
    known = {UNMAPPED, STRAIGHT, OPEN, *PRESETS}
    known |= {f"{preset}+grip" for preset in able}
    if name not in known:
        raise InvalidInputError(
            f"no mapping {name!r}",
            argument="--methods",
            value=name,
            advice=did_you_mean(name, known) or f"one of {', '.join(sorted(known))}",
        )


def make_mapping(
    name: str,
    operator: Operator,
    robot: Hand,
    calibration: int,
    other: Hand | None = None,
) -> Mapping:
    """Return a mapping by name, for a person measured in a calibration recording.

    Args:
        name: As at the top of this file.
        operator: Who will be mapped.
        robot: The robot hand.
        calibration: Seed of the operator's calibration recording.
        other: The robot's other hand, in a task of two hands. It gets a mapping of the same kind,
            for the mirror image of the person.

    Raises:
        HandmapError: If there is no such mapping, or it cannot be used with these hands.
    """
    if not is_peer(name):  # the peer itself says what it does not know
        check_mapping(name)
    recording = partial(operator.calibrate, calibration)
    mapping = _of_one_hand(name, recording, robot)
    if other is None:
        return mapping
    is_plain = GripName.parse(name) is None
    expect(is_plain, "--methods", "mappings without a grip for two hands", got=name)
    return BothHands(mapping, _of_one_hand(name, lambda: mirrored(recording()), other))


def _of_one_hand(name: str, calibrate: Callable[[], Recording], robot: Hand) -> Mapping:
    """Return a mapping of one hand by its name.

    Args:
        name: As at the top of this file.
        calibrate: Returns a recording of the person's hand.
        robot: The robot hand.
    """
    if name == UNMAPPED:
        return Unmapped()
    if name == STRAIGHT:
        return Straight(robot)
    if name == OPEN:
        return Open()
    if name.endswith(".npz"):
        return _trajectory(Path(name))
    if is_peer(name):
        return outside_mapping(name, robot)
    human = scaled_human(calibrate())
    if is_user_file(name):
        return _of_user(name, human, robot)
    if grip := GripName.parse(name):
        return Gripping(human, robot, grip)
    return Mapped(human, robot, name)


def _trajectory(file: Path) -> Replayed:
    """Read a trajectory that `handmap retarget` wrote."""
    with np.load(file) as archive:
        missing = {"time", "q", "joint_names"} - {*archive.files}
        expect(
            not missing,
            "--methods",
            "a trajectory with time, q and joint_names",
            got=f"{file} without {', '.join(sorted(missing))}",
        )
        names = tuple(map(str, archive["joint_names"]))
        return Replayed(archive["time"], archive["q"], names)


def _of_user(name: str, human: Hand, robot: Hand) -> Mapping:
    """Run a user's file, and make the mapping that it defines under a name.

    Raises:
        HandmapError: If it defines none, or raises an error.
    """
    user = read_user_mapping(name)
    made = user.for_hands(human, robot)
    if isinstance(made, Method | Preset):
        mapper = user.run(Mapped, human, robot, made)
        assert isinstance(mapper, Mapped)
        return OfUser(user, mapper)
    if isinstance(made, Mapping):
        return OfUser(user, made)
    if not callable(made):
        raise InvalidInputError(
            argument="--methods",
            expected="a method, a function, or a mapping with reset and map",
            got=f"{name}(...) = {made!r:.60}",
        )
    return OfUser(user, Called(robot, cast("LandmarkFunction", made)))
