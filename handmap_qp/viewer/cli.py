"""The command `handmap view`."""

from __future__ import annotations

import contextlib
import importlib.util
import webbrowser
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from handmap_qp.addresses import check_port
from handmap_qp.errors import InvalidInputError, MissingExtraError
from handmap_qp.ik.options import IkOptions
from handmap_qp.mapping.options import MappingOptions

if TYPE_CHECKING:
    import viser

    from handmap_qp.viewer.replay import Replay


@dataclass(frozen=True)
class View:
    """Look at a mapping in the browser, and change its options while it plays.

    Shows the human hand and the robot hand side by side, reference points and targets, what T_def
    makes of a ball, the robot's joints between their limits, errors and timing.

    Examples: `handmap view recording.npz --robot allegro_right`, or
    `handmap view recording.npz --robot three_finger --html page.html` for a page that plays without
    a server, or `handmap view --live 127.0.0.1` beside a running `handmap serve`.

    Attributes:
        recording: Recording of a human hand, as for `handmap map`.
        robot: Robot hand: a name that `handmap hands` lists, or the path of a hand.yaml. With
            --live, the service says it.
        live: In place of a recording: HOST or HOST:PORT of a mapping service. A session that was
            opened with is_shared can be steered from the view, one with has_detail can be seen.
        session: Name of the service's session; the only one if omitted.
        keys: For an encrypted service: the folder's files NAME.key_secret and server.key.
        html: Write a page that plays by itself to this file, and end.
        host: Address to serve on. Whoever reaches it can use the view: leave it on loopback unless
            you trust the network.
        port: Port to serve on; the next free one where it is taken.
        open: Open the browser.
        human_points: Reference points on the human hand: the name of a set. As all below, for a
            recording.
        robot_points: Reference points on the robot hand: the name of a set; its own default if
            omitted.
        mapping: How the human's motion becomes the robot's, to start with.
        ik: Weights and settings of the QP, to start with.
    """

    recording: tyro.conf.Positional[Path | None] = None
    robot: str | None = None
    live: str | None = None
    session: str | None = None
    keys: tuple[Path, Path] | None = None
    html: Path | None = None
    host: str = "127.0.0.1"
    port: int = 8080
    open: bool = False
    human_points: str | None = None
    robot_points: str | None = None
    mapping: Annotated[MappingOptions, tyro.conf.arg(name="")] = field(
        default_factory=MappingOptions
    )
    ik: Annotated[IkOptions, tyro.conf.arg(name="ik")] = field(default_factory=IkOptions)

    def run(self) -> None:
        """Read, map or listen, and show until interrupted."""
        # Said first, for the rest takes a while.
        if importlib.util.find_spec("viser") is None:
            raise MissingExtraError("viser", "view")
        check_port("--port", self.port)
        if (self.recording is None) == (self.live is None):
            raise InvalidInputError("expected a recording or --live HOST, and not both")
        self._refuse_idle_options()
        if self.live is not None:
            self._show_live(self.live)
        elif self.recording is not None:
            if self.robot is None:
                raise InvalidInputError(
                    "--robot: missing; a recording can be shown on any hand that `handmap hands` lists"
                )
            self._show_recording(self.recording, self.robot)

    def _refuse_idle_options(self) -> None:
        """Refuse options that would do nothing."""
        if self.live is not None:
            self._refuse(["html"], "is for a recording; a session that runs has no end")
            chosen = ["human_points", "robot_points", "mapping", "ik"]
            self._refuse(chosen, "is for a recording; of a service, the session's client chose")
            return
        if self.html is not None:
            self._refuse(
                ["host", "port", "open"], "is for a view that is served, and --html writes a file"
            )
        self._refuse(["session", "keys"], "is for --live, and this is a recording")

    def _refuse(self, names: list[str], reason: str) -> None:
        plain = View()
        for name in names:
            given, usual = getattr(self, name), getattr(plain, name)
            if given != usual:
                # The fields of options are options of their own.
                parts = [
                    part
                    for part in getattr(given, "__slots__", ())
                    if getattr(given, part) != getattr(usual, part)
                ]
                word = (f"ik.{parts[0]}" if name == "ik" else parts[0]) if parts else name
                raise InvalidInputError(f"--{word.replace('_', '-')}: {reason}")

    def _show_recording(self, file: Path, robot: str) -> None:
        from handmap_qp.viewer.app import ReplayViewer
        from handmap_qp.viewer.page import check_page, write_page
        from handmap_qp.viewer.serving import serving

        page = None if self.html is None else check_page(self.html)
        replay = self._replay(file, robot)
        if page is not None:
            with serving() as server:
                write_page(page, server, replay)
            print(f"wrote {page}")
            return
        with serving(self.host, self.port) as server:
            viewer = ReplayViewer(server, replay)
            self._announce(server)
            with contextlib.suppress(KeyboardInterrupt):
                viewer.run()

    def _show_live(self, live: str) -> None:
        from handmap_qp.viewer.live import LiveSource, show_live
        from handmap_qp.viewer.remote import ServiceSession
        from handmap_qp.viewer.serving import serving

        # First of all, for it tells at once whether there is anything to be seen.
        first = ServiceSession(live, session=self.session, robot=self.robot, keys=self.keys)

        def next_source(before: LiveSource | None) -> LiveSource:
            return (
                first
                if before is None
                else ServiceSession(live, session=first.name, robot=self.robot, keys=self.keys)
            )

        try:
            with serving(self.host, self.port) as server:
                self._announce(server)
                with contextlib.suppress(KeyboardInterrupt):
                    show_live(server, next_source)
        finally:
            first.close()

    def _announce(self, server: viser.ViserServer) -> None:
        """Say where to look, and open the browser if asked to."""
        host = server.get_host()
        address = f"http://{f'[{host}]' if ':' in host else host}:{server.get_port()}"
        print(f"see {address} (Ctrl-C ends it)", flush=True)
        if self.open:
            webbrowser.open(address)

    def _replay(self, file: Path, name: str) -> Replay:
        from handmap_qp.hands.library import load_hand
        from handmap_qp.trackers.landmarks import fit_recording
        from handmap_qp.trackers.recording import read_recording
        from handmap_qp.viewer.replay import Replay

        recording = read_recording(file)
        robot = load_hand(name, points=self.robot_points)
        motion = fit_recording(recording)
        return Replay(
            motion, motion.human.with_points(self.human_points), robot, self.mapping, self.ik
        )
