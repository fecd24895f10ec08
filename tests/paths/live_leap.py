"""A webcam or a headset moves an emulated LEAP hand: two programs, from the page on live input.

The motors are emulated on a pseudo-terminal, with the registers and checksums of Dynamixel. The
landmarks of a webcam are those of the recording that comes with the package; the headset is
emulated in Chromium. The path ends well only if the motors' own positions follow the commands of
the session, and the page's emergency stop takes their torque away until it is cleared.
"""

from __future__ import annotations

import json
import re
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from browser import Browser, find_chromium
from paths.fresh import stop
from paths.headset import lead_by_headset, says
from paths.newcomer import Newcomer
from patience import PATIENCE, wait_until

BY_LANDMARKS = "handmap live --recording demo"
BY_HEADSET = "handmap live"
DRIVE = "handmap drive webxr-right --driver leap --port /dev/ttyUSB0"
INSTALL = "pip install packages/drive"
EMULATE = "python -m handmap_drive.emulator dynamixel"
COMMANDS = {
    **dict.fromkeys((BY_LANDMARKS, BY_HEADSET, DRIVE), "docs/live.md"),
    **dict.fromkeys((INSTALL, EMULATE), "docs/drive.md"),
}
SECONDS = 8.0
"""Time over which motors and commands are compared [s]."""
LARGEST_DELAY = 1.0
"""Longest delay of the motors that is tried [s]."""
WORST = 0.1
"""Largest RMS distance of the motors from the commands of that long ago [rad]."""
_PERIOD = 0.02
"""Time between two looks at the motors [s]."""
_COMMANDS = """
import sys
import time
import numpy as np
from handmap_qp.client import Client

session, seconds, file = sys.argv[1:]
with Client() as client:
    client.watch(session)
    rows, until = [], time.monotonic() + float(seconds)
    while time.monotonic() < until:
        if command := client.latest(timeout=1.0):
            rows.append((command.server_time, *command.q))
            names = command.joint_names
times, *q = np.array(rows).T
np.savez(file, time=times, q=np.array(q).T, names=names)
"""
_JOINTS = """
import json
from handmap_drive import DRIVERS
from handmap_qp import load_hand

names = load_hand("leap_right").joint_names
print(json.dumps(DRIVERS["leap"]("", names, None).joint_names))
"""


_ENGAGE = """
import sys
from handmap_qp.client import Client

with Client() as client:
    client.watch(sys.argv[1])
    client.engage()
"""


class Motors:
    """The emulated motors of a LEAP hand, in a terminal of the user's.

    Args:
        process: The emulator.

    Attributes:
        port: The port to give to the driver.
        driver: The driver, which must not end; None before it is started.
    """

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.driver: subprocess.Popen[str] | None = None
        self.port = str(self._line()["port"])

    def _line(self) -> dict[str, Any]:
        assert self._process.stdout
        line = self._process.stdout.readline()
        return json.loads(line) if line else stop("the emulated motors have ended")

    def state(self) -> dict[str, Any]:
        """Return what they do now: `time` [s, monotonic], `angle` [rad], `limit` of torque.

        Asks at most every `_PERIOD`, because motors that are always asked answer no driver.
        """
        time.sleep(_PERIOD)
        if self.driver and self.driver.poll() is not None:
            stop("handmap drive has ended")
        print("{}", file=self._process.stdin, flush=True)
        return self._line()

    def have_torque(self) -> bool:
        """Tell whether all of them have torque."""
        return all(limit > 0.0 for limit in self.state()["limit"])

    def are_free(self) -> bool:
        """Tell whether none of them has torque."""
        return not any(self.state()["limit"])


def distance(
    commands: dict[str, np.ndarray], times: np.ndarray, angles: np.ndarray
) -> tuple[float, float]:
    """Return the delay [s] at which motors are nearest to commands, and the RMS distance [rad].

    Args:
        commands: `time`, shape (T,), and `q` in the motors' order, shape (T, n).
        times: Times of the motors' states, shape (K,).
        angles: Their angles, shape (K, n).
    """
    # What is commanded last is reached after the last state.
    is_early = commands["time"] < times[-1] - LARGEST_DELAY
    at, q = commands["time"][is_early], commands["q"][is_early]
    delays = np.arange(0.0, LARGEST_DELAY, 0.01)
    errors = [
        np.array([np.interp(at + delay, times, joint) for joint in angles.T]).T - q
        for delay in delays
    ]
    worst = [float(np.sqrt(np.mean(error**2))) for error in errors]
    best = int(np.argmin(worst))
    return float(delays[best]), worst[best]


