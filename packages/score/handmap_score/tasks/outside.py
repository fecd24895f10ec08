"""Mappings by programs of others, live in a loop: `OutsideMapping`, `WithinLimits`.

The program is that of `handmap compare --peers`, with the command `live METHOD HAND`
(`handmap_qp.apps.offline.comparison`). It runs in a process of its own. Names are those of
`handmap compare` and `handmap simulate`, such as `dexi-dexpilot`: the peer as published. With
`+limits` at the end, the robot's limits of position and speed clip its joints.
"""

import json
import subprocess
import sys
import weakref
from collections import deque
from contextlib import suppress
from threading import Thread
from typing import IO

import msgspec
import numpy as np

from handmap_qp.apps.offline.comparison import (
    LIMITS,
    PROGRAM,
    OutsideError,
    outside_methods,
    peers_program,
)
from handmap_qp.errors import InvalidInputError, did_you_mean
from handmap_qp.hands import Hand, Names, clip_step
from handmap_qp.se3 import Array
from .operator import HumanHand, Joints

_KNOWN_HAND = "allegro_right"
_RESET = "reset"
_PATIENCE = 5.0
"""Time in which a program must end when its input is closed [s]."""


def base_of(name: str) -> str:
    """Return the name of a peer without its ending."""
    return name.removesuffix(LIMITS)


def peer_methods() -> Names:
    """Return the names of the peers' methods that can run here.

    Raises:
        OutsideError: If none can.
    """
    return tuple(outside_methods(peers_program(), _KNOWN_HAND))


def check_peer(name: str) -> None:
    """Reject a name that no peer has.

    Raises:
        InvalidInputError: If there is no such peer.
        OutsideError: If none can run here.
    """
    known = peer_methods()
    if base_of(name) not in known:
        raise InvalidInputError(
            f"no mapping {name!r}",
            argument="--methods",
            value=name,
            advice=did_you_mean(base_of(name), known) or f"one of {', '.join(known)}",
        )


class OutsideMapping:
    """A method of a peer, in a process of its own.

    Args:
        method: Its name.
        robot: The robot hand.

    Raises:
        OutsideError: If the program does not start, such as for a hand that the peer does not know.
    """

    def __init__(self, method: str, robot: Hand) -> None:
        self._method = method
        self._names = robot.joint_names
        hand = str(robot.spec.file or robot.name)
        program = peers_program() / PROGRAM
        self._process = subprocess.Popen(
            [sys.executable, program, "live", method, hand],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        # Its last words. A program whose warnings nobody reads would wait for ever.
        self._said = deque[str](maxlen=1)
        pipe = self._process.stderr
        self._listener = Thread(target=_listen, args=(pipe, self._said), daemon=True)
        self._listener.start()
        weakref.finalize(self, _end, self._process, self._listener)
        self._read()

    def reset(self) -> None:
        """Begin an attempt: the peer forgets all samples.

        Raises:
            OutsideError: If the program ended, or answers with something else than an empty list.
        """
        self._ask(_RESET, 0)

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the peer's joints, as it gives them.

        Raises:
            OutsideError: If the program ended, or gives other numbers than one for each joint.
        """
        q = self._ask(hand.landmarks.tolist(), len(self._names))
        return dict(zip(self._names, q, strict=True))

    def _ask(self, value: str | list[list[float]], count: int) -> list[float]:
        """Return so many numbers that the program answers."""
        pipe = self._process.stdin
        assert pipe is not None
        # What it said before it ended is the reason.
        with suppress(BrokenPipeError):
            pipe.write(json.dumps(value) + "\n")
            pipe.flush()
        line = self._read()
        with suppress(msgspec.DecodeError):
            numbers = msgspec.json.decode(line, type=list[float])
            if len(numbers) == count and np.isfinite(numbers).all():
                return numbers
        raise OutsideError(f"{self._method}: bad answer: {line.strip():.80}")

    def _read(self) -> str:
        """Return the next line that the program prints."""
        out = self._process.stdout
        assert out is not None
        if line := out.readline():
            return line
        self._listener.join(_PATIENCE)
        raise OutsideError(f"{self._method}: {[*self._said, 'it ended'][0]}")


def _listen(errors: IO[str], said: deque[str]) -> None:
    """Keep the last line that is not empty."""
    for line in errors:
        if words := line.strip():
            said.append(words)


def _end(process: subprocess.Popen[str], listener: Thread) -> None:
    """Close the input of a program, which then ends, or is ended."""
    assert process.stdin is not None
    # What could not be sent to a program that has ended is lost.
    with suppress(BrokenPipeError):
        process.stdin.close()
    try:
        process.wait(_PATIENCE)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    listener.join(_PATIENCE)
    for pipe in (process.stdout, process.stderr):
        if pipe is not None:
            pipe.close()


class WithinLimits:
    """Another mapping, whose joints are clipped by the robot's limits of position and speed.

    Args:
        mapping: The other mapping.
        robot: The robot hand.
    """

    def __init__(self, mapping: OutsideMapping, robot: Hand) -> None:
        self._mapping = mapping
        self._robot = robot
        self._last: Array | None = None

    def reset(self) -> None:
        """Begin an attempt: the first posture is limited in position alone."""
        self._mapping.reset()
        self._last = None

    def map(self, hand: HumanHand, dt: float) -> Joints:
        """Return the clipped joints."""
        names = self._robot.joint_names
        joints = self._mapping.map(hand, dt)
        wanted = np.array([joints[name] for name in names])
        self._last = q = clip_step(self._robot, wanted, self._last, dt)
        return dict(zip(names, q.tolist(), strict=True))


def outside_mapping(name: str, robot: Hand) -> OutsideMapping | WithinLimits:
    """Return a peer by its name, within the robot's limits where the name asks for them."""
    mapping = OutsideMapping(base_of(name), robot)
    return WithinLimits(mapping, robot) if name.endswith(LIMITS) else mapping
