"""`handmap live`: the service, its page and a tracker, started and ended together."""

from __future__ import annotations

import json
import subprocess
import sys
import webbrowser
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from time import sleep
from typing import TYPE_CHECKING, Annotated
from urllib.parse import urlencode

from handmap_core.errors import InvalidInputError, expect, require
from handmap_qp.apps.addresses import REQUESTS_PORT, url_host
from handmap_qp.apps.arguments import hinted
from handmap_qp.apps.interrupts import ended_by_signals
from handmap_qp.hands import Side, Values, robot_files, sided_name
from handmap_qp.human import HumanSample
from handmap_qp.trackers import read_recording
from .cli import send
from .mediapipe_source import MediapipeSource, environment_python
from .processes import end_process, start_command
from .reach import Reach, network_reach, qr_code
from .source import Replay, Sink, Source

if TYPE_CHECKING:
    from .service import ServiceSink

SESSION = "live"
"""Public name of the session that a camera or a recording moves."""
_USUAL = "three_finger"
"""Robot of a camera or a recording if none is named; its model is in the package."""
_LAST_PORT = 65535 - 2
_PERIOD = 0.2
"""Time between two looks at whether the service still runs [s]."""


@dataclass(frozen=True)
class Live:
    """Move a robot hand with your own hand: headset, webcam or recording, in one command.

    Starts the service, prints the address of its page as text and as a QR code, and opens the
    browser. The page takes the hands of a headset, and has the emergency stop, which also works on
    a phone. With --camera, a webcam tracks your hand, and the browser shows the robot as soon as
    your hand is measured. Ctrl-C ends everything; robots hold where they are.

    Motors follow by `handmap drive` in another terminal.

    Examples:
        handmap live                             (headset on a cable, or this machine)
        handmap live --network                   (headset or phone in the same network)
        handmap live --camera 0 --robot leap     (webcam)
        handmap live --recording demo            (no device at all)

    Attributes:
        robot: Robot hand, family of hands (`leap`), or robot with two hands; the page can choose
            another.
        camera: Number of the webcam to track the hand with. MediaPipe does it: install it once by
            `handmap track mediapipe --install`.
        recording: Recording to play again and again in place of a camera.
        side: The hand to track.
        network: Let devices of the network connect, by https and a token. Certificate (by openssl)
            and token are made at the first use, and kept in ~/.local/share/handmap/live.
        address: Address of this machine in the network.
        port: Port of requests; the two after it are of the stream and the page.
        open: Open the browser.
    """

    robot: Annotated[str | None, hinted("ROBOT", "(default: see the page)")] = None
    camera: Annotated[int | None, hinted("NUMBER", "(default: no camera)")] = None
    recording: Annotated[Path | None, hinted("FILE", "(default: none)")] = None
    side: Side = "right"
    network: bool = False
    address: Annotated[str | None, hinted("HOST", "(default: found)")] = None
    port: int = REQUESTS_PORT
    open: bool = True

    def run(self) -> None:
        """Serve, and send a tracker's samples if one is chosen, until Ctrl-C."""
        self._check()
        source = self._source()
        robot = self.robot or (_USUAL if source else "")
        reach = network_reach(self.address) if self.network else None
        with (
            ended_by_signals(),
            _ending_quietly(),
            _service(self.port, reach) as (service, ports),
        ):
            page = page_address(reach, ports["web"], robot if not source else "")
            print(instructions(page, reach, ports["web"], has_source=bool(source)))
            sys.stdout.flush()
            if source is None:
                if self.open:
                    webbrowser.open(page)
                _wait_for(service)
            else:
                # It needs the extra `service`, as the help does not.
                from .service import ServiceSink

                to = f"127.0.0.1:{ports['requests']}"
                sink = ServiceSink(to, robot, source.side, name=SESSION, is_shared=True)
                view = View(sink, to, opens=self.open)
                send(source, [sink, view], is_json=False)

    def _check(self) -> None:
        """Refuse what cannot work, before anything is started.

        Raises:
            InvalidInputError: With the option at fault.
            MissingExtraError: If the packages of the service or the view are missing.
        """
        expected = f"0 to {_LAST_PORT}"
        expect(0 <= self.port <= _LAST_PORT, "--port", expected, value=self.port)
        if self.address and not self.network:
            raise InvalidInputError("needs --network", argument="--address")
        if self.camera is not None and self.recording is not None:
            raise InvalidInputError("excludes --recording", argument="--camera")
        for module in ("segno", "websockets", "zmq"):
            require(module, "service", {"zmq": "pyzmq"}.get(module, ""))
        if self.camera is not None or self.recording is not None:
            require("viser", "view")

    def _source(self) -> Source | None:
        """Return the tracker; None for a headset, whose page sends its samples itself."""
        if self.camera is not None:
            environment_python()
            return MediapipeSource(camera=self.camera, side=self.side)
        if self.recording is not None:
            return Replay(read_recording(self.recording, self.side), loop=True)
        return None