def measure(
    path: Newcomer, motors: Motors, session: str, joints: list[str]
) -> tuple[float, float, float]:
    """Watch motors and commands for some seconds.

    Returns:
        Delay [s], RMS distance then [rad], and the largest motion [rad]: of a command or of a
        motor, whichever moved less. Motors that arrive at a robot that holds follow nothing.
    """
    file = path.work / "commands.npz"
    states = []
    with path.scripted(_COMMANDS, session, str(SECONDS), str(file)) as process:
        while process.poll() is None:
            states.append(motors.state())
        if process.returncode:
            stop(f"no commands of {session} arrive")
    with np.load(file) as archive:
        commands = dict(archive)
    order = [commands["names"].tolist().index(name) for name in joints]
    commands["q"] = commands["q"][:, order]
    times = np.array([each["time"] for each in states])
    angles = np.array([each["angle"] for each in states])
    is_after = commands["time"] > times[0]
    commands = {name: commands[name][is_after] for name in ("time", "q")}
    moved = min(np.ptp(each, axis=0).max() for each in (angles, commands["q"]))
    return *distance(commands, times, angles), float(moved)


def see_following(path: Newcomer, motors: Motors, session: str) -> None:
    """Wait until the motors follow a session; end the path if they never do."""
    joints = json.loads(path.python(_JOINTS))
    until = time.monotonic() + PATIENCE
    with path.step(f"the motors have torque, and follow {session}"):
        wait_until(motors.have_torque, "the motors get no torque")
        while True:
            delay, rms, moved = measure(path, motors, session, joints)
            if rms < WORST and moved > 0.5:
                break
            if time.monotonic() > until:
                stop(f"motors are {rms:.2f} rad off, and moved {moved:.2f} rad")
    path.note(
        f"the motors moved up to {moved:.2f} rad, {1e3 * delay:.0f} ms behind the commands, "
        f"{rms:.3f} rad RMS off then"
    )


def see_stop(
    path: Newcomer, motors: Motors, browser: Browser, resume: Callable[[], object]
) -> None:
    """Press the page's emergency stop: the motors must be free until `resume` is called."""
    with path.step("the emergency stop of the page: motors without torque"):
        browser.click_on("#stop")
        browser.wait_for(says("#state", "EMERGENCY STOP"))
        wait_until(motors.are_free, "the motors keep their torque")
    with path.step("Clear the stop, and Engage: they have it again"):
        resume()
        wait_until(motors.have_torque, "the motors stay without torque")


@contextmanager
def driven(path: Newcomer, session: str) -> Iterator[Motors]:
    """Let emulated motors follow a session, by the commands of the page on motors."""
    with path.entering(EMULATE) as process:
        motors = Motors(process)
        instead = {"/dev/ttyUSB0": motors.port, "webxr-right": session}
        # Nobody is here to hold the space bar.
        with path.entering(DRIVE, "--no-deadman", instead) as motors.driver:
            yield motors


@contextmanager
def live(path: Newcomer, line: str) -> Iterator[str]:
    """Type `handmap live`, and yield the address of the page that it prints."""
    with path.entering(line, "--robot leap --no-open") as process:
        assert process.stdout
        found = re.search(r"https?://\S+", process.stdout.readline())
        yield found[0] if found else stop("handmap live prints no address")


def by_landmarks(path: Newcomer, program: str) -> None:
    """Move the motors by recorded landmarks, as those of a webcam."""
    with (
        live(path, BY_LANDMARKS) as page,
        driven(path, "live") as motors,
        Browser(program) as browser,
    ):
        see_following(path, motors, "live")
        browser.open(page)
        browser.wait_for(says("#scope", "Stops the robot"))

        def resume() -> None:
            browser.click_on("[data-name=live] .clear")
            browser.wait_for(says("[data-name=live] .mode", "holds until Engage"))
            # As the button of the view does, which is a page of its own.
            path.python(_ENGAGE, "live")

        see_stop(path, motors, browser, resume)


def by_headset(path: Newcomer, program: str) -> None:
    """Move the motors by the right hand of an emulated headset."""
    with (
        live(path, BY_HEADSET) as page,
        Browser(program, size=(1100, 1000)) as browser,
    ):
        lead_by_headset(path, browser, page)
        with driven(path, "webxr-right") as motors:
            see_following(path, motors, "webxr-right")

            def resume() -> None:
                for side in ("right", "left"):
                    browser.click_on(f"#{side} .clear")
                browser.wait_for(says("#right .state", "held until Engage"))
                browser.click_on("#right .engage")

            see_stop(path, motors, browser, resume)
            with path.step("the headset ends VR: motors without torque"):
                browser.evaluate("emulated.session.end(); 0")
                wait_until(motors.are_free, "the motors keep their torque")


def main() -> None:
    """Go the path."""
    program = find_chromium()
    if not program:
        stop("no Chromium on the path: HANDMAP_CHROMIUM names one")
    # With what the README installs, the first command says what it lacks.
    title = "Landmarks of a webcam move an emulated LEAP"
    with Newcomer(title, "plot", "view", commands=COMMANDS) as path:
        path.heed(BY_LANDMARKS, "--robot leap")
        path.enter(INSTALL)
        by_landmarks(path, program)
        path.leave_out("a camera, a motor", "none is here")
    title = "An emulated headset moves an emulated LEAP"
    with Newcomer(title, "view", "service", commands=COMMANDS) as path:
        path.enter(INSTALL)
        by_headset(path, program)
        path.leave_out("a headset of a maker, a motor", "none is here")


if __name__ == "__main__":
    main()