class View(Sink):
    """Starts `handmap view` once the session's hand is measured, and ends it at the end.

    Args:
        session: The session to show.
        address: Address of the service's requests.
        opens: Whether it opens the browser.

    Attributes:
        process: The process of the view; None before the hand is measured.
    """

    def __init__(self, session: ServiceSink, address: str, *, opens: bool) -> None:
        self._session = session
        self._words = ["view", "--live", address, "--session", SESSION]
        self._words += ["--open"] * opens
        self.process: subprocess.Popen[str] | None = None

    def __exit__(self, *_: object) -> None:
        if self.process:
            end_process(self.process)

    def put(self, sample: HumanSample) -> None:
        """Start the view at the first command that moves the robot."""
        command = self._session.command
        if self.process is None and command and command.detail:
            self.process = start_command(self._words)

    def status(self) -> str:
        """Return what the person waits for."""
        return "" if self.process else "hold an open hand in view until it is measured"

    def summary(self) -> Values:
        """Return nothing: the session counts."""
        return {}


def page_address(reach: Reach | None, port: int, robot: str) -> str:
    """Return the address of the page, with the robot to choose and the token.

    Args:
        reach: How the network reaches the service; None for this machine alone.
        port: Port of the page.
        robot: A hand, a family of hands or a robot with two; empty for the page's own choice.
    """
    if robot in robot_files():
        chosen = {"robot": robot}
    elif robot:
        sides = ("right", "left")
        # A hand of one side leaves the other side without a robot.
        hands = {side: sided_name(robot, side) for side in sides}
        chosen = {
            side: "" if _is_of_other(hands[side], side) else hands[side]
            for side in sides
        }
    else:
        chosen = {}
    query = f"?{urlencode(chosen)}" if chosen else ""
    if reach is None:
        return f"http://localhost:{port}/{query}"
    return f"https://{url_host(reach.host)}:{port}/{query}#token={reach.token}"


def _is_of_other(name: str, side: Side) -> bool:
    own = name.rpartition("_")[2]
    return own in ("right", "left") and own != side


def instructions(page: str, reach: Reach | None, port: int, *, has_source: bool) -> str:
    """Return what a person reads at the start: address, QR code, and what to do next.

    Args:
        page: Address of the page.
        reach: How the network reaches the service; None for this machine alone.
        port: Port of the page.
        has_source: Whether a camera or a recording moves the robot.
    """
    where = "this network" if reach else "this machine, or a headset on its cable"
    stop = (
        "Emergency stop: the red button of this page, on every device that has it open."
    )
    end = "Ctrl-C ends everything here; robots hold."
    if has_source:
        hand = "Hold an open hand in view: the browser shows the robot once it is measured."
        steps = [hand, stop, end]
    else:
        cable = (
            f"Headset on a cable: run `adb reverse tcp:{port} tcp:{port}` here first."
        )
        accept = "Headset: open the address or scan the code, and accept the certificate once."
        start = (
            "Press Start in VR, put the controllers down, and hold your hands in view."
        )
        steps = [accept if reach else cable, start, f"{stop} {end}"]
    code = _printable(qr_code(page))
    return "\n".join([f"Page (for {where}): {page}", code, *steps])


def _printable(code: str) -> str:
    """Return the code, or nothing where the terminal's characters lack its blocks."""
    try:
        code.encode(sys.stdout.encoding or "utf-8")
    except UnicodeEncodeError:
        return ""
    return code


@contextmanager
def _service(
    port: int, reach: Reach | None
) -> Iterator[tuple[subprocess.Popen[str], dict[str, int]]]:
    """Run the service in a process of its own, which maps while this one tracks.

    Yields:
        The process, and its ports by name.

    Raises:
        InvalidInputError: If it does not start; it has said why.
    """
    stream, web = (port + 1, port + 2) if port else (0, 0)
    ports = ["--port", str(port), "--stream-port", str(stream), "--health-port", "-1"]
    words = ["serve", *ports, "--web", "--web-port", str(web), "--log-level", "error"]
    process = start_command([*words, *(reach.options if reach else [])], is_read=True)
    try:
        line = process.stdout.readline() if process.stdout else ""
        if not line:
            raise InvalidInputError(
                "the service did not start",
                advice="its reason is above; if another one runs, end it or choose --port",
            )
        yield process, json.loads(line)["ports"]
    finally:
        end_process(process)


def _wait_for(service: subprocess.Popen[str]) -> None:
    """Wait for Ctrl-C, or for an end of the service that nobody asked for.

    Raises:
        InvalidInputError: If the service ends.
    """
    while service.poll() is None:
        sleep(_PERIOD)
    raise InvalidInputError("the service has ended", advice="its reason is above")


@contextmanager
def _ending_quietly() -> Iterator[None]:
    """Take Ctrl-C as the usual end."""
    try:
        yield
    except KeyboardInterrupt:
        print("ended: robots hold where they are")
